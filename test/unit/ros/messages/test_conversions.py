"""What messages demand of their reader: covariances that say nothing, status, NaN, units, axes."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hybrid_ins import parameters
from hybrid_ins.bags.messages import new_message
from hybrid_ins.core.inertial.rotations import quat_from_rpy
from hybrid_ins.ros.messages.conversions import (
    GnssInput,
    Refused,
    first_biases,
    floor_covariance,
    imu_yaw,
    mount_matrix,
    set_stamp,
    stamp_ns,
    yaw_ned_from_enu,
)
from hybrid_ins.ros.messages.initial_pose import DEFAULT_STD, initial_yaw

NAN, INF = math.nan, math.inf
DEFAULT = np.diag([9.0, 9.0, 36.0])
VALUES = parameters.defaults()
GNSS = GnssInput.from_parameters(VALUES)


def fix(covariance=None, kind=2, lat=32.0, lon=35.0, alt=10.0, status=0, sec=5):
    message = new_message("sensor_msgs/msg/NavSatFix")
    message.header.stamp.sec = sec
    message.status.status = status
    message.latitude, message.longitude, message.altitude = lat, lon, alt
    message.position_covariance = np.asarray(
        np.diag([0.01, 0.04, 0.09]) if covariance is None else covariance, float
    ).ravel()
    message.position_covariance_type = kind
    return message


def velocity(x=1.0, y=2.0, z=3.0, variance=0.01):
    message = new_message("geometry_msgs/msg/TwistWithCovarianceStamped")
    message.header.stamp.sec = 5
    linear = message.twist.twist.linear
    linear.x, linear.y, linear.z = x, y, z
    message.twist.covariance = (variance * np.eye(6)).ravel()
    return message


def test_a_fix_is_turned_into_ned_with_its_cross_terms() -> None:
    enu = [[0.04, 0.01, 0.002], [0.01, 0.09, -0.003], [0.002, -0.003, 0.16]]
    made = GNSS.position(fix(enu, 3))
    np.testing.assert_allclose(
        made.covariance_n, [[0.09, 0.01, 0.003], [0.01, 0.04, -0.002], [0.003, -0.002, 0.16]]
    )
    assert made.lla == pytest.approx([math.radians(32.0), math.radians(35.0), 10.0])


@pytest.mark.parametrize(
    ("covariance", "kind"),
    [
        (np.eye(3), 0),
        (np.zeros((3, 3)), 3),
        (-np.eye(3), 2),
        (np.full((3, 3), NAN), 3),
        (np.diag([0.1, INF, 0.1]), 2),
        ([[1, 2, 0], [2, 1, 0], [0, 0, 1]], 3),
        (np.diag([0.0, 0.1, 0.1]), 2),
        (np.diag([0.1, -0.1, 0.1]), 2),
        (np.eye(3), 77),
    ],
    ids=[
        "unknown",
        "zero",
        "negative",
        "NaN",
        "inf",
        "indefinite",
        "one zero",
        "one negative",
        "no such type",
    ],
)
def test_a_covariance_that_says_nothing_gives_way_to_the_default(covariance, kind) -> None:
    made = GNSS.position(fix(covariance, kind))
    np.testing.assert_allclose(np.diag(made.covariance_n), np.diag(DEFAULT))


def test_millimetres_are_held_to_the_floor_and_kilometres_refused() -> None:
    floor = VALUES["gnss.position_std_min"]
    made = GNSS.position(fix(9e-6 * np.eye(3)))
    np.testing.assert_allclose(np.diag(made.covariance_n), floor**2)
    assert GNSS.position(fix(1e6 * np.eye(3))).name == "gnss: poor fix"
    for east, north in ((1e6, 1.0), (1.0, 1e6)):
        assert GNSS.position(fix(np.diag([east, north, 1.0]))).name == "gnss: poor fix"


@pytest.mark.parametrize("vertical", [np.nan, np.inf, 0.0, -1.0])
def test_a_vertical_variance_that_is_unknown_leaves_the_horizontal_ones(vertical: float) -> None:
    made = floor_covariance(np.diag([0.02, 0.03, vertical]), 0.01, DEFAULT)

    assert np.diag(made).tolist() == [0.02, 0.03, DEFAULT[2, 2]]


@given(st.lists(st.floats(allow_nan=True, allow_infinity=True), min_size=9, max_size=9))
def test_any_nine_numbers_give_a_positive_definite_covariance(numbers: list[float]) -> None:
    made = floor_covariance(np.array(numbers).reshape(3, 3), 0.01, DEFAULT)
    assert np.all(np.isfinite(made))
    assert np.array_equal(made, made.T) or np.allclose(made, made.T, rtol=1e-9)
    assert np.linalg.eigvalsh(0.5 * made + 0.5 * made.T).min() > 0.0


@pytest.mark.parametrize(
    ("changes", "name"),
    [
        ({"status": -1}, "gnss: no fix"),
        ({"status": -2}, "gnss: no fix"),
        ({"lat": NAN}, "gnss: impossible position"),
        ({"lon": INF}, "gnss: impossible position"),
        ({"alt": INF}, "gnss: impossible position"),
        ({"alt": 1e9}, "gnss: impossible position"),
        ({"lat": 3.2e8}, "gnss: impossible position"),
        ({"lat": 90.0}, "gnss: impossible position"),
        ({"lat": 0.0, "lon": 0.0}, "gnss: impossible position"),
        ({"sec": 0}, "gnss: zero stamp"),
        ({"sec": -5}, "gnss: negative stamp"),
    ],
)
def test_useless_fixes_are_refused_by_name(changes, name) -> None:
    refused = GNSS.position(fix(**changes))
    assert isinstance(refused, Refused) and refused.name == name


@pytest.mark.parametrize(
    ("lat", "lon", "said"),
    [
        (123.12345678901234, 45.1, "latitude 123.1234568, longitude 45.1, altitude "),
        (123.0, 45.0, "latitude and longitude seem to be exchanged"),
        (123.0, 145.0, "check the driver's units"),
        (INF, 45.0, "latitude inf, longitude 45, altitude "),
        (3.2e8, 4.5, "check the driver's units"),
        (-89.90004, 4.5, "latitude -89.90004°: the filter cannot be used at the poles (beyond ±"),
    ],
)
def test_what_is_no_position_is_said_with_the_likely_cause(
    lat: float, lon: float, said: str
) -> None:
    assert said in GNSS.position(fix(lat=lat, lon=lon)).text


def test_a_fix_without_altitude_keeps_its_horizontal_part() -> None:
    covariance = np.diag([0.01, 0.04, NAN])
    made = GNSS.position(fix(covariance, alt=NAN))
    assert math.isnan(made.lla[2])
    assert np.diag(made.covariance_n) == pytest.approx([0.04, 0.01, DEFAULT[2, 2]])


def test_velocity_is_turned_and_an_unknown_climb_leaves_the_rest() -> None:
    assert GNSS.velocity(velocity()).velocity_n == pytest.approx([2.0, 1.0, -3.0])
    made = GNSS.velocity(velocity(z=NAN)).velocity_n
    assert made[:2] == pytest.approx([2.0, 1.0]) and math.isnan(made[2])


def test_one_number_for_all_directions_of_a_velocity_says_less_of_the_vertical() -> None:
    def std(variances: list[float]) -> np.ndarray:
        message = velocity()
        message.twist.covariance = np.diag([*variances, 0.0, 0.0, 0.0]).ravel()
        return np.sqrt(np.diag(GNSS.velocity(message).covariance_n))

    np.testing.assert_allclose(std([0.04, 0.04, 0.04]), [0.2, 0.2, 0.4])
    np.testing.assert_allclose(std([0.01, 0.04, 0.05]), np.sqrt([0.04, 0.01, 0.05]))
    np.testing.assert_allclose(std([0.01, 0.01, 0.01]), [0.1, 0.1, 0.2])
    default = VALUES["gnss.velocity_std_default"]
    np.testing.assert_allclose(std([0.0, 0.0, 0.0]), default * np.array([1.0, 1.0, 2.0]))


@pytest.mark.parametrize("unknown", [0.0, -1.0, NAN])
def test_an_unknown_vertical_variance_leaves_the_horizontal_ones(unknown: float) -> None:
    made = GNSS.position(fix(np.diag([0.01, 0.04, unknown])))
    np.testing.assert_allclose(np.diag(made.covariance_n), [0.04, 0.01, DEFAULT[2, 2]])


@pytest.mark.parametrize("variance", [0.0, -1.0, NAN])
def test_a_driver_without_a_vertical_velocity_says_nothing_of_the_climb(variance: float) -> None:
    """Such drivers leave zero in the field: a helicopter that descended was 132 m too high."""
    message = velocity(z=0.0)
    message.twist.covariance[14] = variance
    made = GNSS.velocity(message)
    assert math.isnan(made.velocity_n[2])
    np.testing.assert_allclose(made.covariance_n[:2, :2], 0.01 * np.eye(2))

    message.twist.twist.linear.z = 3.0  # no driver invents that
    assert GNSS.velocity(message).velocity_n[2] == -3.0
    assert GNSS.velocity(velocity(z=0.0)).velocity_n[2] == 0.0


@pytest.mark.parametrize("bad", [velocity(x=NAN), velocity(z=INF), velocity(y=1e6)])
def test_useless_velocities_are_refused(bad) -> None:
    assert isinstance(GNSS.velocity(bad), Refused)


def test_stamps_go_there_and_back() -> None:
    stamp = fix().header.stamp
    for t_ns in (1, 1_700_000_000_123_456_789, 2**31 * 10**9 - 1):
        set_stamp(stamp, t_ns)
        assert stamp_ns(stamp) == t_ns


@pytest.mark.parametrize("rpy", [(math.pi, 0.0, 0.0), (0.0, 0.0, math.pi / 2), (0.3, -0.2, 1.0)])
def test_a_mount_turns_gravity_back(rpy) -> None:
    # GIVEN an IMU that stands level on the vehicle, but is itself mounted turned
    C_base_imu = np.diag([1.0, -1.0, -1.0]) @ mount_matrix(rpy)
    reading = C_base_imu.T @ [0.0, 0.0, 9.8]
    assert mount_matrix(rpy) @ reading == pytest.approx([0.0, 0.0, -9.8])


@pytest.mark.parametrize("std", [0.2, [0.2], [0.2, 0.2, 0.2]])
def test_biases_to_begin_with_are_turned_into_b_and_one_uncertainty_serves_all_axes(std) -> None:
    values = parameters.check_all(
        {
            "imu.accelerometer_bias": [0.1, 0.2, 0.3],
            "imu.accelerometer_bias_std": std,
            "imu.gyroscope_bias": [0.01, 0.02, 0.03],
        }
    )

    bias_a, std_a, bias_g, std_g = first_biases(values)

    assert bias_a.tolist() == [0.1, -0.2, -0.3] and std_a.tolist() == [0.2, 0.2, 0.2]
    assert bias_g.tolist() == [0.01, -0.02, -0.03] and std_g.tolist() == [0.01, 0.01, 0.01]


def test_headings() -> None:
    assert yaw_ned_from_enu(0.0) == pytest.approx(math.pi / 2)
    assert yaw_ned_from_enu(math.pi / 2) == pytest.approx(0.0)
    level = quat_from_rpy(0.0, 0.0, 0.0)
    assert imu_yaw(tuple(level), mount_matrix((0.0, 0.0, 0.0))) == pytest.approx(math.pi / 2)
    assert imu_yaw((0.0, 0.0, 0.0, 0.0), np.eye(3)) is None
    rpy = (0.3, -0.2, 1.0)  # of an IMU in a vehicle whose nose points to the east
    assert imu_yaw(tuple(quat_from_rpy(*rpy)), mount_matrix(rpy)) == pytest.approx(math.pi / 2)
    assert imu_yaw((NAN, 0.0, 0.0, 1.0), np.eye(3)) is None


@pytest.mark.parametrize("quat", [(0.0,) * 4, (NAN, 0.0, 0.0, 1.0), (0.0, 0.0, 0.0, 5.0)])
def test_a_pose_without_orientation_is_refused(quat) -> None:
    message = new_message("geometry_msgs/msg/PoseWithCovarianceStamped")
    q = message.pose.pose.orientation
    q.x, q.y, q.z, q.w = quat
    assert isinstance(initial_yaw(message, "map"), Refused)


@pytest.mark.parametrize("variance", [0.0, -1.0, NAN, INF])
def test_a_pose_without_a_variance_has_that_of_a_hand(variance: float) -> None:
    message = new_message("geometry_msgs/msg/PoseWithCovarianceStamped")
    message.pose.pose.orientation.w, message.pose.covariance[35] = 1.0, variance

    yaw = initial_yaw(message, "map")

    assert yaw == (pytest.approx(math.pi / 2), DEFAULT_STD)


@pytest.mark.parametrize("variance", [4.0, 1e6, 1e300])
def test_a_pose_whose_heading_is_unknown_is_refused(variance: float) -> None:
    """GIVEN the large variance of what is not known THEN it is no heading to align with."""
    message = new_message("geometry_msgs/msg/PoseWithCovarianceStamped")
    message.pose.pose.orientation.w, message.pose.covariance[35] = 1.0, variance

    refused = initial_yaw(message, "map")

    assert isinstance(refused, Refused) and f"{variance:.3g} rad²" in refused.text
