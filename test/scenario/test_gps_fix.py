"""A recording with GPSFix in place of NavSatFix and velocity, through the estimator's programs."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hybrid_ins.bags.messages import new_message
from hybrid_ins.bags.reader import BagReader, InputTopics
from hybrid_ins.bags.writer import BagWriter
from hybrid_ins.calibration.recording import read_recording
from hybrid_ins.calibration.trial import run_trial
from hybrid_ins.cli import convert, replay, simulate
from hybrid_ins.parameters import check_all
from hybrid_ins.ros.estimator.estimator import Estimator
from hybrid_ins.ros.estimator.gps_fix_input import GpsFixInput
from hybrid_ins.ros.messages.conversions import set_stamp, stamp_ns
from hybrid_ins.ros.messages.type_names import GPS_FIX

RADIANS_FROM_EAST = "is an angle in radians, from east"


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a drive with positions and velocities."""
    path = tmp_path_factory.mktemp("gpsfix") / "drive.mcap"
    words = f"{path} --trajectory car --duration 30 --imu-rate 100 --gnss-velocity 0.05 --seed 2"
    assert simulate.main(words.split()) == 0
    return path


def as_gps_fix(drive: Path, out: Path, track_of: Any = lambda track: track) -> Path:
    """Write a recording with GPSFix messages instead, with 95 % uncertainties."""
    velocities = {stamp_ns(m.header.stamp): m.twist for m in messages(drive, "/gnss/velocity")}
    with BagReader(drive) as bag, BagWriter(out) as written:
        for topic, log_ns, data in bag.raw():
            if topic == "/gnss/velocity":
                continue
            if topic != "/gnss/fix":
                written.write_raw(topic, bag.topics[topic], data, log_ns)
                continue
            fix = bag.decode(topic, log_ns, data)
            made = new_message(GPS_FIX)
            made.header, made.status.status, made.status.satellites_used = fix.header, 19, 17
            made.latitude, made.longitude, made.altitude = fix.latitude, fix.longitude, fix.altitude
            made.position_covariance = fix.position_covariance
            made.position_covariance_type = fix.position_covariance_type
            made.hdop = 0.8
            if velocities:
                twist = velocities[stamp_ns(fix.header.stamp)]
                east, north = twist.twist.linear.x, twist.twist.linear.y
                made.speed, made.climb = math.hypot(east, north), twist.twist.linear.z
                made.track = track_of(math.degrees(math.atan2(east, north)) % 360.0)
                made.err_speed = made.err_climb = 1.96 * math.sqrt(twist.covariance[0])
            written.write("/gnss/gpsfix", made, log_ns)
    return out


def messages(bag: Path, topic: str) -> list[Any]:
    with BagReader(bag) as reader:
        return [message for *_, message in reader.messages(topic)] if topic in reader.topics else []


def places(bag: Path) -> dict[int, np.ndarray[Any, Any]]:
    return {
        stamp_ns(m.header.stamp): np.array(
            [m.pose.pose.position.x, m.pose.pose.position.y, m.pose.pose.position.z]
        )
        for m in messages(bag, "/odometry")
    }


@pytest.mark.slow
def test_a_gps_fix_is_worth_a_navsatfix_and_a_velocity(
    drive: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    gps, apart, together = (tmp_path / name for name in ("gps.mcap", "apart", "together"))
    as_gps_fix(drive, gps)
    caplog.set_level("INFO")

    assert replay.main([str(drive), str(apart)]) == 0
    assert replay.main([str(gps), str(together)]) == 0

    assert "reading /gnss/gpsfix, the only gps_msgs/msg/GPSFix" in caplog.text
    fixes = messages(together, "/gnss/fix")  # for ins_evaluate and the viewers
    assert len(fixes) == len(messages(gps, "/gnss/gpsfix"))
    assert fixes[0].status.status == 2
    velocities = messages(together, "/gnss/velocity")
    # From the first positions on that confirm the track; the car stands for 4 s.
    assert 0.5 * len(fixes) < len(velocities) < len(fixes)
    by_stamp = {stamp_ns(m.header.stamp): m.twist.twist.linear for m in velocities}
    for given in messages(drive, "/gnss/velocity"):
        made, linear = by_stamp.get(stamp_ns(given.header.stamp)), given.twist.twist.linear
        if made is not None:
            assert (made.x, made.y, made.z) == pytest.approx(
                (linear.x, linear.y, linear.z), abs=1e-9
            )
    one, other = places(apart), places(together)
    late = sorted(one.keys() & other.keys())[-1000:]
    assert len(late) == 1000
    assert max(float(np.linalg.norm(one[t] - other[t])) for t in late) < 0.05
    status = messages(together, "/diagnostics")[-1].status
    values = {pair.key: pair.value for s in status if s.name.endswith("input") for pair in s.values}
    assert values["fix_type"] == "RTK fixed"
    assert values["satellites_used"] == "17"
    assert values["hdop"] == "0.8"


def test_a_track_of_another_convention_is_named_and_not_used(
    drive: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """GIVEN radians from east, as some publishers fill it WHEN replayed THEN positions do it."""
    gps, out = tmp_path / "gps.mcap", tmp_path / "out"
    as_gps_fix(
        drive, gps, lambda track: math.remainder(math.pi / 2 - math.radians(track), math.tau)
    )

    one_clock = ["-p", "gnss.time_offset.estimate:=false"]
    assert replay.main([str(gps), str(out), "--fix-topic", "gnss/gpsfix", *one_clock]) == 0

    assert RADIANS_FROM_EAST in caplog.text
    used, given = messages(out, "/gnss/velocity"), messages(gps, "/gnss/gpsfix")
    assert len(used) < 0.1 * len(given)  # before the car turned, one pointed the right way
    truth = {
        stamp_ns(m.header.stamp): m.pose.pose.position for m in messages(out, "/truth/odometry")
    }
    last = sorted(places(out).items())[-1]
    there = truth[last[0]]
    assert last[1] == pytest.approx([there.x, there.y, there.z], abs=0.5)


def test_a_recorded_flight_calibrates_the_same_with_gps_fixes(
    flights: Path, tmp_path: Path
) -> None:
    """GIVEN a real flight with either message WHEN ins_calibrate reads it THEN all is the same."""
    flight, gps = tmp_path / "flight", tmp_path / "gps.mcap"
    assert convert.main([str(flights / "Horizontal" / "path_4"), str(flight)]) == 0
    as_gps_fix(flight, gps)

    values = check_all({"gnss.time_offset.value": 0.11, "gnss.time_offset.estimate": False})
    one, other = read_recording(flight, values), read_recording(gps, values)
    topics: InputTopics = {
        "imu_topic": "/imu/data",
        "fix_topic": "/gnss/fix",
        "velocity_topic": "/gnss/velocity",
    }
    judged, again = run_trial(flight, values, topics), run_trial(gps, values, topics)

    assert len(one.aid_t) > 190
    for name in ("t", "samples", "aid_t", "aid_kind", "aid", "aid_R"):
        np.testing.assert_array_equal(getattr(other, name), getattr(one, name), err_msg=name)
    assert np.isfinite(judged.error).sum() > 40
    np.testing.assert_array_equal(again.error, judged.error)
    assert again.used == judged.used > 0.95


def test_a_navsatfix_goes_before_a_gps_fix(tmp_path: Path) -> None:
    lines: list[str] = []
    estimator = Estimator(check_all({}), lambda level, text: lines.append(f"{level}: {text}"))
    gps = GpsFixInput(estimator, new_message)
    message, fix = new_message(GPS_FIX), new_message("sensor_msgs/msg/NavSatFix")
    for made in (message, fix):
        made.latitude, made.longitude = 32.0, 34.0
        made.header.stamp.sec = 100

    assert len(gps.handle(message)) == 1
    gps.note_fix(fix)
    assert gps.handle(message) == gps.handle(message) == []
    message.header.stamp.sec = 106  # the other is silent
    assert len(gps.handle(message)) == 1

    assert [line for line in lines if "both have messages" in line] == [
        "warn: gnss/fix and gnss/gpsfix both have messages: gnss/gpsfix is not used; remap one"
    ]


def gps_at(seconds: float) -> Any:
    message = new_message(GPS_FIX)
    message.latitude, message.longitude = 32.0, 34.0
    set_stamp(message.header.stamp, round(seconds * 1e9))
    return message


def test_a_gps_fix_is_used_from_the_first_second_of_simulated_time_on() -> None:
    lines: list[str] = []
    gps = GpsFixInput(Estimator(check_all({}), lambda level, text: lines.append(text)), new_message)

    assert [len(gps.handle(gps_at(t))) for t in (0.1, 1.0, 4.9, 6.0)] == [1] * 4
    gps.note_fix(new_message("sensor_msgs/msg/NavSatFix"))  # without a stamp
    assert len(gps.handle(gps_at(4.0))) == 1
    assert not [line for line in lines if "both have messages" in line]


def test_where_the_time_of_arrival_counts_stamps_do_not() -> None:
    gps = GpsFixInput(Estimator(check_all({}), lambda level, text: None), new_message)
    unstamped = new_message("sensor_msgs/msg/NavSatFix")

    gps.note_fix(unstamped, received_ns=100_000_000_000)

    assert gps.handle(gps_at(0.0), received_ns=101_000_000_000) == []
    assert len(gps.handle(gps_at(0.0), received_ns=106_000_000_000)) == 1


def test_the_kind_of_fix_is_logged_when_it_changes() -> None:
    lines: list[str] = []
    estimator = Estimator(check_all({}), lambda level, text: lines.append(text))
    gps = GpsFixInput(estimator, new_message)
    message = new_message(GPS_FIX)
    message.latitude, message.longitude = 32.0, 34.0
    for second, status in enumerate([19, 19, 20, 20, 19, 20, 19], start=1):
        message.header.stamp.sec, message.status.status = second, status
        gps.handle(message)

    assert [line for line in lines if "->" in line] == [
        "gnss/gpsfix: RTK fixed -> RTK float",
        "gnss/gpsfix: RTK float -> RTK fixed",
    ]
