"""
Error of the antenna's lever arm, estimated beside the filter from its innovations.

An antenna that is not where it is said to be leaves innovations that follow the vehicle's turns:
the filter takes the state for that of a vehicle displaced by C_nb dl, and each turn moves it. For
the filter the error dl is a constant, so the sensitivity s = d(error)/d(dl), shape (15, 3), obeys
the filter's own equations, [1]_, and the innovation of a position has the mean h dl with
h = H s + C_nb, that of a velocity with h = H s + C_nb [w x]. A state that was read off the fixes
has s = -C_nb in its position, and h is zero until the vehicle turns.

The estimate is a regression of the innovations on h, with the clock offset of the fixes and the age
of velocities beside it: straight ahead one is like the other. The state is not corrected by it: who
says where the antenna is decides what the odometry is of. But an error that is probable is
*considered*: the mean square of C_nb dl is added to the covariance of the position that is
reported, that of s dl to the covariance of the attitude. It is told once it is certain, and
corrected by `LeverArmObserver.shift` where nobody has said where the antenna is. The antenna is the
vehicle's: what one filter has found is the prior of the next. A lever arm that was not given but
found from motion is considered from the start on.

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
from numba.extending import register_jitable
from numpy.typing import NDArray

from hybrid_ins.core.compilation import kernel
from hybrid_ins.core.inertial.error_model import advance
from hybrid_ins.core.inertial.rotations import matrix_from_quat
from hybrid_ins.core.inertial.state import (
    BIAS_G,
    COVARIANCE,
    DV,
    EPS,
    HEADING_VARIANCE,
    MEAN_RATE,
    N_ERROR,
    QUAT,
    VELOCITY,
)
from hybrid_ins.core.inertial.strapdown import rotation
from hybrid_ins.core.noise.multiple_model_step import mean_system
from hybrid_ins.core.noise.process_noise import Correction
from hybrid_ins.core.sensor_errors.clock_offset import MARGIN, MAX_STD, NIS_MEMORY, RANDOM_WALK
from hybrid_ins.core.sensor_errors.clock_sensitivity import sensitivities
from hybrid_ins.core.sensor_errors.turned_sensitivities import turn_sensitivities
from hybrid_ins.core.shallow_copy import ShallowCopy
from hybrid_ins.core.update.kalman import covariances_at_full_weight
from hybrid_ins.core.update.linalg import factorise, mean_square, regress, whiten

Array = NDArray[np.float64]

GIVEN = np.zeros(3)  # m
PRIOR_STD = 2.0  # m, of each component of the error
SHIFT_SHARE = 0.3  # of an error that is corrected: it may be off by so much
AGE_STD = 0.3  # s, of velocities against positions
HEADING_STD = math.radians(4.0)  # from which the start is observed
MAX_HEADING_STD, SETTLED_NS = math.radians(12.0), 30_000_000_000  # later: of the heading; ns
SEARCHED_NS = 10_000_000_000  # after the start: until then s lacks what the search has done
PROBABLE, ELSEWHERE = 4.0, 6.0  # standard deviations of dl, from which it is considered, certain
LEAST_ERROR = 0.2  # m, of an axis: a smaller one is left to who measures it
MAX_INTERVAL = 3.0  # s without a measurement: beyond it the mean motion does not represent the IMU

# What is known, as one flat vector.
N_PARAMETERS = 5  # clock offset that the stamps lack [s], age of velocities [s], dl [m], b
PARAMETERS, ERROR = slice(0, N_PARAMETERS), slice(2, N_PARAMETERS)
P_PARAMETERS = slice(5, 30)  # their covariance, row by row
NIS_SCALE, DISTANCE = 30, 31  # mean normalised NIS; see `LeverArmError`
FIX_STD = 32  # m, of the last position from north, as it was fused
CONSIDERED = slice(33, 36)  # m², NED: what is added to the covariance of the position
LAST_VELOCITY, LAST_C = slice(36, 39), slice(39, 48)  # n, and C_nb, after the last correction
SENSITIVITIES = slice(48, 48 + 3 * N_ERROR)  # s, row by row
CORRECTED = slice(SENSITIVITIES.stop, SENSITIVITIES.stop + 3)  # m, b: of dl, and considered
CERTAIN = CORRECTED.stop  # 1: the error is worth telling
N_VALUES = CERTAIN + 1
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
        if self._is_found:
            P, self._values = (MAX_STD**2, AGE_STD**2, *np.square(found_std)), _START.copy()
            self._values[P_PARAMETERS] = np.diag(P).ravel()
        self._t_ns = self._start_ns = 0  # of the last correction (0: s is not known), of the first

    @property
    def estimate(self) -> LeverArmError:
        """See `LeverArmError`."""
        values = self._values
        variance = values[P_PARAMETERS][:: N_PARAMETERS + 1][ERROR] * _variance_factor(values)
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
    def of_attitude(self) -> Array:
        """
        Return what is added to the covariance of the reported attitude, (6,) [rad²], NED.

        A vehicle that turns on the spot shows heading and place of its antenna together only: what
        is not known of one that was found is not known of the heading.
        """
        values = self._values
        if not (self._is_found or values[CONSIDERED].any()):
            return np.zeros(6)
        s = values[SENSITIVITIES].reshape(N_ERROR, 3)[EPS]
        P = values[P_PARAMETERS].reshape(N_PARAMETERS, N_PARAMETERS)[ERROR, ERROR]
        square = _variance_factor(values) * P + np.outer(values[ERROR], values[ERROR])
        found: Array = (s @ square @ s.T)[np.triu_indices(3)]
        return found

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
        found._forgets = earlier._forgets
        P = values[P_PARAMETERS].reshape(N_PARAMETERS, N_PARAMETERS)
        values[PARAMETERS.start] = P[0] = P[:, 0] = 0.0
        P[0, 0] = MAX_STD**2
        values[CONSIDERED] = values[CONSIDERED].sum()
        found._values = values
        return found

    def restart(self) -> None:
        """Note that the state was changed by other means than measurements."""
        self._t_ns = 0

    def shift_clock(self, by: float) -> None:
        """Note that ``by`` [s] more is added to the stamps of fixes from now on."""
        self._values = self._values.copy()
        self._values[PARAMETERS.start] -= by
        self._values[P_PARAMETERS.start] += by**2

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

    def update(self, correction: Correction, nav: Array, is_fix: bool) -> None:
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
        """
        before = correction.nav
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
        self._values, self._t_ns = self._values.copy(), correction.t_ns
        if self._forgets and age_ns > SEARCHED_NS:
            self._forget()
        observe_lever_arm(
            self._values,
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
        )


@kernel()
def dependence_on_lever_arm(nav, H):  # type: ignore[no-untyped-def]
    """
    Return how an innovation depends on the lever arm besides by the state, (m, 3).

    A velocity does with the angular rate: vibration in it would be taken for turns.
    """
    m, C, rate = len(H), np.empty(9), np.empty(3)
    rotation(nav[QUAT], C)
    for i in range(3):
        rate[i] = nav[MEAN_RATE][i] - nav[BIAS_G][i]
    found = np.zeros((m, 3))
    for a in range(m):
        for j in range(3):
            k, n = (j + 1) % 3, (j + 2) % 3
            for i in range(3):
                found[a, j] += H[a, i] * C[3 * i + j]
                swing = C[3 * i + k] * rate[n] - C[3 * i + n] * rate[k]  # C_nb [w x]
                found[a, j] += H[a, 3 + i] * swing
    return found


@kernel()
def observe_lever_arm(  # type: ignore[no-untyped-def]
    values, T, before, after, z, H, K, S, weight, informs, is_fix
):
    """
    Take a correction into account, by a Kalman filter of clock offset and lever arm.

    Parameters
    ----------
    values : ndarray, shape (N_VALUES,)
        What is known; overwritten.
    T : float
        Time since the last correction [s]; negative: its sensitivity does not hold.
    before, after : ndarray, shape (N_FLAT,)
        Flat state before and after the correction.
    z, H, K, S : ndarray, shape (m,), (m, 15), (15, m), (m, m)
        Innovation, measurement matrix, gain, and covariance of the innovation.
    weight : float
        With which the measurement was fused: its covariance was divided by that.
    informs, is_fix : bool
        The innovation is regressed; it depends on the antenna.
    """
    m, s, last_C = len(z), values[SENSITIVITIES].reshape(N_ERROR, 3), values[LAST_C].reshape(3, 3)
    C = np.empty(9)
    rotation(before[QUAT], C)
    if T < 0.0:
        for i in range(N_ERROR):
            for j in range(3):
                s[i, j] = -C[3 * i + j] if i < 3 else 0.0
    elif T > 0.0:
        F, _ = mean_system(before, values[LAST_VELOCITY], last_C, T)
        advance(F, T, s)
    h = np.zeros((m, N_PARAMETERS))
    of_error = h[:, ERROR]
    for a in range(m):
        for j in range(3):
            for i in range(N_ERROR):
                of_error[a, j] += H[a, i] * s[i, j]
    if is_fix:
        to_clock, _ = sensitivities(before, H)
        of_itself = dependence_on_lever_arm(before, H)
        for a in range(m):
            h[a, 0], h[a, 1] = to_clock[a, 0], to_clock[a, 1]
            for j in range(3):
                of_error[a, j] += of_itself[a, j]
    if informs:
        P = values[P_PARAMETERS].reshape(N_PARAMETERS, N_PARAMETERS)
        P[0, 0] += max(T, 0.0) * RANDOM_WALK**2
        total, R = covariances_at_full_weight(before[COVARIANCE], H, S, weight)
        if H[0, 0] != 0.0:
            values[FIX_STD] = np.sqrt(max(R[0, 0], 0.0))
        factorise(total)
        now = values[PARAMETERS]
        values[NIS_SCALE] += (mean_square(z, h, now, total) - values[NIS_SCALE]) / NIS_MEMORY
        regress(now, P, z, h, total)
        _consider(values, C)
    for i in range(N_ERROR):
        for j in range(3):
            for a in range(m):
                s[i, j] -= K[i, a] * of_error[a, j]
    for i in range(3):
        values[LAST_VELOCITY][i] = after[VELOCITY][i]
    rotation(after[QUAT], values[LAST_C])
    turn_sensitivities(s, C, values[LAST_C])


@register_jitable
def _variance_factor(values):  # type: ignore[no-untyped-def]
    """Return the factor by which the variances in ``values`` are too small."""
    return MARGIN**2 * max(values[NIS_SCALE], 1.0)


@register_jitable
def _consider(values, C):  # type: ignore[no-untyped-def]
    """Decide whether there is an error, and write what is considered of it."""
    factor, P = _variance_factor(values), np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            P[i, j] = factor * values[P_PARAMETERS][N_PARAMETERS * (2 + i) + 2 + j]
    error, total = values[ERROR].copy(), values[ERROR] + values[CORRECTED]
    values[DISTANCE], is_large = _distance(error, P, values[FIX_STD])
    values[CERTAIN] = 1.0 if is_large and values[DISTANCE] > ELSEWHERE else 0.0
    distance, is_large = _distance(total, P, values[FIX_STD])
    for i in range(3):
        values[CONSIDERED][i] = 0.0
        if is_large and distance > PROBABLE:
            for j in range(3):
                for k in range(3):
                    mean_square = total[j] * total[k] + P[j, k]
                    values[CONSIDERED][i] += C[3 * i + j] * mean_square * C[3 * i + k]


@register_jitable
def _distance(error, P, fix_std):  # type: ignore[no-untyped-def]
    """Return the distance from none in standard deviations, and whether an axis is worth it."""
    least, is_large = max(LEAST_ERROR, 2.0 * fix_std), False
    for i in range(3):
        is_large |= abs(error[i]) > max(least, 3.0 * np.sqrt(P[i, i]))
    root = P.copy()
    factorise(root)
    return np.sqrt(whiten(root, error.copy())), is_large
