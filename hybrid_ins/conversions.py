"""
The border between ROS and the filter: messages and samples, ENU/FLU and NED/FRD, degrees, radians.

Messages are read and filled by attribute: they may come from rclpy or from a bag. What cannot be
used is refused with a reason for the user, never with an exception.

References
----------
REP-103 (units and axes), REP-105 (frames), REP-145 (IMU), and the definitions of the messages.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from hybrid_ins.core.attitude import (
    matrix_from_quat,
    quat_from_matrix,
    quat_from_rpy,
    rpy_from_quat,
)
from hybrid_ins.core.earth import EARTH_RATE, ECCENTRICITY_SQ, LocalFrame, lla_to_ecef, radii
from hybrid_ins.core.gate import Verdict
from hybrid_ins.core.measurements import Measurement, PositionFix, VelocityFix
from hybrid_ins.core.state import (
    BIAS_G,
    COVARIANCE,
    LAST_W,
    LLA,
    QUAT,
    VELOCITY,
    NavState,
    unpack,
)
from hybrid_ins.core.strapdown import rotation
from hybrid_ins.wire import ImuFields

Array = NDArray[np.float64]
Message = Any
NewMessage = Callable[[str], Message]

FLIP = np.diag([1.0, -1.0, -1.0])  # FLU <-> FRD
SWAP = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])  # ENU <-> NED
UNKNOWN_COVARIANCE, APPROXIMATED, DIAGONAL, KNOWN = 0, 1, 2, 3
STATUS_FIX = 0
LEVELS = (b"\x00", b"\x01", b"\x02")  # OK, WARN, ERROR of DiagnosticStatus

OUTPUTS = {
    "odometry": "nav_msgs/msg/Odometry",
    "odometry/local": "nav_msgs/msg/Odometry",
    "gnss/filtered": "sensor_msgs/msg/NavSatFix",
    "q/accelerometer": "geometry_msgs/msg/Vector3Stamped",
    "q/gyroscope": "geometry_msgs/msg/Vector3Stamped",
    "imu/bias": "geometry_msgs/msg/AccelWithCovarianceStamped",
    "gnss/verdict": "diagnostic_msgs/msg/DiagnosticStatus",
    "datum": "sensor_msgs/msg/NavSatFix",
    "/diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
}


def stamp_ns(stamp: Message) -> int:
    """Integer nanoseconds of a builtin_interfaces/Time."""
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def set_stamp(stamp: Message, t_ns: int) -> None:
    """Write integer nanoseconds into a builtin_interfaces/Time."""
    seconds, nanoseconds = divmod(t_ns, 1_000_000_000)
    stamp.sec, stamp.nanosec = int(seconds), int(nanoseconds)


def yaw_ned_from_enu(yaw: float) -> float:
    """Heading from north, clockwise, of a REP-103 yaw from east, counter-clockwise [rad]."""
    return math.remainder(0.5 * math.pi - yaw, 2.0 * math.pi)


def quat_nb_from_enu(quat_xyzw: ArrayLike) -> Array:
    """C_nb as a quaternion (4,), of the FLU body's orientation in ENU."""
    return quat_from_matrix(SWAP @ matrix_from_quat(quat_xyzw) @ FLIP)


def mount_matrix(rpy: Sequence[float]) -> Array:
    """
    Matrix (3, 3) from the IMU message's axes to b (FRD of the base frame).

    ``rpy`` turns the base frame's axes into the IMU's [rad].
    """
    return np.asarray(FLIP @ matrix_from_quat(quat_from_rpy(*rpy)))


@dataclass(frozen=True, slots=True)
class Refused:
    """Input that could not be used, and why; ``name`` counts it, ``text`` tells the user."""

    name: str
    text: str


@dataclass(frozen=True, slots=True)
class GnssInput:
    """
    How GNSS messages become measurements.

    Attributes
    ----------
    lever_b : ndarray, shape (3,)
        Antenna relative to the IMU [m], b.
    position_std_default : ndarray, shape (3,)
        East, north, up [m].
    position_std_min, position_std_max, velocity_std_default, velocity_std_min : float
        [m], [m/s].
    time_offset : float
        Added to the stamps [s].
    """

    lever_b: Array
    position_std_default: Array
    position_std_min: float
    position_std_max: float
    velocity_std_default: float
    velocity_std_min: float
    time_offset: float

    @classmethod
    def from_parameters(cls, values: Mapping[str, Any]) -> GnssInput:
        """Read the ``gnss`` parameters."""
        lever = np.subtract(values["gnss.antenna_position"], values["imu.position"])
        return cls(
            FLIP @ lever, np.array(values["gnss.position_std_default"]),
            values["gnss.position_std_min"], values["gnss.position_std_max"],
            values["gnss.velocity_std_default"], values["gnss.velocity_std_min"],
            values["gnss.time_offset.value"])

    def position(self, message: Message) -> PositionFix | Refused:
        """Convert a sensor_msgs/NavSatFix."""
        t_ns = stamp_ns(message.header.stamp)
        if t_ns <= 0:
            return Refused("gnss: zero stamp", "header.stamp is zero: the driver must stamp fixes")
        if message.status.status < STATUS_FIX:
            return Refused("gnss: no fix", f"status {message.status.status} means no fix")
        lat, lon, height = message.latitude, message.longitude, message.altitude
        if not (abs(lat) <= 90.0 and abs(lon) <= 360.0) or math.isinf(height):
            return Refused("gnss: impossible position",
                           f"latitude {lat}, longitude {lon}, altitude {height} is no position")
        if abs(height) > 1e6:
            return Refused("gnss: impossible position", f"altitude {height:g} m is no position")
        if abs(lat) > 89.9:
            return Refused("gnss: impossible position",
                           f"latitude {lat:g}°: navigation in NED ends before the poles")
        covariance_enu = self._position_covariance(message)
        sigma = np.sqrt(np.diag(covariance_enu))
        if max(sigma[0], sigma[1]) > self.position_std_max:
            return Refused("gnss: poor fix",
                           f"σ {max(sigma[0], sigma[1]):.1f} m exceeds gnss.position_std_max "
                           f"{self.position_std_max:g} m")
        return PositionFix(
            t_ns + round(self.time_offset * 1e9),
            np.array([math.radians(lat), math.radians(lon), height]),
            SWAP @ covariance_enu @ SWAP, self.lever_b)

    def _position_covariance(self, message: Message) -> Array:
        """Covariance (3, 3) [m², ENU] to use: the message's where it is one, with the floor."""
        default = np.diag(self.position_std_default**2)
        if message.position_covariance_type in (APPROXIMATED, DIAGONAL, KNOWN):
            covariance = np.array(message.position_covariance, float).reshape(3, 3)
            covariance = 0.5 * (covariance + covariance.T)
            if math.isnan(message.altitude):
                covariance[2, :] = covariance[:, 2] = 0.0
                covariance[2, 2] = default[2, 2]
        else:
            covariance = default
        return floor_covariance(covariance, self.position_std_min, default)

    def velocity(self, message: Message) -> VelocityFix | Refused:
        """Convert a geometry_msgs/TwistWithCovarianceStamped with ENU components."""
        t_ns = stamp_ns(message.header.stamp)
        if t_ns <= 0:
            return Refused("velocity: zero stamp", "header.stamp is zero: the driver must stamp")
        linear = message.twist.twist.linear
        velocity_enu = np.array([linear.x, linear.y, linear.z], float)
        if not np.all(np.isfinite(velocity_enu[:2])) or math.isinf(velocity_enu[2]):
            return Refused("velocity: not finite", f"{velocity_enu} holds no velocity")
        if np.nanmax(np.abs(velocity_enu)) > 1000.0:
            return Refused("velocity: absurd", f"{velocity_enu} m/s is no vehicle's velocity")
        default = np.eye(3) * self.velocity_std_default**2
        covariance = np.array(message.twist.covariance, float).reshape(6, 6)[:3, :3]
        covariance = floor_covariance(
            0.5 * (covariance + covariance.T), self.velocity_std_min, default)
        return VelocityFix(
            t_ns + round(self.time_offset * 1e9), SWAP @ velocity_enu, SWAP @ covariance @ SWAP,
            self.lever_b)


def floor_covariance(covariance: Array, std_min: float, default: Array) -> Array:
    """
    Return a covariance (3, 3) fit for use.

    ``default`` where ``covariance`` says nothing (not finite, not positive definite: a zero or a
    negative variance means unknown, not perfect); otherwise no axis below ``std_min``, its
    correlations kept.
    """
    if not np.all(np.isfinite(covariance)):
        return default
    values, axes = np.linalg.eigh(covariance)
    if values[0] <= 1e-12 * values[2] or values[2] <= 0.0:
        return default
    return np.asarray((axes * np.maximum(values, std_min**2)) @ axes.T)


def initial_yaw(message: Message) -> tuple[float, float] | Refused:
    """
    Heading [rad from north] and its uncertainty of a PoseWithCovarianceStamped in the map frame.
    """
    q = message.pose.pose.orientation
    quat = np.array([q.x, q.y, q.z, q.w], float)
    norm = float(np.linalg.norm(quat))
    if not 0.9 < norm < 1.1:
        return Refused("initialpose: no orientation", f"quaternion {quat} has norm {norm:.2f}")
    variance = float(message.pose.covariance[35])
    std = math.sqrt(variance) if math.isfinite(variance) and variance > 0.0 else 0.2
    yaw_enu = float(rpy_from_quat(quat / norm)[2])
    return yaw_ned_from_enu(yaw_enu), std


def imu_fields(message: Message) -> ImuFields:
    """What the filter reads of a sensor_msgs/Imu message object."""
    q, w, a = message.orientation, message.angular_velocity, message.linear_acceleration
    return ImuFields(
        stamp_ns(message.header.stamp), message.header.frame_id,
        (q.x, q.y, q.z, q.w), float(message.orientation_covariance[0]),
        (w.x, w.y, w.z), float(message.angular_velocity_covariance[0]),
        (a.x, a.y, a.z), float(message.linear_acceleration_covariance[0]))


def imu_yaw(orientation_xyzw: Sequence[float], mount: Array) -> float | None:
    """
    Heading [rad from north] of b, of an IMU's orientation in ENU; None for no quaternion.

    ``mount``, shape (3, 3), leads from the IMU message's axes to b.
    """
    quat = np.array(orientation_xyzw, float)
    norm = float(np.linalg.norm(quat))
    if not 0.9 < norm < 1.1:
        return None
    C_nb = SWAP @ matrix_from_quat(quat / norm) @ mount.T
    return float(rpy_from_quat(quat_from_matrix(C_nb))[2])


class MapFrame:
    """
    The map: ENU at a datum.

    Parameters
    ----------
    datum_lla : ndarray, shape (3,)
        rad, rad, m.
    """

    def __init__(self, datum_lla: Array) -> None:
        self.datum_lla = np.asarray(datum_lla, float)
        frame = LocalFrame(self.datum_lla)
        self.origin_e = lla_to_ecef(self.datum_lla)
        self.C_me = np.ascontiguousarray(SWAP @ frame.C_en.T)


@njit(cache=True, fastmath={"contract"}, error_model="numpy")
def odometry_values(nav, origin_e, C_me, arm_b, rate_variance, out):  # type: ignore[no-untyped-def]
    """
    Write what an Odometry message says of a flat state.

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
        np.sin(lla[0]), np.cos(lla[0]), np.sin(lla[1]), np.cos(lla[1]))
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
        out[i] = (C_me[i, 0] * ex + C_me[i, 1] * ey + C_me[i, 2] * ez
                  - M[i, 0] * arm_n[0] - M[i, 1] * arm_n[1] - M[i, 2] * arm_n[2])
    R = np.empty((3, 3))  # FLU to map
    for i in range(3):
        for j in range(3):
            r = M[i, 0] * C[j] + M[i, 1] * C[3 + j] + M[i, 2] * C[6 + j]
            R[i, j] = r if j == 0 else -r
    _write_quaternion(R, out)

    P = np.empty((15, 15))
    unpack(nav[COVARIANCE], P)
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
    swing = (rate[1] * arm_b[2] - rate[2] * arm_b[1],
             rate[2] * arm_b[0] - rate[0] * arm_b[2],
             rate[0] * arm_b[1] - rate[1] * arm_b[0])
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


@njit(cache=True, fastmath={"contract"}, error_model="numpy")
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


@njit(cache=True, error_model="numpy")
def _write_quaternion(R, out):  # type: ignore[no-untyped-def]
    """Write the quaternion xyzw, w >= 0, of a rotation matrix into ``out[3:7]``."""
    trace = R[0, 0] + R[1, 1] + R[2, 2]
    squares = (1.0 + 2.0 * R[0, 0] - trace, 1.0 + 2.0 * R[1, 1] - trace,
               1.0 + 2.0 * R[2, 2] - trace, 1.0 + trace)
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


@njit(cache=True, error_model="numpy")
def odometry_block(rows, origin_e, C_me, arm_b, rate_variance, out):  # type: ignore[no-untyped-def]
    """`odometry_values` of many flat states ``rows``, (N, N_NAV), into ``out``, (N, 85)."""
    for k in range(rows.shape[0]):
        odometry_values(rows[k], origin_e, C_me, arm_b, rate_variance, out[k])


def filtered_fix(
    new: NewMessage, t_ns: int, frame_id: str, state: NavState, arm_b: Array
) -> Message:
    """Fill a NavSatFix with the base frame's position and its covariance, known in full."""
    message = new(OUTPUTS["gnss/filtered"])
    set_stamp(message.header.stamp, t_ns)
    message.header.frame_id = frame_id
    message.status.status = STATUS_FIX
    message.status.service = 0
    C_nb = matrix_from_quat(state.quat_xyzw)
    frame = LocalFrame(state.lla)
    base_lla = frame.lla(-C_nb @ arm_b)
    message.latitude = math.degrees(base_lla[0])
    message.longitude = math.degrees(base_lla[1])
    message.altitude = float(base_lla[2])
    x, y, z = C_nb @ arm_b
    J = np.hstack((np.eye(3), np.array([[0, z, -y], [-z, 0, x], [y, -x, 0]])))
    block = np.ix_([0, 1, 2, 6, 7, 8], [0, 1, 2, 6, 7, 8])
    message.position_covariance[:] = (SWAP @ (J @ state.P[block] @ J.T) @ SWAP).ravel()
    message.position_covariance_type = KNOWN
    return message


def datum_fix(new: NewMessage, t_ns: int, frame_id: str, datum_lla: Array) -> Message:
    """Fill a NavSatFix that says where the map's origin is."""
    message = new(OUTPUTS["datum"])
    set_stamp(message.header.stamp, t_ns)
    message.header.frame_id = frame_id
    message.latitude, message.longitude = map(math.degrees, datum_lla[:2])
    message.altitude = float(datum_lla[2])
    message.status.status = STATUS_FIX
    return message


def variances(new: NewMessage, t_ns: int, frame_id: str, q: Array) -> Message:
    """Fill a Vector3Stamped with per-axis variances; an axis' sign does not matter to them."""
    message = new("geometry_msgs/msg/Vector3Stamped")
    set_stamp(message.header.stamp, t_ns)
    message.header.frame_id = frame_id
    message.vector.x, message.vector.y, message.vector.z = map(float, q)
    return message


def biases(new: NewMessage, t_ns: int, frame_id: str, state: NavState) -> Message:
    """Fill an AccelWithCovarianceStamped: accelerometer bias linear, gyroscope bias angular."""
    message = new(OUTPUTS["imu/bias"])
    set_stamp(message.header.stamp, t_ns)
    message.header.frame_id = frame_id
    linear, angular = FLIP @ state.bias_a, FLIP @ state.bias_g
    accel = message.accel
    accel.accel.linear.x, accel.accel.linear.y, accel.accel.linear.z = map(float, linear)
    accel.accel.angular.x, accel.accel.angular.y, accel.accel.angular.z = map(float, angular)
    T = np.kron(np.eye(2), FLIP)
    accel.covariance[:] = (T @ state.P[9:, 9:] @ T).ravel()
    return message


def status(
    new: NewMessage, name: str, level: int, text: str, values: Mapping[str, object]
) -> Message:
    """Fill a DiagnosticStatus; level 0 OK, 1 WARN, 2 ERROR."""
    message = new("diagnostic_msgs/msg/DiagnosticStatus")
    # rclpy holds a byte as bytes, a bag's reader as int.
    message.level = LEVELS[level] if isinstance(message.level, bytes) else level
    message.name, message.message, message.hardware_id = f"hybrid_ins: {name}", text, ""
    pairs = []
    for key, value in values.items():
        pair = new("diagnostic_msgs/msg/KeyValue")
        pair.key, pair.value = key, f"{value:.6g}" if isinstance(value, float) else str(value)
        pairs.append(pair)
    message.values = pairs
    return message


def verdict_status(new: NewMessage, verdict: Verdict, time_offset: float) -> Message:
    """Fill the DiagnosticStatus that says what became of one fix."""
    measurement: Measurement = verdict.measurement
    sigma = dict(zip(("sigma_n", "sigma_e", "sigma_u"), verdict.sigma, strict=False))
    if verdict.accepted:
        text = verdict.reason or "fused"
    else:
        text = f"refused: {verdict.reason}"
    if not verdict.accepted and math.isfinite(verdict.nis):
        text += f" (NIS {verdict.nis:.1f} > {verdict.threshold:.1f})"
    return status(new, "gnss", 0 if verdict.accepted and not verdict.reset else 1, text, {
        "stamp": measurement.t_ns - round(time_offset * 1e9), "kind": measurement.kind,
        "accepted": str(verdict.accepted).lower(), "reason": verdict.reason,
        "nis": verdict.nis, "dof": len(verdict.sigma), "threshold": verdict.threshold,
        "sigma_e": sigma.get("sigma_e", math.nan), "sigma_n": sigma.get("sigma_n", math.nan),
        "sigma_u": sigma.get("sigma_u", math.nan), "time_offset": time_offset,
        "age": verdict.age,
    })
