"""
One step of the regression on the antenna's lever arm, compiled; see `lever_arm`.

What is known is one flat vector, so that a compiled call has one argument and a checkpoint is one
copy.
"""

from __future__ import annotations

import math

import numpy as np
from numba.extending import register_jitable

from hybrid_ins.core.compilation import kernel
from hybrid_ins.core.inertial.error_model import advance
from hybrid_ins.core.inertial.state import (
    BIAS_G,
    COVARIANCE,
    DP,
    DV,
    EPS,
    MEAN_RATE,
    N_ERROR,
    QUAT,
    VELOCITY,
)
from hybrid_ins.core.inertial.strapdown import rotation
from hybrid_ins.core.noise.multiple_model_step import mean_system
from hybrid_ins.core.sensor_errors.clock_offset import (
    DRIFT,
    MARGIN,
    NIS_MEMORY,
    P_DRIFT,
    RANDOM_WALK,
)
from hybrid_ins.core.sensor_errors.clock_sensitivity import sensitivities
from hybrid_ins.core.update.kalman import covariances_at_full_weight
from hybrid_ins.core.update.linalg import factorise, mean_square, regress, whiten
from hybrid_ins.core.update.measurements import turned

PROBABLE, ELSEWHERE = 4.0, 6.0  # standard deviations of dl, from which it is considered, certain
AGE_STD = 0.3  # s, of velocities against positions
HEADING_STD = math.radians(4.0)  # from which the start is observed
LEAST_ERROR = 0.2  # m, of an axis: a smaller one is left to who measures it
DRIFT_TIME = 10.0  # s, over which a clock drift that is not known adds up

N_PARAMETERS = 5  # clock offset that the stamps lack [s], age of velocities [s], dl [m], b
OFFSET, PARAMETERS, ERROR = 0, slice(0, N_PARAMETERS), slice(2, N_PARAMETERS)
P_OFFSET, P_PARAMETERS = 5, slice(5, 30)  # their covariance, row by row
NIS_SCALE, DISTANCE = 30, 31  # mean normalised NIS; see `LeverArmError`
FIX_STD = 32  # m, of the last position from north, as it was fused
CONSIDERED = slice(33, 36)  # m², NED: what is added to the covariance of the position
LAST_VELOCITY, LAST_C = slice(36, 39), slice(39, 48)  # n, and C_nb, after the last correction
SENSITIVITIES = slice(48, 48 + 3 * N_ERROR)  # s, row by row
CORRECTED = slice(SENSITIVITIES.stop, SENSITIVITIES.stop + 3)  # m, b: of dl, and considered
CERTAIN = CORRECTED.stop  # 1: the error is worth telling
N_VALUES = CERTAIN + 1


@kernel()
def dependence_on_arm(nav, H):  # type: ignore[no-untyped-def]
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
    values, since, T, before, after, z, H, K, S, weight, informs, is_fix, clock
):
    """
    Take a correction into account, by a Kalman filter of clock offset and lever arm.

    Parameters
    ----------
    values : ndarray, shape (N_VALUES,)
        What is known; overwritten.
    since : float
        Time since the last correction [s]; 0: there was none.
    T : float
        The same; negative: its sensitivity does not hold.
    before, after : ndarray, shape (N_FLAT,)
        Flat state before and after the correction.
    z, H, K, S : ndarray, shape (m,), (m, 15), (15, m), (m, m)
        Innovation, measurement matrix, gain, and covariance of the innovation.
    weight : float
        With which the measurement was fused: its covariance was divided by that.
    informs, is_fix : bool
        The innovation is regressed; it depends on the antenna.
    clock : ndarray, shape (N_CLOCK,)
        `ClockOffsetObserver.values`: the drift is from there.
    """
    values[OFFSET] += since * clock[DRIFT]
    values[P_OFFSET] += since * (RANDOM_WALK**2 + DRIFT_TIME * clock[P_DRIFT])
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
        of_itself = dependence_on_arm(before, H)
        for a in range(m):
            h[a, 0], h[a, 1] = to_clock[a, 0], to_clock[a, 1]
            for j in range(3):
                of_error[a, j] += of_itself[a, j]
    if informs:
        P = values[P_PARAMETERS].reshape(N_PARAMETERS, N_PARAMETERS)
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
    _turn(s, C, values[LAST_C])


@register_jitable
def _turn(s, before, after):  # type: ignore[no-untyped-def]
    """
    Turn the sensitivities of position, velocity and attitude with a corrected attitude.

    What a lever arm does to the state turns with the vehicle, not with what is known of its
    attitude: otherwise the correction of a heading would be taken for a turn.
    """
    change = np.empty(9)  # C_after C_before'
    for i in range(3):
        change[i::3] = turned(after, before[3 * i : 3 * i + 3])
    for j in range(3):
        for part in (DP, DV, EPS):
            s[part, j] = turned(change, s[part, j])


@register_jitable
def variance_factor(values):  # type: ignore[no-untyped-def]
    """Return the factor by which the variances in ``values`` are too small."""
    return MARGIN**2 * max(values[NIS_SCALE], 1.0)


@register_jitable
def _consider(values, C):  # type: ignore[no-untyped-def]
    """Decide whether there is an error, and write what is considered of it."""
    factor, P = variance_factor(values), np.empty((3, 3))
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
