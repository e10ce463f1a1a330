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

from hybrid_ins.ros.messages import type_names

MESSAGES = {
    type_names.ODOMETRY: Odometry,
    type_names.FIX: NavSatFix,
    type_names.IMU: Imu,
    type_names.PRESSURE: FluidPressure,
    type_names.TWIST: TwistWithCovarianceStamped,
    type_names.VECTOR: Vector3Stamped,
    type_names.ACCELERATION: AccelWithCovarianceStamped,
    type_names.STATUS: DiagnosticStatus,
    type_names.DIAGNOSTICS: DiagnosticArray,
}


def new_message(type_name: str) -> Any:
    """Return an empty message of one of the types in ``MESSAGES``."""
    return MESSAGES[type_name]()
