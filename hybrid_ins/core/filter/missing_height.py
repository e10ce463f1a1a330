"""
What bounds the vertical channel of an INS where a receiver gives positions without a height.

Nothing else does: an error of 0.05 m/s² on the vertical axis is a kilometre after 200 s, and since
a horizontal metre is the longer an angle the lower the vehicle is, horizontal positions in a local
frame are wrong with it. That no vehicle climbs or descends for long is assumed, to some m/s.

A height that was never given is not estimated but considered, as the slow error of
`position_scatter` is: in the filter, whose nonlinearity grows with the errors of position, a
kilometre would make horizontal fixes evidence on the attitude. The first height ends it. Heights
that turn out to be frozen were never given; what the filter has made of them is a vertical velocity
of zero that it was too sure of.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.constraints.constraint_observer import inflated
from hybrid_ins.core.filter.events import CovarianceInflation
from hybrid_ins.core.fix_checks.frozen_height import FrozenHeight
from hybrid_ins.core.inertial.state import DV, N_ERROR, VELOCITY
from hybrid_ins.core.update.gate import Verdict
from hybrid_ins.core.update.measurements import ASSUMED, LinearModel, PositionFix

Array = NDArray[np.float64]

CLIMB_STD = 3.0  # m/s: steep roads have 1, drones, helicopters and gliders 2 to 5
CLIMB_TIME = 30.0  # s, that a climb lasts
FROZEN_STD = 1.0  # m/s, of the climb that frozen heights have hidden: a road at 15 m/s has less
PERIOD_NS = 1_000_000_000  # between two measurements
UNKNOWN_HEIGHT_STD = 1000.0  # m: land is 0.8 km above the sea on average
MISSING_NS = 5_000_000_000  # without a height


@dataclass(frozen=True, slots=True)
class LevelMotion:
    """No vertical velocity, but for climbs."""

    t_ns: int  # ns, IMU clock
    height_variance: float  # m², of a height that was never given; 0: it was

    kind: ClassVar[str] = "level motion"
    sensor: ClassVar[str] = ASSUMED
    in_body: ClassVar[bool] = False

    def linearise(self, nav: Array) -> LinearModel:
        """See `Measurement.linearise`."""
        H = np.zeros((1, N_ERROR))
        H[0, DV.stop - 1] = 1.0
        R = inflated(np.array([[CLIMB_STD**2]]), CLIMB_TIME, PERIOD_NS * 1e-9)
        return -nav[VELOCITY][2:], H, R


class MissingHeight:
    """Knows since when fixes lack the height, and what is to be measured meanwhile."""

    def __init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """Forget the fixes before a restart: stamps may have gone back."""
        self._fix_ns = self._height_ns = self._next_ns = self._frozen_ns = 0

    def on_verdict(self, verdict: Verdict) -> None:
        """Note a fix that was fused."""
        fix = verdict.measurement
        if isinstance(fix, PositionFix) and verdict.accepted:
            self._fix_ns = fix.t_ns
            if math.isfinite(fix.lla[2]) and fix.t_ns >= self._frozen_ns:
                self._height_ns = fix.t_ns

    def on_frozen(self, found: FrozenHeight) -> CovarianceInflation:
        """Note that the heights so far were none; return what that is to the filter."""
        self._frozen_ns, self._height_ns, self._next_ns = found.t_ns, 0, 0
        std = np.zeros(N_ERROR)
        std[DV.stop - 1] = FROZEN_STD
        return CovarianceInflation(found.t_ns, std, np.zeros(3))

    def measurement(self, t_ns: int) -> LevelMotion | None:
        """Return what is to be measured at a stamp [ns]; None while fixes have heights, or fail."""
        comes = self._fix_ns > 0 and t_ns - self._fix_ns < MISSING_NS
        if t_ns < self._next_ns or not comes or t_ns - self._height_ns < MISSING_NS:
            return None
        self._next_ns = t_ns + PERIOD_NS
        return LevelMotion(t_ns, 0.0 if self._height_ns else UNKNOWN_HEIGHT_STD**2)
