"""
The heading that a geometry_msgs/PoseWithCovarianceStamped on ``initialpose`` gives.
"""

from __future__ import annotations

import math

import numpy as np

from hybrid_ins.core.inertial.rotations import UNKNOWN_ANGLE_STD, rpy_from_quat
from hybrid_ins.resources import shortened
from hybrid_ins.ros.messages.conversions import Message, Refused, yaw_ned_from_enu

YAW_VARIANCE = 35  # its place in the covariance
DEFAULT_STD = 0.2  # rad, where the message gives no variance


def initial_yaw(message: Message, map_frame: str) -> tuple[float, float] | Refused:
    """
    Heading [rad from north] and its uncertainty of a PoseWithCovarianceStamped in the map frame.

    An empty frame_id is taken for the map's.
    """
    frame = message.header.frame_id
    if frame not in ("", map_frame):
        return Refused(
            "initialpose: other frame",
            f"the pose is in frame '{shortened(frame)}', not '{map_frame}': set RViz's fixed frame "
            "to the map",
        )
    q = message.pose.pose.orientation
    quat = np.array([q.x, q.y, q.z, q.w], float)
    norm = math.hypot(*quat)
    if not 0.9 < norm < 1.1:
        return Refused(
            "initialpose: no orientation",
            f"quaternion {quat} has norm {norm:.2f}: it has to be 1; let the sender fill "
            "pose.orientation",
        )
    variance = float(message.pose.covariance[YAW_VARIANCE])
    std = math.sqrt(variance) if math.isfinite(variance) and variance > 0.0 else DEFAULT_STD
    if std > UNKNOWN_ANGLE_STD:
        return Refused(
            "initialpose: unknown heading",
            f"covariance[{YAW_VARIANCE}], the variance of the yaw, is {variance:.3g} rad²: that "
            f"gives no heading; let the sender set it, or leave it 0 for {DEFAULT_STD:g} rad",
        )
    yaw_enu = float(rpy_from_quat(quat / norm)[2])
    return yaw_ned_from_enu(yaw_enu), std
