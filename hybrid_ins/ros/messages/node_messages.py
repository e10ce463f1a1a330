"""
The node's message classes by the names of their types.
"""

from __future__ import annotations

from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import (
    AccelWithCovarianceStamped,
    TwistWithCovarianceStamped,
    Vector3Stamped,
)
from nav_msgs.msg import Odometry
from sensor_msgs.msg import FluidPressure, Imu, NavSatFix

MESSAGES = {
    "nav_msgs/msg/Odometry": Odometry,
    "sensor_msgs/msg/NavSatFix": NavSatFix,
    "sensor_msgs/msg/Imu": Imu,
    "sensor_msgs/msg/FluidPressure": FluidPressure,
    "geometry_msgs/msg/TwistWithCovarianceStamped": TwistWithCovarianceStamped,
    "geometry_msgs/msg/Vector3Stamped": Vector3Stamped,
    "geometry_msgs/msg/AccelWithCovarianceStamped": AccelWithCovarianceStamped,
    "diagnostic_msgs/msg/DiagnosticStatus": DiagnosticStatus,
    "diagnostic_msgs/msg/DiagnosticArray": DiagnosticArray,
}


def new_message(type_name: str) -> Any:
    """Return an empty message of one of the types in ``MESSAGES``."""
    return MESSAGES[type_name]()
