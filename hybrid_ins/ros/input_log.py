"""
Counts of input that was refused or is odd, and its warnings.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable

from hybrid_ins.ros.conversions import Refused

Log = Callable[[str, str], None]


class InputLog:
    """
    Counts by name, and warns of the first, tenth, hundredth... of each name.

    Parameters
    ----------
    log : callable
        Called with a level (info, warn, error) and a line for the user.

    Attributes
    ----------
    counts : Counter
        By name.
    """

    def __init__(self, log: Log) -> None:
        self.counts: Counter[str] = Counter()
        self.log = log
        self._informed: Counter[str] = Counter()

    def count_and_warn(self, topic: str, refused: Refused) -> None:
        """Count what was refused or is odd on a topic, and warn where it is due."""
        self.counts[refused.name] += 1
        count = self.counts[refused.name]
        if _is_told(count):
            so_far = f" ({count} so far)" if count > 1 else ""
            self.log("warn", f"{topic}: {refused.text}{so_far}")

    def warn_once(self, name: str, text: str) -> None:
        """Warn of something that lasts, the first time; it is not counted as odd."""
        self._informed[name] += 1
        if self._informed[name] == 1:
            self.log("warn", text)

    def inform(self, name: str, text: str) -> None:
        """Log the first, tenth, hundredth... information of a name; it is not counted as odd."""
        self._informed[name] += 1
        if _is_told(self._informed[name]):
            self.log("info", text)


def _is_told(count: int) -> bool:
    """Return whether a count is a power of ten."""
    return str(count).strip("0") == "1"
