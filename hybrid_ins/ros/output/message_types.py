"""
The node's output topics with their types, and the bytes of messages made of reports.

Reports are serialised without message objects, which would take ten times as long.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from hybrid_ins.ros.messages.cdr import (
    LITTLE_ENDIAN,
    OdometryEncoder,
    put_count,
    put_doubles,
    put_text,
    stamped,
)
from hybrid_ins.ros.messages.conversions import STATUS_FIX, STATUS_NO_FIX, fill_transform
from hybrid_ins.ros.messages.interface import PUBLISHED
from hybrid_ins.ros.messages.type_names import TRANSFORMS
from hybrid_ins.ros.output.odom_frame import map_from_odom
from hybrid_ins.ros.reporting.reports import (
    Diagnostics,
    MapOdometry,
    Odometry,
    Position,
    Report,
    Status,
    Vector,
)

Message = Any

OUTPUTS = {topic.name: topic.type_name for topic in PUBLISHED if topic.type_name != TRANSFORMS}


def encode(report: Report, hardware_id: str = "") -> bytes:
    """
    Return the serialised message of a report.

    Parameters
    ----------
    report : Report
    hardware_id : str
        Of a status: what it is about.
    """
    content = report.content
    if isinstance(content, Status):
        message = bytearray(LITTLE_ENDIAN)
        _put_status(message, content, hardware_id)
        return bytes(message)
    if isinstance(content, Diagnostics):
        message = stamped(content.t_ns, "")
        put_count(message, len(content.statuses))
        for status in content.statuses:
            _put_status(message, status, hardware_id)
        return bytes(message)
    if isinstance(content, MapOdometry):
        encoder = OdometryEncoder(content.frame_id, content.child_frame_id)
        return encoder.encode_values(content.t_ns, content.values)
    message = stamped(content.t_ns, content.frame_id)
    if isinstance(content, Position):
        message.append((STATUS_FIX if content.has_fix else STATUS_NO_FIX) & 0xFF)
        message += bytes(2 + len(message) % 2)  # no service is known
        longitude = math.remainder(content.longitude, 360.0)  # fixes may have 0 to 360°
        place = content.latitude, longitude, content.height
        put_doubles(message, place, content.covariance_enu)
        message.append(content.covariance_type)
    elif isinstance(content, Vector):
        put_doubles(message, content.xyz)
    else:
        put_doubles(message, content.accelerometer, content.gyroscope, content.covariance)
    return bytes(message)


def _put_status(message: bytearray, status: Status, hardware_id: str) -> None:
    message.append(status.level)
    for text in (status.name, status.text, hardware_id):
        put_text(message, text)
    put_count(message, len(status.values))
    for key, value in status.values:
        put_text(message, key)
        put_text(message, value)


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
