"""What is read from a bag for calibration, and which recordings are refused with the reason."""

import math
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hybrid_ins import parameters
from hybrid_ins.bags.messages import new_message
from hybrid_ins.bags.reader import BagReader, InputTopics
from hybrid_ins.bags.writer import BagWriter
from hybrid_ins.calibration.filter_pass import Nominal, first_state
from hybrid_ins.calibration.innovations import POSITION
from hybrid_ins.calibration.recording import WHEELS, Recording, read_recording
from hybrid_ins.cli import simulate
from hybrid_ins.errors import InputError
from hybrid_ins.replay import replay_bag
from hybrid_ins.ros.messages.conversions import set_stamp
from tools.robustness.disturbances import Flight
from tools.robustness.lasting_faults import by_another_clock


@pytest.mark.parametrize(
    ("ahead", "words"),
    [(18.0, "18.0 s ahead of the IMU's .*GPS time"), (-1.5e9, "years behind the IMU's")],
)
def test_fixes_of_another_clock_are_named(tmp_path: Path, ahead: float, words: str) -> None:
    bag, disturbed = tmp_path / "flight.mcap", tmp_path / "disturbed.mcap"
    assert simulate.main([str(bag), "--duration", "12", "--imu-rate", "50"]) == 0
    flight = Flight.read(bag, 0.0, 1.0)
    by_another_clock(ahead)(flight)
    flight.write(disturbed)
    values = parameters.defaults()

    assert len(read_recording(bag, values).aid_t) > 50
    with pytest.raises(InputError, match=words) as raised:
        read_recording(disturbed, values)
    assert "use_receive_time" not in str(raised.value)  # a bag's stamps are what they are


def test_a_name_that_is_no_utf_8_can_be_written_to_the_parameters(tmp_path: Path) -> None:
    bag = tmp_path / os.fsdecode(b"caf\xe9.mcap")
    assert simulate.main([str(bag), "--duration", "12", "--imu-rate", "50"]) == 0

    assert read_recording(bag, parameters.defaults()).name == "caf?.mcap"


def test_fixes_that_a_driver_repeats_are_read_once(tmp_path: Path) -> None:
    bag, repeated = tmp_path / "flight.mcap", tmp_path / "repeated.mcap"
    assert simulate.main([str(bag), "--duration", "12", "--imu-rate", "50"]) == 0
    flight, values = Flight.read(bag, 0.0, 1.0), parameters.defaults()
    fixes = [entry.message for entry in flight.entries if entry.topic == "/gnss/fix"]
    for k, fix in enumerate(fixes):
        first = fixes[k // 2 * 2]
        fix.latitude, fix.longitude, fix.altitude = first.latitude, first.longitude, first.altitude
    flight.write(repeated)

    read = len(read_recording(bag, values).aid_t) - len(read_recording(repeated, values).aid_t)

    assert len(fixes) // 2 - 5 <= read <= len(fixes) // 2


@pytest.mark.parametrize("topic", list(WHEELS))
def test_wheels_are_read_from_either_topic_in_the_order_of_their_stamps(
    tmp_path: Path, topic: str
) -> None:
    """
    GIVEN a flight with wheels at a place of their own, late by half a second, one in another frame
    WHEN it is read
    THEN they are in b relative to the IMU, by stamp since the first sample, that one left out.
    """
    plain, path = tmp_path / "flight.mcap", tmp_path / "wheels.mcap"
    assert simulate.main([str(plain), "--duration", "12", "--imu-rate", "50"]) == 0
    values = parameters.check_all(
        {"aiding.velocity_position": [-1.0, 0.5, 0.2], "imu.position": [0.3, 0.0, 0.1]}
    )
    with BagReader(plain) as bag, BagWriter(path) as copy:
        origin = int(bag.imu("/imu/data").stamp_ns[0])
        for source in ("/imu/data", "/gnss/fix"):
            for _, log_ns, message in bag.messages(source):
                copy.write(source, message, log_ns)
        for k in reversed(range(40)):
            message = new_message(WHEELS[topic])
            t_ns = origin + 200_000_000 * k
            set_stamp(message.header.stamp, t_ns)
            message.twist.twist.linear.x = 0.1 * k
            message.twist.covariance[0] = 0.04
            if k == 7:
                message.header.frame_id = "wheel"
                if hasattr(message, "child_frame_id"):
                    message.child_frame_id = "wheel"
            copy.write(topic, message, t_ns + 500_000_000)

    found = read_recording(path, values).body_velocity

    assert read_recording(plain, values).body_velocity == ()
    kept = [k for k in range(40) if k != 7]
    assert [one.t_ns for one in found] == [200_000_000 * k for k in kept]
    np.testing.assert_allclose([one.velocity_b[0] for one in found], 0.1 * np.array(kept))
    assert all(np.isnan(one.velocity_b[1:]).all() for one in found)
    np.testing.assert_allclose(found[0].point_b, [-1.3, -0.5, -0.1])
    assert found[0].covariance_b[0, 0] == pytest.approx(0.04)


def circling_late(longitude: float, height: float) -> Recording:
    """Return a minute that moves in its last third only, about a longitude [rad]."""
    t, fix_t = np.arange(0.0, 60.0, 0.02), np.arange(0.0, 60.0, 0.2)
    turn = np.maximum(fix_t - 40.0, 0.0)
    east, north = 5e-7 + 2e-6 * np.sin(turn), 2e-6 * (1.0 - np.cos(turn))
    east[::2] -= 1e-6  # the first fixes are on both sides
    lla = np.column_stack((0.5 + north, longitude + east, np.full(len(fix_t), height)))
    lla[:, 1] = np.remainder(lla[:, 1] + math.pi, 2.0 * math.pi) - math.pi
    return Recording(
        "late",
        t,
        np.tile([0.0, 0.0, -9.8, 0.0, 0.0, 0.0], (len(t), 1)),
        fix_t,
        np.full(len(fix_t), POSITION),
        lla,
        np.tile(np.eye(3), (len(fix_t), 1, 1)),
    )


@pytest.mark.parametrize("height", [100.0, math.nan])
def test_the_date_line_and_a_missing_height_are_no_motion(height: float) -> None:
    """At the date line a metre was 40 000 km, and without a height no motion was found."""
    inland, across = circling_late(1.0, 100.0), circling_late(math.pi, height)
    std, none = np.full(3, 0.1), np.zeros(3)
    nominal = Nominal(0.0, none, 1e-4, 1e-8, 1e-3, 1e-5, none, std, none, std)

    there, here = (first_state(one, 0.0, nominal) for one in (inland, across))

    assert np.ptp(across.aid[:, 1]) > 6.0
    for name in ("position", "velocity", "up_n"):
        np.testing.assert_allclose(getattr(here, name), getattr(there, name), atol=1e-3)
    assert across.begin_of_motion(15.0) == pytest.approx(inland.begin_of_motion(15.0))
    assert inland.begin_of_motion(15.0) > 30.0


def with_imu(plain: Path, out: Path, change: Callable[[int, Any], None]) -> Path:
    """Copy a flight; ``change`` is given the number and the message of each IMU sample."""
    with BagReader(plain) as bag, BagWriter(out) as copy:
        for topic in ("/imu/data", "/gnss/fix"):
            for k, (_, log_ns, message) in enumerate(bag.messages(topic)):
                if topic == "/imu/data":
                    change(k, message)
                copy.write(topic, message, log_ns)
    return out


def test_samples_that_the_node_refuses_are_left_out_and_no_others(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """
    GIVEN a flight with one stamp far ahead, and readings that say that they are none
    WHEN it is read, and replayed
    THEN both leave out the same samples, use what follows, and say why.
    """
    plain = tmp_path / "flight.mcap"
    assert simulate.main([str(plain), "--duration", "12", "--imu-rate", "50"]) == 0

    def spoil(k: int, imu: Any) -> None:
        if k == 100:
            imu.header.stamp.sec += 1000
        elif k % 3 == 2:
            imu.linear_acceleration_covariance = np.array([-1.0, *np.zeros(8)])

    path = with_imu(plain, tmp_path / "spoilt.mcap", spoil)
    values = parameters.defaults()

    read = read_recording(path, values)

    topics: InputTopics = {
        "imu_topic": "/imu/data", "fix_topic": "/gnss/fix", "velocity_topic": "/gnss/velocity",
    }  # fmt: skip
    replayed = replay_bag(path, tmp_path / "out.mcap", values, topics)
    count = len(read_recording(plain, values).t)
    expected = {"imu: stamp jumps": 1, "imu: no reading": count // 3}
    assert {k: n for k, n in replayed.estimator.inputs.counts.items() if "imu: " in k} == expected
    assert read.rows.tolist() == [k for k in range(count) if k != 100 and k % 3 != 2]
    assert f"1 of {count} samples are left out: header.stamp jumps" in caplog.text
    assert f"{count // 3} of {count} samples are left out: covariance[0] is -1" in caplog.text


def test_recordings_are_dated_by_receipt_where_the_node_is_told_to(tmp_path: Path) -> None:
    plain = tmp_path / "flight.mcap"
    assert simulate.main([str(plain), "--duration", "12", "--imu-rate", "50"]) == 0
    path = with_imu(plain, tmp_path / "other.mcap", lambda k, imu: set_stamp(imu.header.stamp, 1))
    values = parameters.check_all({"use_receive_time": True})

    read = read_recording(path, values)

    with BagReader(path) as bag:
        imu_ns = bag.imu().log_ns
        fix_ns = np.array([log_ns for _, log_ns, _ in bag.messages("/gnss/fix")])
    np.testing.assert_allclose(read.t, 1e-9 * (imu_ns - imu_ns[0]))
    np.testing.assert_allclose(read.aid_t, 1e-9 * (fix_ns - imu_ns[0]))
    with pytest.raises(InputError):
        read_recording(path, parameters.defaults())


def test_a_receiver_that_states_no_covariance_is_known(tmp_path: Path) -> None:
    plain, path = tmp_path / "flight.mcap", tmp_path / "unknown.mcap"
    assert simulate.main([str(plain), "--duration", "12", "--imu-rate", "50"]) == 0
    flight = Flight.read(plain, 0.0, 1.0)
    for entry in flight.entries:
        if entry.topic == "/gnss/fix":
            entry.message.position_covariance_type = 0
    flight.write(path)

    assert read_recording(plain, parameters.defaults()).states_std
    assert not read_recording(path, parameters.defaults()).states_std
