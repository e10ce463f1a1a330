"""
The 15-state error model in NED: the system matrix F, and the process noise G Qc G' dt.

Each is defined once: the functions that are compiled into the filter step are those that the tests
check, F against finite differences of the mechanisation. F's zero pattern is what
``tools/generate_covariance.py`` unrolls into ``_covariance_step``.

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

from hybrid_ins.core.inertial.earth import (
    EARTH_RATE,
    ECCENTRICITY_SQ,
    GRAVITY_EQUATOR,
    SOMIGLIANA,
    gravity_gradient,
    radii,
)


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


@register_jitable(inline="always")  # a call would be 4 % of a step
def process_noise(C, psd, dt):  # type: ignore[no-untyped-def]
    """
    Return the non-zero blocks of Q^d = G Qc G' dt, eq. (7) of [3]_, over ``dt`` [s].

    G, shape (15, 12), has C_nb in the rows of the velocity and -C_nb in those of the misalignment,
    and the identity in those of the biases; [1]_ eq. 14.78.

    Parameters
    ----------
    C : ndarray, shape (9,)
        C_nb, row by row.
    psd : ndarray, shape (12,)
        Diagonal of Qc.

    Returns
    -------
    q_v, q_eps : tuple of 6 float
        Upper triangles of the blocks of velocity and misalignment, n, row by row.
    q_a, q_g : tuple of 3 float
        Diagonals of the blocks of the accelerometer and gyroscope biases.
    """
    ax, ay, az = dt * psd[0], dt * psd[1], dt * psd[2]
    gx, gy, gz = dt * psd[3], dt * psd[4], dt * psd[5]
    q_v = (
        C[0] * C[0] * ax + C[1] * C[1] * ay + C[2] * C[2] * az,
        C[0] * C[3] * ax + C[1] * C[4] * ay + C[2] * C[5] * az,
        C[0] * C[6] * ax + C[1] * C[7] * ay + C[2] * C[8] * az,
        C[3] * C[3] * ax + C[4] * C[4] * ay + C[5] * C[5] * az,
        C[3] * C[6] * ax + C[4] * C[7] * ay + C[5] * C[8] * az,
        C[6] * C[6] * ax + C[7] * C[7] * ay + C[8] * C[8] * az,
    )
    q_eps = (
        C[0] * C[0] * gx + C[1] * C[1] * gy + C[2] * C[2] * gz,
        C[0] * C[3] * gx + C[1] * C[4] * gy + C[2] * C[5] * gz,
        C[0] * C[6] * gx + C[1] * C[7] * gy + C[2] * C[8] * gz,
        C[3] * C[3] * gx + C[4] * C[4] * gy + C[5] * C[5] * gz,
        C[3] * C[6] * gx + C[4] * C[7] * gy + C[5] * C[8] * gz,
        C[6] * C[6] * gx + C[7] * C[7] * gy + C[8] * C[8] * gz,
    )
    q_a = (dt * psd[6], dt * psd[7], dt * psd[8])
    q_g = (dt * psd[9], dt * psd[10], dt * psd[11])
    return q_v, q_eps, q_a, q_g


@register_jitable
def advance(F, dt, x):  # type: ignore[no-untyped-def]
    """Overwrite ``x``, shape (15, k), by (I + F dt + (F dt)² / 2) x."""
    n, columns = x.shape
    change = x.copy()
    for order in range(1, 3):
        product = np.zeros((n, columns))
        for i in range(n):
            for k in range(n):
                element = dt / order * F[i, k]
                if element != 0.0:
                    for j in range(columns):
                        product[i, j] += element * change[k, j]
        for i in range(n):
            for j in range(columns):
                x[i, j] += product[i, j]
        change = product
