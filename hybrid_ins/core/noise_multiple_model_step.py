"""
Prediction and update of many covariances at once: a step of `NoiseMultipleModelBank`.

The hypotheses differ in their noise alone and share transition and measurement. The step is
written as loops over the hypotheses, which the compiler turns into vector instructions, one for
each element of transition and measurement that is not zero.
"""

from __future__ import annotations

import numpy as np
from numba.extending import register_jitable

from hybrid_ins.core.compilation import kernel
from hybrid_ins.core.earth import normal_gravity
from hybrid_ins.core.error_model import system_matrix
from hybrid_ins.core.linalg import factorise
from hybrid_ins.core.state import LLA, N_ERROR, PLACES, QUAT, VELOCITY
from hybrid_ins.core.strapdown import rotation


@kernel()
def mean_system(nav, velocity_n, C_nb, T):  # type: ignore[no-untyped-def]
    """
    Error dynamics over the time since a correction, without IMU samples.

    Parameters
    ----------
    nav : ndarray, shape (N_FLAT,)
        Flat state now.
    velocity_n, C_nb : ndarray, shape (3,), (3, 3)
        After that correction.
    T : float
        Time since it [s]; 0: there was none.

    Returns
    -------
    F, C_nb : ndarray, shape (15, 15), (3, 3)
        System matrix and attitude of the mean motion.
    """
    F, C_mean, f_n = np.zeros((N_ERROR, N_ERROR)), np.empty((3, 3)), np.zeros(3)
    C = C_mean.reshape(9)
    f_n[2] = -normal_gravity(nav[LLA][0], nav[LLA][2])[1]
    rotation(nav[QUAT], C)
    if T > 0.0:
        for i in range(3):
            f_n[i] += (nav[VELOCITY][i] - velocity_n[i]) / T
            for j in range(3):
                C_mean[i, j] = 0.5 * (C_mean[i, j] + C_nb[i, j])
    system_matrix(nav[LLA], nav[VELOCITY], f_n, C, F)
    return F, C_mean


@kernel(fastmath={"contract"})
def advance(  # type: ignore[no-untyped-def]
    P_all, offset_all, F, T, C, psd, factors, walk, z, H, R, dx, G, tail_dof
):
    """
    Predict and update every hypothesis.

    Parameters
    ----------
    P_all, offset_all : ndarray, shape (120, n), (15, n)
        Covariances as packed upper triangles, and the offset of each estimate from the
        running filter's: one hypothesis per column.
    F, T : ndarray, float
        System matrix, shape (15, 15), and the time to go [s].
    C, psd : ndarray, shape (3, 3), (12,)
        C_nb, and Qc's diagonal at factor 1.
    factors, walk : ndarray, shape (3, n)
        On the accelerometer's noise, the gyroscope's, and R; density of a random walk of
        position [m²/s].
    z, H, R : ndarray, shape (m,), (m, 15), (m, m)
        The running filter's innovation, measurement matrix, covariance at factor 1.
    dx, G : ndarray, shape (15,), (15, 15)
        By which the running filter was corrected; derivative of the error about the corrected
        state by the one that H refers to.
    tail_dof : float
        Degrees of freedom of an innovation.

    Returns
    -------
    P, offset, log_likelihood : ndarray, shape (120, n), (15, n), (n,)
        After the update, and the log-likelihood of the innovation.
    """
    count, m = P_all.shape[1], z.shape[0]
    transition, noise = _transition_and_noise(F, T, C, psd)
    before = P_all.copy()
    for i in range(3):
        place = PLACES[i, i]
        for h in range(count):
            before[place, h] += T * walk[i, h]
    P, offset = _transformed(transition, before, offset_all)
    for i in range(N_ERROR):
        for j in range(i + 1):
            a, b, c = noise[0, i, j], noise[1, i, j], noise[2, i, j]
            if a != 0.0 or b != 0.0 or c != 0.0:
                place = PLACES[i, j]
                for h in range(count):
                    P[place, h] += factors[0, h] * a + factors[1, h] * b + c

    PHt, own = np.zeros((m, N_ERROR, count)), np.empty((m, count))
    for a in range(m):
        for k in range(N_ERROR):
            if H[a, k] != 0.0:
                for i in range(N_ERROR):
                    place = PLACES[i, k]
                    for h in range(count):
                        PHt[a, i, h] += H[a, k] * P[place, h]
    S, white = np.empty((m, m)), np.empty(m)
    weight, log_likelihood = np.ones(count), np.empty(count)
    for h in range(count):
        for repeat in range(2):
            for a in range(m):
                white[a] = z[a]
                for k in range(N_ERROR):
                    white[a] -= H[a, k] * offset[k, h]
                for b in range(a + 1):
                    S[a, b] = weight[h] * factors[2, h] * R[a, b]
                    for k in range(N_ERROR):
                        S[a, b] += H[a, k] * PHt[b, k, h]
            nis, log_det = _whiten(S, white)
            if repeat == 0:
                tail = np.log1p(nis / (tail_dof - 1.3))
                log_likelihood[h] = -0.5 * log_det - 0.5 * (tail_dof + m) * tail
                if nis <= m:
                    break
                # An outlier is weighted down, by each hypothesis for itself.
                weight[h] = (tail_dof + nis) / (tail_dof + m)
        for a in range(m):
            own[a, h] = white[a]
            # With S = L L' and W = P H' L'^-1: K z = W L^-1 z and P - K H P = P - W W'.
            for i in range(N_ERROR):
                for b in range(a):
                    PHt[a, i, h] -= S[a, b] * PHt[b, i, h]
                PHt[a, i, h] /= S[a, a]
    for i in range(N_ERROR):
        for h in range(count):
            offset[i, h] -= dx[i]
        for a in range(m):
            for h in range(count):
                offset[i, h] += PHt[a, i, h] * own[a, h]
            for j in range(i, N_ERROR):
                place = PLACES[i, j]
                for h in range(count):
                    P[place, h] -= PHt[a, i, h] * PHt[a, j, h]
    if not _is_identity(G):
        P, offset = _transformed(G, P, offset)
    return P, offset, log_likelihood


@register_jitable
def _is_identity(A):  # type: ignore[no-untyped-def]
    for i in range(N_ERROR):
        for j in range(N_ERROR):
            if A[i, j] != (1.0 if i == j else 0.0):
                return False
    return True


@register_jitable
def _transformed(A, P_all, offset_all):  # type: ignore[no-untyped-def]
    """Return A P A' and A times the offset, of every hypothesis."""
    count = P_all.shape[1]
    P, offset = np.zeros_like(P_all), np.zeros_like(offset_all)
    half = np.empty((N_ERROR, count))
    for i in range(N_ERROR):  # a row of A P at a time, three columns of A at a time
        half[:] = 0.0
        for k in range(0, N_ERROR, 3):
            u, v, w = A[i, k], A[i, k + 1], A[i, k + 2]
            if u == 0.0 and v == 0.0 and w == 0.0:
                continue
            for h in range(count):
                offset[i, h] += (
                    u * offset_all[k, h] + v * offset_all[k + 1, h] + w * offset_all[k + 2, h]
                )
            for j in range(N_ERROR):
                at, at1, at2 = PLACES[k, j], PLACES[k + 1, j], PLACES[k + 2, j]
                for h in range(count):
                    half[j, h] += u * P_all[at, h] + v * P_all[at1, h] + w * P_all[at2, h]
        for j in range(i + 1):
            place = PLACES[i, j]
            for k in range(0, N_ERROR, 3):
                u, v, w = A[j, k], A[j, k + 1], A[j, k + 2]
                if u == 0.0 and v == 0.0 and w == 0.0:
                    continue
                for h in range(count):
                    P[place, h] += u * half[k, h] + v * half[k + 1, h] + w * half[k + 2, h]
    return P, offset


@register_jitable
def _transition_and_noise(F, T, C, psd):  # type: ignore[no-untyped-def]
    """Return exp(F T) and the Q^d of accelerometer, gyroscope and biases, (15, 15), (3, 15, 15)."""
    n = N_ERROR
    square, cube = np.empty((n, n)), np.empty((n, n))
    transition, half = np.empty((n, n)), np.empty((n, n))
    _product(F, F, square)
    _product(square, F, cube)
    for i in range(n):
        for j in range(n):
            one = 1.0 if i == j else 0.0
            first, second, third = T * F[i, j], T * T * square[i, j], T * T * T * cube[i, j]
            transition[i, j] = one + first + 0.5 * second + third / 6.0
            half[i, j] = one + 0.5 * first + 0.125 * second
    density, noise = np.zeros((3, n, n)), np.empty((3, n, n))
    for i in range(3):
        for j in range(3):
            for k in range(3):
                density[0, 3 + i, 3 + j] += C[i, k] * C[j, k] * psd[k]
                density[1, 6 + i, 6 + j] += C[i, k] * C[j, k] * psd[3 + k]
        density[2, 9 + i, 9 + i] = psd[6 + i]
        density[2, 12 + i, 12 + i] = psd[9 + i]
    for s in range(3):  # Simpson's rule over the interval
        for i in range(n):
            for j in range(n):
                noise[s, i, j] = T / 6.0 * density[s, i, j]
        for k in range(3 + 3 * s, 6 + 3 * s if s < 2 else n, 3):
            _add_sandwich(4.0 * T / 6.0, half, density[s], k, noise[s])
            _add_sandwich(T / 6.0, transition, density[s], k, noise[s])
    return transition, noise


@register_jitable
def _whiten(S, z):  # type: ignore[no-untyped-def]
    """Turn S (its lower triangle) into its Cholesky factor L, z into L^-1 z; NIS, log det of S."""
    factorise(S)
    nis, log_det = 0.0, 0.0
    for i in range(z.shape[0]):
        for k in range(i):
            z[i] -= S[i, k] * z[k]
        z[i] /= S[i, i]
        nis += z[i] * z[i]
        log_det += 2.0 * np.log(S[i, i])
    return nis, log_det


@register_jitable
def _add_sandwich(weight, A, D, first, out):  # type: ignore[no-untyped-def]
    """Add weight A D A' to ``out`` (15, 15), of the 3 x 3 block of D from ``first`` on."""
    for i in range(N_ERROR):
        u, v, w = 0.0, 0.0, 0.0
        for k in range(first, first + 3):
            u += weight * A[i, k] * D[k, first]
            v += weight * A[i, k] * D[k, first + 1]
            w += weight * A[i, k] * D[k, first + 2]
        if u != 0.0 or v != 0.0 or w != 0.0:
            for j in range(N_ERROR):
                out[i, j] += u * A[j, first] + v * A[j, first + 1] + w * A[j, first + 2]


@register_jitable
def _product(A, B, out):  # type: ignore[no-untyped-def]
    """Write A B into ``out``, all of shape (15, 15)."""
    for i in range(N_ERROR):
        for j in range(N_ERROR):
            out[i, j] = 0.0
        for k in range(N_ERROR):
            a = A[i, k]
            if a != 0.0:
                for j in range(N_ERROR):
                    out[i, j] += a * B[k, j]
