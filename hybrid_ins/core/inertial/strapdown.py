"""
Strapdown mechanisation in NED on the rotating WGS-84 Earth.

Two consecutive IMU samples are taken as a linear course between them; attitude and velocity
increments carry the coning and sculling terms of that course, so that the step's error is of third
order in its length.

References
----------
.. [1] P. Groves, *Principles of GNSS, Inertial, and Multisensor Integrated Navigation Systems*,
       2nd ed., sections 5.4-5.5.
.. [2] P. Savage, "Strapdown inertial navigation integration algorithm design", parts 1-2, JGCD
       21(1-2), 1998.
.. [3] B. Or, I. Klein, "A hybrid model and learning-based adaptive navigation filter", IEEE TIM
       2022, eq. (28)-(31).
"""

from __future__ import annotations

import numpy as np
from numba.extending import register_jitable

from hybrid_ins.core.inertial.earth import earth_rate_n, normal_gravity, radii


@register_jitable
def rotation(quat, C):  # type: ignore[no-untyped-def]
    """Write the matrix C, shape (9,) row by row, of a unit quaternion (x, y, z, w)."""
    x, y, z, w = quat[0], quat[1], quat[2], quat[3]
    xx, yy, zz = x * x, y * y, z * z
    xy, xz, yz = x * y, x * z, y * z
    wx, wy, wz = w * x, w * y, w * z
    C[0], C[1], C[2] = 1.0 - 2.0 * (yy + zz), 2.0 * (xy - wz), 2.0 * (xz + wy)
    C[3], C[4], C[5] = 2.0 * (xy + wz), 1.0 - 2.0 * (xx + zz), 2.0 * (yz - wx)
    C[6], C[7], C[8] = 2.0 * (xz - wy), 2.0 * (yz + wx), 1.0 - 2.0 * (xx + yy)


@register_jitable
def half_rotation(x, y, z):  # type: ignore[no-untyped-def]
    """
    Scale s and scalar part c of the quaternion (s x, s y, s z, c) of a rotation vector [rad].

    Series to eighth order: exact to rounding below 0.25 rad, which is 250 rad/s at 1 kHz.
    """
    a = 0.25 * (x * x + y * y + z * z)
    s = 0.5 * (1.0 - a / 6.0 * (1.0 - a / 20.0 * (1.0 - a / 42.0 * (1.0 - a / 72.0))))
    c = 1.0 - a / 2.0 * (1.0 - a / 12.0 * (1.0 - a / 30.0 * (1.0 - a / 56.0)))
    return s, c


@register_jitable
def multiply(quat, x, y, z, w):  # type: ignore[no-untyped-def]
    """Multiply ``quat`` in place by the quaternion (x, y, z, w) from the right."""
    qx, qy, qz, qw = quat[0], quat[1], quat[2], quat[3]
    quat[0] = qw * x + qx * w + qy * z - qz * y
    quat[1] = qw * y - qx * z + qy * w + qz * x
    quat[2] = qw * z + qx * y - qy * x + qz * w
    quat[3] = qw * w - qx * x - qy * y - qz * z


@register_jitable
def mechanise(lla, velocity, quat, f0, w0, f1, w1, dt, C, f_n):  # type: ignore[no-untyped-def]
    """
    Advance position, velocity and attitude in place over one IMU interval.

    Parameters
    ----------
    lla, velocity, quat : ndarray, shape (3,), (3,), (4,)
        lla [rad, rad, m], velocity_n [m/s], quaternion of C_nb; overwritten.
    f0, w0, f1, w1 : sequence of 3 float
        Bias-free specific force [m/s²] and angular rate [rad/s], b, at the interval's two ends.
    dt : float
        Length of the interval [s].
    C, f_n : ndarray, shape (9,), (3,)
        Written: C_nb at the interval's start and the mean specific force in n [m/s²], which the
        error model needs.
    """
    lat, height = lla[0], lla[2]
    vn, ve, vd = velocity[0], velocity[1], velocity[2]
    sin_lat, cos_lat = np.sin(lat), np.cos(lat)
    tan_lat = sin_lat / cos_lat
    meridian, transverse = radii(lat)
    meridian += height
    transverse += height
    ie_n, ie_d = earth_rate_n(lat)
    en_n, en_e, en_d = ve / transverse, -vn / meridian, -ve * tan_lat / transverse

    # Rotation of the body over the interval, with the coning term ([2] part 1, eq. 33).
    half_dt, twelfth = 0.5 * dt, dt * dt / 12.0
    ax = half_dt * (w0[0] + w1[0]) + twelfth * (w0[1] * w1[2] - w0[2] * w1[1])
    ay = half_dt * (w0[1] + w1[1]) + twelfth * (w0[2] * w1[0] - w0[0] * w1[2])
    az = half_dt * (w0[2] + w1[2]) + twelfth * (w0[0] * w1[1] - w0[1] * w1[0])

    # Velocity increment in the axes of the interval's start: rotation and sculling ([2] part 2).
    ux, uy, uz = half_dt * (f0[0] + f1[0]), half_dt * (f0[1] + f1[1]), half_dt * (f0[2] + f1[2])
    dx = (
        ux
        + 0.5 * (ay * uz - az * uy)
        + twelfth * (w0[1] * f1[2] - w0[2] * f1[1] + f0[1] * w1[2] - f0[2] * w1[1])
    )
    dy = (
        uy
        + 0.5 * (az * ux - ax * uz)
        + twelfth * (w0[2] * f1[0] - w0[0] * f1[2] + f0[2] * w1[0] - f0[0] * w1[2])
    )
    dz = (
        uz
        + 0.5 * (ax * uy - ay * ux)
        + twelfth * (w0[0] * f1[1] - w0[1] * f1[0] + f0[0] * w1[1] - f0[1] * w1[0])
    )

    rotation(quat, C)
    tn = C[0] * dx + C[1] * dy + C[2] * dz
    te = C[3] * dx + C[4] * dy + C[5] * dz
    td = C[6] * dx + C[7] * dy + C[8] * dz

    # The navigation frame turns meanwhile ([1] eq. 5.86 to first order).
    rn, re, rd = dt * (ie_n + en_n), dt * en_e, dt * (ie_d + en_d)
    un = tn - 0.5 * (re * td - rd * te)
    ue = te - 0.5 * (rd * tn - rn * td)
    ud = td - 0.5 * (rn * te - re * tn)
    f_n[0], f_n[1], f_n[2] = un / dt, ue / dt, ud / dt

    # Gravity and Coriolis ([1] eq. 5.54), the latter at the velocity of the interval's middle.
    gravity_n, gravity_d = normal_gravity(lat, height)
    kn, ke, kd = 2.0 * ie_n + en_n, en_e, 2.0 * ie_d + en_d
    mn = vn + 0.5 * (un + dt * (gravity_n + kd * ve - ke * vd))
    me = ve + 0.5 * (ue + dt * (kn * vd - kd * vn))
    md = vd + 0.5 * (ud + dt * (gravity_d + ke * vn - kn * ve))
    velocity[0] = vn + un + dt * (gravity_n + kd * me - ke * md)
    velocity[1] = ve + ue + dt * (kn * md - kd * mn)
    velocity[2] = vd + ud + dt * (gravity_d + ke * mn - kn * me)

    mean_n, mean_e = 0.5 * (vn + velocity[0]), 0.5 * (ve + velocity[1])
    turn = dt * mean_n / meridian
    lla[0] = lat + turn
    lla[1] += dt * mean_e / (transverse * (cos_lat - 0.5 * turn * sin_lat))
    lla[2] = height - 0.5 * dt * (vd + velocity[2])

    # quat <- exp(-w_in dt) * quat * exp(w_ib dt) with w_in at the mean velocity
    en_n = mean_e / transverse
    rn, re, rd = dt * (ie_n + en_n), -turn, dt * (ie_d - en_n * tan_lat)
    s, c = half_rotation(ax, ay, az)
    multiply(quat, s * ax, s * ay, s * az, c)
    qx, qy, qz, qw = quat[0], quat[1], quat[2], quat[3]
    s, c = half_rotation(rn, re, rd)
    nx, ny, nz = -s * rn, -s * re, -s * rd
    x = c * qx + nx * qw + ny * qz - nz * qy
    y = c * qy - nx * qz + ny * qw + nz * qx
    z = c * qz + nx * qy - ny * qx + nz * qw
    w = c * qw - nx * qx - ny * qy - nz * qz
    scale = 1.5 - 0.5 * (x * x + y * y + z * z + w * w)
    quat[0], quat[1], quat[2], quat[3] = x * scale, y * scale, z * scale, w * scale
