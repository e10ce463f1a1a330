"""
The Kalman update in Joseph form and the closed loop that follows it.

What dead reckoning makes Gaussian is not the error of position and velocity but that error before
it was bent by the error of attitude: J(φ)⁻¹ δp and J(φ)⁻¹ δv with φ = -ε and J the left Jacobian of
rotations [3]_. P is the covariance of those. The two differ by half of φ × δ: nothing while fixes
come, metres after a minute without them, far more than the returning fixes are uncertain by. A
correction for which that matters is iterated, see `correct`.

The matrices are small and written out as loops: they compile in a tenth of the time that linear
algebra from a library takes, and run no slower.

References
----------
.. [1] P. Groves, *Principles of GNSS, Inertial, and Multisensor Integrated Navigation Systems*,
       2nd ed., sections 3.2 and 14.1.1.
.. [2] B. Or, I. Klein, "A hybrid model and learning-based adaptive navigation filter", IEEE TIM
       2022, eq. (8)-(12).
.. [3] A. Barrau, S. Bonnabel, "The invariant extended Kalman filter as a stable observer", IEEE
       TAC 62, 2017: log-linear error propagation.
.. [4] Y. Bar-Shalom, X. Li, T. Kirubarajan, *Estimation with Applications to Tracking and
       Navigation*, 2001, section 10.5.2 (iterated EKF).
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
    DIAGONAL,
    LLA,
    N_ERROR,
    QUAT,
    VELOCITY,
    unpack,
)
from hybrid_ins.core.strapdown import half_rotation

BENT = 0.03  # of a measurement's standard deviation: a smaller bend is none
LARGEST_BEND = 0.5  # rad, of a correction of attitude: beyond it the iteration need not end well
SETTLED = 1e-7  # rad
PASSES = 10


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

    Where it moves position or velocity so far that the bend (see above) counts, it is fused by
    Gauss and Newton's iteration, [4]_: each pass linearises at the last one's result.

    Returns
    -------
    dx, K : ndarray, shape (15,), (15, m)
        The correction that was applied and the gain it came from, eq. (10)-(11) of [2]_.
    """
    dx, K = _gain(nav[COVARIANCE], z, H, R)
    if _is_bent(nav[COVARIANCE], dx, H, R):
        return _correct_bent(nav, z, H, R, dx, K)
    _shrink(nav[COVARIANCE], K, H, R)
    inject(nav, dx)
    return dx, K


@register_jitable
def _gain(packed, z, H, R):  # type: ignore[no-untyped-def]
    """Return K z, shape (15,), and K, shape (15, m)."""
    root, K = _spread(packed, H, R)
    factorise(root)
    dx = np.zeros(N_ERROR)
    for i in range(N_ERROR):
        solve(root, K[i])
        for a in range(len(z)):
            dx[i] += K[i, a] * z[a]
    return dx, K


@register_jitable
def _is_bent(packed, dx, H, R):  # type: ignore[no-untyped-def]
    """Tell whether a correction's bend shows in the measurement."""
    turn = packed[DIAGONAL[6]] + packed[DIAGONAL[7]] + packed[DIAGONAL[8]]
    for a in range(len(R)):
        bend = 0.0
        for first in (0, 3):
            h = H[a, first] ** 2 + H[a, first + 1] ** 2 + H[a, first + 2] ** 2
            bend += h * (dx[first] ** 2 + dx[first + 1] ** 2 + dx[first + 2] ** 2)
        if 0.25 * bend * turn > BENT**2 * R[a, a]:
            return True
    return False


@register_jitable
def _correct_bent(nav, z, H, R, straight, K_straight):  # type: ignore[no-untyped-def]
    """`correct` by iteration; with the plain correction, given as well, where that does not end."""
    m, packed = len(z), nav[COVARIANCE]
    x, G, bent = straight.copy(), np.eye(N_ERROR), straight.copy()
    H_x, z_x = np.empty((m, N_ERROR)), np.empty(m)
    K, moved = K_straight, np.inf
    for _ in range(PASSES):
        if not x[6] ** 2 + x[7] ** 2 + x[8] ** 2 < LARGEST_BEND**2 or moved < SETTLED**2:
            break
        _bend(x, bent, G)
        for a in range(m):
            z_x[a] = z[a]
            for j in range(N_ERROR):
                H_x[a, j] = 0.0
                for i in range(N_ERROR):
                    H_x[a, j] += H[a, i] * G[i, j]
                z_x[a] += H_x[a, j] * x[j] - H[a, j] * bent[j]
        last = x
        x, K = _gain(packed, z_x, H_x, R)
        moved = (x[6] - last[6]) ** 2 + (x[7] - last[7]) ** 2 + (x[8] - last[8]) ** 2
    if not moved < SETTLED**2:
        _shrink(packed, K_straight, H, R)
        inject(nav, straight)
        return straight, K_straight
    _bend(x, bent, G)
    _shrink(packed, K, H_x, R)
    # What is uncertain now is so about the new estimate, where nothing is bent.
    P, GP, gain = np.empty((N_ERROR, N_ERROR)), np.zeros((N_ERROR, N_ERROR)), np.zeros_like(K)
    unpack(packed, P)
    for i in range(N_ERROR):
        for k in range(N_ERROR):
            for j in range(N_ERROR):
                GP[i, j] += G[i, k] * P[k, j]
            for a in range(m):
                gain[i, a] += G[i, k] * K[k, a]
    at = 0
    for i in range(N_ERROR):
        for j in range(i, N_ERROR):
            packed[at] = 0.0
            for k in range(N_ERROR):
                packed[at] += GP[i, k] * G[j, k]
            at += 1
    inject(nav, bent)
    return bent, gain


@register_jitable
def _bend(x, bent, G):  # type: ignore[no-untyped-def]
    """Write the error state, shape (15,), that ``x`` is bent to, and its derivative (15, 15)."""
    phi, turned = (-x[6], -x[7], -x[8]), np.empty(3)
    square = phi[0] ** 2 + phi[1] ** 2 + phi[2] ** 2
    first = 0.5 * (1.0 - square / 12.0 * (1.0 - square / 30.0))
    second = (1.0 - square / 20.0 * (1.0 - square / 42.0)) / 6.0
    for i in range(N_ERROR):
        bent[i] = x[i]
    # J = I + first [φ×] + second [φ×]², and [a×][b×] = b a' - (a'b) I.
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        for block in (0, 3, 6):
            for n in range(3):
                G[block + i, block + n] = second * phi[i] * phi[n]
            G[block + i, block + i] += 1.0 - second * square
            G[block + i, block + j] -= first * phi[k]
            G[block + i, block + k] += first * phi[j]
    for block in (0, 3):
        u = (x[block], x[block + 1], x[block + 2])
        along = phi[0] * u[0] + phi[1] * u[1] + phi[2] * u[2]
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            turned[i] = phi[j] * u[k] - phi[k] * u[j]
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            bent[block + i] = 0.0
            for n in range(3):
                bent[block + i] += G[block + i, block + n] * u[n]
                G[block + i, 6 + n] = second * u[i] * phi[n]
            G[block + i, 6 + i] -= second * along
            G[block + i, 6 + j] -= first * u[k] + second * turned[k]
            G[block + i, 6 + k] += first * u[j] + second * turned[j]


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


@kernel()
def log_determinant(S):  # type: ignore[no-untyped-def]
    """Return the logarithm of the determinant of a positive definite matrix."""
    root = S.copy()
    factorise(root)
    total = 0.0
    for i in range(S.shape[0]):
        total += 2.0 * np.log(root[i, i])
    return total


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
