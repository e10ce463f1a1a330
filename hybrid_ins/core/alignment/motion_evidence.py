"""
Whether a vehicle has moved since filters of several headings began.

A receiver that finds or loses its solution steps by a metre at rest: motion is spread over several
fixes, so the largest step between two of them does not count.

At rest nothing shows the heading, yet some heading always fits best: that in which the wander of
the fixes has the direction of the tilt that a gyroscope's bias feigns. A real fixed wing stood for
200 s; with the noise of its aerobatics assumed, its heading was "known" to 10° after a minute, and
129° off.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.filter.ins_filter import InsFilter
from hybrid_ins.core.inertial.earth import displacement
from hybrid_ins.core.inertial.state import COVARIANCE, DIAGONAL, DV, VELOCITY
from hybrid_ins.core.noise.position_scatter import horizontal_variance
from hybrid_ins.core.update.measurements import Measurement, PositionFix

Array = NDArray[np.float64]

FAST, FAR = 3.0, 4.0  # standard deviations, of the speed from zero and of a fix from the first one
LASTING_NS = 2_000_000_000  # of either: one fix may be an outlier


class MotionEvidence:
    """
    Compares speed and displacement with their uncertainty.

    Attributes
    ----------
    moves : bool
        The last measurement shows motion.
    shown : bool
        It was shown for a while: the vehicle has moved.
    may_rest : bool
        The IMU does not show that the vehicle moves: before fixes do, all is chance.
    """

    def __init__(self) -> None:
        self.moves = self.shown = False
        self.may_rest = True
        self._first_lla: Array | None = None
        self._last_lla = np.empty(3)
        self._largest = np.zeros(2)  # m, NE: step from a fix to the next
        self._steps = 0  # so far, at a fix
        self._since_ns = 0  # of the motion, if there is one

    def observe(self, measurement: Measurement, best: InsFilter) -> bool:
        """
        Use a measurement and the likeliest filter.

        Returns whether a motion begins here before which the vehicle may have been at rest.
        """
        if self.shown:
            return False
        variance = float(best.nav[COVARIANCE][DIAGONAL[DV]][:2].sum())
        speed = float(np.linalg.norm(best.nav[VELOCITY][:2]))
        before, self.moves = self.moves, speed > FAST * math.sqrt(max(variance, 0.0))
        if isinstance(measurement, PositionFix):
            if self._first_lla is None:
                self._first_lla = self._last_lla = measurement.lla
            away = displacement(self._first_lla, measurement.lla)[:2]
            step = displacement(self._last_lla, measurement.lla)[:2]
            self._last_lla = measurement.lla
            if np.linalg.norm(step) > np.linalg.norm(self._largest):
                self._largest = step
            std = math.sqrt(2.0 * horizontal_variance(measurement.claimed))
            others = (away - self._largest) * (1.0 + 1.0 / max(self._steps - 1, 1))
            self._steps += 1
            far = min(np.linalg.norm(away), np.linalg.norm(others))
            self.moves = self.moves or bool(far > FAR * std)
        if self.moves and not before:
            self._since_ns = best.t_ns
        elif self.moves and best.t_ns - self._since_ns >= LASTING_NS:
            self.shown = True
        return self.may_rest and self.moves and not before

    @property
    def counts(self) -> bool:
        """What is measured now is evidence on the heading."""
        return self.moves or not self.may_rest

    @property
    def shows_heading(self) -> bool:
        """What was measured so far says which heading is right."""
        return self.shown or not self.may_rest
