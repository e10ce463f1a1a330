"""
A whole flight in arrays, and its way into a bag on the node's topics.

What the converted and the simulated flights have in common: both end here.

==================  ===========================================  ======================
topic               type                                         frame
==================  ===========================================  ======================
/imu/data           sensor_msgs/Imu                              imu_link (FLU)
/gnss/fix           sensor_msgs/NavSatFix                        gnss_link (1)
/gnss/velocity      geometry_msgs/TwistWithCovarianceStamped     gnss_link (1), ENU axes
/truth/odometry     nav_msgs/Odometry                            map, base_link
/truth/datum        sensor_msgs/NavSatFix, once                  origin of map
==================  ===========================================  ======================

(1) base_link where the fixes are made from the reference's own positions: the antenna is there,
and ins_calibrate finds where the IMU is.

The truth's map has its origin at the first fix, noise and all: it is the map of a filter that
takes its datum from the first fix.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from operator import itemgetter
from pathlib import Path

import numpy as np

from hybrid_ins import progress
from hybrid_ins.bags.messages import Message, new_message
from hybrid_ins.bags.writer import BagWriter
from hybrid_ins.core.inertial.rotations import matrix_from_quat
from hybrid_ins.errors import InputError
from hybrid_ins.ros.messages.conversions import (
    DIAGONAL,
    FLIP,
    STATUS_FIX,
    SWAP,
    datum_fix,
    quat_nb_from_enu,
    set_place,
    set_stamp,
)
from hybrid_ins.ros.messages.trajectory import Array, Stamps, Trajectory
from hybrid_ins.ros.messages.type_names import FIX, IMU, ODOMETRY, TWIST

# 2023-01-01T00:00:00Z. Files and simulations count from zero, which ROS takes for an unset stamp.
EPOCH_NS = 1_672_531_200_000_000_000
UNKNOWN_VARIANCE = 1e6

Entry = tuple[int, int, str, Message]  # log time [ns], rank at equal times, topic, message


@dataclass(frozen=True, eq=False)
class ImuRecord:
    """IMU samples as the sensor gave them."""

    stamp_ns: Stamps  # (N,) IMU clock
    specific_force_b: Array  # (N, 3) m/s2, FRD
    angular_rate_b: Array  # (N, 3) rad/s, FRD
    quat_xyzw: Array | None = None  # (N, 4) of C_nb, where the sensor gives it
    attitude_std: Array | None = None  # (3,) rad: roll, pitch, yaw


@dataclass(frozen=True, eq=False)
class GnssRecord:
    """Fixes as the receiver gave them."""

    stamp_ns: Stamps  # (M,) reference clock
    lla: Array  # (M, 3) rad, rad, m
    position_std: Array  # (3,) m: north, east, down
    velocity_n: Array | None = None  # (M, 3) m/s
    velocity_std: Array | None = None  # (3,) m/s: north, east, down
    frame_id: str = "gnss_link"  # where the antenna is


@dataclass(frozen=True, eq=False)
class TruthRecord:
    """Reference motion; the angular rate is that over the Earth. Unknown attitude: None."""

    track: Trajectory  # stamps in the reference clock
    angular_rate_b: Array | None = None  # (K, 3) rad/s, FRD
    angular_rate_std: float = 0.0  # rad/s


def write_flight(
    path: Path | str,
    imu: ImuRecord,
    gnss: GnssRecord,
    truth: TruthRecord,
    *,
    log_offset_ns: int = 0,
    others: Iterable[Iterable[Entry]] = (),
    overwrite: bool = False,
) -> None:
    """
    Write a flight's bag, with the log times in one order.

    Parameters
    ----------
    path : Path
        Of the bag, see `BagWriter`.
    imu, gnss, truth : ImuRecord, GnssRecord, TruthRecord
    log_offset_ns : int
        From the stamps of fixes and truth to the clock of the log, which is the IMU's.
    others : iterable of iterables
        Further messages, each stream in order of log time. A stream may reuse one message object:
        each entry is written before the next one of its stream is asked for.
    overwrite : bool
        Replace an existing bag.

    Raises
    ------
    InputError
        The bag exists already.

    """
    datum = _datum_entry(gnss, truth, min(imu.stamp_ns[0], gnss.stamp_ns[0] + log_offset_ns))
    streams = [
        [datum],
        _imu_entries(imu),
        _fix_entries(gnss, log_offset_ns),
        _velocity_entries(gnss, log_offset_ns),
        odometry_entries(truth, "/truth/odometry", log_offset_ns),
        *others,
    ]
    count = imu.stamp_ns.size + gnss.stamp_ns.size + truth.track.stamp_ns.size
    entries = heapq.merge(*streams, key=itemgetter(0, 1))
    with BagWriter(path, overwrite=overwrite) as bag:
        for log_ns, _, topic, message in progress.track(entries, "writing", total=count):
            bag.write(topic, message, log_ns)


def first_datum(gnss: GnssRecord) -> Array:
    """
    Origin of the map, lla shape (3,): the first fix, rounded as its message is.

    Raises
    ------
    InputError
        There is no fix.

    """
    if not gnss.stamp_ns.size:
        raise InputError("no GNSS fix is left: shorten the outages or raise the rate")
    return np.append(np.radians(np.degrees(gnss.lla[0, :2])), gnss.lla[0, 2])


def stamps(t: Array, epoch: float = EPOCH_NS * 1e-9) -> Stamps:
    """Turn times [s] into stamps [ns]; `epoch` [s since 1970] is added, to the nanosecond."""
    return np.rint(t * 1e9).astype(np.int64) + round(epoch * 1e9)


def stamp(message: Message, stamp_ns: int, frame_id: str) -> Message:
    """Fill a message's header and return the message."""
    set_stamp(message.header.stamp, stamp_ns)
    message.header.frame_id = frame_id
    return message


def _datum_entry(gnss: GnssRecord, truth: TruthRecord, log_ns: int) -> Entry:
    datum_lla = truth.track.datum_lla
    if datum_lla is None:
        raise ValueError("the truth has no datum")
    message = datum_fix(new_message, int(gnss.stamp_ns[0]), "map", datum_lla)
    return int(log_ns), -1, "/truth/datum", message


def _imu_entries(imu: ImuRecord) -> Iterator[Entry]:
    message = new_message(IMU)
    quats = np.broadcast_to([0.0, 0.0, 0.0, 1.0], (imu.stamp_ns.size, 4))
    if imu.quat_xyzw is None or imu.attitude_std is None:
        message.orientation_covariance[0] = -1.0  # sensor_msgs/Imu: no orientation
    else:
        quats = quat_nb_from_enu(imu.quat_xyzw)  # its own inverse
        message.orientation_covariance[[0, 4, 8]] = imu.attitude_std**2
    specific_force = imu.specific_force_b @ FLIP
    angular_rate = imu.angular_rate_b @ FLIP
    for row, stamp_ns in enumerate(imu.stamp_ns.tolist()):
        stamp(message, stamp_ns, "imu_link")
        set_vector(message.linear_acceleration, specific_force[row])
        set_vector(message.angular_velocity, angular_rate[row])
        set_quaternion(message.orientation, quats[row])
        yield stamp_ns, 0, "/imu/data", message


def _fix_entries(gnss: GnssRecord, log_offset_ns: int) -> Iterator[Entry]:
    message = new_message(FIX)
    message.status.status = STATUS_FIX
    message.status.service = 1  # SERVICE_GPS
    message.position_covariance[[0, 4, 8]] = (gnss.position_std @ SWAP) ** 2
    message.position_covariance_type = DIAGONAL
    for stamp_ns, lla in zip(gnss.stamp_ns.tolist(), gnss.lla, strict=True):
        stamp(message, stamp_ns, gnss.frame_id)
        set_place(message, lla)
        yield stamp_ns + log_offset_ns, 1, "/gnss/fix", message


def _velocity_entries(gnss: GnssRecord, log_offset_ns: int) -> Iterator[Entry]:
    if gnss.velocity_n is None or gnss.velocity_std is None:
        return
    message = new_message(TWIST)
    # A receiver does not measure the rotation.
    variances = [*(gnss.velocity_std @ SWAP) ** 2, *np.full(3, UNKNOWN_VARIANCE)]
    message.twist.covariance[:] = np.diag(variances).ravel()
    for stamp_ns, velocity in zip(gnss.stamp_ns.tolist(), gnss.velocity_n @ SWAP, strict=True):
        stamp(message, stamp_ns, gnss.frame_id)
        set_vector(message.twist.twist.linear, velocity)
        yield stamp_ns + log_offset_ns, 2, "/gnss/velocity", message


def odometry_entries(truth: TruthRecord, topic: str, log_offset_ns: int = 0) -> Iterator[Entry]:
    """Yield a motion as odometry on a topic; see `write_flight`."""
    track = truth.track
    count = len(track)
    message = new_message(ODOMETRY)
    message.child_frame_id = "base_link"
    quats = np.zeros((count, 4)) if track.quat_xyzw is None else track.quat_xyzw
    C_base_map = np.swapaxes(matrix_from_quat(quats), -1, -2)
    pose_covariance = np.zeros((count, 6, 6))
    twist_covariance = np.zeros((count, 6, 6))
    linear, angular = np.zeros((count, 3)), np.zeros((count, 3))
    if track.position_cov is not None:
        pose_covariance[:, :3, :3] = track.position_cov
    if track.attitude_cov is not None:
        pose_covariance[:, 3:, 3:] = track.attitude_cov
    # Without an attitude base_link's axes are unknown, and no twist can be given in them.
    if track.quat_xyzw is not None and track.velocity_enu is not None:
        linear = (C_base_map @ track.velocity_enu[..., None])[..., 0]
        if track.velocity_cov is not None:
            twist_covariance[:, :3, :3] = track.velocity_cov
    if track.quat_xyzw is not None and truth.angular_rate_b is not None:
        angular = truth.angular_rate_b @ FLIP
        twist_covariance[:, 3:, 3:] = truth.angular_rate_std**2 * np.eye(3)
    pose, twist = message.pose.pose, message.twist.twist
    for row, stamp_ns in enumerate(track.stamp_ns.tolist()):
        stamp(message, stamp_ns, "map")
        set_vector(pose.position, track.position_enu[row])
        set_quaternion(pose.orientation, quats[row])
        set_vector(twist.linear, linear[row])
        set_vector(twist.angular, angular[row])
        message.pose.covariance = pose_covariance[row].ravel()
        message.twist.covariance = twist_covariance[row].ravel()
        yield stamp_ns + log_offset_ns, 3, topic, message


def set_vector(target: Message, vector: Array) -> None:
    """Fill a Vector3 or Point message."""
    target.x, target.y, target.z = vector.tolist()


def set_quaternion(target: Message, quat_xyzw: Array) -> None:
    """Fill a Quaternion message."""
    target.x, target.y, target.z, target.w = quat_xyzw.tolist()
