"""
Conversions between ROS and the filter: messages to samples, ENU/FLU to NED/FRD, degrees to radians.

Messages are read and filled by attribute: they may come from rclpy or from a bag. Input that cannot
be used is refused with a reason for the user, never with an exception.

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
from numpy.typing import ArrayLike, NDArray

from hybrid_ins.core.inertial.earth import LocalFrame, ecef_to_lla, lla_to_ecef
from hybrid_ins.core.inertial.rotations import (
    matrix_from_quat,
    quat_from_matrix,
    quat_from_rpy,
    rpy_from_quat,
)
from hybrid_ins.core.sensor_errors.clock_prior import ClockDrift
from hybrid_ins.core.update.measurements import PositionFix, VelocityFix
from hybrid_ins.ros.messages.cdr import ImuFields
from hybrid_ins.ros.messages.type_names import FIX

Array = NDArray[np.float64]
Message = Any
NewMessage = Callable[[str], Message]

FLIP = np.diag([1.0, -1.0, -1.0])  # FLU <-> FRD
SWAP = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])  # ENU <-> NED
APPROXIMATED, DIAGONAL, KNOWN = 1, 2, 3  # covariance types of a NavSatFix besides unknown
STATUS_FIX, STATUS_NO_FIX = 0, -1
UNKNOWN = np.eye(3)  # in place of a covariance that cannot be used
HIGHEST = 1e6  # m, of a position above the ellipsoid, or below
NEAR_POLE = 89.9  # deg, beyond which north turns too fast for a filter in NED
VERTICAL_RATIO = 2.0  # of a velocity's σ: of a receiver that has one number for all directions


def stamp_ns(stamp: Message) -> int:
    """Integer nanoseconds of a builtin_interfaces/Time."""
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def time_of(message: Message, received_ns: int | None) -> int:
    """Return a message's stamp, or when it was received where that counts [ns]."""
    return stamp_ns(message.header.stamp) if received_ns is None else received_ns


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


def first_biases(values: Mapping[str, Any]) -> tuple[Array, Array, Array, Array]:
    """Accelerometer bias to begin with and its std [m/s²], gyroscope's [rad/s], (3,) each, b."""
    bias_a, bias_g = (FLIP @ values[f"imu.{s}_bias"] for s in ("accelerometer", "gyroscope"))
    std_a, std_g = (
        np.broadcast_to(values[f"imu.{s}_bias_std"], 3) for s in ("accelerometer", "gyroscope")
    )
    return bias_a, std_a, bias_g, std_g


def clock_drift(values: Mapping[str, Any]) -> ClockDrift:
    """Drift of the fixes' clock that is to be expected [s/s]."""
    name = "gnss.time_offset.drift"
    return ClockDrift(values[name] / 1e6, values[f"{name}_std"] / 1e6)


@dataclass(frozen=True, slots=True)
class Refused:
    """Input that could not be used: the ``name`` that counts it, and the ``text`` for the user."""

    name: str
    text: str


def unusable_stamp(sensor: str, t_ns: int) -> Refused:
    """Return that a sensor's message has no stamp, or one [ns] that no clock shows."""
    if t_ns == 0:
        return Refused(f"{sensor}: zero stamp", "header.stamp is zero: the driver must set it")
    return Refused(
        f"{sensor}: negative stamp",
        f"header.stamp is {t_ns / 1e9:.0f} s: ROS counts to the year 2038, and goes on below zero; "
        "check the driver's clock and its unit (seconds)",
    )


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
            FLIP @ lever,
            np.array(values["gnss.position_std_default"]),
            values["gnss.position_std_min"],
            values["gnss.position_std_max"],
            values["gnss.velocity_std_default"],
            values["gnss.velocity_std_min"],
            values["gnss.time_offset.value"],
        )

    def position(self, message: Message, received_ns: int | None = None) -> PositionFix | Refused:
        """Convert a sensor_msgs/NavSatFix; ``received_ns`` replaces its stamp if given."""
        t_ns = time_of(message, received_ns)
        if t_ns <= 0:
            return unusable_stamp("gnss", t_ns)
        if message.status.status < STATUS_FIX:
            return Refused("gnss: no fix", f"status {message.status.status} means no fix")
        lat, lon, height = message.latitude, message.longitude, message.altitude
        if not (abs(lat) <= 90.0 and abs(lon) <= 360.0) or math.isinf(height):
            return Refused(
                "gnss: impossible position",
                f"{place_of(lat, lon)}, altitude {height:.7g} is not a position: "
                f"{cause_of(lat, lon)}",
            )
        if lat == 0.0 and lon == 0.0:
            return Refused(
                "gnss: impossible position",
                "latitude and longitude are exactly zero: the receiver has no position; the driver "
                "should report status NO_FIX",
            )
        if abs(height) > HIGHEST:
            return Refused("gnss: impossible position", f"altitude {height:g} m is not on Earth")
        if abs(lat) > NEAR_POLE:
            return Refused(
                "gnss: impossible position",
                f"latitude {lat:.7g}°: the filter cannot be used at the poles (beyond "
                f"±{NEAR_POLE:g}°)",
            )
        covariance_enu = self._position_covariance(message)
        sigma = math.sqrt(max(covariance_enu[0, 0], covariance_enu[1, 1]))
        if sigma > self.position_std_max:
            return Refused(
                "gnss: poor fix",
                f"σ {sigma:.1f} m exceeds gnss.position_std_max {self.position_std_max:g} m",
            )
        return PositionFix(
            t_ns + round(self.time_offset * 1e9),
            np.array([math.radians(lat), math.radians(lon), height]),
            SWAP @ covariance_enu @ SWAP,
            self.lever_b,
            t_ns,
        )

    def _position_covariance(self, message: Message) -> Array:
        """Covariance (3, 3) [m², ENU] to use: the message's where it is one, with the floor."""
        default = np.diag(self.position_std_default**2)
        if message.position_covariance_type in (APPROXIMATED, DIAGONAL, KNOWN):
            covariance = np.array(message.position_covariance, float).reshape(3, 3)
            if math.isnan(message.altitude):
                covariance[2, :] = covariance[:, 2] = 0.0
                covariance[2, 2] = default[2, 2]
        else:
            covariance = default
        return floor_covariance(covariance, self.position_std_min, default)

    def velocity(self, message: Message, received_ns: int | None = None) -> VelocityFix | Refused:
        """Convert a geometry_msgs/TwistWithCovarianceStamped with ENU components, likewise."""
        t_ns = time_of(message, received_ns)
        if t_ns <= 0:
            return unusable_stamp("velocity", t_ns)
        linear = message.twist.twist.linear
        velocity_enu = np.array([linear.x, linear.y, linear.z], float)
        if not np.all(np.isfinite(velocity_enu[:2])) or math.isinf(velocity_enu[2]):
            return Refused("velocity: not finite", f"{velocity_enu} m/s is not finite")
        if np.nanmax(np.abs(velocity_enu)) > 1000.0:
            return Refused(
                "velocity: absurd",
                f"{velocity_enu} m/s is too fast for a vehicle: check the driver's unit (m/s)",
            )
        default = np.diag([1.0, 1.0, VERTICAL_RATIO**2]) * self.velocity_std_default**2
        covariance = np.array(message.twist.covariance, float).reshape(6, 6)[:3, :3]
        if velocity_enu[2] == 0.0 and not covariance[2, 2] > 0.0:
            velocity_enu[2] = math.nan  # of a driver that has no vertical velocity
        is_one_number = len(set(covariance.diagonal().tolist())) == 1
        covariance = floor_covariance(covariance, self.velocity_std_min, default)
        if is_one_number and covariance[2, 2] == covariance[0, 0]:
            covariance[2, 2] *= VERTICAL_RATIO**2
        return VelocityFix(
            t_ns + round(self.time_offset * 1e9),
            np.array([velocity_enu[1], velocity_enu[0], -velocity_enu[2]]),  # up may be NaN
            SWAP @ covariance @ SWAP,
            self.lever_b,
            t_ns,
        )


def missing_covariance(message: Message) -> str:
    """Return why a NavSatFix has no covariance that can be used; empty where it has one."""
    if message.position_covariance_type not in (APPROXIMATED, DIAGONAL, KNOWN):
        return f"position_covariance_type {message.position_covariance_type} means unknown"
    east, north = float(message.position_covariance[0]), float(message.position_covariance[4])
    if not (math.isfinite(east) and math.isfinite(north)):
        return f"position_covariance {east:g}, {north:g} is not finite"
    if east <= 0.0 or north <= 0.0:
        return f"position_covariance {east:g}, {north:g} is not positive"
    covariance = np.array(message.position_covariance, dtype=float).reshape(3, 3)
    if floor_covariance(covariance, 0.0, UNKNOWN) is UNKNOWN:
        return "position_covariance is not positive definite"
    return ""


def floor_covariance(covariance: Array, std_min: float, default: Array) -> Array:
    """
    Return a covariance (3, 3) fit for use.

    The symmetric part counts. ``default`` where it is unknown (not finite, not positive
    definite: a zero or a negative variance means unknown, not perfect), of the vertical alone where
    only that is; otherwise no axis below ``std_min``, its correlations kept.
    """
    if not 0.0 < covariance[2, 2] < math.inf:
        covariance = covariance.copy()
        covariance[2, :] = covariance[:, 2] = 0.0
        covariance[2, 2] = default[2, 2]
    if not np.isfinite(covariance).all():
        return default
    covariance = 0.5 * covariance + 0.5 * covariance.T
    diagonal = covariance.diagonal()
    values = diagonal.tolist()
    if 0.0 not in values and np.count_nonzero(covariance) == 3:  # most receivers give no more
        is_known = min(values) > 1e-12 * max(values)
        return np.diag(np.maximum(diagonal, std_min**2)) if is_known else default
    variances, axes = np.linalg.eigh(covariance)
    if variances[0] <= 1e-12 * variances[2] or variances[2] <= 0.0:
        return default
    return np.asarray((axes * np.maximum(variances, std_min**2)) @ axes.T)


def fill_transform(
    transform: Message,
    t_ns: int,
    parent: str,
    child: str,
    position: ArrayLike,
    quat_xyzw: ArrayLike,
) -> None:
    """Fill a geometry_msgs/TransformStamped: pose of ``child`` in ``parent``."""
    set_stamp(transform.header.stamp, t_ns)
    transform.header.frame_id, transform.child_frame_id = parent, child
    p, q = transform.transform.translation, transform.transform.rotation
    p.x, p.y, p.z = np.asarray(position, float).tolist()
    q.x, q.y, q.z, q.w = np.asarray(quat_xyzw, float).tolist()


def imu_fields(message: Message) -> ImuFields:
    """What the filter reads of a sensor_msgs/Imu message object."""
    q, w, a = message.orientation, message.angular_velocity, message.linear_acceleration
    return ImuFields(
        stamp_ns(message.header.stamp),
        (a.x, a.y, a.z),
        (w.x, w.y, w.z),
        message.header.frame_id,
        (q.x, q.y, q.z, q.w),
        float(message.linear_acceleration_covariance[0]),
        float(message.angular_velocity_covariance[0]),
        float(message.orientation_covariance[0]),
    )


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


def place_of(latitude: float, longitude: float) -> str:
    """Return a place [deg] as text, to a centimetre."""
    return f"latitude {round(latitude, 7):.10g}, longitude {round(longitude, 7):.10g}"


def cause_of(latitude: float, longitude: float) -> str:
    """Return why a place [deg] may be none on Earth, and what to check."""
    if 90.0 < abs(latitude) <= 180.0 and abs(longitude) <= 90.0:
        return "latitude and longitude seem to be exchanged: let the driver publish them in order"
    return "check the driver's units (degrees, metres)"


def lla_from_degrees(latitude: float, longitude: float, height: float) -> Array:
    """Return a position, shape (3,) [rad, rad, m], of degrees and metres."""
    return np.array([math.radians(latitude), math.radians(longitude), height])


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

    def position(self, lla: Array) -> Array:
        """East, north, up [m], shape (3,), of latitude, longitude [rad] and height [m]."""
        return np.asarray(self.C_me @ (lla_to_ecef(lla) - self.origin_e))

    def lla(self, position_enu: Array) -> Array:
        """Latitude, longitude [rad] and height [m], shape (3,), of east, north, up [m]."""
        return ecef_to_lla(self.origin_e + self.C_me.T @ position_enu)


def set_place(place: Message, lla: Array) -> None:
    """Fill a NavSatFix's or GeoPoint's place, its longitude within 180°: [rad, rad, m]."""
    place.latitude = math.degrees(lla[0])
    place.longitude = math.degrees(math.remainder(lla[1], math.tau))
    place.altitude = float(lla[2])


def datum_fix(new: NewMessage, t_ns: int, frame_id: str, datum_lla: Array) -> Message:
    """Fill a NavSatFix with the origin of the map."""
    message = new(FIX)
    set_stamp(message.header.stamp, t_ns)
    message.header.frame_id = frame_id
    set_place(message, datum_lla)
    message.status.status = STATUS_FIX
    return message
