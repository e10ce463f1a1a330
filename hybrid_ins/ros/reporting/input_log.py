"""
Counts of input that was refused or is odd, and its warnings.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable

from hybrid_ins.ros.messages.conversions import Refused

Log = Callable[[str, str], None]  # level (info, warn, error) and a line for the user

RECENT_NS = 10_000_000_000  # seconds in which what is odd is new
ORDINARY = ("gnss: aligning",)  # counts of what happens at every start


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
    notes : dict of str
        What is used in place of input that is missing, by name; for diagnostics.
    receiver : dict
        What the GNSS receiver says of its fixes, by name; for diagnostics.
    last_refused : dict of str
        Why a message was refused or is odd, the last on each topic.
    """

    def __init__(self, log: Log) -> None:
        self.counts: Counter[str] = Counter()
        self.log = log
        self.notes: dict[str, str] = {}
        self.receiver: dict[str, object] = {}
        self.last_refused: dict[str, str] = {}
        self._informed: Counter[str] = Counter()
        self._totals: deque[tuple[int, int]] = deque(maxlen=64)  # stamp [ns], total

    def count_and_warn(self, topic: str, refused: Refused) -> None:
        """Count what was refused or is odd on a topic, and warn where it is due."""
        self.counts[refused.name] += 1
        self.last_refused[topic] = refused.text
        count = self.counts[refused.name]
        if is_logged(count):
            so_far = f" ({count} so far)" if count > 1 else ""
            self.log("warn", f"{topic}: {refused.text}{so_far}")

    def new_in_last_seconds(self, t_ns: int) -> int:
        """Return how many messages were odd in the last seconds before a stamp [ns]."""
        total = sum(n for name, n in self.counts.items() if name not in ORDINARY)
        if self._totals and t_ns < self._totals[-1][0]:
            self._totals.clear()
        while len(self._totals) > 1 and t_ns - self._totals[0][0] > RECENT_NS:
            self._totals.popleft()
        before = self._totals[0][1] if self._totals else 0
        self._totals.append((t_ns, total))
        return total - before

    def note(self, name: str, text: str) -> None:
        """Warn of a substitute for missing input, and keep it for diagnostics."""
        if name not in self.notes:
            self.notes[name] = text
            self.log("warn", text)

    def warn_once(self, name: str, text: str) -> None:
        """Warn of something that lasts, the first time; it is not counted as odd."""
        self._informed[name] += 1
        if self._informed[name] == 1:
            self.log("warn", text)

    def inform(self, name: str, text: str, level: str = "info") -> None:
        """Log the first, tenth, hundredth... information of a name; it is not counted as odd."""
        self._informed[name] += 1
        if is_logged(self._informed[name]):
            self.log(level, text)


def is_logged(count: int) -> bool:
    """Return whether a count is a power of ten."""
    return str(count).strip("0") == "1"
