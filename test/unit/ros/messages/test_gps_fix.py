"""A GPSFix as position and velocity, by arithmetic; and drivers that fill the track wrongly."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from hybrid_ins.bags.messages import new_message
from hybrid_ins.ros.messages.gps_fix import TrackCheck, position_of, velocity_of
from hybrid_ins.ros.messages.type_names import GPS_FIX

EARTH = 6_371_000.0  # m


def message(**fields: Any) -> Any:
    made = new_message(GPS_FIX)
    made.header.stamp.sec, made.header.frame_id = 5, "antenna"
    made.latitude, made.longitude, made.altitude = 32.0, 34.0, 50.0
    for name, value in fields.items():
        target = made.status if hasattr(made.status, name) else made
        setattr(target, name, value)
    return made


def covariance(twist: Any) -> np.ndarray[Any, Any]:
    return np.array(twist.twist.covariance).reshape(6, 6)[:3, :3]


@pytest.mark.parametrize(
    ("status", "expected"), [(-1, -1), (0, 0), (1, 1), (2, 2), (18, 2), (19, 2), (20, 2), (33, 1)]
)
def test_status_is_that_of_a_navsatfix(status: int, expected: int) -> None:
    assert position_of(message(status=status), new_message).status.status == expected


def test_position_and_its_covariance_are_those_of_the_message() -> None:
    given = np.arange(9.0)

    fix = position_of(
        message(position_covariance=given, position_covariance_type=3, err_horz=9.0), new_message
    )

    assert (fix.latitude, fix.longitude, fix.altitude) == (32.0, 34.0, 50.0)
    assert fix.header.frame_id == "antenna"
    assert fix.position_covariance_type == 3
    assert np.array_equal(fix.position_covariance, given)


def test_uncertainties_of_95_percent_stand_in_for_a_covariance() -> None:
    """95 % of a circle lie within √(-2 ln 0.05) standard deviations, of a line within 1.96."""
    fix = position_of(message(err_horz=2.0, err_vert=3.0), new_message)

    sigma_h, sigma_v = 2.0 / math.sqrt(-2.0 * math.log(0.05)), 3.0 / 1.959964
    assert np.diag(fix.position_covariance.reshape(3, 3)) == pytest.approx(
        [sigma_h**2, sigma_h**2, sigma_v**2], rel=1e-3
    )
    assert fix.position_covariance_type == 2


@pytest.mark.parametrize("error", [0.0, -1.0, math.nan])
def test_without_any_uncertainty_the_covariance_is_unknown(error: float) -> None:
    fix = position_of(message(err=error, err_horz=error, err_vert=error), new_message)

    assert fix.position_covariance_type == 0


def test_another_message_stays_as_it_is() -> None:
    fix = new_message("sensor_msgs/msg/NavSatFix")

    assert position_of(fix, new_message) is fix


@pytest.mark.parametrize(
    ("track", "east", "north"), [(0.0, 0.0, 10.0), (90.0, 10.0, 0.0), (-135.0, -7.0711, -7.0711)]
)
def test_track_is_clockwise_from_north(track: float, east: float, north: float) -> None:
    twist = velocity_of(message(track=track, speed=10.0, climb=-1.0), new_message)

    linear = twist.twist.twist.linear
    assert (linear.x, linear.y, linear.z) == pytest.approx((east, north, -1.0), abs=1e-4)
    assert not np.any(covariance(twist))  # unknown


def test_uncertainties_along_and_across_the_track() -> None:
    """Eastward at 20 m/s, known to 0.1 m/s and 1° (σ): across 20 m/s x 0.01745 = 0.349 m/s."""
    twist = velocity_of(
        message(track=90.0, speed=20.0, err_speed=0.196, err_track=1.96, err_climb=0.392),
        new_message,
    )

    assert np.diag(covariance(twist)) == pytest.approx([0.1**2, 0.349**2, 0.2**2], rel=2e-3)


def test_covariance_is_that_of_many_samples() -> None:
    rng = np.random.default_rng(1)
    speed = rng.normal(15.0, 0.3, 100_000)
    track = np.radians(rng.normal(30.0, 2.0, 100_000))
    samples = np.cov(speed * np.sin(track), speed * np.cos(track))

    twist = velocity_of(
        message(track=30.0, speed=15.0, err_speed=0.3 * 1.96, err_track=2.0 * 1.96), new_message
    )

    assert covariance(twist)[:2, :2] == pytest.approx(samples, rel=0.03)


@pytest.mark.parametrize(
    "fields",
    [
        {},  # what a driver leaves that has no velocity
        {"speed": math.nan, "track": 10.0},
        {"speed": 1.0, "track": math.nan},
        {"speed": 1.0, "track": -2e10},  # a receiver's "do not use"
        {"speed": 1.0, "status": -1},
        {"climb": math.nan},
    ],
)
def test_no_velocity(fields: dict[str, float]) -> None:
    assert velocity_of(message(**fields), new_message) is None


def test_a_vehicle_that_stands_has_a_velocity() -> None:
    twist = velocity_of(message(err_speed=0.2), new_message)

    assert twist.twist.twist.linear.x == 0.0
    assert covariance(twist)[0, 0] == pytest.approx((0.2 / 1.96) ** 2)


def drive(track_of: Any, speed: float = 5.0, period: float = 0.2) -> TrackCheck:
    """Drive 20 s in a curve, the course from 20° to 320°; the track is made of the course [rad]."""
    check, north, east = TrackCheck(), 0.0, 0.0
    for k in range(round(20.0 / period)):
        t = k * period
        course = math.radians(20.0 + 15.0 * t)
        check.observe(
            round(t * 1e9),
            message(
                latitude=32.0 + math.degrees(north / EARTH),
                longitude=34.0 + math.degrees(east / EARTH / math.cos(math.radians(32.0))),
                track=track_of(course),
                speed=speed,
            ),
        )
        north += speed * math.cos(course) * period
        east += speed * math.sin(course) * period
    return check


def test_a_right_track_is_confirmed() -> None:
    check = drive(lambda course: math.degrees(course) % 360.0)

    assert check.confirmed
    assert not check.contradicted


@pytest.mark.parametrize(
    ("track_of", "name"),
    [
        (lambda course: math.pi / 2 - course, "radians, from east"),
        (lambda course: 90.0 - math.degrees(course), "angle from east"),
        (lambda course: math.degrees(course) + 180.0, "not the direction of motion"),
    ],
)
def test_a_wrong_track_is_named(track_of: Any, name: str) -> None:
    check = drive(track_of)

    assert not check.confirmed
    assert name in check.contradicted


def test_standing_confirms_nothing() -> None:
    check = drive(lambda course: 0.0, speed=0.05)

    assert not check.confirmed
    assert not check.contradicted
