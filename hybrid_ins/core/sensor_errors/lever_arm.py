"""
Error of the antenna's lever arm, estimated beside the filter from its innovations.

An antenna that is not where it is said to be leaves innovations that follow the vehicle's turns:
the filter takes the state for that of a vehicle displaced by C_nb dl, and each turn moves it. For
the filter the error dl is a constant, so the sensitivity s = d(error)/d(dl), shape (15, 3), obeys
the filter's own equations, [1]_, and the innovation of a position has the mean h dl with
h = H s + C_nb, that of a velocity with h = H s + C_nb [w x]. A state that was read off the fixes
has s = -C_nb in its position, and h is zero until the vehicle turns.

The estimate is a regression of the innovations on h, with the clock offset of the fixes and the age
of velocities beside it: straight ahead one is like the other. Where nobody has placed the antenna,
the filter's clock offset is that of this regression, so that its sigma contains the lever arm's.

The state is not corrected by the estimate: who says where the antenna is decides what the odometry
is of. But an error that is probable is *considered*: the mean square of C_nb dl is added to the
covariance of the position that is reported. It is told once it is certain, and corrected by
`LeverArmObserver.shift` where nobody has said where the antenna is. The antenna is the vehicle's:
what one filter has found is the prior of the next. A lever arm that was not given but found from
motion is considered from the start on.

Where the noise factors rise by what a lever arm does, the attitude follows each turn, and the
estimate is too short and no less certain. What the first seconds show of an antenna that nobody has
placed is forgotten: the search for the heading has put into the state what s does not contain.

Headings that are hardly known are a nonlinear problem: nothing is observed meanwhile. A wrong place
of the antenna may itself keep a heading from being known well, so after half a minute less is
asked for.

References
----------
.. [1] B. Friedland, "Treatment of bias in recursive filtering", IEEE Transactions on Automatic
       Control 14, 1969.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.inertial.rotations import matrix_from_quat
from hybrid_ins.core.inertial.state import DV, HEADING_VARIANCE, N_ERROR, QUAT
from hybrid_ins.core.noise.process_noise import Correction
from hybrid_ins.core.sensor_errors.clock_offset import (
    MAX_STD,
    P_RESIDUAL,
    RESIDUAL,
    ClockOffsetObserver,
    variance_of_shift,
)
from hybrid_ins.core.sensor_errors.lever_arm_step import (
    AGE_STD,
    CERTAIN,
    CONSIDERED,
    CORRECTED,
    DISTANCE,
    ERROR,
    HEADING_STD,
    LAST_VELOCITY,
    N_PARAMETERS,
    N_VALUES,
    NIS_SCALE,
    OFFSET,
    P_OFFSET,
    P_PARAMETERS,
    SENSITIVITIES,
    observe_lever_arm,
    variance_factor,
)
from hybrid_ins.core.shallow_copy import ShallowCopy

Array = NDArray[np.float64]

GIVEN = np.zeros(3)  # m
PRIOR_STD = 2.0  # m, of each component of the error
SHIFT_SHARE = 0.3  # of an error that is corrected: it may be off by so much
LIKELY = 1.0  # m, of an antenna that nobody has placed: a clock found without it lacks that way
MAX_HEADING_STD, SETTLED_NS = math.radians(12.0), 30_000_000_000  # later: of the heading; ns
SEARCHED_NS = 10_000_000_000  # after the start: until then s lacks what the search has done
MAX_INTERVAL = 3.0  # s without a measurement: beyond it the mean motion does not represent the IMU

_START = np.zeros(N_VALUES)
_START[P_PARAMETERS] = np.diag((MAX_STD**2, AGE_STD**2, *3 * [PRIOR_STD**2])).ravel()
_START[NIS_SCALE] = 1.0


class LeverArmError(NamedTuple):
    """What the innovations show of the antenna's place."""

    error_b: Array  # (3,) m, true minus that of the fixes, b
    std: Array  # (3,) m
    distance: float  # of the error from none, in standard deviations of three dimensions
    is_certain: bool  # worth telling


class LeverArmObserver(ShallowCopy):
    """
    Estimates how far the antenna is from where it is said to be.

    Arrays are replaced, never changed in place: a shallow copy is a checkpoint.

    Parameters
    ----------
    found_std : ndarray, shape (3,)
        Standard deviation of a lever arm that was found from motion [m], b; zeros: it is exact.
    is_placed : bool
        Somebody has said where the antenna is: no large error is to be expected.
    """

    def __init__(self, found_std: Array = GIVEN, is_placed: bool = True) -> None:
        self._values, self._is_found = _START, bool(np.any(found_std))
        self._forgets = not (is_placed or self._is_found)
        self._shares_clock = not is_placed or self._is_found
        if self._is_found:
            P, self._values = (MAX_STD**2, AGE_STD**2, *np.square(found_std)), _START.copy()
            self._values[P_PARAMETERS] = np.diag(P).ravel()
        self._t_ns = self._start_ns = 0  # of the last correction (0: s is not known), of the first
        self._seen_ns = 0  # of the last one that the values contain

    @property
    def estimate(self) -> LeverArmError:
        """See `LeverArmError`."""
        values = self._values
        variance = values[P_PARAMETERS][:: N_PARAMETERS + 1][ERROR] * variance_factor(values)
        found = values[ERROR].copy(), np.sqrt(variance), values.item(DISTANCE)
        return LeverArmError(*found, bool(values[CERTAIN]))

    def considered(self, nav: Array) -> Array:
        """
        Return what is added to the covariance of the reported position, (3,) [m²], NED.

        Where the heading of the flat state ``nav`` is not known, north and east get both.
        """
        remains_of_antenna = self._values[CORRECTED].any()  # the odometry
        if remains_of_antenna or not self._is_found:
            return self._values[CONSIDERED]
        error_b, std = self.estimate[:2]
        C = matrix_from_quat(nav[QUAT])
        variance: Array = (C @ error_b) ** 2 + C**2 @ std**2
        if nav[HEADING_VARIANCE] > MAX_HEADING_STD**2:
            variance[:2] = variance[:2].sum()
        return variance

    @property
    def has_begun(self) -> bool:
        """A correction was seen: what an earlier filter has found comes too late."""
        return self._start_ns > 0

    def or_earlier(self, earlier: LeverArmObserver) -> LeverArmObserver:
        """
        Return this, or before its first correction what an earlier filter has found of the antenna.

        The clock offset is another one. Until the heading is known, the mean square of the error
        may have any direction.
        """
        if self.has_begun:
            return self
        found, values = self.__copy__(), earlier._values.copy()
        found._forgets, found._shares_clock = earlier._forgets, earlier._shares_clock
        _set_clock(values, 0.0, MAX_STD**2)
        values[CONSIDERED] = values[CONSIDERED].sum()
        found._values = values
        return found

    def restart(self) -> None:
        """Note that the state was changed by other means than measurements."""
        self._t_ns = 0

    def set_clock(self, residual: float, variance: float, velocity_n: Array) -> None:
        """
        Note a clock offset [s] and its variance [s²] that were found without the lever arm.

        At the velocity [m/s] a likely one is worth some time.
        """
        speed = float(np.linalg.norm(velocity_n))
        self._values = self._values.copy()
        _set_clock(self._values, residual, variance + (LIKELY / max(speed, LIKELY / MAX_STD)) ** 2)

    def inflate_clock(self, std: float) -> None:
        """Allow for a change of the clock by ``std`` [s]."""
        self._values = self._values.copy()
        self._values[P_OFFSET] += std**2

    def shift_clock(self, by: float) -> None:
        """Note that ``by`` [s] more is added to the stamps of fixes from now on."""
        self._values = self._values.copy()
        self._values[OFFSET] -= by
        self._values[P_OFFSET] += variance_of_shift(by)

    def _forget(self) -> None:
        """Forget what is known of the error; the values must be a copy."""
        self._forgets, values = False, self._values
        P = values[P_PARAMETERS].reshape(N_PARAMETERS, N_PARAMETERS)
        values[ERROR] = P[ERROR] = P[:, ERROR] = 0.0
        P[ERROR, ERROR] = np.diag(_START[P_PARAMETERS][:: N_PARAMETERS + 1][ERROR])

    def shift(self, by_b: Array, moves_odometry: bool) -> Array:
        """
        Correct a part ``by_b`` (3,) [m], b, of the error: fixes contain it from now on.

        Returns the error (15,) that it has caused in the state. What is left is considered from now
        on where that moves the odometry, all of it where it remains that of the antenna.
        """
        self._values = values = self._values.copy()
        if moves_odometry:
            self._is_found = True
        else:
            values[CORRECTED] += by_b
        P = values[P_PARAMETERS].reshape(N_PARAMETERS, N_PARAMETERS)
        P[ERROR, ERROR] += np.square(SHIFT_SHARE * np.linalg.norm(by_b)) * np.eye(3)
        values[ERROR] -= by_b
        values[CERTAIN] = 0.0
        caused = values[SENSITIVITIES].reshape(N_ERROR, 3) @ by_b
        values[LAST_VELOCITY] += caused[DV]
        return np.asarray(caused)

    def update(
        self, correction: Correction, nav: Array, is_fix: bool, clock: ClockOffsetObserver
    ) -> None:
        """
        Use a correction by a fix, or note one by another measurement.

        Parameters
        ----------
        correction : Correction
            With the state before it.
        nav : ndarray, shape (N_FLAT,)
            Flat state after it.
        is_fix : bool
            Otherwise it only changes the sensitivity.
        clock : ClockOffsetObserver
            Of the same filter, after the correction. Where nobody has placed the antenna, it is
            told what the regression shows of it.
        """
        before = correction.nav
        if self._shares_clock and not self.has_begun:
            now = clock.values
            self._values = self._values.copy()
            _set_clock(self._values, now.item(RESIDUAL), now.item(P_RESIDUAL))
        self._start_ns = self._start_ns or correction.t_ns
        age_ns = correction.t_ns - self._start_ns
        largest_std = MAX_HEADING_STD if age_ns > SETTLED_NS else HEADING_STD
        if before[HEADING_VARIANCE] > largest_std**2:
            self._t_ns = 0
            return
        if not (is_fix or self._t_ns):
            return
        T = (correction.t_ns - self._t_ns) * 1e-9
        if not (self._t_ns and 0.0 <= T <= MAX_INTERVAL):
            T = -1.0
        since = max(0.0, (correction.t_ns - (self._seen_ns or correction.t_ns)) * 1e-9)
        self._values, self._t_ns = self._values.copy(), correction.t_ns
        self._seen_ns = correction.t_ns
        if self._forgets and age_ns > SEARCHED_NS:
            self._forget()
        observe_lever_arm(
            self._values,
            since,
            T,
            before,
            nav,
            correction.z,
            correction.H,
            correction.K,
            correction.S,
            correction.weight,
            is_fix and correction.fused,
            is_fix,
            clock.values,
        )
        if self._shares_clock and is_fix:
            values = self._values
            clock.consider_lever_arm(values.item(OFFSET), values.item(P_OFFSET))


def _set_clock(values: Array, residual: float, variance: float) -> None:
    """Replace what is known of the clock offset [s] and its variance [s²]."""
    P = values[P_PARAMETERS].reshape(N_PARAMETERS, N_PARAMETERS)
    values[OFFSET], P[0], P[:, 0] = residual, 0.0, 0.0
    P[0, 0] = min(variance, MAX_STD**2)
