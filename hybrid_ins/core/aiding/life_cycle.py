"""
Life cycle of sensors that aid the filter besides GNSS.

What such a sensor claims is checked against the filter before it is used. While fixes come,
the filter knows velocity, heading and height without it: readings that agree for some seconds make
the sensor aid, readings that disagree for some seconds make it refused, whatever it did before.
In an outage nothing but the filter itself contradicts a sensor: readings that it rejects for some
seconds make the sensor refused, and it aids again once it agrees with a state that is known as well
as then. A state that has become uncertain meanwhile would agree with anything: the sensor waits
for fixes. A reading far off is not fused; a sensor that errs by and by would take the filter
along, so that it is compared with a state that nothing has aided for some seconds, too, see
`UnaidedState`.
What a sensor cannot know of itself, the scale and the place of wheels, the offset of a pressure
height, is estimated at the same time, see `hybrid_ins.core.aiding.sensors`.

    absent    no reading yet
    waiting   no reading yet that could be checked
    aiding    agrees with the motion; its readings are used
    refused   disagrees with the motion; its readings are not used until they agree again
    frozen    repeats one reading while the vehicle moves; nothing is used until it changes
    lost      no reading for `SILENCE`

References
----------
.. [1] P. Groves, *Principles of GNSS, Inertial, and Multisensor Integrated Navigation Systems*,
       2nd ed., sections 16.2 (scale of odometry) and 17.3 (innovation monitoring).
"""

from __future__ import annotations

import math
from enum import Enum
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.aiding.lasting_errors import LastingErrors
from hybrid_ins.core.constraints.constraint_observer import inflated
from hybrid_ins.core.inertial.state import VELOCITY, covariance
from hybrid_ins.core.update.measurements import Measurement

Array = NDArray[np.float64]

SILENCE_NS = 2_000_000_000
AGREES, DISAGREES = 3.0, 7.0  # mean NIS per component, of a sensor to be used, to be refused
SHOWN = 3.0  # s of readings that show either
NIS_MEMORY = 3.0  # s over which the NIS is averaged
USUAL_MEMORY = 30.0  # s over which the variance is averaged of states that check a sensor
STILL_KNOWN = 4.0  # factor on the variance of such a state, or one that refused it in an outage
LARGEST_NIS = 50.0  # that counts: one outlier does not refuse a sensor
FAR = 19.5, 23.0, 25.9  # NIS of 1, 2, 3 components, which one reading in 100 000 exceeds
FROZEN, FROZEN_COUNT = 2.0, 6  # s and readings that are the same
MOVING = 0.3  # m/s, of a vehicle whose readings change
CONTRADICTED = 1.0  # s of readings that are as far off a state that nothing has aided


class AidingState(Enum):
    """Where in its life cycle a sensor is."""

    ABSENT = "absent"
    WAITING = "waiting"
    AIDING = "aiding"
    REFUSED = "refused"
    FROZEN = "frozen"
    LOST = "lost"


class Innovation(NamedTuple):
    """How far a reading, corrected, is off a state, and the covariances of that by their causes."""

    z: Array  # (m,)
    of_state: Array  # (m, m), H P Hᵀ
    nuisance: Array
    considered: Array
    R: Array  # (m, m), as claimed

    @property
    def expected(self) -> Array:
        """Covariance of all but the reading."""
        return self.of_state + self.nuisance + self.considered


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
    took_along : bool
        It was refused in an outage after the filter had followed it, for the time being; who
        restores the state resets this.
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
        self._usual = math.inf  # mean variance of what a state that checks it predicts
        self._value = b""  # of the last reading
        self._repeated, self._repetitions = 0.0, 0  # s, for how long it has come, and how often
        self._is_frozen = False
        self._contradicted = 0.0  # s, for how long the IMU contradicts what the filter follows
        self.took_along = False

    def state(self, t_ns: int) -> AidingState:
        """Return the state at a stamp [ns]."""
        if not self._last_ns:
            return AidingState.ABSENT
        if t_ns - self._last_ns > SILENCE_NS:
            return AidingState.LOST
        if self._agrees is None:
            return AidingState.WAITING
        if self._is_frozen:
            return AidingState.FROZEN
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
        self,
        reading: Measurement,
        nav: Array,
        *,
        checked: bool,
        outage: bool,
        unaided: Array | None = None,
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
        unaided : ndarray, optional
            In an outage, the same as it would be had nothing aided it for some seconds.
        """
        if not self.prepare(reading, nav, checked):
            return None
        if self._was_silent:
            self._resume(outage)
        self._note_repetition(reading, nav)
        seen = self._innovation(reading, nav)
        z, R = seen.z, seen.R
        nis = float(z @ np.linalg.solve(seen.expected + R, z)) / len(z)
        variance = float(np.trace(seen.of_state)) / len(z)
        if outage and self._agrees is not None:
            self._check_in_outage(nis, variance)
            if self._is_far(seen):
                return None
            if self._agrees and unaided is not None:
                self._compare(self._innovation(reading, unaided))
        elif checked and self.can_check(seen.of_state + seen.considered, R):
            self._check(nis, variance)
            of_sensor = inflated(R, self.error_time, self._interval)
            self._lasting.add(z, seen.expected, of_sensor, self._interval)
            self.learn(reading, nav, z, seen.of_state, R)
        if not self._agrees or self._is_frozen or not (outage or self.always):
            return None
        return self.measurement(self.corrected(reading), self.factor * R, seen.nuisance)

    def prepare(self, reading: Measurement, nav: Array, checked: bool) -> bool:
        """Follow errors that change by themselves; return whether the reading can be compared."""
        return True

    def _innovation(self, reading: Measurement, nav: Array) -> Innovation:
        z, H, R = self.corrected(reading).linearise(nav)
        of_state = H @ covariance(nav) @ H.T
        return Innovation(z, of_state, self.nuisance(reading, nav), self.considered(nav), R)

    def value(self, reading: Measurement) -> Array:
        """Return what was measured; zero of a sensor that may read so for long, at rest."""
        raise NotImplementedError

    def _note_repetition(self, reading: Measurement, nav: Array) -> None:
        """Note whether a reading is one again and again while the vehicle moves."""
        value = self.value(reading)
        if value.tobytes() != self._value:
            self._value, self._repeated, self._repetitions = value.tobytes(), 0.0, 0
        self._repeated += self._interval if self._repetitions else 0.0
        self._repetitions += 1
        moves = float(np.linalg.norm(nav[VELOCITY])) > MOVING and bool(np.nan_to_num(value).any())
        is_repeated = self._repeated >= FROZEN and self._repetitions >= FROZEN_COUNT
        self._is_frozen = moves and is_repeated

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

    def _check(self, nis: float, variance: float) -> None:
        """
        Decide whether the sensor is used, by the NIS per component of its readings.

        A state whose mean ``variance`` is far above the usual one, as behind the last fix before an
        outage, decides nothing.
        """
        if self._checked is None:
            self._nis, self._checked, self._usual = min(nis, LARGEST_NIS), 0.0, variance
            return
        if variance > STILL_KNOWN * self._usual:
            return
        self._usual += (1.0 - math.exp(-self._interval / USUAL_MEMORY)) * (variance - self._usual)
        self._average(nis)
        self._checked += self._interval
        if self._checked >= SHOWN:
            self._decide()
            self._refused_with = 0.0  # what fixes refuse does not come back in an outage

    def _check_in_outage(self, nis: float, variance: float) -> None:
        """Decide that by the filter alone, with the mean variance of what it predicts."""
        if self._agrees:
            self._refused_with = variance
        elif variance > STILL_KNOWN * self._refused_with:
            return
        self._average(nis)
        self._decide()

    def _is_far(self, seen: Innovation) -> bool:
        """Return whether a reading is farther off a state than errors as large as known explain."""
        S = seen.expected + self.factor * seen.R
        return float(seen.z @ np.linalg.solve(S, seen.z)) > FAR[len(seen.z) - 1]

    def _compare(self, unaided: Innovation) -> None:
        """Refuse a sensor that has taken the filter along, away from what the IMU measures."""
        is_far = self._is_far(unaided)
        self._contradicted = self._contradicted + self._interval if is_far else 0.0
        if self._contradicted >= CONTRADICTED:
            self._agrees, self._nis, self._contradicted = False, LARGEST_NIS, 0.0
            self.took_along = True

    def _average(self, nis: float) -> None:
        gain = 1.0 - math.exp(-self._interval / NIS_MEMORY)
        self._nis += gain * (min(nis, LARGEST_NIS) - self._nis)

    def _decide(self) -> None:
        if self._nis < AGREES:
            self._agrees = True
        elif self._nis > DISAGREES:
            self._agrees = False
