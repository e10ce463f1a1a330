"""
The 15-state error model in NED: F, G, and their discretisation.

``system_matrix`` is the one definition of F: the reference that tests check against finite
differences of the mechanisation, and the text that is compiled into the filter step. Its zero
pattern is what ``tools/generate_covariance.py`` unrolls into ``covariance_step``.

With errors as true minus estimated and ``C_nb(true) = (I - [eps x]) C_nb(estimated)``, a white
reading noise enters the velocity through C_nb and the misalignment through -C_nb. (The paper's
eq. (4) prints these rows one block too high.)

References
----------
.. [1] P. Groves, *Principles of GNSS, Inertial, and Multisensor Integrated Navigation Systems*,
       2nd ed., section 14.2.4.
.. [2] J. Farrell, *Aided Navigation*, 2008, section 11.4.
.. [3] B. Or, I. Klein, "A hybrid model and learning-based adaptive navigation filter", IEEE TIM
       2022, eq. (1)-(7).
"""

from __future__ import annotations

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray

from hybrid_ins.core.earth import (
    EARTH_RATE,
    ECCENTRICITY_SQ,
    GRAVITY_EQUATOR,
    SOMIGLIANA,
    gravity_gradient,
    radii,
)
from hybrid_ins.core.state import B_A, B_G, DV, EPS, N_ERROR, N_NOISE, W_A, W_AB, W_G, W_GB

Array = NDArray[np.float64]


@register_jitable
def system_matrix(lla, velocity, f_n, C, F):  # type: ignore[no-untyped-def]
    """
    Write the non-zero elements of F, eq. (3) of [3]_ in full, into ``F``, shape (15, 15).

    Parameters
    ----------
    lla, velocity : ndarray, shape (3,)
        lla [rad, rad, m] and velocity_n [m/s] of the estimate.
    f_n : ndarray, shape (3,)
        Specific force [m/s²], n.
    C : ndarray, shape (9,)
        C_nb, row by row.
    F : ndarray, shape (15, 15)
        Zero wherever this function does not write.
    """
    lat, height = lla[0], lla[2]
    vn, ve, vd = velocity[0], velocity[1], velocity[2]
    sin_lat, cos_lat = np.sin(lat), np.cos(lat)
    tan_lat = sin_lat / cos_lat
    meridian, transverse = radii(lat)
    w = 1.0 - ECCENTRICITY_SQ * sin_lat * sin_lat
    d_meridian = 3.0 * meridian * ECCENTRICITY_SQ * sin_lat * cos_lat / w
    d_transverse = transverse * ECCENTRICITY_SQ * sin_lat * cos_lat / w
    rm, rt = 1.0 / (meridian + height), 1.0 / (transverse + height)
    ie_n, ie_d = EARTH_RATE * cos_lat, -EARTH_RATE * sin_lat
    en_n, en_e, en_d = ve * rt, -vn * rm, -ve * tan_lat * rt
    in_n, in_e, in_d = ie_n + en_n, en_e, ie_d + en_d
    kn, ke, kd = in_n + ie_n, in_e, in_d + ie_d

    # w_in by position: north through latitude (in metres), down through height.
    g_n = rm * (ie_d - ve * d_transverse * rt * rt)
    g_e = rm * vn * d_meridian * rm * rm
    g_d = rm * (-ie_n - ve * rt / (cos_lat * cos_lat) + ve * tan_lat * d_transverse * rt * rt)
    h_n, h_e, h_d = ve * rt * rt, -vn * rm * rm, -ve * tan_lat * rt * rt

    # position
    F[0, 0], F[0, 2] = -vd * rm, vn * rm
    F[1, 0], F[1, 1], F[1, 2] = ve * tan_lat * rt, -(vd + vn * tan_lat) * rt, ve * rt
    F[0, 3] = F[1, 4] = F[2, 5] = 1.0

    # velocity by position: v x (d w_en + 2 d w_ie) + d gravity
    k_n, k_e, k_d = g_n + rm * ie_d, g_e, g_d - rm * ie_n
    root = np.sqrt(w)
    d_gravity = (
        rm
        * GRAVITY_EQUATOR
        * sin_lat
        * cos_lat
        * (
            2.0 * SOMIGLIANA / root
            + (1.0 + SOMIGLIANA * sin_lat * sin_lat) * ECCENTRICITY_SQ / (root * w)
        )
    )
    gravity_n_per_h, gravity_d_per_h = gravity_gradient(lat, height)
    F[3, 0] = ve * k_d - vd * k_e
    F[3, 2] = ve * h_d - vd * h_e - gravity_n_per_h
    F[4, 0], F[4, 2] = vd * k_n - vn * k_d, vd * h_n - vn * h_d
    F[5, 0] = vn * k_e - ve * k_n + d_gravity
    F[5, 2] = vn * h_e - ve * h_n - gravity_d_per_h

    # velocity by velocity: -[(w_en + 2 w_ie) x] + [v x] dw_en/dv
    F[3, 3], F[3, 4], F[3, 5] = vd * rm, kd - ve * tan_lat * rt, -ke
    F[4, 3], F[4, 4], F[4, 5] = -kd, (vd + vn * tan_lat) * rt, kn
    F[5, 3], F[5, 4] = ke - vn * rm, -kn - ve * rt

    # velocity by misalignment [f_n x] and accelerometer bias -C_nb
    F[3, 7], F[3, 8] = -f_n[2], f_n[1]
    F[4, 6], F[4, 8] = f_n[2], -f_n[0]
    F[5, 6], F[5, 7] = -f_n[1], f_n[0]

    # misalignment by position, velocity and itself
    F[6, 0], F[6, 2] = g_n, h_n
    F[7, 0], F[7, 2] = g_e, h_e
    F[8, 0], F[8, 2] = g_d, h_d
    F[6, 4], F[7, 3], F[8, 4] = rt, -rm, -tan_lat * rt
    F[6, 7], F[6, 8] = in_d, -in_e
    F[7, 6], F[7, 8] = -in_d, in_n
    F[8, 6], F[8, 7] = in_e, -in_n

    for i in range(3):
        for j in range(3):
            F[3 + i, 9 + j] = -C[3 * i + j]
            F[6 + i, 12 + j] = C[3 * i + j]


def noise_matrix(C_nb: Array) -> Array:
    """Return the shaping matrix G, shape (15, 12), with its rows where they belong; [1]_ 14.78."""
    G = np.zeros((N_ERROR, N_NOISE))
    G[DV, W_A] = C_nb
    G[EPS, W_G] = -C_nb
    G[B_A, W_AB] = G[B_G, W_GB] = np.eye(3)
    return G


def discretise(F: Array, G: Array, psd: Array, dt: float) -> tuple[Array, Array]:
    """
    Return Phi and Q^d, both (15, 15), over ``dt`` [s]: eq. (6) and (7) of [3]_.

    ``psd``, shape (12,), is the diagonal of Qc. The compiled step does the same on the zero
    pattern of F; a test holds the two together.
    """
    return np.eye(N_ERROR) + F * dt, (G * (psd * dt)) @ G.T
