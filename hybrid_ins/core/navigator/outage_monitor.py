"""Tells the filters that fixes are missing, so that they consider scale errors of the IMU."""

from __future__ import annotations

from hybrid_ins.core.filter.events import Outage
from hybrid_ins.core.navigator.fix_watch import FixWatch
from hybrid_ins.core.navigator.phase_machine import PhaseMachine

PERIOD_NS = 500_000_000


class OutageMonitor:
    """Submits an `Outage` twice a second for as long as there is one."""

    def __init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """Restart, as the filter did: stamps may have gone back."""
        self._next_ns = 0

    def run_periodic(self, phases: PhaseMachine, fixes: FixWatch, t_ns: int) -> None:
        """Do what is due at the stamp of the last sample [ns]."""
        if t_ns < self._next_ns or phases.filter is None:
            return
        self._next_ns = t_ns + PERIOD_NS
        if fixes.outage(t_ns):
            phases.submit(Outage(t_ns))
