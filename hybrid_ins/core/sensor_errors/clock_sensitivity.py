"""
How innovations of fixes change with their clock offset: sensitivities beside the filter's state.

A fix that was valid a time tau after its stamp is displaced by v tau. The filter follows part of
that: its state has the error s tau, and an innovation the mean h tau with h = H s + v (of a
velocity: H s + a). For the filter tau is a constant, so its sensitivity s = d(error)/d(tau) obeys
the filter's own equations, [1]_::

    s <- Phi s              with every step of the covariance (`propagation`)
    s <- s - K h            with every correction, h = H s where the measurement has no clock

The s that these give is as stable as the filter is.

Receivers deliver velocities of another age than positions: their clock offset is tau + delta. The
filter has a sensitivity to delta likewise, u, and an innovation the mean h tau + g delta, where
g = H u, of a velocity H u + a.

References
----------
.. [1] B. Friedland, "Treatment of bias in recursive filtering", IEEE Transactions on Automatic
       Control 14, 1969.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.compilation import kernel
from hybrid_ins.core.inertial.propagation import MEAN_TIME
from hybrid_ins.core.inertial.state import (
    ACCELERATION,
    AGE_SENSITIVITY,
    DP,
    DV,
    N_ERROR,
    PSD,
    QUAT,
    SENSITIVITY,
    VELOCITY,
)
from hybrid_ins.core.inertial.strapdown import rotation
from hybrid_ins.core.update.linalg import factorise, whiten

Array = NDArray[np.float64]

OF_CORRECTIONS = 4.0  # variance of v in h against that of its corrections: 1.6 to 3.9 in 12 motions


def initial_sensitivity(velocity_n: Array, acceleration_n: Array) -> Array:
    """Return the sensitivity, shape (15,), of a state that was read off the fixes."""
    s = np.zeros(N_ERROR)
    s[DP], s[DV] = -velocity_n, -acceleration_n
    return s


@kernel()
def sensitivities(nav, H):  # type: ignore[no-untyped-def]
    """
    Return how an innovation of fixes changes with the clock offset and with the age of velocities.

    Parameters
    ----------
    nav : ndarray, shape (N_FLAT,)
        Flat state before the correction.
    H : ndarray, shape (m, 15)
        Measurement matrix.

    Returns
    -------
    h : ndarray, shape (m, 2)
        H s + v and H u of a position, H s + a and H u + a of a velocity.
    change : ndarray, shape (m,)
        a of a velocity: how it changes with its stamp.
    """
    m = H.shape[0]
    s, u = nav[SENSITIVITY], nav[AGE_SENSITIVITY]
    velocity, acceleration = nav[VELOCITY], nav[ACCELERATION]
    h, change = np.zeros((m, 2)), np.zeros(m)
    for a in range(m):
        for i in range(N_ERROR):
            h[a, 0] += H[a, i] * s[i]
            h[a, 1] += H[a, i] * u[i]
        for i in range(3):
            h[a, 0] += H[a, i] * velocity[i]
            change[a] += H[a, 3 + i] * acceleration[i]
        h[a, 0] += change[a]
        h[a, 1] += change[a]
    return h, change


@kernel()
def correct_sensitivities(nav, H, K, h, dx, by_position):  # type: ignore[no-untyped-def]
    """
    Correct s and u with the state: s <- s - K h, where v in h is the corrected velocity.

    Parameters
    ----------
    nav : ndarray, shape (N_FLAT,)
        Flat state; its sensitivities are overwritten.
    H, K : ndarray, shape (m, 15), (15, m)
        Measurement matrix and gain.
    h : ndarray, shape (m, 2)
        `sensitivities` before the correction, or H s and H u where the measurement has no clock.
    dx : ndarray, shape (15,)
        Correction of the state.
    by_position : bool
        A fix of the position corrects, so that h contains v.
    """
    s, u = nav[SENSITIVITY], nav[AGE_SENSITIVITY]
    for a in range(H.shape[0]):
        to_offset = h[a, 0]
        if by_position:
            for i in range(3):
                to_offset += H[a, i] * dx[3 + i]
        for i in range(N_ERROR):
            s[i] -= K[i, a] * to_offset
            u[i] -= K[i, a] * h[a, 1]


@kernel()
def noise_information(nav, H, K, S, is_position):  # type: ignore[no-untyped-def]
    """
    Return how much an innovation would say of the clock offset if nothing moved.

    Parameters
    ----------
    nav : ndarray, shape (N_FLAT,)
        Flat state.
    H, K, S : ndarray, shape (m, 15), (15, m), (m, m)
        Measurement matrix, gain and covariance of the innovation.
    is_position : bool
        Otherwise of a velocity.

    Returns
    -------
    float
        trace(S^-1 N) [1/s²], where N is the covariance of the error of h: the variance of the
        velocity that a position corrects, or of the mean acceleration.
    """
    m = H.shape[0]
    root, error, total = S.copy(), np.zeros((3, m)), 0.0  # error' error is N
    factorise(root)
    if is_position:
        for a in range(m):
            for c in range(m):
                correction = 0.0
                for i in range(3):
                    correction += H[a, i] * K[3 + i, c]
                for b in range(c + 1):
                    error[b, a] += np.sqrt(OF_CORRECTIONS) * correction * root[c, b]
    else:
        C, q = np.empty(9), nav[PSD]
        rotation(nav[QUAT], C)
        for a in range(m):
            for i in range(3):
                error[i, a] = C[3 * a + i] * np.sqrt(q[i] / MEAN_TIME)
    for i in range(3):
        total += whiten(root, error[i])
    return total
