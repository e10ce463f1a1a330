"""
The sensors that aid the filter besides GNSS, and what is estimated of the errors of each.

When a sensor is used: `hybrid_ins.core.aiding.life_cycle`.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.aiding.life_cycle import DISAGREES, AidingSensor
from hybrid_ins.core.aiding.measurements import BarometricHeight, BodyVelocity, Heading
from hybrid_ins.core.constraints.constraint_observer import STATE_TIME, inflated
from hybrid_ins.core.inertial.state import (
    HEADING_CONSIDERED,
    HEADING_DOUBT,
    PAST_VARIANCE,
    SLOW_VARIANCE,
    covariance,
)
from hybrid_ins.core.update.measurements import Measurement

Array = NDArray[np.float64]

SMALLEST_SCALE_STD = 1e-4
CONTRADICTED = 60.0  # s, by fixes, after which a scale that was shown is not known any more
SHOWN = 0.7  # factor on the σ of a scale by which motion has shown it; standing shows nothing


class VelocitySensor(AidingSensor):
    """
    Wheels or a Doppler log, with a scale error, at a place that is not known exactly.

    Parameters
    ----------
    scale, scale_std : float
        Nominal factor from readings to speed, and its standard deviation.
    place_std : ndarray, shape (3,)
        Standard deviation of the readings' ``point_b`` [m].

    Attributes
    ----------
    scale : float
        As estimated.
    shift_b : ndarray, shape (3,)
        What was found of the place, relative to the nominal one [m].
    has_changed : bool
        Fixes have contradicted a scale that had been shown, which was estimated anew.
    """

    name = "velocity"
    error_time = 0.2  # what lasts for longer, the innovations show: `LastingErrors`

    def __init__(self, scale: float, scale_std: float, place_std: Array) -> None:
        super().__init__()
        self.scale = scale
        self._nominal_std = scale_std
        self._is_shown = False  # readings have agreed with the motion by this scale
        self._contradicted_for = 0.0  # s
        self.has_changed = False
        self.shift_b = np.zeros(3)
        self._P = np.diag([scale_std, *place_std]) ** 2

    @property
    def sigma(self) -> Array:
        """Standard deviations of the scale and of the place [m], (4,)."""
        return np.asarray(np.sqrt(np.diag(self._P)))

    def value(self, reading: Measurement) -> Array:
        """See `AidingSensor`."""
        assert isinstance(reading, BodyVelocity)
        return reading.velocity_b

    def corrected(self, reading: Measurement) -> BodyVelocity:
        """See `AidingSensor`."""
        assert isinstance(reading, BodyVelocity)
        return replace(
            reading,
            velocity_b=self.scale * reading.velocity_b,
            covariance_b=self.scale**2 * reading.covariance_b,
            point_b=reading.point_b + self.shift_b,
        )

    def nuisance(self, reading: Measurement, nav: Array) -> Array:
        """See `AidingSensor`."""
        assert isinstance(reading, BodyVelocity)
        J = reading.by_scale_and_place(nav)
        return np.asarray(J @ self._P @ J.T)

    def learn(self, reading: Measurement, nav: Array, z: Array, HPH: Array, R: Array) -> None:
        """See `AidingSensor`; z = scale · reading - velocity of the place."""
        assert isinstance(reading, BodyVelocity)
        J = reading.by_scale_and_place(nav)
        known = J @ self._P @ J.T
        is_far = float(z @ np.linalg.solve(HPH + known + R, z)) > DISAGREES * len(z)
        self._is_shown |= bool(self._agrees and self.sigma[0] < SHOWN * self._nominal_std)
        if self._is_shown and (is_far or not self._agrees):
            self._contradicted_for += self._interval
            if self._contradicted_for < CONTRADICTED:
                return
            self._is_shown, self.has_changed = False, True
            self._P[0, 0] = self._nominal_std**2
        self._contradicted_for = 0.0
        N = inflated(HPH, STATE_TIME, self._interval)
        N = N + inflated(R, self.error_time, self._interval)
        K = np.linalg.solve(known + N, J @ self._P).T
        error = K @ z
        self.scale -= float(error[0])
        self.shift_b = self.shift_b - error[1:]
        A = np.eye(4) - K @ J
        self._P = A @ self._P @ A.T + K @ N @ K.T
        self._P[0, 0] = max(self._P[0, 0], SMALLEST_SCALE_STD**2)

    def measurement(self, corrected: Measurement, R: Array, nuisance: Array) -> Measurement:
        """See `AidingSensor`."""
        assert isinstance(corrected, BodyVelocity)
        given = np.flatnonzero(np.isfinite(corrected.velocity_b))
        covariance_b = corrected.covariance_b.copy()
        covariance_b[np.ix_(given, given)] = inflated(
            R, self.error_time, self._interval
        ) + inflated(nuisance, 5.0, self._interval)
        return replace(corrected, covariance_b=covariance_b)


class HeadingSensor(AidingSensor):
    """A heading, used only once the motion has confirmed it."""

    name = "heading"
    always = True
    period = 1.0
    error_time = 10.0  # of iron nearby, of an installation error
    KNOWN = math.radians(8.0)  # rad, σ of a heading from motion that can confirm another

    def value(self, reading: Measurement) -> Array:
        """See `AidingSensor`."""
        assert isinstance(reading, Heading)
        return np.array([reading.yaw])

    def can_check(self, of_state: Array, R: Array) -> bool:
        """Return whether the heading is known, at all or as well as the sensor knows it."""
        return float(of_state[0, 0]) < max(self.KNOWN**2, float(R[0, 0]))

    def considered(self, nav: Array) -> Array:
        """See `AidingSensor`; a heading that motion does not show is no evidence on another."""
        return np.array([[nav[HEADING_CONSIDERED] + nav[HEADING_DOUBT]]])

    def measurement(self, corrected: Measurement, R: Array, nuisance: Array) -> Measurement:
        """See `AidingSensor`."""
        assert isinstance(corrected, Heading)
        variance = float(inflated(R, self.error_time, self._interval)[0, 0])
        return replace(corrected, variance=variance)


class HeightSensor(AidingSensor):
    """A pressure height, whose offset wanders with the weather."""

    name = "baro"
    period = 0.5
    WANDER = 0.03  # m/√s, of the offset
    SIGMAS = 2.0  # of the fixes' slow error: more of it would be blamed on the sensor

    def __init__(self) -> None:
        super().__init__()
        self.offset = 0.0
        self._variance = math.inf
        self._known_ns = 0  # when that was the variance

    @property
    def offset_std(self) -> float:
        """Standard deviation of the offset [m]."""
        return math.sqrt(self._variance)

    def value(self, reading: Measurement) -> Array:
        """See `AidingSensor`."""
        assert isinstance(reading, BarometricHeight)
        return np.array([reading.height])

    def corrected(self, reading: Measurement) -> BarometricHeight:
        """See `AidingSensor`."""
        assert isinstance(reading, BarometricHeight)
        return replace(reading, height=reading.height - self.offset)

    def nuisance(self, reading: Measurement, nav: Array) -> Array:
        """See `AidingSensor`."""
        return np.array([[min(self._variance, 1e8)]])

    def considered(self, nav: Array) -> Array:
        """See `AidingSensor`; the offset follows slow errors of the fixes, but late."""
        variance = nav[SLOW_VARIANCE][2] + nav[PAST_VARIANCE][2]
        return np.array([[self.SIGMAS**2 * variance]])

    def prepare(self, reading: Measurement, nav: Array, checked: bool) -> bool:
        """See `AidingSensor`; the offset wanders, and begins with the first reading."""
        elapsed = max(reading.t_ns - self._known_ns, 0) * 1e-9
        self._known_ns = reading.t_ns
        if math.isfinite(self._variance):
            self._variance += self.WANDER**2 * elapsed
            return True
        if checked:
            z, H, R = reading.linearise(nav)
            self.offset = float(z[0])
            self._variance = float((H @ covariance(nav) @ H.T + R)[0, 0]) + 1.0
        return False

    def learn(self, reading: Measurement, nav: Array, z: Array, HPH: Array, R: Array) -> None:
        """See `AidingSensor`: z = reading - offset - height."""
        N = inflated(HPH, STATE_TIME, self._interval) + inflated(R, self.error_time, self._interval)
        gain = self._variance / (self._variance + float(N[0, 0]))
        self.offset += gain * float(z[0])
        self._variance *= 1.0 - gain

    def measurement(self, corrected: Measurement, R: Array, nuisance: Array) -> Measurement:
        """See `AidingSensor`."""
        assert isinstance(corrected, BarometricHeight)
        variance = inflated(R, self.error_time, self._interval)
        variance = variance + inflated(nuisance, 10.0, self._interval)
        return replace(corrected, variance=float(variance[0, 0]))
