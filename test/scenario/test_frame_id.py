"""
The frame_id of messages where /tf_static places the sensors.

A message that is refused changes nothing, stray ones are refused by name, and a frame_id that lasts
moves the sensor.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from support.drive import KNOWN, Drive

from hybrid_ins.bags.messages import new_message
from hybrid_ins.core.inertial.rotations import heading_from_quat
from hybrid_ins.core.inertial.state import QUAT
from hybrid_ins.ros.estimator.imu_block import handle_imu_block
from hybrid_ins.ros.messages.cdr import ImuFields
from hybrid_ins.ros.messages.conversions import fill_transform, set_stamp
from hybrid_ins.ros.messages.type_names import TRANSFORMS
from hybrid_ins.ros.placement.frame_id import CONFIRMED

LEVEL = (0.0, 0.0, 9.8)
STILL = (0.0, 0.0, 0.0)
UNTURNED = (0.0, 0.0, 0.0, 1.0)
PLACES = {"imu": (0.3, 0.0, 0.0), "gnss": (0.0, 0.0, 1.0), "second": (0.0, 2.0, 0.0)}


class Placed(Drive):
    """A flight whose sensors /tf_static places; the truth is that of the IMU all the same."""

    frames = ("imu", "gnss")

    def __init__(self) -> None:
        super().__init__(**KNOWN)
        message = new_message(TRANSFORMS)
        for name, place in PLACES.items():
            message.transforms.append(new_message("geometry_msgs/msg/TransformStamped"))
            fill_transform(message.transforms[-1], 0, "base_link", name, place, UNTURNED)
        self.estimator.handle_static_transforms(message)
        handle_imu, handle_fix = self.estimator.handle_imu, self.estimator.handle_fix

        def imu(fields: ImuFields) -> Any:
            return handle_imu(fields._replace(frame_id=fields.frame_id or self.frames[0]))

        def fix(message: Any) -> None:
            message.header.frame_id = message.header.frame_id or self.frames[1]
            handle_fix(message)

        self.given_imu, self.given_fix = handle_imu, handle_fix
        self.estimator.handle_imu = imu  # type: ignore[method-assign, assignment]
        self.estimator.handle_fix = fix  # type: ignore[method-assign, assignment]

    def imu(self, t: float, frame: str, force: tuple[float, float, float] = LEVEL) -> None:
        self.given_imu(ImuFields(self.stamp(t), force, STILL, frame))

    def one_fix(self, t: float, frame: str, status: int = 0) -> None:
        message = new_message("sensor_msgs/msg/NavSatFix")
        set_stamp(message.header.stamp, self.stamp(t))
        message.header.frame_id, message.status.status = frame, status
        message.latitude, message.longitude = np.degrees(self.fix_lla[0, :2]).tolist()
        message.altitude = float(self.fix_lla[0, 2])
        message.position_covariance = np.eye(3).ravel()
        message.position_covariance_type = 2
        self.given_fix(message)

    @property
    def places(self) -> tuple[list[float], list[float]]:
        placement = self.estimator.placement
        return placement.arm_b.tolist(), placement.lever_b.tolist()


@pytest.fixture
def flying() -> Placed:
    drive = Placed()
    drive.play(0.0, 8.0)
    assert drive.estimator.aligned
    assert drive.places == ([0.3, 0.0, 0.0], [-0.3, 0.0, -1.0])
    drive.log.clear()
    return drive


@pytest.mark.parametrize("frame", ["", "second", "nowhere"])
def test_a_message_that_is_of_no_use_moves_no_sensor(flying: Placed, frame: str) -> None:
    running, places = flying.estimator.navigator.filter, flying.places

    flying.imu(8.0, frame, (math.nan, 0.0, 0.0))
    flying.given_imu(ImuFields(flying.stamp(8.0), LEVEL, STILL, frame, specific_force_cov0=-1.0))
    flying.one_fix(8.0, frame, status=-1)

    assert flying.estimator.navigator.filter is running and flying.places == places
    assert not [name for name in flying.estimator.inputs.counts if "frame_id" in name]


@pytest.mark.parametrize("frame", ["", "second", "nowhere"])
def test_a_stray_message_is_refused_by_name(flying: Placed, frame: str) -> None:
    running, places = flying.estimator.navigator.filter, flying.places
    last_ns = flying.estimator.navigator.last_ns

    flying.imu(8.0, frame)
    flying.one_fix(8.0, frame)

    counts = flying.estimator.inputs.counts
    assert counts["imu/data: another frame_id"] == counts["gnss/fix: another frame_id"] == 1
    assert [f"the frame_id is '{frame}', not" in line for line in flying.warnings()] == [True] * 2
    assert flying.estimator.navigator.filter is running and flying.places == places
    assert flying.estimator.navigator.last_ns == last_ns
    flying.play(8.0, 12.0)
    assert flying.estimator.navigator.filter is running
    assert "another frame_id" in str(flying.status("input").values)


def test_of_two_publishers_the_first_is_used(flying: Placed) -> None:
    # WHEN a second one publishes at the same rate, for much longer than a change has to last
    alone = Placed()
    alone.play(0.0, 8.0)
    for k in range(400):
        for drive in (flying, alone):
            drive.play(8.0 + 0.01 * k, 8.0 + 0.01 * (k + 1))
        flying.imu(8.0 + 0.01 * (k + 0.5), "second", (3.0, 0.0, 9.8))

    # THEN it has changed nothing
    np.testing.assert_array_equal(flying.odometry, alone.odometry)
    assert flying.estimator.inputs.counts["imu/data: another frame_id"] == 400
    assert len(flying.warnings()) == 3


def test_a_frame_id_that_lasts_moves_the_sensor_once(flying: Placed) -> None:
    session = flying.estimator.noise.reader
    flying.frames = ("second", "gnss")
    flying.play(8.0, 9.0)
    assert flying.estimator.aligned and flying.places[0] == [0.3, 0.0, 0.0]

    flying.play(9.0, 20.0)

    assert flying.estimator.aligned and flying.places[0] == [0.0, -2.0, 0.0]
    assert flying.estimator.noise.reader is session  # the model is not loaded again
    assert flying.estimator.inputs.counts["imu/data: frame_id changes"] == 1
    assert "a sensor was moved, by /tf_static" in flying.warnings()[-1]


def test_a_sensor_that_moves_in_motion_does_not_bring_the_first_heading_back() -> None:
    """GIVEN a vehicle that has turned since it began THEN the heading is the motion's to show."""
    drive = Placed()
    drive.play(0.0, 40.0)
    navigator, errors = drive.estimator.navigator, []
    drive.frames = ("second", "gnss")

    for k in range(40, 55):
        drive.play(k, k + 1.0)
        i = int(np.argmin(np.abs(drive.truth.t - k - 1.0)))
        if navigator.filter is not None:
            turn = heading_from_quat(navigator.filter.nav[QUAT])
            turn -= heading_from_quat(drive.truth.quat_xyzw[i])
            errors.append(abs(math.remainder(turn, math.tau)))

    assert "a sensor was moved" in "".join(drive.warnings())
    assert len(errors) > 5 and max(errors) < 0.5


@pytest.mark.parametrize("frame", ["nowhere", ""])
def test_a_frame_id_without_a_transform_takes_the_place_away_and_says_so(
    flying: Placed, frame: str
) -> None:
    for k in range(12):  # samples stop meanwhile: one in a row is enough
        flying.one_fix(8.0 + 0.2 * k, frame)

    assert flying.places[1] == [-0.3, 0.0, 0.0]
    assert flying.estimator.inputs.counts["gnss/fix: another frame_id"] == CONFIRMED
    [line, *_] = [text for level, text in flying.log if level == "info"]
    assert line == (
        f"gnss/fix: no transform from 'base_link' to '{frame}' (neither gnss.antenna_position nor "
        "/tf_static): assuming that they coincide"
    )


def test_a_frame_id_at_the_same_place_is_used_at_once(flying: Placed) -> None:
    drive = Drive(**KNOWN)  # without transforms
    drive.play(0.0, 8.0)
    running = drive.estimator.navigator.filter

    drive.estimator.handle_imu(ImuFields(drive.stamp(8.0), LEVEL, STILL, "other"))

    assert drive.estimator.navigator.filter is running
    assert drive.estimator.navigator.last_ns == drive.stamp(8.0)


def test_of_two_publishers_without_transforms_each_frame_is_told_once() -> None:
    drive = Drive()
    for k in range(300):
        frame = "second" if k % 2 else "first"
        drive.estimator.handle_imu(ImuFields(drive.stamp(0.01 * k), LEVEL, STILL, frame))

    told = [text for level, text in drive.log if "no transform" in text]
    assert ["'first'" in text for text in told] == [True, False]
    assert any("frame_id changes" in text for text in drive.warnings())


def test_a_recording_is_read_as_it_is_live() -> None:
    # GIVEN messages of a second publisher among those of the first, and then of the second alone
    one, block = Placed(), Placed()
    for drive in (one, block):
        drive.play(0.0, 8.0)
    n = 400
    stamps = np.array([one.stamp(8.0 + 0.01 * k) for k in range(n)])
    force, rate = np.tile(LEVEL, (n, 1)), np.zeros((n, 3))
    frames = ["second" if k % 7 == 3 or k > 200 else "imu" for k in range(n)]

    for k, frame in enumerate(frames):
        one.given_imu(ImuFields(int(stamps[k]), LEVEL, STILL, frame))
        one.estimator.run_periodic()
    block.estimator.handle_imu = block.given_imu  # type: ignore[method-assign]
    start = 0
    for stop in range(1, n + 1):
        if stop == n or frames[stop] != frames[start]:
            rows = slice(start, stop)
            handle_imu_block(
                block.estimator, stamps[rows], force[rows], rate[rows], frame_id=frames[start]
            )
            start = stop

    assert one.estimator.inputs.counts == block.estimator.inputs.counts
    assert one.estimator.inputs.counts["imu/data: another frame_id"] > 100
    assert one.places == block.places == ([0.0, -2.0, 0.0], [0.0, 2.0, -1.0])
    assert one.estimator.navigator.last_ns == block.estimator.navigator.last_ns
