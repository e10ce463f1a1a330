"""When scale errors of the IMU are considered: where fixes are missing, about the mean motion."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.events import ScaleErrors
from hybrid_ins.core.fix_watch import FixWatch
from hybrid_ins.core.phase_machine import PhaseMachine
from hybrid_ins.core.samples import ImuRing, readings_of

Array = NDArray[np.float64]

PERIOD_NS = 500_000_000
MEMORY = 20.0  # s of motion with fixes that the biases follow


class ScaleErrorMonitor:
    """
    Follows the mean motion while fixes come; in outages lets the filters consider scale errors.

    Parameters
    ----------
    std : float
        Standard deviation of scale errors; 0: they are not considered.

    Attributes
    ----------
    mean : ndarray, shape (6,), or None
        Mean specific force f₀ [m/s²] and angular rate ω₀ [rad/s] with fixes, b; None: not known.
    """

    def __init__(self, std: float) -> None:
        self._std = std
        self.restart()

    def restart(self) -> None:
        """Restart, as the filter did."""
        self.mean: Array | None = None
        self._next_ns = 0

    def run_periodic(self, phases: PhaseMachine, ring: ImuRing, fixes: FixWatch, t_ns: int) -> None:
        """
        Do what is due at a stamp.

        Parameters
        ----------
        phases : PhaseMachine
            The filters.
        ring : ImuRing
            Recent IMU samples.
        fixes : FixWatch
        t_ns : int
            Stamp of the last sample [ns].
        """
        if self._std == 0.0 or t_ns < self._next_ns or phases.filter is None:
            return
        self._next_ns = t_ns + PERIOD_NS
        if not fixes.outage(t_ns):
            self._learn(readings_of(ring.after(t_ns - PERIOD_NS)).mean(axis=0))
        elif self.mean is not None:
            phases.submit(ScaleErrors(t_ns, self.mean, self._std))

    def _learn(self, recent: Array) -> None:
        if self.mean is None:
            self.mean = recent
        share = 1.0 - math.exp(-PERIOD_NS * 1e-9 / MEMORY)
        self.mean = self.mean + share * (recent - self.mean)
