"""
Linear algebra of small symmetric matrices, written out as loops.

The matrices have at most six rows: loops compile in a tenth of the time that a library's linear
algebra takes, and run no slower.
"""

from __future__ import annotations

import numpy as np
from numba.extending import register_jitable

from hybrid_ins.core.compilation import kernel


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
    """Overwrite ``x`` (m,) by the solution of S y = x, given the Cholesky factor of S."""
    m = len(x)
    for i in range(m):
        for k in range(i):
            x[i] -= root[i, k] * x[k]
        x[i] /= root[i, i]
    for i in range(m - 1, -1, -1):
        for k in range(i + 1, m):
            x[i] -= root[k, i] * x[k]
        x[i] /= root[i, i]


@register_jitable
def whiten(root, x):  # type: ignore[no-untyped-def]
    """Overwrite ``x`` (m,) by L^-1 x and return its square, given the Cholesky factor L."""
    square = 0.0
    for i in range(len(x)):
        for k in range(i):
            x[i] -= root[i, k] * x[k]
        x[i] /= root[i, i]
        square += x[i] * x[i]
    return square


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
def regress(now, P, z, h, root):  # type: ignore[no-untyped-def]
    """
    Correct parameters by a measurement of the mean h times the parameters: a Kalman update.

    Parameters
    ----------
    now, P : ndarray, shape (n,), (n, n)
        Parameters and their covariance; overwritten.
    z, h : ndarray, shape (m,), (m, n)
        Measurement.
    root : ndarray, shape (m, m)
        Cholesky factor of the covariance of its error.
    """
    m, n = h.shape
    rest, white, g = z.copy(), h.copy(), np.empty(n)
    whiten(root, rest)
    for j in range(n):
        whiten(root, white[:, j])
    for a in range(m):
        missing, variance = rest[a], 1.0
        for i in range(n):
            g[i] = 0.0
            for j in range(n):
                g[i] += P[i, j] * white[a, j]
        for j in range(n):
            missing -= white[a, j] * now[j]
            variance += white[a, j] * g[j]
        for i in range(n):
            now[i] += g[i] * missing / variance
            for j in range(n):
                P[i, j] -= g[i] * (g[j] / variance)


@register_jitable
def mean_square(z, h, now, root):  # type: ignore[no-untyped-def]
    """Return the normalised square of z - h now, over its dimension; see `regress`."""
    m, n = h.shape
    rest = z.copy()
    for a in range(m):
        for j in range(n):
            rest[a] -= h[a, j] * now[j]
    return whiten(root, rest) / m
