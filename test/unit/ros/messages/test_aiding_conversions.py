"""Messages of aiding sensors: axes, signs and variances, which drivers often leave at zero."""

import math
from typing import Any

import numpy as np
import pytest

from hybrid_ins import parameters
from hybrid_ins.bags.messages import new_message
from hybrid_ins.core.aiding.measurements import BarometricHeight, BodyVelocity, Heading
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


def test_a_velocity_is_turned_into_b_with_its_cross_terms() -> None:
    message = odometry((0.04, 0.09, 0.16), x=3.0, cross=0.01)
    message.twist.twist.linear.y, message.twist.twist.linear.z = 0.5, -0.2

    found = MESSAGES.odometry(message)

    assert isinstance(found, BodyVelocity)
    assert found.velocity_b.tolist() == [3.0, -0.5, 0.2]
    expected = [[0.04, -0.01, -0.01], [-0.01, 0.09, 0.01], [-0.01, 0.01, 0.16]]
    np.testing.assert_allclose(found.covariance_b, expected)


@pytest.mark.parametrize("cross", [math.nan, math.inf, 1.0, -1.0])
def test_cross_terms_that_no_errors_have_do_not_count(cross: float) -> None:
    """They ended the program, or left the wheels' scale without a variance."""
    found = MESSAGES.odometry(odometry((0.04, 0.09, 1e6), cross=cross))

    assert isinstance(found, BodyVelocity)
    np.testing.assert_allclose(found.covariance_b[:2, :2], np.diag([0.04, 0.09]))
    assert np.isfinite(found.covariance_b).all()


def test_the_point_whose_velocity_is_measured_is_relative_to_the_imu() -> None:
    values = {**parameters.defaults(), "aiding.velocity_position": [1.0, 2.0, 3.0]}
    messages = AidingMessages.from_parameters(values, np.array([0.1, 0.2, 0.3]))

    found = messages.odometry(odometry((0.04, 0.04, 0.04)))

    assert isinstance(found, BodyVelocity)
    assert found.point_b == pytest.approx([0.9, -2.2, -3.3])


def test_a_heading_has_the_variance_of_its_yaw() -> None:
    message = new_message("sensor_msgs/msg/Imu")
    set_stamp(message.header.stamp, 1_000_000_000)
    message.orientation.z, message.orientation.w = math.sin(0.15), math.cos(0.15)
    message.orientation_covariance = np.diag([0.04, 0.05, 0.09]).ravel()

    found = MESSAGES.heading(message)

    assert isinstance(found, Heading)
    assert found.yaw == pytest.approx(math.pi / 2 - 0.3)
    assert found.variance == pytest.approx(0.09)


def test_a_height_has_the_variance_of_its_pressure() -> None:
    def height(pascal: float) -> BarometricHeight:
        message = new_message("sensor_msgs/msg/FluidPressure")
        set_stamp(message.header.stamp, 1_000_000_000)
        message.fluid_pressure, message.variance = pascal, 400.0
        found = MESSAGES.pressure(message)
        assert isinstance(found, BarometricHeight)
        return found

    at = height(90_000.0)
    slope = (height(90_001.0).height - height(89_999.0).height) / 2.0
    assert at.height == pytest.approx(988.0, abs=1.0)
    assert at.variance == pytest.approx(400.0 * slope**2, rel=1e-6)


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
