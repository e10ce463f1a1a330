"""
The compiled steps of the smoother: see `smoother` for what they are part of.

References
----------
.. [1] G. Bierman, "Fixed interval smoothing with discrete measurements", International Journal of
       Control 18, 1973, eq. (9)-(16).
"""

from __future__ import annotations

import numpy as np
from numba.extending import register_jitable

from hybrid_ins.core.compilation import kernel
from hybrid_ins.core.inertial.propagation import propagate_covariance, step
from hybrid_ins.core.inertial.state import (
    COVARIANCE,
    N_ERROR,
    N_NAV,
    PENDING_DT,
    SYSTEM,
    unpack,
)
from hybrid_ins.core.update.iterated_update import is_nonlinear, iterate, left_jacobian_transform
from hybrid_ins.core.update.kalman import gain, inject
from hybrid_ins.core.update.linalg import factorise, solve

FIRST_OF_P = COVARIANCE.start


@kernel(fastmath={"contract"})
def run_and_keep(nav, dt, readings, interval, rows, F, lengths, at):  # type: ignore[no-untyped-def]
    """
    Advance the flat state as `propagation.run`, and keep what the covariance steps are made of.

    Parameters
    ----------
    nav, dt, readings, interval
        See `propagation.run`. Nothing is pending in ``nav`` before and after.
    rows : ndarray, shape (N, N_NAV)
        Written: the flat state after each sample.
    F, lengths, at : ndarray, shape (N, 225), (N,), (N,)
        Written: system matrix and length [s] of each covariance step, and the row it leads to.

    Returns
    -------
    int
        Number of covariance steps.
    """
    count, pending, n = 0, 0.0, dt.shape[0]
    for k in range(n):
        s = readings[k]
        pending += dt[k]
        step(nav, dt[k], s[0], s[1], s[2], s[3], s[4], s[5], interval)
        if k == n - 1 and nav[PENDING_DT] > 0.0:
            propagate_covariance(nav)
        if nav[PENDING_DT] == 0.0:
            F[count] = nav[SYSTEM]
            lengths[count], at[count] = pending, k
            count += 1
            pending = 0.0
        for i in range(N_NAV):
            rows[k, i] = nav[i]
    return count


@register_jitable
def _product(A, B):  # type: ignore[no-untyped-def]
    """A B."""
    C = np.zeros((A.shape[0], B.shape[1]))
    for i in range(A.shape[0]):
        for k in range(A.shape[1]):
            a = A[i, k]
            if a != 0.0:
                for j in range(B.shape[1]):
                    C[i, j] += a * B[k, j]
    return C


@register_jitable
def _congruence(A, L):  # type: ignore[no-untyped-def]
    """A' L A, exactly symmetric for a symmetric L."""
    n = A.shape[1]
    LA, C = _product(L, A), np.zeros((n, n))
    for k in range(A.shape[0]):
        for i in range(n):
            a = A[k, i]
            if a != 0.0:
                for j in range(i, n):
                    C[i, j] += a * LA[k, j]
    for i in range(n):
        for j in range(i):
            C[i, j] = C[j, i]
    return C


@register_jitable
def _transition(F, length):  # type: ignore[no-untyped-def]
    """I + F dt, as in `propagation.propagate_covariance`."""
    A = np.empty((N_ERROR, N_ERROR))
    for i in range(N_ERROR):
        for j in range(N_ERROR):
            A[i, j] = length * F[N_ERROR * i + j]
        A[i, i] += 1.0
    return A


@register_jitable
def _transposed_times(A, x):  # type: ignore[no-untyped-def]
    """A' x."""
    y = np.zeros(A.shape[1])
    for k in range(A.shape[0]):
        for i in range(A.shape[1]):
            y[i] += A[k, i] * x[k]
    return y


@kernel()
def propagation_adjoint(F, lengths, costate, information):  # type: ignore[no-untyped-def]
    """
    Carry the adjoint back over covariance steps.

    Parameters
    ----------
    F, lengths : ndarray
        See `run_and_keep`.
    costate, information : ndarray, shape (15,), (15, 15)
        lambda and Lambda after the last of them.

    Returns
    -------
    costate, information : ndarray, shape (15,), (15, 15)
        Before the first.
    """
    for j in range(lengths.shape[0] - 1, -1, -1):
        A = _transition(F[j], lengths[j])
        costate = _transposed_times(A, costate)
        information = _congruence(A, information)
    return costate.copy(), information.copy()


@kernel()
def correction_adjoint(nav, z, H, R, is_linear, costate, information):  # type: ignore[no-untyped-def]
    """
    Carry the adjoint back through a correction; eq. (9)-(12) of [1]_.

    Parameters
    ----------
    nav : ndarray, shape (N_FLAT,)
        Flat state before the correction.
    z, H, R : ndarray
        See `iterated_update.update`.
    is_linear : bool
        It was `kalman.linear_update`, else `iterated_update.correct`.
    costate, information : ndarray, shape (15,), (15, 15)
        lambda and Lambda after it.

    Returns
    -------
    costate, information : ndarray, shape (15,), (15, 15)
        Before it.
    """
    packed = nav[COVARIANCE]
    dx, K = gain(packed, z, H, R)
    if not is_linear and is_nonlinear(packed, dx, H, R):
        converged, K_x, z_x, H_x, _, G = iterate(packed, z, H, R, dx, K)
        if converged:
            # What comes later speaks of the error about the corrected state, where P is G P' G'.
            costate = _transposed_times(G, costate)
            information = _congruence(G, information)
            z, H, K = z_x, H_x, K_x
    P = np.empty((N_ERROR, N_ERROR))
    unpack(packed, P)
    S = _product(H, _product(P, H.T.copy()))
    root = S + R
    factorise(root)
    weighted, SH = z.copy(), H.copy()
    solve(root, weighted)
    for j in range(N_ERROR):
        solve(root, SH[:, j])
    A = np.eye(N_ERROR) - _product(K, H)
    before = _transposed_times(A, costate) + _transposed_times(H, weighted)
    gained = _product(H.T.copy(), SH)
    return before, _congruence(A, information) + 0.5 * (gained + gained.T)


@register_jitable
def _smoothed(row, costate, information, error, P_s):  # type: ignore[no-untyped-def]
    """Write the smoothed error P lambda and its covariance P - P Lambda P."""
    P = np.empty((N_ERROR, N_ERROR))
    unpack(row[COVARIANCE], P)
    error[:] = _transposed_times(P, costate)
    lost = _congruence(P, information)
    for i in range(N_ERROR):
        for j in range(N_ERROR):
            P_s[i, j] = P[i, j] - lost[i, j]


@kernel()
def smoothed_rows(first, rows, dt, F, lengths, at, costate, information):  # type: ignore[no-untyped-def]
    """
    Return the smoothed flat states, shape (N, N_NAV), of a stretch between two updates.

    Parameters
    ----------
    first : ndarray, shape (N_NAV,)
        Flat state before the first sample.
    rows, F, lengths, at
        See `run_and_keep`; rows that no covariance step leads to are interpolated, and an ``at``
        below zero leads to none.
    dt : ndarray, shape (N,)
        Length of the steps between the rows [s].
    costate, information : ndarray, shape (15,), (15, 15)
        lambda and Lambda at the last row.
    """
    n, m = rows.shape[0], lengths.shape[0]
    errors, P_s = np.zeros((m + 1, N_ERROR)), np.zeros((m + 1, N_ERROR, N_ERROR))
    for j in range(m - 1, -1, -1):
        if at[j] >= 0:
            _smoothed(rows[at[j]], costate, information, errors[j + 1], P_s[j + 1])
        A = _transition(F[j], lengths[j])
        costate = _transposed_times(A, costate)
        information = _congruence(A, information)
    _smoothed(first, costate, information, errors[0], P_s[0])
    out = rows.copy()
    j, since = 0, 0.0
    flat, moved, G = np.empty(N_NAV), np.empty(N_ERROR), np.eye(N_ERROR)
    for k in range(n):
        if m == 0:
            share, low, high = 0.0, 0, 0
        else:
            since += dt[k]
            while at[j] < k:
                j += 1
                since = dt[k]
            share, low, high = min(since / lengths[j], 1.0), j, j + 1
            if at[j] == k:
                share = 1.0
        error = (1.0 - share) * errors[low] + share * errors[high]
        P = (1.0 - share) * P_s[low] + share * P_s[high]
        left_jacobian_transform(error, moved, G)
        P = _congruence(G.T.copy(), P)
        flat[:] = rows[k]
        inject(flat, moved)
        out[k] = flat
        place = FIRST_OF_P
        for i in range(N_ERROR):
            for c in range(i, N_ERROR):
                out[k, place] = P[i, c]
                place += 1
    return out
