"""
The measurement update by an ordinary fix, in one compiled call.

Nearly all fixes agree with the state so well that nothing is inflated or rejected.
`fuse_ordinary_fix` does with such a fix what `measurement_update.MeasurementUpdate` does with any:
that is the readable form, and both give the same.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.compilation import kernel
from hybrid_ins.core.filter.filter_noise import FilterNoise
from hybrid_ins.core.inertial.state import (
    CLOCK_VARIANCE,
    COVARIANCE,
    DIAGONAL,
    HEADING_ARM,
    N_ERROR,
    N_NAV,
    QUAT,
    SLOW_VARIANCE,
    VELOCITY,
)
from hybrid_ins.core.inertial.strapdown import rotation
from hybrid_ins.core.noise.heading_information import (
    HEADING,
    follow_heading,
    heading_information,
)
from hybrid_ins.core.noise.position_scatter import Split
from hybrid_ins.core.noise.process_noise import Correction
from hybrid_ins.core.noise.scatter_evidence import scatter_evidence
from hybrid_ins.core.noise.slow_error import change_slow_error
from hybrid_ins.core.noise.stamp_scatter import stamp_covariance
from hybrid_ins.core.sensor_errors.clock_offset import age_mean_square, observe, share_of_motion
from hybrid_ins.core.sensor_errors.clock_sensitivity import (
    correct_sensitivities,
    noise_information,
    sensitivities,
)
from hybrid_ins.core.update.gate import ORDINARY, TAIL_DOF, TAIL_EXPONENT
from hybrid_ins.core.update.iterated_update import update_and_linearise
from hybrid_ins.core.update.kalman import innovation_covariance
from hybrid_ins.core.update.linalg import factorise, whiten
from hybrid_ins.core.update.measurements import (
    PositionFix,
    VelocityFix,
    position_model,
    velocity_model,
)

Array = NDArray[np.float64]

FULL_WEIGHT = np.array([ORDINARY.get(m, 0.0) for m in range(4)])  # largest NIS, by components

# What is returned, as one flat vector.
NIS, LOG_DET, WEIGHT, TOTALS, COUNTS = 0, 1, 2, slice(3, 5), slice(5, 7)
SIGMA, INNOVATION, CORRECTION = slice(7, 10), slice(10, 13), slice(13, 13 + N_ERROR)
ATTITUDE = slice(CORRECTION.stop, CORRECTION.stop + 9)
S_MATRIX = slice(ATTITUDE.stop, ATTITUDE.stop + 9)
H_MATRIX = slice(S_MATRIX.stop, S_MATRIX.stop + 3 * N_ERROR)
K_MATRIX = slice(H_MATRIX.stop, H_MATRIX.stop + 3 * N_ERROR)
LINEAR_Z = slice(K_MATRIX.stop, K_MATRIX.stop + 3)
LINEAR_H = slice(LINEAR_Z.stop, LINEAR_Z.stop + 3 * N_ERROR)
LINEAR_X = slice(LINEAR_H.stop, LINEAR_H.stop + N_ERROR)
LINEAR_G = slice(LINEAR_X.stop, LINEAR_X.stop + N_ERROR * N_ERROR)
OF_STAMP = slice(LINEAR_G.stop, LINEAR_G.stop + 9)
NORMALISED = slice(OF_STAMP.stop, OF_STAMP.stop + 3)
TURN = NORMALISED.stop
N_RESULT = TURN + 1


@kernel()
def fuse_ordinary_fix(  # type: ignore[no-untyped-def]
    nav,
    measured,
    lever_b,
    white,
    is_position,
    slow_variance,
    slow_interval,
    claimed_growth,
    learning,
    fix_factor,
    stamp_variance,
    clock,
    interval,
    heading,
    heading_interval,
    limit,
    before,
    result,
):
    """
    Fuse a fix if its NIS is at most ``limit``; otherwise change nothing.

    Parameters
    ----------
    nav : ndarray, shape (N_FLAT,)
        Flat state with nothing pending; overwritten.
    measured, lever_b, white : ndarray, shape (3,), (3,), (m, m)
        See `measurements.PositionFix` and `VelocityFix`, `position_scatter.Split`; of a velocity
        all of its covariance. m is 2 where the fix lacks the vertical.
    is_position : bool
        Otherwise the fix is a velocity.
    slow_variance, slow_interval, claimed_growth
        See `position_scatter.Split`.
    learning : bool
        The scatter of positions is learned.
    fix_factor : float
        On ``white``.
    stamp_variance : float
        Of the stamp of a position, or of the age of a velocity [s²].
    clock : ndarray, shape (N_CLOCK,)
        `ClockOffsetObserver.values`; overwritten.
    interval : float
        Time since the last correction by a fix that ``clock`` contains [s].
    heading : ndarray, shape (N_VALUES,)
        `HeadingInformation.values`; overwritten.
    heading_interval : float
        Time since the last fix that was fused, or since the start [s].
    limit : float
        `Gate.ordinary_limit`.
    before : ndarray, shape (N_FLAT,) or (0,)
        Written: the state that the fix was compared with.
    result : ndarray, shape (N_RESULT,)
        Written: NIS and log det of the innovation, and the standard deviations used for the fix,
        all with the variance of the clock offset considered; the fix's weight; the
        `scatter_evidence`; innovation, correction, C_nb after it, S, H and gain; the
        `iterated_update.linearisation`; and the covariance by a stamp's error of 1 s.

    Returns
    -------
    bool
        The fix was fused.
    """
    m, variance = len(white), nav[CLOCK_VARIANCE]
    finite = limit >= 0.0
    for i in range(N_NAV):
        finite = finite and np.isfinite(nav[i])
    if not finite:
        return False
    if is_position:
        z, H = position_model(nav, measured, lever_b)
    else:
        z, H = velocity_model(nav, measured, lever_b)
    z, H = z[:m], H[:m]
    packed, scaled, R = nav[COVARIANCE], np.empty((m, m)), np.empty((m, m))
    diagonal, slow = np.empty(m), nav[SLOW_VARIANCE].copy()
    for a in range(m):
        diagonal[a] = packed[DIAGONAL[a]]
        for b in range(m):
            scaled[a, b] = R[a, b] = white[a, b] * fix_factor
    if is_position:
        change_slow_error(nav, slow_variance, slow_interval, claimed_growth)
    h, change = sensitivities(nav, H)
    if is_position:
        of_stamp = stamp_covariance(nav[VELOCITY], share_of_motion(clock), m)
    else:
        of_stamp = np.outer(change, change)
        if variance > 0.0:
            stamp_variance = max(stamp_variance, age_mean_square(clock))
    for a in range(m):
        for b in range(m):
            result[OF_STAMP][m * a + b] = of_stamp[a, b]
            of_stamp[a, b] *= stamp_variance
            R[a, b] += of_stamp[a, b]
    S, _ = innovation_covariance(packed, H, R)
    root = np.empty((m, m))
    for a in range(m):
        result[SIGMA][a] = np.sqrt(R[a, a] + variance * h[a, 0] * h[a, 0])
        for b in range(m):
            root[a, b] = S[a, b] + variance * h[a, 0] * h[b, 0]
    factorise(root)
    nis, log_det = whiten(root, z.copy()), 0.0
    for a in range(m):
        log_det += 2.0 * np.log(root[a, a])
    if not nis <= limit:
        for a in range(m):
            packed[DIAGONAL[a]], nav[SLOW_VARIANCE][a] = diagonal[a], slow[a]
        return False
    if is_position and learning:
        totals, counts, normalised = scatter_evidence(packed, z, H, scaled, of_stamp)
        result[TOTALS], result[COUNTS] = totals, counts
        for a in range(m):
            result[NORMALISED][a] = normalised[a]
    if is_position:
        for i in range(2):
            nav[HEADING_ARM][i] = -H[i, HEADING]
    weight = min(1.0, (TAIL_DOF + FULL_WEIGHT[m]) / (TAIL_DOF + nis)) ** TAIL_EXPONENT
    for i in range(len(before)):
        before[i] = nav[i]
    information, of_noise = heading_information(packed, H, S, R)
    heading_variance = packed[DIAGONAL[HEADING]]
    dx, K, z_x, H_x, x, G, result[TURN] = update_and_linearise(nav, z, H, R / weight)
    after = packed[DIAGONAL[HEADING]]
    follow_heading(heading, heading_interval, information, of_noise, heading_variance, after)
    correct_sensitivities(nav, H, K, h, dx, is_position)
    result[NIS], result[LOG_DET], result[WEIGHT] = nis, log_det, weight
    rotation(nav[QUAT], result[ATTITUDE])
    for i in range(N_ERROR):
        result[CORRECTION][i] = dx[i]
        for a in range(m):
            result[H_MATRIX][N_ERROR * a + i], result[K_MATRIX][m * i + a] = H[a, i], K[i, a]
            result[LINEAR_H][N_ERROR * a + i] = H_x[a, i]
        result[LINEAR_X][i] = x[i]
        for j in range(N_ERROR):
            result[LINEAR_G][N_ERROR * i + j] = G[i, j]
    for a in range(m):
        result[INNOVATION][a], result[LINEAR_Z][a] = z[a], z_x[a]
        for b in range(m):
            result[S_MATRIX][m * a + b] = S[a, b]
            S[a, b] += (1.0 / weight - 1.0) * R[a, b] - (0.0 if is_position else of_stamp[a, b])
    observe(clock, interval, z, h, S, noise_information(nav, H, K, S, is_position), True)
    return True


def correction_of(
    fix: PositionFix | VelocityFix,
    result: Array,
    interval: float,
    before: Array,
    weight: float,
    noise: FilterNoise,
    scatter_in_force: bool,
    split: Split,
) -> Correction:
    """Return the correction by a fix from the result of `fuse_ordinary_fix`."""
    m = len(fix.claimed)
    return Correction(
        fix.t_ns,
        result[INNOVATION][:m],
        result[S_MATRIX][: m * m].reshape(m, m),
        result[H_MATRIX][: m * N_ERROR].reshape(m, N_ERROR),
        result[K_MATRIX][: m * N_ERROR].reshape(N_ERROR, m),
        result[CORRECTION],
        result[ATTITUDE].reshape(3, 3),
        interval,
        before,
        True,
        weight=weight,
        linear=(
            result[LINEAR_Z][:m],
            result[LINEAR_H][: m * N_ERROR].reshape(m, N_ERROR),
            result[LINEAR_X],
            result[LINEAR_G].reshape(N_ERROR, N_ERROR),
        ),
        turn=float(result[TURN]),
        of_stamp=result[OF_STAMP][: m * m].reshape(m, m) if scatter_in_force else None,
        fix_factor=noise.found.fixes,
        stamp_std=noise.stamp_std_of(fix),
        slow_growth=split.claimed_growth,
        claimed_stds=split.claimed_stds,
        kind=fix.kind,
        factors_by_axis=noise.factors_by_axis(fix),
    )
