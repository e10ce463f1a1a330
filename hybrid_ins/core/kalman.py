"""
The Kalman update in Joseph form and the closed loop that follows it.

The matrices are small and written out as loops: they compile in a tenth of the time that linear
algebra from a library takes, and run no slower.

References
----------
.. [1] P. Groves, *Principles of GNSS, Inertial, and Multisensor Integrated Navigation Systems*,
       2nd ed., sections 3.2 and 14.1.1.
.. [2] B. Or, I. Klein, "A hybrid model and learning-based adaptive navigation filter", IEEE TIM
       2022, eq. (8)-(12).
"""

from __future__ import annotations

import numpy as np
from numba.extending import register_jitable

from hybrid_ins.core.compilation import kernel
from hybrid_ins.core.earth import radii
from hybrid_ins.core.state import (
    BIAS_A,
    BIAS_G,
    COVARIANCE,
    LLA,
    N_ERROR,
    QUAT,
    VELOCITY,
    unpack,
)
from hybrid_ins.core.strapdown import half_rotation


@kernel()
def innovation(nav, z, H, R):  # type: ignore[no-untyped-def]
    """
    Return the innovation's covariance S, shape (m, m), and its normalised square (NIS).

    Parameters
    ----------
    nav : ndarray, shape (N_FLAT,)
        Flat state with nothing pending.
    z, H, R : ndarray, shape (m,), (m, 15), (m, m)
        Innovation (measured minus predicted), measurement matrix, measurement covariance.
    """
    S, _ = _spread(nav[COVARIANCE], H, R)
    root = S.copy()
    factorise(root)
    nis = 0.0
    white = z.copy()
    for i in range(len(z)):
        for k in range(i):
            white[i] -= root[i, k] * white[k]
        white[i] /= root[i, i]
        nis += white[i] * white[i]
    return S, nis


@kernel()
def correct(nav, z, H, R):  # type: ignore[no-untyped-def]
    """
    Fuse a measurement into the flat state ``nav``, in place; parameters as in `innovation`.

    Returns
    -------
    dx, K : ndarray, shape (15,), (15, m)
        The correction that was applied and the gain it came from, eq. (10)-(11) of [2]_.
    """
    m = len(z)
    root, PHt = _spread(nav[COVARIANCE], H, R)
    factorise(root)
    K = PHt
    for i in range(N_ERROR):
        solve(root, K[i])
    dx = np.zeros(N_ERROR)
    for i in range(N_ERROR):
        for a in range(m):
            dx[i] += K[i, a] * z[a]
    _shrink(nav[COVARIANCE], K, H, R)
    inject(nav, dx)
    return dx, K


@register_jitable
def _spread(packed, H, R):  # type: ignore[no-untyped-def]
    """Return S = H P H' + R, shape (m, m), and P H', shape (15, m)."""
    m = H.shape[0]
    P = np.empty((N_ERROR, N_ERROR))
    unpack(packed, P)
    PHt = np.zeros((N_ERROR, m))
    for a in range(m):
        for k in range(N_ERROR):
            h = H[a, k]
            if h != 0.0:
                for i in range(N_ERROR):
                    PHt[i, a] += P[k, i] * h
    S = np.empty((m, m))
    for a in range(m):
        for b in range(m):
            total = R[a, b]
            for k in range(N_ERROR):
                total += H[a, k] * PHt[k, b]
            S[a, b] = total
    return S, PHt


@register_jitable
def _shrink(packed, K, H, R):  # type: ignore[no-untyped-def]
    """P <- A P A' + K R K' with A = I - K H, eq. (12) of [2]_ in Joseph's form."""
    m = H.shape[0]
    P, A = np.empty((N_ERROR, N_ERROR)), np.eye(N_ERROR)
    unpack(packed, P)
    for i in range(N_ERROR):
        for a in range(m):
            for j in range(N_ERROR):
                A[i, j] -= K[i, a] * H[a, j]
    AP, KR = np.zeros((N_ERROR, N_ERROR)), np.zeros((N_ERROR, m))
    for i in range(N_ERROR):
        for k in range(N_ERROR):
            for j in range(N_ERROR):
                AP[i, j] += A[i, k] * P[k, j]
        for a in range(m):
            for b in range(m):
                KR[i, a] += K[i, b] * R[b, a]
    at = 0
    for i in range(N_ERROR):
        for j in range(i, N_ERROR):
            total = 0.0
            for k in range(N_ERROR):
                total += AP[i, k] * A[j, k]
            for a in range(m):
                total += KR[i, a] * K[j, a]
            packed[at] = total
            at += 1


@register_jitable
def factorise(S):  # type: ignore[no-untyped-def]
    """Overwrite the lower triangle of a positive definite matrix by its Cholesky factor."""
    for i in range(S.shape[0]):
        for j in range(i + 1):
            total = S[i, j]
            for k in range(j):
                total -= S[i, k] * S[j, k]
            S[i, j] = np.sqrt(total) if i == j else total / S[j, j]


@register_jitable
def solve(root, x):  # type: ignore[no-untyped-def]
    """Overwrite ``x`` (m,) by the solution of S y = x, given what `factorise` made of S."""
    m = len(x)
    for i in range(m):
        for k in range(i):
            x[i] -= root[i, k] * x[k]
        x[i] /= root[i, i]
    for i in range(m - 1, -1, -1):
        for k in range(i + 1, m):
            x[i] -= root[k, i] * x[k]
        x[i] /= root[i, i]


@kernel()
def inject(nav, dx):  # type: ignore[no-untyped-def]
    """Move the estimate by the error state ``dx``, shape (15,): the closed loop's reset."""
    lla, quat = nav[LLA], nav[QUAT]
    meridian, transverse = radii(lla[0])
    lla[1] += dx[1] / ((transverse + lla[2]) * np.cos(lla[0]))
    lla[0] += dx[0] / (meridian + lla[2])
    lla[2] -= dx[2]
    velocity, bias_a, bias_g = nav[VELOCITY], nav[BIAS_A], nav[BIAS_G]
    for i in range(3):
        velocity[i] += dx[3 + i]
        bias_a[i] += dx[9 + i]
        bias_g[i] += dx[12 + i]
    # C_nb <- exp(-[eps x]) C_nb; a large correction is applied in parts the series is exact for.
    ex, ey, ez = -dx[6], -dx[7], -dx[8]
    parts = int(4.0 * np.sqrt(ex * ex + ey * ey + ez * ez)) + 1
    ex, ey, ez = ex / parts, ey / parts, ez / parts
    s, c = half_rotation(ex, ey, ez)
    ex, ey, ez = s * ex, s * ey, s * ez
    for _ in range(parts):
        x, y, z, w = quat[0], quat[1], quat[2], quat[3]
        quat[0] = c * x + ex * w + ey * z - ez * y
        quat[1] = c * y - ex * z + ey * w + ez * x
        quat[2] = c * z + ex * y - ey * x + ez * w
        quat[3] = c * w - ex * x - ey * y - ez * z
    norm = np.sqrt(quat[0] ** 2 + quat[1] ** 2 + quat[2] ** 2 + quat[3] ** 2)
    for i in range(4):
        quat[i] /= norm
