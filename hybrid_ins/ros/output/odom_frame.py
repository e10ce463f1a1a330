"""
The odometry that never jumps: the same motion in ``odom``, without the corrections.

Position is the integral of the corrected velocity, yaw that of the corrected turn about the
vertical; roll and pitch are the filter's own. So a correction changes where the motion goes from
here, but not where it has been, and a step is never longer than speed times time. ``odom`` differs
from the map by a translation and a turn about the vertical, which is the transform map→odom.

References
----------
REP-105 (frames).
"""

from __future__ import annotations

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray

from hybrid_ins.core.compilation import kernel
from hybrid_ins.core.inertial.strapdown import half_rotation, multiply, rotation

Array = NDArray[np.float64]

# The state: the pose in odom, the velocity there and the rate in the base frame at its time, what
# covariance height and the rest have gathered since the start, and scratch.
_QUAT, _RATE = slice(3, 7), slice(10, 13)
_HEIGHT = 13
_XX, _XY, _YY = 14, 15, 16
_XD, _YD, _XE, _YE = 17, 18, 19, 20  # of the position with d and e
_DD, _DE, _EE = 21, 22, 23
_SCRATCH = slice(24, 42)
N_LOCAL = 42
VELOCITY_ERROR_TIME = 1.0  # s, that an error of the velocity lives: from fix to fix
HEADING_WALK = 1e-7  # rad²/s, of d besides that of e
LEAST_VARIANCE = 1e-6  # m², rad²: consumers invert covariances


def start() -> Array:
    """Return the state before the first sample, shape (N_LOCAL,): odom's origin."""
    state = np.zeros(N_LOCAL)
    state[6] = 1.0
    state[[_HEIGHT, _XX, _YY, _DD]] = LEAST_VARIANCE
    return state


@kernel(allocates=False, fastmath={"contract"})
def advance(state, dt, odometry, out):  # type: ignore[no-untyped-def]
    """
    Move the pose in odom on to a sample and write its Odometry message.

    Parameters
    ----------
    state : ndarray, shape (N_LOCAL,)
        See `start`; overwritten.
    dt : float
        Time since the last sample [s]; 0 where the filter has restarted: the pose stays, and
        motion goes on from it.
    odometry : ndarray, shape (85,)
        Values of `output.odometry_values` for this sample.
    out : ndarray, shape (85,)
        Written: the same in odom. The pose's covariance is that of the way since the start.
    """
    R_map, R = state[_SCRATCH][:9], state[_SCRATCH][9:]
    rotation(odometry[3:7], R_map)
    rate = odometry[46:49]
    half = 0.5 * dt
    quat, last_rate = state[_QUAT], state[_RATE]
    x, y, z = (
        half * (rate[0] + last_rate[0]),
        half * (rate[1] + last_rate[1]),
        half * (rate[2] + last_rate[2]),
    )
    s, c = half_rotation(x, y, z)
    multiply(quat, s * x, s * y, s * z, c)
    rotation(quat, R)
    # The turn about the vertical that brings the map's attitude closest to the predicted one.
    M = (
        R[0] * R_map[0]
        + R[1] * R_map[1]
        + R[2] * R_map[2]
        + R[3] * R_map[3]
        + R[4] * R_map[4]
        + R[5] * R_map[5],
        R[3] * R_map[0]
        + R[4] * R_map[1]
        + R[5] * R_map[2]
        - R[0] * R_map[3]
        - R[1] * R_map[4]
        - R[2] * R_map[5],
    )
    yaw = np.arctan2(M[1], M[0])
    c, s = np.cos(yaw), np.sin(yaw)
    hc, hs = np.cos(0.5 * yaw), np.sin(0.5 * yaw)
    qx, qy, qz, qw = odometry[3], odometry[4], odometry[5], odometry[6]
    quat[0], quat[1], quat[2], quat[3] = (
        hc * qx - hs * qy,
        hc * qy + hs * qx,
        hc * qz + hs * qw,
        hc * qw - hs * qz,
    )

    v = odometry[43:46]
    east = R_map[0] * v[0] + R_map[1] * v[1] + R_map[2] * v[2]
    north = R_map[3] * v[0] + R_map[4] * v[1] + R_map[5] * v[2]
    velocity = (
        c * east - s * north,
        s * east + c * north,
        R_map[6] * v[0] + R_map[7] * v[1] + R_map[8] * v[2],
    )
    for i in range(3):
        state[i] += half * (state[7 + i] + velocity[i])
        state[7 + i] = velocity[i]
        state[10 + i] = rate[i]
        out[i] = state[i]
    sign = 1.0 if quat[3] >= 0.0 else -1.0
    for i in range(4):
        out[3 + i] = sign * quat[i]

    _gather(state, dt, velocity, odometry)
    for i in range(7, 43):
        out[i] = 0.0
    out[7], out[8], out[14], out[21] = state[_XX], state[_XY], state[_YY], state[_HEIGHT]
    out[12], out[18], out[42] = state[_XD], state[_YD], state[_DD]
    out[13], out[37], out[38] = out[8], out[12], out[18]
    # Roll and pitch as in the map, about odom's axes.
    a, b, d = odometry[28], odometry[29], odometry[35]
    out[28] = c * c * a - 2.0 * c * s * b + s * s * d
    out[29] = c * s * (a - d) + (c * c - s * s) * b
    out[34] = out[29]
    out[35] = s * s * a + 2.0 * c * s * b + c * c * d
    for i in range(43, 85):
        out[i] = odometry[i]


@register_jitable
def _gather(state, dt, velocity, odometry):  # type: ignore[no-untyped-def]
    """Let covariances grow over a step that ends with a velocity [m/s] in odom."""
    if dt > 0.0:
        across = (-dt * velocity[1], dt * velocity[0])  # m per radian that the motion points wrong
        x, y = state[_XD] - state[_XE], state[_YD] - state[_YE]
        wrong = state[_DD] - 2.0 * state[_DE] + state[_EE]
        state[_XX] += across[0] * (2.0 * x + across[0] * wrong)
        state[_XY] += across[0] * y + across[1] * (x + across[0] * wrong)
        state[_YY] += across[1] * (2.0 * y + across[1] * wrong)
        for i in range(2):
            state[_XD + i] += across[i] * (state[_DD] - state[_DE])
            state[_XE + i] += across[i] * (state[_DE] - state[_EE])
    noise = VELOCITY_ERROR_TIME * dt * (odometry[49] + odometry[56] + odometry[63]) / 1.5
    state[_XX] += noise
    state[_YY] += noise
    state[_HEIGHT] += noise
    growth, left = odometry[42] - state[_EE], 0.0  # another filter has an error of its own
    if dt > 0.0 and state[_EE] > 0.0:
        left = min(1.0, odometry[42] / state[_EE])
    state[_XE] *= left
    state[_YE] *= left
    state[_DE] *= left
    if left == 1.0:
        state[_DD] += growth
        state[_DE] += growth
    state[_DD] += HEADING_WALK * dt
    state[_EE] = odometry[42]


@kernel()
def advance_block(state, dt, odometry, out):  # type: ignore[no-untyped-def]
    """`advance` over many samples: ``dt`` (N,), ``odometry`` and ``out`` (N, 85)."""
    for k in range(dt.shape[0]):
        advance(state, dt[k], odometry[k], out[k])


def map_from_odom(odometry: Array, local: Array) -> tuple[Array, float]:
    """Return odom's origin in the map (3,) [m] and odom's yaw in the map [rad]; both (85,)."""
    x, y, z, w = local[3:7]
    a, b, c, d = odometry[3:7]
    # The turn between the two attitudes has but a vertical part.
    yaw = 2.0 * float(np.arctan2(-a * y + b * x + c * w - d * z, a * x + b * y + c * z + d * w))
    cos, sin = np.cos(yaw), np.sin(yaw)
    px, py, pz = local[:3]
    turned = np.array([cos * px - sin * py, sin * px + cos * py, pz])
    return odometry[:3] - turned, yaw
