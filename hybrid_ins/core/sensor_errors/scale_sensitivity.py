"""
What errors of an IMU's scale factors and axes do to a state, over its samples.

The equations are in `scale_errors`.
"""

from __future__ import annotations

import numpy as np
from numba.extending import register_jitable

from hybrid_ins.core.compilation import kernel
from hybrid_ins.core.inertial.error_model import advance, system_matrix
from hybrid_ins.core.inertial.state import BIAS_A, BIAS_G, LLA, N_ERROR, QUAT, VELOCITY
from hybrid_ins.core.inertial.strapdown import half_rotation, multiply, rotation

N_SCALE = 18  # elements of M_a and M_g, row by row
LONGEST_PART, LARGEST_TURN = 0.1, 0.1  # s, rad, in which the motion is taken for constant


@kernel()
def follow_samples(nav, dt, readings, reference, U, driven):  # type: ignore[no-untyped-def]
    """
    Carry sensitivities over IMU samples.

    Parameters
    ----------
    nav : ndarray, shape (N_NAV,) or longer
        Flat state at the last sample.
    dt : ndarray, shape (N,)
        Time from each sample's predecessor [s].
    readings : ndarray, shape (N, 6)
        Specific force [m/s²] and angular rate [rad/s], b, as measured.
    reference : ndarray, shape (6,)
        Readings of which the biases contain all that scale errors do.
    U : ndarray, shape (15, k)
        Overwritten by Φ U.
    driven : ndarray, shape (15, N_SCALE)
        Overwritten by Φ driven + D.
    """
    n, time, turn = len(dt), 0.0, 0.0
    for k in range(n):
        time += dt[k]
        square = 0.0
        for i in range(3):
            square += (readings[k, 3 + i] - nav[BIAS_G][i]) ** 2
        turn += dt[k] * np.sqrt(square)
    parts = min(max(1, int(np.ceil(max(time / LONGEST_PART, turn / LARGEST_TURN) - 1e-6))), n)
    lengths, means, C = np.zeros(parts), np.zeros((parts, 6)), np.empty((parts, 9))
    quat = nav[QUAT].copy()
    for p in range(parts - 1, -1, -1):
        for k in range(p * n // parts, (p + 1) * n // parts):
            lengths[p] += dt[k]
            for i in range(6):
                means[p, i] += dt[k] * readings[k, i]
        for i in range(6):
            means[p, i] /= lengths[p]
        back = np.empty(3)  # half of the part's rotation
        for i in range(3):
            back[i] = -0.5 * lengths[p] * (means[p, 3 + i] - nav[BIAS_G][i])
        scale, scalar = half_rotation(back[0], back[1], back[2])
        multiply(quat, scale * back[0], scale * back[1], scale * back[2], scalar)
        rotation(quat, C[p])
        multiply(quat, scale * back[0], scale * back[1], scale * back[2], scalar)
    F, f_n = np.zeros((N_ERROR, N_ERROR)), np.empty(3)
    for p in range(parts):
        for i in range(3):
            f_n[i] = 0.0
            for j in range(3):
                f_n[i] += C[p, 3 * i + j] * (means[p, j] - nav[BIAS_A][j])
        system_matrix(nav[LLA], nav[VELOCITY], f_n, C[p], F)
        # M (f - f0) is an error of a reading, as a bias is; half of it before, half behind a part.
        _drive(driven, F, means[p], reference, 0.5 * lengths[p])
        advance(F, lengths[p], U)
        advance(F, lengths[p], driven)
        _drive(driven, F, means[p], reference, 0.5 * lengths[p])


@register_jitable
def _drive(driven, F, reading, reference, dt):  # type: ignore[no-untyped-def]
    """Add what M (f - f₀) and M ω do in a time ``dt`` [s] to ``driven``, (15, N_SCALE)."""
    for sensor in range(2):
        for i in range(3):
            bias = 9 + 3 * sensor + i
            for row in range(3, 9):
                element = dt * F[row, bias]
                if element != 0.0:
                    for j in range(3):
                        off = reading[3 * sensor + j] - reference[3 * sensor + j]
                        driven[row, 9 * sensor + 3 * i + j] += element * off
