"""
Whether fixes come, and whether they alone have determined the state for a while.
"""

from __future__ import annotations

from hybrid_ins.core.filter.ins_filter import NEVER_NS
from hybrid_ins.core.noise.multiple_model import MAX_INTERVAL
from hybrid_ins.core.update.gate import Verdict
from hybrid_ins.core.update.measurements import GNSS

OUTAGE_NS = round(MAX_INTERVAL * 1e9)  # without a fix, from which on there is an outage
SETTLED_NS = 5_000_000_000  # of fixes after an outage, until its end no longer shows


class FixWatch:
    """
    Distinguishes outages from times in which fixes come, by the stamps of fused fixes.

    Attributes
    ----------
    started : bool
        A fix was fused.
    """

    def __init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """Forget the fixes before a restart: stamps may have gone back."""
        self._fix_ns = 0  # stamp of the last fix that was fused
        self._aided_ns = NEVER_NS  # since when there is no outage

    def on_start(self, t_ns: int) -> None:
        """Note that there is a state since a stamp [ns]: it starts from a fix."""
        if not self.started:
            self._fix_ns = self._aided_ns = t_ns

    @property
    def started(self) -> bool:
        """See above."""
        return self._fix_ns > 0

    def on_verdict(self, verdict: Verdict) -> None:
        """Note a fix that was fused."""
        if verdict.accepted and verdict.measurement.sensor == GNSS:
            t_ns = verdict.measurement.t_ns
            if t_ns - self._fix_ns > OUTAGE_NS:
                self._aided_ns = t_ns
            self._fix_ns = max(self._fix_ns, t_ns)

    def outage(self, t_ns: int) -> bool:
        """Return whether fixes are missing at a stamp [ns]."""
        return t_ns - self._fix_ns > OUTAGE_NS

    def settled(self, t_ns: int) -> bool:
        """Return whether fixes have determined the state for a while at a stamp [ns]."""
        return not self.outage(t_ns) and t_ns - self._aided_ns >= SETTLED_NS
