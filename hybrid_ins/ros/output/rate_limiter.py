"""Rate limiter driven by message stamps."""

from __future__ import annotations


class RateLimiter:
    """
    Picks the first stamp of each period, the periods counted from stamp zero.

    Where time jumps, back or ahead, the next stamp is due.

    Parameters
    ----------
    rate : float
        [Hz]; 0: every stamp is due.
    """

    def __init__(self, rate: float) -> None:
        self._next_ns = 0
        self.change(rate)

    def change(self, rate: float) -> None:
        """Go on at another rate [Hz]."""
        self._period_ns = int(1e9 / rate) if rate else 0

    def is_due(self, t_ns: int) -> bool:
        """Return whether a stamp [ns] is the first of its period."""
        period_ns = self._period_ns
        if not period_ns:
            return True
        if self._next_ns - period_ns <= t_ns < self._next_ns:
            return False
        self._next_ns = t_ns - t_ns % period_ns + period_ns
        return True
