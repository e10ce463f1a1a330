"""Twists of wheels: which axes they measure, by variances that drivers leave at zero."""

import math
from typing import Any

import numpy as np
import pytest

from hybrid_ins import parameters
from hybrid_ins.bags.messages import new_message
from hybrid_ins.core.aiding.measurements import BodyVelocity
from hybrid_ins.ros.messages.aiding_conversions import AidingMessages, substituted
from hybrid_ins.ros.messages.conversions import Refused, set_stamp

MESSAGES = AidingMessages.from_parameters(parameters.defaults(), np.zeros(3))
STD = MESSAGES.velocity_std_min


def odometry(variance: tuple[float, float, float], x: float = 3.0, cross: float = 0.0) -> Any:
    """Return the odometry of wheels that turn."""
    message = new_message("nav_msgs/msg/Odometry")
    set_stamp(message.header.stamp, 1_000_000_000)
    message.twist.twist.linear.x = x
    covariance = np.full((6, 6), cross)
    covariance[range(3), range(3)] = variance
    message.twist.covariance = covariance.ravel()
    return message


@pytest.mark.parametrize(
    ("variance", "std"),
    [
        ((0.0, 1e6, 1e6), STD),
        ((0.0, 0.0, 1e6), STD),
        ((0.0, -1.0, -1.0), STD),
        ((0.0, 0.0, 0.0), STD),
        ((0.04, 1e6, 1e6), 0.2),
        ((1e-9, 1e6, 1e6), STD),
    ],
)
def test_wheels_count_along_the_nose_whatever_their_driver_leaves_at_zero(
    variance: tuple[float, float, float], std: float
) -> None:
    found = MESSAGES.odometry(odometry(variance, cross=0.001 if std == 0.2 else 0.0))

    assert isinstance(found, BodyVelocity)
    assert found.velocity_b[0] == 3.0 and np.isnan(found.velocity_b[1:]).all()
    assert found.covariance_b[0, 0] == pytest.approx(std**2)


def test_a_substitute_for_a_variance_of_zero_is_named_with_its_parameter() -> None:
    text = substituted(odometry((0.0, 1e6, 1e6)), STD)

    assert "along x is 0" in text and "aiding.velocity_std_min, 0.05 m/s, is used" in text
    assert substituted(odometry((0.0, 0.0, 0.0)), STD) == ""  # unknown, as ROS says
    assert substituted(odometry((0.04, 1e6, 1e6)), STD) == ""
    assert substituted(odometry((0.0, 0.04, 1e6)), STD) == ""  # y alone is measured


@pytest.mark.parametrize(
    ("variance", "x"),
    [((1e6, 1e6, 1e6), 3.0), ((-1.0, 0.0, 0.0), 3.0), ((0.0, 1e6, 1e6), math.nan)],
)
def test_why_no_axis_is_usable_is_said_with_the_remedy(
    variance: tuple[float, float, float], x: float
) -> None:
    refused = MESSAGES.odometry(odometry(variance, x))

    assert isinstance(refused, Refused)
    assert "a variance has to be above 0 and below 100 (m/s)²" in refused.text
    assert "let the driver set twist.covariance" in refused.text


@pytest.mark.parametrize(
    ("read", "kind"),
    [
        (MESSAGES.twist, "geometry_msgs/msg/TwistWithCovarianceStamped"),
        (MESSAGES.odometry, "nav_msgs/msg/Odometry"),
        (MESSAGES.heading, "sensor_msgs/msg/Imu"),
        (MESSAGES.pressure, "sensor_msgs/msg/FluidPressure"),
    ],
)
def test_the_time_of_arrival_replaces_a_stamp_where_it_is_given(read: Any, kind: str) -> None:
    message = new_message(kind)
    if kind.endswith("FluidPressure"):
        message.fluid_pressure = 101_325.0
    elif kind.endswith("Imu"):
        message.orientation.w = 1.0

    assert isinstance(read(message), Refused)  # its stamp is zero
    assert read(message, 5).t_ns == 5
