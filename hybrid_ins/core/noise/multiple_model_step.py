"""
Prediction and update of many covariances at once: a step of `NoiseMultipleModelBank`.

The hypotheses differ in their noise alone and share transition and measurement. The step is loops
over them, which the compiler turns into vector instructions, one for each element of transition and
measurement that is not zero.
"""

from __future__ import annotations

import numpy as np
from numba.extending import register_jitable

from hybrid_ins.core.inertial.earth import normal_gravity
from hybrid_ins.core.inertial.error_model import system_matrix
from hybrid_ins.core.inertial.state import LLA, N_ERROR, PLACES, QUAT, VELOCITY
from hybrid_ins.core.inertial.strapdown import rotation

N_NAVIGATION = 9  # rows of the error state that are no biases
OFFSETS = PLACES[-1, -1] + 1  # rows of covariance before the offsets'
N_ROWS = OFFSETS + N_ERROR
HALF_ROWS = np.arange(N_NAVIGATION * N_ERROR).reshape(N_NAVIGATION, N_ERROR)
OFFSET_ROWS = OFFSETS + np.arange(N_ERROR)[None, :]
GROUP, PADDED = 6, 18  # elements of a row; more at once are not turned into vector instructions


@register_jitable
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


@register_jitable
def advance(  # type: ignore[no-untyped-def]
    estimates,
    after,
    G,
    F,
    T,
    C,
    psd,
    factors,
    walk,
    slow_growth,
    stamp_std,
    z,
    H,
    R,
    roots,
    of_stamp,
    dx,
    tail_dof,
    log_likelihood,
):
    """
    Predict and update every hypothesis.

    Parameters
    ----------
    estimates : ndarray, shape (N_ROWS, n)
        One hypothesis per column: its covariance as a packed upper triangle (``OFFSETS`` rows), and
        the offset of its estimate from the running filter's.
    after : ndarray, shape (N_ROWS, n)
        Written: the same after the update.
    G : ndarray, shape (15, 15)
        Derivative by which the error that ``estimates`` refers to is still to be multiplied.
    F, T : ndarray, float
        System matrix, shape (15, 15), and the time to go [s].
    C, psd : ndarray, shape (3, 3), (12,)
        C_nb, and Qc's diagonal at factor 1.
    factors, walk : ndarray, shape (3, n)
        On the accelerometer's noise, the gyroscope's, and R; density of a random walk of
        position [m²/s].
    slow_growth : ndarray, shape (3,)
        Variance [m²] by which all have changed at the least, see `Correction`.
    stamp_std : ndarray, shape (n,)
        Standard deviation of the fix's stamp [s].
    z, H, R : ndarray, shape (m,), (m, 15), (m, m)
        The running filter's innovation, measurement matrix, covariance at factor 1 with a stamp
        that is exact.
    roots : ndarray, shape (m, n)
        Roots of the factors on R's rows and columns.
    of_stamp, dx : ndarray, shape (m, m), (15,)
        See `Correction`.
    tail_dof : float
        Degrees of freedom of an innovation.
    log_likelihood : ndarray, shape (n,)
        The log-likelihood of the innovation is added.
    """
    count, m = estimates.shape[1], z.shape[0]
    transition, noise = _transition_and_noise(F, T, C, psd)
    _transform(transition, G, estimates, after)
    _add_noise(after, transition, noise, factors, walk, T)
    _add_slow_growth(after, slow_growth, walk, T)
    padded = m + -m % 3
    PHt, own = np.zeros((padded * N_ERROR, count)), np.empty((m, count))
    HPHt, S, white = np.empty((m * m, count)), np.empty((m, m, count)), np.zeros((padded, count))
    _innovations(after, z, H, PHt, HPHt, own)
    r_factor, outlying = np.empty(count), np.ones(count)
    nis, root_det = np.empty(count), np.empty(count)
    for h in range(count):
        r_factor[h] = factors[2, h]
    for repeat in range(2):
        for a in range(m):
            for h in range(count):
                white[a, h] = own[a, h]
            for b in range(a + 1):
                place, r = m * a + b, R[a, b]
                for h in range(count):
                    S[a, b, h] = HPHt[place, h] + r_factor[h] * roots[a, h] * roots[b, h] * r
                if of_stamp[a, b] != 0.0:
                    for h in range(count):
                        S[a, b, h] += outlying[h] * stamp_std[h] ** 2 * of_stamp[a, b]
        _whiten(S, white, nis, root_det)
        if repeat == 0:
            outliers = False
            for h in range(count):
                tail = np.log1p(nis[h] / (tail_dof - 1.3))
                log_likelihood[h] -= np.log(root_det[h]) + 0.5 * (tail_dof + m) * tail
                if nis[h] > m:  # An outlier is weighted down, by each hypothesis for itself.
                    outlying[h] = (tail_dof + nis[h]) / (tail_dof + m)
                    r_factor[h] *= outlying[h]
                    outliers = True
            if not outliers:
                break
    _correct(after, S, PHt, white, dx)


@register_jitable
def _transform(transition, G, before, after):  # type: ignore[no-untyped-def]
    """
    Write A P A' and A times the offset, of every hypothesis and with A = transition G.

    The biases' rows of ``transition`` and G are those of the identity.
    """
    n, count = N_ERROR, before.shape[1]
    A = np.zeros((N_NAVIGATION, n))
    for i in range(N_NAVIGATION):
        for k in range(n):
            for j in range(n):
                A[i, j] += transition[i, k] * G[k, j]
    values, columns = np.empty((N_NAVIGATION, PADDED)), np.empty((N_NAVIGATION, PADDED), np.int64)
    _write_nonzero(A, values, columns)
    half = np.empty((N_NAVIGATION * n, count))  # A P, row by row
    for j in range(n):  # a column of P at a time stays in the processor's cache
        for i in range(N_NAVIGATION):
            _combine(values, columns, i, PLACES, j, before, half, n * i + j)
    for i in range(N_NAVIGATION):
        _combine(values, columns, i, OFFSET_ROWS, 0, before, after, OFFSETS + i)
        for j in range(i + 1):
            _combine(values, columns, j, HALF_ROWS, i, half, after, PLACES[i, j])
        for j in range(N_NAVIGATION, n):
            place, row = PLACES[i, j], n * i + j
            for h in range(count):
                after[place, h] = half[row, h]
    for row in range(PLACES[N_NAVIGATION, N_NAVIGATION], N_ROWS):
        if row < OFFSETS or row >= OFFSETS + N_NAVIGATION:
            for h in range(count):
                after[row, h] = before[row, h]


@register_jitable
def _add_noise(after, transition, noise, factors, walk, T):  # type: ignore[no-untyped-def]
    """Add the noise of the time T [s] to the covariances."""
    count = after.shape[1]
    first = 0  # of the hypotheses with a walk, which are the last
    while first < count and walk[2, first] == 0.0:
        first += 1
    for i in range(N_ERROR):
        for j in range(i + 1):
            place = PLACES[i, j]
            a, b, c = noise[0, i, j], noise[1, i, j], noise[2, i, j]
            if a != 0.0 or b != 0.0 or c != 0.0:
                for h in range(count):
                    after[place, h] += factors[0, h] * a + factors[1, h] * b + c
            a = T * transition[i, 0] * transition[j, 0]
            b = T * transition[i, 1] * transition[j, 1]
            c = T * transition[i, 2] * transition[j, 2]
            if a != 0.0 or b != 0.0 or c != 0.0:
                for h in range(first, count):
                    after[place, h] += a * walk[0, h] + b * walk[1, h] + c * walk[2, h]


@register_jitable
def _add_slow_growth(after, slow_growth, walk, T):  # type: ignore[no-untyped-def]
    """Add the change of the claimed slow error, as far as a hypothesis has none of its own."""
    for i in range(3):
        if slow_growth[i] > 0.0:
            for h in range(after.shape[1]):
                after[PLACES[i, i], h] += max(slow_growth[i] - T * walk[i, h], 0.0)


@register_jitable
def _innovations(after, z, H, PHt, HPHt, own):  # type: ignore[no-untyped-def]
    """Write P H' and H P H' (its lower triangle), row by row, and the innovation of each."""
    m, count = z.shape[0], after.shape[1]
    values, columns = np.empty((m, PADDED)), np.empty((m, PADDED), np.int64)
    _write_nonzero(H, values, columns)
    rows = np.arange(m * N_ERROR).reshape(m, N_ERROR)
    for a in range(m):
        for i in range(N_ERROR):
            _combine(values, columns, a, PLACES, i, after, PHt, rows[a, i])
        for b in range(a + 1):
            _combine(values, columns, a, rows, b, PHt, HPHt, m * a + b)
        _combine(values, columns, a, OFFSET_ROWS, 0, after, own, a)
        for h in range(count):
            own[a, h] = z[a] - own[a, h]


@register_jitable
def _whiten(S, z, nis, root_det):  # type: ignore[no-untyped-def]
    """
    Turn every S (its lower triangle) into its Cholesky factor L, and z into L^-1 z.

    Writes the square of that, and the root of the determinant of S.
    """
    m, count = S.shape[0], z.shape[1]
    for h in range(count):
        nis[h], root_det[h] = 0.0, 1.0
    for a in range(m):
        for b in range(a + 1):
            for c in range(b):
                for h in range(count):
                    S[a, b, h] -= S[a, c, h] * S[b, c, h]
            if a == b:
                for h in range(count):
                    S[a, a, h] = np.sqrt(S[a, a, h])
            else:
                for h in range(count):
                    S[a, b, h] /= S[b, b, h]
        for b in range(a):
            for h in range(count):
                z[a, h] -= S[a, b, h] * z[b, h]
        for h in range(count):
            z[a, h] /= S[a, a, h]
            nis[h] += z[a, h] * z[a, h]
            root_det[h] *= S[a, a, h]


@register_jitable
def _correct(after, L, PHt, white, dx):  # type: ignore[no-untyped-def]
    """Update by the innovations; with W = P H' L'^-1, K z = W L^-1 z and P - K H P = P - W W'."""
    m, count = L.shape[0], white.shape[1]
    for a in range(m):
        for h in range(count):
            L[a, a, h] = 1.0 / L[a, a, h]
        for i in range(N_ERROR):
            row = N_ERROR * a + i
            for b in range(a):
                other = N_ERROR * b + i
                for h in range(count):
                    PHt[row, h] -= L[a, b, h] * PHt[other, h]
            for h in range(count):
                PHt[row, h] *= L[a, a, h]
    for i in range(N_ERROR):
        offset = OFFSETS + i
        for h in range(count):
            after[offset, h] -= dx[i]
        for a in range(0, m, 3):  # three at a time: those beyond m are zero
            u, v, w = N_ERROR * a + i, N_ERROR * (a + 1) + i, N_ERROR * (a + 2) + i
            for h in range(count):
                after[offset, h] += (
                    PHt[u, h] * white[a, h]
                    + PHt[v, h] * white[a + 1, h]
                    + PHt[w, h] * white[a + 2, h]
                )
            for j in range(i, N_ERROR):
                place = PLACES[i, j]
                x, y, z = N_ERROR * a + j, N_ERROR * (a + 1) + j, N_ERROR * (a + 2) + j
                for h in range(count):
                    after[place, h] -= (
                        PHt[u, h] * PHt[x, h] + PHt[v, h] * PHt[y, h] + PHt[w, h] * PHt[z, h]
                    )


@register_jitable
def _write_nonzero(A, values, columns):  # type: ignore[no-untyped-def]
    """Write the elements of each row of A that are not zero, and their columns; then zeros."""
    for i in range(A.shape[0]):
        found = 0
        for j in range(PADDED):
            values[i, j], columns[i, j] = 0.0, 0
        for j in range(A.shape[1]):
            if A[i, j] != 0.0:
                values[i, found], columns[i, found] = A[i, j], j
                found += 1


@register_jitable
def _combine(values, columns, i, rows, j, source, out, at):  # type: ignore[no-untyped-def]
    """Write row i of a matrix, by `_write_nonzero`, times the rows[j] of ``source`` to out[at]."""
    for n in range(0, PADDED, GROUP):
        if n > 0 and values[i, n] == 0.0:
            break
        a, b, c = values[i, n], values[i, n + 1], values[i, n + 2]
        d, e, f = values[i, n + 3], values[i, n + 4], values[i, n + 5]
        at_a, at_b = rows[j, columns[i, n]], rows[j, columns[i, n + 1]]
        at_c, at_d = rows[j, columns[i, n + 2]], rows[j, columns[i, n + 3]]
        at_e, at_f = rows[j, columns[i, n + 4]], rows[j, columns[i, n + 5]]
        if n > 0:
            for h in range(out.shape[1]):
                total = a * source[at_a, h] + b * source[at_b, h] + c * source[at_c, h]
                total += d * source[at_d, h] + e * source[at_e, h] + f * source[at_f, h]
                out[at, h] += total
        elif d != 0.0:
            for h in range(out.shape[1]):
                total = a * source[at_a, h] + b * source[at_b, h] + c * source[at_c, h]
                total += d * source[at_d, h] + e * source[at_e, h] + f * source[at_f, h]
                out[at, h] = total
        else:
            for h in range(out.shape[1]):
                out[at, h] = a * source[at_a, h] + b * source[at_b, h] + c * source[at_c, h]


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
    """Write A B into ``out``, all of shape (15, 15) and with no rows of the biases."""
    for i in range(N_ERROR):
        for j in range(N_ERROR):
            out[i, j] = 0.0
    for i in range(N_NAVIGATION):
        for k in range(N_NAVIGATION):
            a = A[i, k]
            if a != 0.0:
                for j in range(N_ERROR):
                    out[i, j] += a * B[k, j]
