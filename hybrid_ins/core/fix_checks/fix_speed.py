"""
Plausibility of GNSS measurements by the speed that the vehicle would have needed.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from hybrid_ins.core.inertial.earth import horizontal_displacement
from hybrid_ins.core.update.measurements import Measurement, PositionFix, VelocityFix

SIGMAS = 4.0  # of the measurements' own noise, that no speed needs to explain
SHORTEST_INTERVAL = 1.0  # s: in less, noise and small jumps look like speed


class _Place(NamedTuple):
    t_ns: int
    latitude: float  # rad
    longitude: float  # rad
    variance: float  # m², of the worse horizontal axis


class SpeedCheck:
    """
    Refuses GNSS positions that are out of reach, and velocities that are too great.

    A position is compared with the last one that was in reach. Where positions that are not agree
    with each other for ``patience`` seconds, the earlier ones were wrong: the next is admitted.

    Parameters
    ----------
    max_speed : float
        Of the vehicle over ground [m/s].
    patience : float
        [s].
    """

    def __init__(self, max_speed: float, patience: float) -> None:
        self.max_speed = max_speed
        self.patience = patience
        self.reset()

    def reset(self) -> None:
        """Forget all positions."""
        self._last: _Place | None = None
        self._refused: _Place | None = None
        self._refused_since_ns = 0

    def is_reachable(self, measurement: Measurement) -> bool:
        """Return whether a vehicle of that speed can have given rise to a measurement."""
        if isinstance(measurement, PositionFix):
            return self._is_position_reachable(measurement)
        if isinstance(measurement, VelocityFix):
            noise = math.sqrt(float(np.max(np.diag(measurement.covariance_n))))
            speed = float(np.linalg.norm(np.nan_to_num(measurement.velocity_n)))
            return speed - SIGMAS * noise <= self.max_speed
        return True

    def _is_position_reachable(self, fix: PositionFix) -> bool:
        variance = float(max(fix.covariance_n[0, 0], fix.covariance_n[1, 1]))
        here = _Place(fix.t_ns, float(fix.lla[0]), float(fix.lla[1]), variance)
        if self._last is None or self._connects(self._last, here):
            self._admit(here)
            return True
        if self._refused is None or not self._connects(self._refused, here):
            self._refused_since_ns = here.t_ns
        self._refused = here
        if (here.t_ns - self._refused_since_ns) * 1e-9 < self.patience:
            return False
        self._admit(here)
        return True

    def _admit(self, here: _Place) -> None:
        if self._last is None or here.t_ns > self._last.t_ns or self._refused is not None:
            self._last = here
        self._refused = None

    def _connects(self, before: _Place, here: _Place) -> bool:
        """Return whether the vehicle can get from one place to the other in that time."""
        north, east = horizontal_displacement(before[1:3], here[1:3])
        seconds = max(abs(here.t_ns - before.t_ns) * 1e-9, SHORTEST_INTERVAL)
        noise = SIGMAS * math.sqrt(before.variance + here.variance)
        return math.hypot(north, east) - noise <= self.max_speed * seconds
