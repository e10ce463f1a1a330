"""
Rotations: unit quaternions (x, y, z, w), matrices and roll-pitch-yaw, over any leading axes.

``quat_xyzw`` rotates from the second frame of its name to the first, like the matrix: the product
``quat_multiply(quat_ab, quat_bc)`` is ``quat_ac``.

References
----------
.. [1] J. Solà, *Quaternion kinematics for the error-state Kalman filter*, 2017, sections 1-4.
.. [2] P. Groves, *Principles of GNSS, Inertial, and Multisensor Integrated Navigation Systems*,
       2nd ed., section 2.2.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

UNKNOWN_ANGLE_STD = math.pi / math.sqrt(3.0)  # rad, of an angle of which nothing is known


def cross(a: Array, b: Array) -> Array:
    """Return a x b of two vectors (3,); `numpy.cross` takes ten times as long for one."""
    (x, y, z), (u, v, w) = a.tolist(), b.tolist()
    return np.array([y * w - z * v, z * u - x * w, x * v - y * u])


def skew(vector: ArrayLike) -> Array:
    """Matrix (..., 3, 3) with ``skew(a) @ b == cross(a, b)``, of vectors (..., 3)."""
    v = np.asarray(vector, float)
    matrix = np.zeros((*v.shape, 3))
    matrix[..., 0, 1], matrix[..., 0, 2], matrix[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    return matrix - np.swapaxes(matrix, -1, -2)


def quat_multiply(left: ArrayLike, right: ArrayLike) -> Array:
    """Product (..., 4) of two quaternions (..., 4); [1]_ eq. 12."""
    a, b = np.asarray(left, float), np.asarray(right, float)
    vector = a[..., 3:] * b[..., :3] + b[..., 3:] * a[..., :3] + np.cross(a[..., :3], b[..., :3])
    scalar = a[..., 3] * b[..., 3] - np.sum(a[..., :3] * b[..., :3], axis=-1)
    return np.concatenate((vector, scalar[..., None]), axis=-1)


def quat_conjugate(quat_xyzw: ArrayLike) -> Array:
    """The inverse rotation."""
    q = np.asarray(quat_xyzw, float)
    return np.concatenate((-q[..., :3], q[..., 3:]), axis=-1)


def quat_from_rotvec(rotvec: ArrayLike) -> Array:
    """Unit quaternions (..., 4) of rotation vectors (..., 3) [rad]; [1]_ eq. 101."""
    r = np.asarray(rotvec, float)
    angle = np.linalg.norm(r, axis=-1, keepdims=True)
    return np.concatenate((r * (0.5 * np.sinc(angle / (2.0 * np.pi))), np.cos(0.5 * angle)), -1)


def rotvec_from_quat(quat_xyzw: ArrayLike) -> Array:
    """Shortest rotation vectors (..., 3) [rad] of unit quaternions (..., 4); [1]_ eq. 103."""
    q = np.asarray(quat_xyzw, float)
    q = np.where(q[..., 3:] < 0.0, -q, q)
    sine = np.linalg.norm(q[..., :3], axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(sine, q[..., 3:])
    return q[..., :3] * np.where(sine > 1e-12, angle / np.maximum(sine, 1e-300), 2.0)


def left_jacobian(rotvec: ArrayLike) -> Array:
    """Matrices (..., 3, 3): the mean of all rotations on the way to ``rotvec``; [1]_ eq. 145."""
    cross = skew(rotvec)
    angle = np.linalg.norm(rotvec, axis=-1)[..., None, None]
    first = 0.5 * np.sinc(angle / (2.0 * np.pi)) ** 2
    large = np.maximum(angle, 1e-2)
    second = np.where(
        angle < 1e-2, (1.0 - angle**2 / 20.0) / 6.0, (large - np.sin(large)) / large**3
    )
    matrix: Array = np.eye(3) + first * cross + second * cross @ cross
    return matrix


def matrix_from_quat(quat_xyzw: ArrayLike) -> Array:
    """Rotation matrices (..., 3, 3) of unit quaternions (..., 4); [1]_ eq. 115."""
    q = np.asarray(quat_xyzw, float)
    # A single one in plain numbers: a fifth of the time.
    x, y, z, w = q.tolist() if q.ndim == 1 else np.moveaxis(q, -1, 0)
    C = np.empty((*q.shape[:-1], 3, 3))
    C[..., 0, 0], C[..., 1, 1] = 1 - 2 * (y * y + z * z), 1 - 2 * (x * x + z * z)
    C[..., 2, 2] = 1 - 2 * (x * x + y * y)
    C[..., 0, 1], C[..., 1, 0] = 2 * (x * y - w * z), 2 * (x * y + w * z)
    C[..., 0, 2], C[..., 2, 0] = 2 * (x * z + w * y), 2 * (x * z - w * y)
    C[..., 1, 2], C[..., 2, 1] = 2 * (y * z - w * x), 2 * (y * z + w * x)
    return C


def quat_from_matrix(matrix: ArrayLike) -> Array:
    """
    Unit quaternions (..., 4), w >= 0, of rotation matrices (..., 3, 3).

    All four component squares are formed and the largest is divided by, so that no rotation is
    ill-conditioned.
    """
    m = np.asarray(matrix, float)
    d = np.diagonal(m, axis1=-2, axis2=-1)
    trace = np.sum(d, axis=-1)
    rows = np.empty((*m.shape[:-2], 4, 4))  # row i holds 4 q_i * (x, y, z, w)
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        rows[..., i, i] = 1.0 + 2.0 * d[..., i] - trace
        rows[..., i, j] = rows[..., j, i] = m[..., i, j] + m[..., j, i]
        rows[..., i, 3] = rows[..., 3, i] = m[..., k, j] - m[..., j, k]
    rows[..., 3, 3] = 1.0 + trace
    best = np.argmax(np.diagonal(rows, axis1=-2, axis2=-1), axis=-1)
    q = np.take_along_axis(rows, best[..., None, None], axis=-2)[..., 0, :]
    unit: Array = q / np.copysign(np.linalg.norm(q, axis=-1, keepdims=True), q[..., 3:])
    return unit


def quat_from_rpy(roll: ArrayLike, pitch: ArrayLike, yaw: ArrayLike) -> Array:
    """Quaternions (..., 4) of turns about z (yaw), y (pitch) and x (roll) [rad]; [2]_ 2.2.1."""
    half = 0.5 * np.stack(np.broadcast_arrays(roll, pitch, yaw), axis=-1).astype(float)
    (sr, sp, sy), (cr, cp, cy) = np.moveaxis(np.sin(half), -1, 0), np.moveaxis(np.cos(half), -1, 0)
    return np.stack(
        (
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
            cr * cp * cy + sr * sp * sy,
        ),
        axis=-1,
    )


def rpy_from_quat(quat_xyzw: ArrayLike) -> Array:
    """Roll, pitch, yaw [rad], shape (..., 3), of unit quaternions (..., 4); [2]_ eq. 2.23."""
    q = np.asarray(quat_xyzw, float)
    x, y, z, w = q[..., 0], q[..., 1], q[..., 2], q[..., 3]
    return np.stack(
        (
            np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)),
            np.arcsin(np.clip(2 * (w * y - z * x), -1.0, 1.0)),
            np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)),
        ),
        axis=-1,
    )


def heading_from_quat(quat_xyzw: ArrayLike) -> float:
    """Heading [rad from north] of an attitude C_nb."""
    return float(rpy_from_quat(quat_xyzw)[2])


def slerp(first: ArrayLike, second: ArrayLike, fraction: ArrayLike) -> Array:
    """Rotation (..., 4) at ``fraction`` (...,) of the way from ``first`` to ``second``."""
    step = rotvec_from_quat(quat_multiply(quat_conjugate(first), second))
    return quat_multiply(first, quat_from_rotvec(step * np.asarray(fraction)[..., None]))
