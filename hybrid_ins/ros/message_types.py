"""
The node's output topics with their types, and messages made of reports.

Messages are filled by attribute: they may be rclpy's or those of a bag.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from hybrid_ins.ros.conversions import STATUS_FIX, STATUS_NO_FIX, fill_transform, set_stamp
from hybrid_ins.ros.interface import PUBLISHED, STATUS, TRANSFORMS
from hybrid_ins.ros.odom_frame import map_from_odom
from hybrid_ins.ros.reports import (
    Diagnostics,
    ImuBiases,
    Odometry,
    Position,
    Report,
    Status,
    Vector,
)

Message = Any
NewMessage = Callable[[str], Message]

KEY_VALUE = "diagnostic_msgs/msg/KeyValue"
OUTPUTS = {topic.name: topic.type_name for topic in PUBLISHED if topic.type_name != TRANSFORMS}


def to_message(report: Report, new: NewMessage, hardware_id: str = "") -> Message:
    """
    Return the message of a report.

    Parameters
    ----------
    report : Report
    new : callable
        Given the name of a type, returns an empty message of it, as `bags.bag.new_message`.
    hardware_id : str
        Of a status: what it is about.
    """
    content = report.content
    if isinstance(content, Status):
        return _status(content, new, hardware_id)
    message = new(OUTPUTS[report.topic])
    set_stamp(message.header.stamp, content.t_ns)
    if isinstance(content, Diagnostics):
        message.status = [_status(status, new, hardware_id) for status in content.statuses]
        return message
    message.header.frame_id = content.frame_id
    if isinstance(content, Position):
        message.status.status = STATUS_FIX if content.has_fix else STATUS_NO_FIX
        message.status.service = 0
        message.latitude, message.longitude = content.latitude, content.longitude
        message.altitude = content.height
        message.position_covariance = content.covariance_enu
        message.position_covariance_type = content.covariance_type
    elif isinstance(content, Vector):
        _set(message.vector, content.xyz)
    elif isinstance(content, ImuBiases):
        _set(message.accel.accel.linear, content.accelerometer)
        _set(message.accel.accel.angular, content.gyroscope)
        message.accel.covariance = content.covariance
    return message


def _set(vector: Message, xyz: Any) -> None:
    vector.x, vector.y, vector.z = xyz.tolist()


def _status(status: Status, new: NewMessage, hardware_id: str) -> Message:
    message = new(STATUS)
    # The level is a byte: a number in a bag's message, bytes in rclpy's.
    message.level = bytes([status.level]) if isinstance(message.level, bytes) else status.level
    message.name, message.message = status.name, status.text
    message.hardware_id = hardware_id
    message.values = [_key_value(key, value, new) for key, value in status.values]
    return message


def _key_value(key: str, value: str, new: NewMessage) -> Message:
    message = new(KEY_VALUE)
    message.key, message.value = key, value
    return message


def fill_transforms(
    transforms: Sequence[Message], odometry: Odometry, values: Mapping[str, Any]
) -> None:
    """
    Fill two geometry_msgs/TransformStamped: map→odom and odom→base after a sample.

    Parameters
    ----------
    transforms : sequence of two messages
    odometry : Odometry
    values : mapping
        Checked parameters: the names of the frames.
    """
    odom = values["odom_frame"]
    origin, yaw = map_from_odom(odometry.in_map, odometry.in_odom)
    turn = (0.0, 0.0, math.sin(0.5 * yaw), math.cos(0.5 * yaw))
    position, quat = odometry.in_odom[:3], odometry.in_odom[3:7]
    first, second = transforms
    fill_transform(first, odometry.t_ns, values["map_frame"], odom, origin, turn)
    fill_transform(second, odometry.t_ns, odom, values["base_frame"], position, quat)
