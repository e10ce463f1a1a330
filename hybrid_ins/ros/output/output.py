"""
From the flat state to the numbers of messages: the base frame in an ENU map, FLU axes, degrees.

These are the numbers of the messages that are published, in the messages' own order, compiled:
they are computed at the IMU's rate.

References
----------
REP-103 (units and axes), REP-105 (frames), and the definitions of the messages.
"""

from __future__ import annotations

import numpy as np
from numba.extending import register_jitable

from hybrid_ins.core.compilation import kernel
from hybrid_ins.core.inertial.earth import EARTH_RATE, ECCENTRICITY_SQ, radii, wrapped
from hybrid_ins.core.inertial.state import (
    BIAS_A,
    BIAS_G,
    LAST_W,
    LLA,
    QUAT,
    VELOCITY,
    unpack_total,
)
from hybrid_ins.core.inertial.strapdown import rotation

N_ODOMETRY = 85
N_FIX = 12
N_BIAS = 42


@kernel(fastmath={"contract"})
def odometry_values(nav, origin_e, C_me, arm_b, rate_variance, out):  # type: ignore[no-untyped-def]
    """
    Write the numbers of an Odometry message for a flat state.

    Parameters
    ----------
    nav : ndarray, shape (N_NAV,) or longer
        Flat state of the IMU.
    origin_e, C_me : ndarray, shape (3,), (3, 3)
        Datum, Earth-fixed, and the rotation from Earth-fixed to map.
    arm_b : ndarray, shape (3,)
        IMU relative to the base frame's origin [m], b.
    rate_variance : ndarray, shape (3,)
        Of one gyroscope reading [(rad/s)²], b.
    out : ndarray, shape (85,)
        Written: position (3), quaternion xyzw (4), pose covariance (36), linear (3) and angular
        velocity (3) in the base frame, twist covariance (36).
    """
    lla = nav[LLA]
    sin_lat, cos_lat, sin_lon, cos_lon = (
        np.sin(lla[0]),
        np.cos(lla[0]),
        np.sin(lla[1]),
        np.cos(lla[1]),
    )
    transverse = radii(lla[0])[1]
    horizontal = (transverse + lla[2]) * cos_lat
    ex = horizontal * cos_lon - origin_e[0]
    ey = horizontal * sin_lon - origin_e[1]
    ez = (transverse * (1.0 - ECCENTRICITY_SQ) + lla[2]) * sin_lat - origin_e[2]
    M = np.empty((3, 3))  # n to map
    for i in range(3):
        a, b, c = C_me[i, 0], C_me[i, 1], C_me[i, 2]
        M[i, 0] = -sin_lat * cos_lon * a - sin_lat * sin_lon * b + cos_lat * c
        M[i, 1] = -sin_lon * a + cos_lon * b
        M[i, 2] = -cos_lat * cos_lon * a - cos_lat * sin_lon * b - sin_lat * c
    C = np.empty(9)
    rotation(nav[QUAT], C)
    arm_n = np.empty(3)
    for i in range(3):
        arm_n[i] = C[3 * i] * arm_b[0] + C[3 * i + 1] * arm_b[1] + C[3 * i + 2] * arm_b[2]
    for i in range(3):
        out[i] = (
            C_me[i, 0] * ex
            + C_me[i, 1] * ey
            + C_me[i, 2] * ez
            - M[i, 0] * arm_n[0]
            - M[i, 1] * arm_n[1]
            - M[i, 2] * arm_n[2]
        )
    R = np.empty((3, 3))  # FLU to map
    for i in range(3):
        for j in range(3):
            r = M[i, 0] * C[j] + M[i, 1] * C[3 + j] + M[i, 2] * C[6 + j]
            R[i, j] = r if j == 0 else -r
    _write_quaternion(R, out)

    P = np.empty((15, 15))
    unpack_total(nav, P)
    # Pose: dp_base = dp - [arm_n x] eps, rotation about the map's axes -eps.
    J = np.zeros((6, 15))
    for i in range(3):
        J[i, i] = 1.0
        J[3 + i, 6 + i] = -1.0
    J[0, 7], J[0, 8] = arm_n[2], -arm_n[1]
    J[1, 6], J[1, 8] = -arm_n[2], arm_n[0]
    J[2, 6], J[2, 7] = arm_n[1], -arm_n[0]
    _write_covariance(J, M, P, out[7:43])

    # Twist: v_b = C' v - w x arm_b; angular rate relative to the Earth.
    v = nav[VELOCITY]
    ie_n, ie_d = EARTH_RATE * cos_lat, -EARTH_RATE * sin_lat
    rate, linear = np.empty(3), np.empty(3)
    for i in range(3):
        rate[i] = nav[LAST_W][i] - nav[BIAS_G][i] - C[i] * ie_n - C[6 + i] * ie_d
    swing = (
        rate[1] * arm_b[2] - rate[2] * arm_b[1],
        rate[2] * arm_b[0] - rate[0] * arm_b[2],
        rate[0] * arm_b[1] - rate[1] * arm_b[0],
    )
    for i in range(3):
        linear[i] = C[i] * v[0] + C[3 + i] * v[1] + C[6 + i] * v[2] - swing[i]
    for i in range(3):
        sign = 1.0 if i == 0 else -1.0
        out[43 + i] = sign * linear[i]
        out[46 + i] = sign * rate[i]
    J[:] = 0.0
    for i in range(3):
        J[i, 3], J[i, 4], J[i, 5] = C[i], C[3 + i], C[6 + i]
        # -C' [v x] on eps
        J[i, 6] = -(C[3 + i] * v[2] - C[6 + i] * v[1])
        J[i, 7] = -(C[6 + i] * v[0] - C[i] * v[2])
        J[i, 8] = -(C[i] * v[1] - C[3 + i] * v[0])
        J[3 + i, 12 + i] = -1.0
    J[0, 13], J[0, 14] = arm_b[2], -arm_b[1]
    J[1, 12], J[1, 14] = -arm_b[2], arm_b[0]
    J[2, 12], J[2, 13] = arm_b[1], -arm_b[0]
    T = np.zeros((3, 3))
    T[0, 0], T[1, 1], T[2, 2] = 1.0, -1.0, -1.0
    _write_covariance(J, T, P, out[49:85])
    for i in range(3):
        out[49 + 21 + 7 * i] += rate_variance[i]


@register_jitable
def _write_covariance(J, T, P, out):  # type: ignore[no-untyped-def]
    """Write A P A', with A = blockdiag(T, T) J, shape (6, 15), into ``out``, shape (36,)."""
    A = np.zeros((6, 15))
    for block in range(0, 6, 3):
        for i in range(3):
            for k in range(3):
                t = T[i, k]
                if t != 0.0:
                    for j in range(15):
                        A[block + i, j] += t * J[block + k, j]
    AP = np.zeros((6, 15))
    for i in range(6):
        for k in range(15):
            a = A[i, k]
            if a != 0.0:
                for j in range(15):
                    AP[i, j] += a * P[k, j]
    for i in range(6):
        for j in range(i, 6):
            total = 0.0
            for k in range(15):
                total += AP[i, k] * A[j, k]
            out[6 * i + j] = total
            out[6 * j + i] = total


@register_jitable
def _write_quaternion(R, out):  # type: ignore[no-untyped-def]
    """Write the quaternion xyzw, w >= 0, of a rotation matrix into ``out[3:7]``."""
    trace = R[0, 0] + R[1, 1] + R[2, 2]
    squares = (
        1.0 + 2.0 * R[0, 0] - trace,
        1.0 + 2.0 * R[1, 1] - trace,
        1.0 + 2.0 * R[2, 2] - trace,
        1.0 + trace,
    )
    sx, sy, sz = R[0, 1] + R[1, 0], R[0, 2] + R[2, 0], R[1, 2] + R[2, 1]
    dx, dy, dz = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
    if squares[3] >= max(squares[0], squares[1], squares[2]):
        x, y, z, w = dx, dy, dz, squares[3]
    elif squares[0] >= max(squares[1], squares[2]):
        x, y, z, w = squares[0], sx, sy, dx
    elif squares[1] >= squares[2]:
        x, y, z, w = sx, squares[1], sz, dy
    else:
        x, y, z, w = sy, sz, squares[2], dz
    scale = 1.0 / np.sqrt(x * x + y * y + z * z + w * w)
    if w < 0.0:
        scale = -scale
    out[3], out[4], out[5], out[6] = x * scale, y * scale, z * scale, w * scale


@kernel()
def odometry_block(rows, origin_e, C_me, arm_b, rate_variance, out):  # type: ignore[no-untyped-def]
    """`odometry_values` of many flat states ``rows``, (N, N_NAV), into ``out``, (N, 85)."""
    for k in range(rows.shape[0]):
        odometry_values(rows[k], origin_e, C_me, arm_b, rate_variance, out[k])


@kernel(fastmath={"contract"})
def fix_values(nav, arm_b, out):  # type: ignore[no-untyped-def]
    """
    Write the numbers of a NavSatFix message for a flat state.

    Parameters
    ----------
    nav : ndarray, shape (N_NAV,) or longer
        Flat state of the IMU.
    arm_b : ndarray, shape (3,)
        IMU relative to the base frame's origin [m], b; short against the Earth's radius.
    out : ndarray, shape (12,)
        Written: latitude, longitude [deg], ellipsoidal height [m] of the base frame, position
        covariance [m², ENU] (9).
    """
    lla = nav[LLA]
    C = np.empty(9)
    rotation(nav[QUAT], C)
    arm_n = np.empty(3)
    for i in range(3):
        arm_n[i] = C[3 * i] * arm_b[0] + C[3 * i + 1] * arm_b[1] + C[3 * i + 2] * arm_b[2]
    meridian, transverse = radii(lla[0])
    out[0] = np.degrees(lla[0] - arm_n[0] / (meridian + lla[2]))
    lon = lla[1] - arm_n[1] / ((transverse + lla[2]) * np.cos(lla[0]))
    out[1] = np.degrees(wrapped(lon))  # a vehicle may have crossed the date line
    out[2] = lla[2] + arm_n[2]
    P = np.empty((15, 15))
    unpack_total(nav, P)
    # dp_base = dp - [arm_n x] eps, rows east, north, up.
    A = np.zeros((3, 15))
    A[0, 1], A[1, 0], A[2, 2] = 1.0, 1.0, -1.0
    A[0, 6], A[0, 8] = -arm_n[2], arm_n[0]
    A[1, 7], A[1, 8] = arm_n[2], -arm_n[1]
    A[2, 6], A[2, 7] = -arm_n[1], arm_n[0]
    for i in range(3):
        for j in range(i, 3):
            total = 0.0
            for k in range(9):
                for m in range(9):
                    total += A[i, k] * P[k, m] * A[j, m]
            out[3 + 3 * i + j] = total
            out[3 + 3 * j + i] = total


@kernel(fastmath={"contract"})
def bias_values(nav, out):  # type: ignore[no-untyped-def]
    """
    Write the numbers of an AccelWithCovariance message for a flat state's biases.

    Parameters
    ----------
    nav : ndarray, shape (N_NAV,) or longer
        Flat state.
    out : ndarray, shape (42,)
        Written: accelerometer bias [m/s²] (3), gyroscope bias [rad/s] (3), their covariance (36),
        axes FLU.
    """
    P = np.empty((15, 15))
    unpack_total(nav, P)
    for i in range(3):
        sign = 1.0 if i == 0 else -1.0
        out[i] = sign * nav[BIAS_A][i]
        out[3 + i] = sign * nav[BIAS_G][i]
    for i in range(6):
        for j in range(6):
            sign = 1.0 if (i % 3 == 0) == (j % 3 == 0) else -1.0
            out[6 + 6 * i + j] = sign * P[9 + i, 9 + j]
