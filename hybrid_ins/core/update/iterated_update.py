"""
The measurement update of the filter: linear where that is accurate, iterated where it is not.

After dead reckoning (J⁻¹ δp, J⁻¹ δv, ε) is close to Gaussian, not (δp, δv, ε): φ = -ε is the error
of attitude and J(φ) the left Jacobian of rotations, [1]_. P is the covariance of the former. The
two differ by half of φ × δ: nothing while fixes arrive, metres after a minute without them, far
more than the standard deviation of the returning fixes. A correction for which that matters is
iterated by Gauss and Newton's method, [2]_.

A corrected heading turns the errors about the vertical, `kalman.turn_errors`. The transform
of an iterated correction has done so by half of the correction.

References
----------
.. [1] A. Barrau, S. Bonnabel, "The invariant extended Kalman filter as a stable observer", IEEE
       TAC 62, 2017: log-linear error propagation.
.. [2] Y. Bar-Shalom, X. Li, T. Kirubarajan, *Estimation with Applications to Tracking and
       Navigation*, 2001, section 10.5.2 (iterated EKF).
.. [3] B. Or, I. Klein, "A hybrid model and learning-based adaptive navigation filter", IEEE TIM
       2022, eq. (10)-(11).
"""

from __future__ import annotations

import numpy as np
from numba.extending import register_jitable

from hybrid_ins.core.compilation import kernel
from hybrid_ins.core.inertial.state import COVARIANCE, DIAGONAL, N_ERROR, pack_upper, unpack
from hybrid_ins.core.update.kalman import apply, gain, inject, joseph_update, turn_errors

LEAST_TURN = 1e-3  # rad: after a smaller correction of the heading, errors keep their directions
NONLINEARITY_LIMIT = 0.03  # of a measurement's standard deviation: a smaller difference is ignored
MAX_ROTATION = 0.5  # rad, of a correction of attitude: beyond it the iteration may not converge
CONVERGED = 1e-7  # rad
MAX_ITERATIONS = 10


@kernel()
def update(nav, z, H, R):  # type: ignore[no-untyped-def]
    """
    Fuse a measurement into the flat state ``nav``, in place.

    Parameters
    ----------
    nav, z, H, R
        See `kalman.innovation`.

    Returns
    -------
    dx, K : ndarray, shape (15,), (15, m)
        The correction that was applied and the gain it came from, eq. (10)-(11) of [3]_.
    turn : float
        Angle [rad] by which the errors were turned then, or 0.
    """
    dx, K, _, _, _, _, turn = update_and_linearise(nav, z, H, R)
    return dx, K, turn


@register_jitable
def update_and_linearise(nav, z, H, R):  # type: ignore[no-untyped-def]
    """Return the correction and its gain, what `linearisation` does at the state before, a turn."""
    dx, K, z_x, H_x, x, G = correct(nav, z, H, R)
    turn = dx[8] - np.arctan2(G[6, 7], G[6, 6])
    if abs(turn) < LEAST_TURN:
        turn = 0.0
    else:
        turn_errors(nav[COVARIANCE], turn)
    return dx, K, z_x, H_x, x, G, turn


@register_jitable
def correct(nav, z, H, R):  # type: ignore[no-untyped-def]
    """Correct the flat state, but leave the directions of the errors."""
    dx, K = gain(nav[COVARIANCE], z, H, R)
    if is_nonlinear(nav[COVARIANCE], dx, H, R):
        return _update_by_iteration(nav, z, H, R, dx, K)
    apply(nav, dx, K, H, R)
    return dx, K, z, H, dx, np.eye(N_ERROR)


@kernel()
def linearisation(packed, z, H, R):  # type: ignore[no-untyped-def]
    """
    Return the linear correction that `update` comes down to, in the transformed error.

    Parameters
    ----------
    packed : ndarray, shape (120,)
        Upper triangle of P, before the correction.
    z, H, R : ndarray
        See `update`.

    Returns
    -------
    z_x, H_x : ndarray, shape (m,), (m, 15)
        Innovation and measurement matrix at the correction.
    x : ndarray, shape (15,)
        The correction, K z_x.
    G : ndarray, shape (15, 15)
        Derivative of the error by the transformed one: about the new estimate P is G P G'.
    """
    x, K = gain(packed, z, H, R)
    if is_nonlinear(packed, x, H, R):
        converged, K_x, z_x, H_x, _, G = iterate(packed, z, H, R, x, K)
        if converged:
            return z_x, H_x, _product(K_x, z_x), G
    return z.copy(), H.copy(), x, np.eye(N_ERROR)


@register_jitable
def is_nonlinear(packed, dx, H, R):  # type: ignore[no-untyped-def]
    """Return whether the difference of half φ × δ is noticeable in the measurement."""
    rotation = packed[DIAGONAL[6]] + packed[DIAGONAL[7]] + packed[DIAGONAL[8]]
    for a in range(len(R)):
        difference = 0.0
        for first in (0, 3):
            h = H[a, first] ** 2 + H[a, first + 1] ** 2 + H[a, first + 2] ** 2
            difference += h * (dx[first] ** 2 + dx[first + 1] ** 2 + dx[first + 2] ** 2)
        if 0.25 * difference * rotation > NONLINEARITY_LIMIT**2 * R[a, a]:
            return True
    return False


@register_jitable
def iterate(packed, z, H, R, linear, K_linear):  # type: ignore[no-untyped-def]
    """
    Find the correction by iteration, beginning with the linear one and its gain.

    Parameters
    ----------
    packed : ndarray, shape (120,)
        Upper triangle of P.
    z, H, R, linear, K_linear : ndarray
        See `update`.

    Returns
    -------
    converged : bool
        Otherwise the linear correction is to be used.
    K : ndarray, shape (15, m)
        Gain at the correction.
    z_x, H_x : ndarray, shape (m,), (m, 15)
        Innovation and measurement matrix at the correction, of the transformed error.
    error, G : ndarray, shape (15,), (15, 15)
        The correction, and its derivative by the transformed error.
    """
    m = len(z)
    x, G, error = linear.copy(), np.eye(N_ERROR), linear.copy()
    H_x, z_x = np.empty((m, N_ERROR)), np.empty(m)
    K, moved = K_linear, np.inf
    for _ in range(MAX_ITERATIONS):
        if not x[6] ** 2 + x[7] ** 2 + x[8] ** 2 < MAX_ROTATION**2 or moved < CONVERGED**2:
            break
        left_jacobian_transform(x, error, G)
        for a in range(m):
            z_x[a] = z[a]
            for j in range(N_ERROR):
                H_x[a, j] = H[a, j]
                if j < 9:  # see `left_jacobian_transform` for the rows of G that are not 0 there
                    H_x[a, j] = 0.0
                    for i in range(0 if j >= 6 else j - j % 3, j - j % 3 + 3):
                        H_x[a, j] += H[a, i] * G[i, j]
                z_x[a] += H_x[a, j] * x[j] - H[a, j] * error[j]
        last = x
        x, K = gain(packed, z_x, H_x, R)
        moved = (x[6] - last[6]) ** 2 + (x[7] - last[7]) ** 2 + (x[8] - last[8]) ** 2
    converged = moved < CONVERGED**2
    if converged:
        left_jacobian_transform(x, error, G)
    return converged, K, z_x, H_x, error, G


@register_jitable
def _update_by_iteration(nav, z, H, R, linear, K_linear):  # type: ignore[no-untyped-def]
    """Iterate; use the linear correction, given as well, where that diverges."""
    packed = nav[COVARIANCE]
    converged, K, z_x, H_x, error, G = iterate(packed, z, H, R, linear, K_linear)
    if not converged:
        apply(nav, linear, K_linear, H, R)
        return linear, K_linear, z, H, linear, np.eye(N_ERROR)
    joseph_update(packed, K, H_x, R)
    # P now refers to the new estimate, about which (δp, δv, ε) and its transform are the same.
    P = np.empty((N_ERROR, N_ERROR))
    unpack(packed, P)
    pack_upper(_transformed(G, _transformed(G, P).T).T, packed)
    inject(nav, error)
    return error, _transformed(G, K), z_x, H_x, _product(K, z_x), G


@register_jitable
def _product(K, z):  # type: ignore[no-untyped-def]
    """Return K z; a product of matrices would load SciPy."""
    x = np.zeros(N_ERROR)
    for i in range(N_ERROR):
        for a in range(len(z)):
            x[i] += K[i, a] * z[a]
    return x


@register_jitable
def _transformed(G, A):  # type: ignore[no-untyped-def]
    """Return G A, shape (15, n), for the derivative G of `left_jacobian_transform`."""
    product = A.copy()
    for i in range(9):
        block = i - i % 3
        for j in range(A.shape[1]):
            product[i, j] = 0.0
            for k in range(block, block + 3):
                product[i, j] += G[i, k] * A[k, j]
            if block < 6:
                for k in range(6, 9):
                    product[i, j] += G[i, k] * A[k, j]
    return product


@register_jitable
def left_jacobian_transform(x, error, G):  # type: ignore[no-untyped-def]
    """Write (J u, J v, ε, ...), shape (15,), of x = (u, v, ε, ...), and its derivative (15, 15)."""
    phi, turned = (-x[6], -x[7], -x[8]), np.empty(3)
    square = phi[0] ** 2 + phi[1] ** 2 + phi[2] ** 2
    first = 0.5 * (1.0 - square / 12.0 * (1.0 - square / 30.0))
    second = (1.0 - square / 20.0 * (1.0 - square / 42.0)) / 6.0
    for i in range(N_ERROR):
        error[i] = x[i]
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
            error[block + i] = 0.0
            for n in range(3):
                error[block + i] += G[block + i, block + n] * u[n]
                G[block + i, 6 + n] = second * u[i] * phi[n]
            G[block + i, 6 + i] -= second * along
            G[block + i, 6 + j] -= first * u[k] + second * turned[k]
            G[block + i, 6 + k] += first * u[j] + second * turned[j]
