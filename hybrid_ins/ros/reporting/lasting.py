"""
What lasts: conditions that diagnostics show for many seconds, for the log and for a run's end.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping

from hybrid_ins.ros.reporting.input_log import Log

WARN_AFTER = (10, 100, 1000, 10_000)  # s, in all, at which a condition is logged


class LastingConditions:
    """
    Counts the seconds of each condition.

    Parameters
    ----------
    log : callable
        Called with a level and a line for the user.
    """

    def __init__(self, log: Log) -> None:
        self._log = log
        self._seconds: Counter[str] = Counter()
        self._total = 0

    def note(self, conditions: Mapping[str, str]) -> None:
        """Note the conditions of one more second: names with texts for the log."""
        self._total += 1
        for name, text in conditions.items():
            self._seconds[name] += 1
            if self._seconds[name] in WARN_AFTER:
                self._log("warn", f"{text} (for {self._seconds[name]} s so far)")

    def summary(self) -> str:
        """Return which conditions lasted for how long; empty where none did."""
        lasting = [(n, s) for n, s in self._seconds.most_common() if s >= WARN_AFTER[0]]
        return "; ".join(f"{name} for {s} of {self._total} s" for name, s in lasting)
