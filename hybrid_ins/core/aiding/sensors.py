"""
Life cycle of sensors that aid the filter besides GNSS.

What such a sensor claims is checked against the filter before it is used. While fixes come,
the filter knows velocity, heading and height without it: readings that agree for some seconds make
the sensor aid, readings that disagree for some seconds make it refused, whatever it did before.
In an outage nothing but the filter itself contradicts a sensor: readings that it rejects for some
seconds make the sensor refused, and it aids again once it agrees with a state that is known as well
as then. A state that has become uncertain meanwhile would agree with anything: the sensor waits
for fixes.
What a sensor cannot know of itself, the scale and the place of wheels, the offset of a pressure
height, is estimated at the same time.

    absent    no reading yet
    waiting   no reading yet that could be checked
    aiding    agrees with the motion; its readings are used
    refused   disagrees with the motion; its readings are not used until they agree again
    lost      no reading for `SILENCE`

References
----------
.. [1] P. Groves, *Principles of GNSS, Inertial, and Multisensor Integrated Navigation Systems*,
       2nd ed., sections 16.2 (scale of odometry) and 17.3 (innovation monitoring).
"""

from __future__ import annotations

import math
from dataclasses import replace
from enum import Enum
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.aiding.lasting_errors import LastingErrors
from hybrid_ins.core.aiding.measurements import BarometricHeight, BodyVelocity, Heading
from hybrid_ins.core.constraints.constraint_observer import STATE_TIME, inflated
from hybrid_ins.core.inertial.state import (
    HEADING_CONSIDERED,
    HEADING_DOUBT,
    JUMP_VARIANCE,
    SLOW_VARIANCE,
    covariance,
)
from hybrid_ins.core.update.measurements import Measurement

Array = NDArray[np.float64]

SILENCE_NS = 2_000_000_000
AGREES, DISAGREES = 3.0, 7.0  # mean NIS per component, of a sensor to be used, to be refused
SHOWN = 3.0  # s of readings that show either
NIS_MEMORY = 3.0  # s over which the NIS is averaged
SMALLEST_SCALE_STD = 1e-4
STILL_KNOWN = 4.0  # factor on the variance of a state that refused a sensor and may accept it
LARGEST_NIS = 50.0  # that counts: one outlier does not refuse a sensor


class AidingState(Enum):
    """Where in its life cycle a sensor is."""

    ABSENT = "absent"
    WAITING = "waiting"
    AIDING = "aiding"
    REFUSED = "refused"
    LOST = "lost"


class AidingSensor:
    """
    One aiding sensor: whether it is used, and what is known of its errors.

    Attributes
    ----------
    name : str
        As in the verdicts and the diagnostics.
    always : bool
        Readings are fused while fixes come, too; otherwise in outages only.
    period : float
        Between two readings that are used [s]; others are left out.
    error_time : float
        Correlation time of its errors [s].
    """

    name: ClassVar[str]
    always: ClassVar[bool] = False
    period: ClassVar[float] = 0.2
    error_time: ClassVar[float] = 0.5

    def __init__(self) -> None:
        self.restart()
        self._refused_with = 0.0  # mean variance of the state that refused it in an outage
        self._lasting = LastingErrors()

    def restart(self) -> None:
        """Await a first reading, as the filter restarts; what is known of its errors is kept."""
        self._last_ns = self._used_ns = 0
        self._was_silent = False  # before the reading that comes
        self._begin_checks()

    def _begin_checks(self) -> None:
        """Know nothing of whether it agrees."""
        self._agrees: bool | None = None
        self._nis = 0.0
        self._checked: float | None = None  # s, since the first reading that was checked

    def state(self, t_ns: int) -> AidingState:
        """Return the state at a stamp [ns]."""
        if not self._last_ns:
            return AidingState.ABSENT
        if t_ns - self._last_ns > SILENCE_NS:
            return AidingState.LOST
        if self._agrees is None:
            return AidingState.WAITING
        return AidingState.AIDING if self._agrees else AidingState.REFUSED

    @property
    def nis(self) -> float:
        """Mean NIS per component of the last readings that could be checked."""
        return self._nis

    @property
    def factor(self) -> float:
        """Factor on the claimed variance, by errors that are larger or last longer."""
        return self._lasting.factor

    def admit(self, t_ns: int) -> bool:
        """Note a reading at a stamp [ns]; return whether it is due to be used."""
        if self._last_ns - t_ns > SILENCE_NS:  # another time base
            self.restart()
        self._was_silent |= t_ns - self._last_ns > SILENCE_NS
        self._last_ns = max(self._last_ns, t_ns)
        if t_ns - self._used_ns < round(0.9 * self.period * 1e9):
            return False
        self._interval = min(max((t_ns - self._used_ns) * 1e-9, self.period), 1.0)
        self._used_ns = t_ns
        return True

    def check(
        self, reading: Measurement, nav: Array, *, checked: bool, outage: bool
    ) -> Measurement | None:
        """
        Check a reading, and return the measurement to be fused, if there is any.

        Parameters
        ----------
        reading : Measurement
            With what the sensor claims.
        nav : ndarray, shape (N_NAV,) or longer
            Flat state of its time, with nothing pending.
        checked : bool
            Fixes alone have determined that state for a while.
        outage : bool
            Fixes are missing.
        """
        if self._was_silent:
            self._resume(outage)
        corrected = self.corrected(reading)
        z, H, R = corrected.linearise(nav)
        HPH = H @ covariance(nav) @ H.T
        nuisance, considered = self.nuisance(reading, nav), self.considered(nav)
        expected = HPH + nuisance + considered
        nis = float(z @ np.linalg.solve(expected + R, z)) / len(z)
        if outage and self._agrees is not None:
            self._check_in_outage(nis, float(np.trace(HPH)) / len(z))
        elif checked and self.can_check(HPH + considered, R):
            self._check(nis)
            of_sensor = inflated(R, self.error_time, self._interval)
            self._lasting.add(z, expected, of_sensor, self._interval)
            self.learn(reading, nav, z, HPH, R)
        if not self._agrees or not (outage or self.always):
            return None
        return self.measurement(corrected, self.factor * R, nuisance)

    def measurement(self, corrected: Measurement, R: Array, nuisance: Array) -> Measurement:
        """Return a reading with the covariance of errors that last."""
        raise NotImplementedError

    def corrected(self, reading: Measurement) -> Measurement:
        """Return a reading without the errors that are known."""
        return reading

    def nuisance(self, reading: Measurement, nav: Array) -> Array:
        """Return the covariance of what is left of those errors, (m, m) or one for all."""
        return np.zeros((1, 1))

    def considered(self, nav: Array) -> Array:
        """Return the covariance that the state which checks it has besides that of the filter."""
        return np.zeros((1, 1))

    def learn(self, reading: Measurement, nav: Array, z: Array, HPH: Array, R: Array) -> None:
        """Estimate those errors from an innovation of the filter."""

    def can_check(self, of_state: Array, R: Array) -> bool:
        """Return whether the state is known well enough to check a reading."""
        return True

    def _resume(self, outage: bool) -> None:
        """
        Go on after silence: fixes show anew whether the sensor agrees.

        In an outage there are none, and one that agreed goes on until the filter contradicts it.
        """
        self._was_silent = False
        if outage and self._agrees:
            self._nis = max(self._nis, AGREES)
        else:
            self._begin_checks()

    def _check(self, nis: float) -> None:
        """Decide whether the sensor is used, by the NIS per component of its readings."""
        if self._checked is None:
            self._nis, self._checked = min(nis, LARGEST_NIS), 0.0
            return
        self._average(nis)
        self._checked += self._interval
        if self._checked >= SHOWN:
            self._decide()

    def _check_in_outage(self, nis: float, variance: float) -> None:
        """Decide that by the filter alone, with the mean variance of what it predicts."""
        if self._agrees:
            self._refused_with = variance
        elif variance > STILL_KNOWN * self._refused_with:
            return
        self._average(nis)
        self._decide()

    def _average(self, nis: float) -> None:
        gain = 1.0 - math.exp(-self._interval / NIS_MEMORY)
        self._nis += gain * (min(nis, LARGEST_NIS) - self._nis)

    def _decide(self) -> None:
        if self._nis < AGREES:
            self._agrees = True
        elif self._nis > DISAGREES:
            self._agrees = False


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
    """

    name = "velocity"
    error_time = 0.2  # what lasts for longer, the innovations show: `LastingErrors`

    def __init__(self, scale: float, scale_std: float, place_std: Array) -> None:
        super().__init__()
        self.scale = scale
        self.shift_b = np.zeros(3)
        self._P = np.diag([scale_std, *place_std]) ** 2

    @property
    def sigma(self) -> Array:
        """Standard deviations of the scale and of the place [m], (4,)."""
        return np.asarray(np.sqrt(np.diag(self._P)))

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
        N = inflated(HPH, STATE_TIME, self._interval)
        N = N + inflated(R, self.error_time, self._interval)
        K = np.linalg.solve(J @ self._P @ J.T + N, J @ self._P).T
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

    @property
    def offset_std(self) -> float:
        """Standard deviation of the offset [m]."""
        return math.sqrt(self._variance)

    def corrected(self, reading: Measurement) -> BarometricHeight:
        """See `AidingSensor`."""
        assert isinstance(reading, BarometricHeight)
        return replace(reading, height=reading.height - self.offset)

    def nuisance(self, reading: Measurement, nav: Array) -> Array:
        """See `AidingSensor`."""
        return np.array([[min(self._variance, 1e8)]])

    def considered(self, nav: Array) -> Array:
        """See `AidingSensor`; the offset follows slow errors of the fixes, but late."""
        variance = nav[SLOW_VARIANCE][2] + nav[JUMP_VARIANCE][2]
        return np.array([[self.SIGMAS**2 * variance]])

    def check(
        self, reading: Measurement, nav: Array, *, checked: bool, outage: bool
    ) -> Measurement | None:
        """See `AidingSensor`; the offset wanders, and begins with the first reading."""
        if math.isinf(self._variance):
            if not checked:
                return None
            z, H, R = reading.linearise(nav)
            self.offset = float(z[0])
            self._variance = float((H @ covariance(nav) @ H.T + R)[0, 0]) + 1.0
            return None
        self._variance += self.WANDER**2 * self._interval
        return super().check(reading, nav, checked=checked, outage=outage)

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
