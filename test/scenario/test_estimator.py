"""The estimator between its messages: control, restarts, and what it says of bad input."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from support.drive import GIVEN, KNOWN, Drive
from support.long_stand import car_then_stand

from hybrid_ins import parameters
from hybrid_ins.bags.messages import new_message
from hybrid_ins.core.inertial.rotations import quat_from_rpy
from hybrid_ins.core.noise.process_noise import ConstantNoise
from hybrid_ins.core.update import chi_square
from hybrid_ins.ros.messages.conversions import FLIP, mount_matrix, set_stamp, stamp_ns
from hybrid_ins.ros.reporting.reports import Diagnostics, MapOdometry
from hybrid_ins.simulation.motions import (
    START_LLA,
    Motion,
    integral,
    motion_through,
    smoothed,
    time_grid,
    velocity_of,
)


def test_reset_aligns_anew_and_keeps_the_map() -> None:
    drive = Drive(**GIVEN)
    drive.play(0.0, 10.0)
    datum = [report.topic for report in drive.estimator.pop_reports()].count("datum")

    drive.estimator.reset()

    assert not drive.estimator.aligned
    drive.play(10.0, 10.5)
    assert "aligning" in drive.status("filter").text
    drive.play(10.5, 30.0)
    assert drive.estimator.aligned and drive.error(29.99) < 0.5
    again = [report.topic for report in drive.estimator.pop_reports()].count("datum")
    assert (datum, again) == (1, 0)


def test_a_pose_by_hand_gives_the_heading() -> None:
    # GIVEN an estimator that waits for motion to show its heading
    drive = Drive()
    drive.play(0.0, 3.5)
    assert not drive.estimator.aligned
    pose = new_message("geometry_msgs/msg/PoseWithCovarianceStamped")
    q = pose.pose.pose.orientation
    q.x, q.y, q.z, q.w = quat_from_rpy(0.0, 0.0, math.pi / 2 - 0.7).tolist()
    pose.pose.covariance[35] = 0.02**2

    drive.estimator.handle_initial_pose(pose)

    drive.play(3.5, 4.2)
    assert drive.estimator.aligned
    assert float(drive.status("filter").values[4][1]) < 2.0  # sigma_heading_deg


def test_a_pose_without_rotation_changes_nothing() -> None:
    drive = Drive(**GIVEN)
    drive.play(0.0, 5.0)
    before = drive.odometry.copy()
    drive.estimator.handle_initial_pose(new_message("geometry_msgs/msg/PoseWithCovarianceStamped"))
    assert drive.estimator.aligned and np.array_equal(before, drive.odometry)
    assert drive.estimator.inputs.counts["initialpose: no orientation"] == 1


def test_a_pose_in_another_frame_is_refused_with_the_remedy() -> None:
    drive = Drive(**GIVEN)
    drive.play(0.0, 5.0)
    pose = new_message("geometry_msgs/msg/PoseWithCovarianceStamped")
    pose.header.frame_id, pose.pose.pose.orientation.w = "odom" * 1000, 1.0

    drive.estimator.handle_initial_pose(pose)

    assert drive.estimator.aligned
    assert drive.estimator.inputs.counts["initialpose: other frame"] == 1
    [line] = drive.warnings()
    assert "not 'map'" in line and len(line) < 300


def test_what_a_user_changes_leaves_a_line() -> None:
    drive = Drive(**GIVEN)
    drive.play(0.0, 5.0)
    pose = new_message("geometry_msgs/msg/PoseWithCovarianceStamped")
    pose.pose.pose.orientation.w, pose.pose.covariance[35] = 1.0, math.radians(3.0) ** 2
    drive.log.clear()

    drive.estimator.change({"gnss.patience": 1.5})
    drive.estimator.handle_initial_pose(pose)
    drive.estimator.reset()

    assert drive.log == [
        ("info", "parameter gnss.patience is 1.5 from now on"),
        ("info", "initialpose: heading 90.0° ± 3.0° from north: aligning anew"),
        ("info", "reset: aligning anew"),
    ]


def test_the_summary_says_that_fixes_have_ended() -> None:
    drive = Drive(**KNOWN)
    drive.play(0.0, 12.0)
    assert "none in the last" not in drive.estimator.status.summary()

    drive.play(12.0, 30.0, with_fixes=False)
    assert "fixes fused; none in the last 18 s" in drive.estimator.status.summary()


def test_a_flood_of_fixes_is_cut_and_told() -> None:
    drive = Drive()
    drive.play(0.0, 2.0, with_fixes=False)

    for k in range(600):
        drive.fix(k % 5)

    assert drive.estimator.inputs.counts["gnss: too many messages"] == 500
    assert any("more than 100 in a second" in line for line in drive.warnings())


@pytest.mark.parametrize("leap", [1, -1, 3])
def test_a_receiver_whose_clock_leaps_by_whole_seconds_is_followed(leap: int) -> None:
    # GIVEN a filter that runs on fixes 0.1 s late
    drive = Drive(**KNOWN)
    drive.delay = 0.1
    drive.play(0.0, 15.0)
    # WHEN the receiver stamps by whole seconds earlier or later from then on
    stamp, fix = drive.stamp, drive.fix

    def leapt(k: int) -> None:
        drive.stamp = lambda t: stamp(t) + leap * 1_000_000_000  # type: ignore[method-assign]
        fix(k)
        drive.stamp = stamp  # type: ignore[method-assign]

    drive.fix = leapt  # type: ignore[method-assign]
    drive.play(15.0, 25.0)
    # THEN its stamps are corrected by that, which is told, and the state is right
    assert drive.estimator.clock.offset == -leap
    assert any(f"leapt by {leap:+d} s" in line for line in drive.warnings())
    assert drive.error(25.0) < 0.5


@pytest.mark.parametrize(("before", "after"), [(0.1, 1.1), (1.1, 0.1)])
def test_a_driver_that_is_one_message_late_from_then_on_keeps_its_stamps(
    before: float, after: float
) -> None:
    # GIVEN a filter that runs on fixes with a delay
    drive = Drive(**{**KNOWN, "gnss.max_delay": 2.0})
    drive.delay = before
    drive.play(0.0, 15.0)
    # WHEN the delay changes by a second, as that of a driver whose buffer fills or is emptied
    drive.delay = after
    drive.play(15.0, 16.5, with_fixes=False)
    drive.play(16.5, 26.0)
    # THEN the stamps are right as they are
    assert drive.estimator.clock.offset == 0.0
    assert not any("leapt" in line for line in drive.warnings())
    assert drive.error(26.0) < 0.5


def test_changes_while_it_runs_keep_the_state_and_outlast_late_fixes() -> None:
    # GIVEN fixes that come 0.3 s late: each is fused in a state from before
    drive = Drive(**KNOWN)
    drive.delay = 0.3
    drive.play(0.0, 20.0)
    running = drive.estimator.navigator.filter
    assert running is not None and running.update.scatter.learning

    # WHEN parameters change, and the next fixes come
    for changes in (
        {"noise.mode": "constant"},
        {"gnss.gate_probability": 0.99},
        {"gnss.patience": 7.0},
        {"gnss.position_std_min": 0.05},
        {"gnss.time_offset.std": 0.004},
        {"imu.accelerometer_bias_walk": 2e-3},
    ):
        drive.estimator.change(parameters.check_change(drive.estimator.values, changes))
        assert drive.estimator.aligned
    drive.play(20.0, 20.5)

    # THEN the changed values are in force, in the filter that ran before
    assert drive.estimator.navigator.filter is running
    gate, threshold = running.update.gate, chi_square.quantile(0.99, 3)
    assert [gate.ordinary_limit("position", 3, s) for s in (6.9, 7.1)] == [threshold, -1.0]
    assert running.clock.prior is not None and running.clock.prior.scale == 0.004
    assert isinstance(running.noise.model, ConstantNoise)
    assert running.noise.process.bias_walk.tolist() == [4e-6] * 3 + [1e-8] * 3
    assert not running.update.scatter.learning
    drive.estimator.change({"noise.mode": "learned"})
    drive.play(20.5, 30.0)
    assert drive.estimator.navigator.filter is running and running.update.scatter.learning
    assert drive.error(29.99) < 0.5
    assert not drive.warnings()


def test_what_a_search_found_of_the_clock_outlasts_fixes_from_before_it() -> None:
    # GIVEN fixes that come later than the filters of a search lag behind the IMU
    drive = Drive(**GIVEN)
    drive.delay = 0.9

    # WHEN the search has ended, and some of them come that are older than its end
    drive.play(0.0, 14.0)

    assert any("clock offset found" in text for _, text in drive.log)
    running = drive.estimator.navigator.filter
    assert running is not None and running.clock.prior is not None


def test_a_change_leaves_alone_what_it_does_not_concern() -> None:
    drive = Drive(**KNOWN)
    drive.play(0.0, 5.0)
    running = drive.estimator.navigator.filter
    assert running is not None
    update = running.update
    before = update.gate, update.noise, update.clock.prior, update.scatter

    drive.estimator.change({"odometry_rate": 50.0})

    after = running.update.gate, running.update.noise, update.clock.prior, running.update.scatter
    assert all(a is b for a, b in zip(after, before, strict=True))


def test_filters_after_a_change_follow_it() -> None:
    drive = Drive(**KNOWN, **{"noise.mode": "constant"})
    drive.play(0.0, 5.0)

    drive.estimator.change({"noise.mode": "learned"})
    drive.estimator.reset()
    drive.play(5.0, 12.0)

    running = drive.estimator.navigator.filter
    assert running is not None and running.update.scatter.learning


def test_odometry_before_the_heading_is_known_follows_a_changed_noise() -> None:
    drive = Drive(**{"alignment.heading_source": "imu"})  # whose messages have no orientation
    drive.play(0.0, 1.0)
    drive.estimator.pop_reports()

    drive.estimator.change({"noise.q_gyroscope": 0.25})

    drive.play(1.0, 1.5)
    found = [report.content for report in drive.estimator.pop_reports()]
    values = [content.values for content in found if isinstance(content, MapOdometry)]
    assert values and all(row[49 + 21] >= 0.25 for row in values)  # variance of the rate about x


@pytest.mark.parametrize(
    ("source", "gravity", "text"),
    [
        ("motion", 0.0, "gravity seems to be removed: let the driver publish specific force"),
        ("imu", 9.8, "an orientation in the IMU messages: let the driver fill it"),
    ],
)
def test_an_imu_that_no_filter_starts_with_is_named_in_the_log(
    source: str, gravity: float, text: str
) -> None:
    drive = Drive(**{"alignment.heading_source": source})

    drive.play(0.0, 13.0, force=lambda f: f - np.array([0.0, 0.0, 9.8 - gravity]))

    assert not drive.estimator.aligned
    (line,) = (line for line in drive.warnings() if text in line)
    assert line.startswith("aligning: it needs ") and line.endswith("(for 10 s so far)")


@pytest.mark.parametrize("max_speed", [515.0, 0.1])
def test_odometry_of_a_search_follows_a_changed_speed_limit(max_speed: float) -> None:
    drive = Drive()
    drive.play(0.0, 3.5)
    assert not drive.estimator.aligned and drive.estimator.navigator.phase.best is not None
    drive.estimator.pop_reports()

    drive.estimator.change({"gnss.max_speed": max_speed})

    drive.play(3.5, 3.8)
    topics = {report.topic for report in drive.estimator.pop_reports()}
    assert ("odometry" in topics) is (max_speed > 1.0)


@pytest.mark.parametrize(
    "jump",
    [-3600.0, *(pytest.param(by, marks=pytest.mark.slow) for by in (3600.0, -5.0))],
    ids=["back", "ahead", "loop"],
)
def test_clocks_that_jump_begin_anew_said_once(jump: float) -> None:
    drive = Drive()
    drive.play(0.0, 25.0)
    assert drive.estimator.aligned
    # WHEN simulated time, or a bag that is played again, jumps
    drive.shift_ns = round(jump * 1e9)
    drive.play(25.0, 50.0)

    said = [text for text in drive.warnings() if "aligning anew" in text]
    assert len(said) == 1, drive.warnings()
    assert drive.estimator.aligned and drive.error(49.99) < 0.5


def test_the_time_of_arrival_replaces_stamps_where_the_owner_gives_it() -> None:
    drive, other = Drive(**KNOWN), Drive(**KNOWN)
    handle_imu, handle_fix = drive.estimator.handle_imu, drive.estimator.handle_fix

    def imu(fields: Any) -> Any:
        return handle_imu(fields._replace(stamp_ns=0), fields.stamp_ns)

    def fix(message: Any) -> None:
        received_ns = stamp_ns(message.header.stamp)
        set_stamp(message.header.stamp, 0)
        handle_fix(message, received_ns)

    drive.estimator.handle_imu = imu  # type: ignore[method-assign, assignment]
    drive.estimator.handle_fix = fix  # type: ignore[method-assign, assignment]
    for each in (drive, other):
        each.play(0.0, 8.0)

    assert drive.published > 300
    np.testing.assert_array_equal(drive.odometry, other.odometry)


def test_accelerations_of_zero_are_no_free_fall() -> None:
    drive = Drive(**KNOWN)
    drive.play(0.0, 20.0)
    before = drive.odometry.copy()

    drive.play(20.0, 20.3, force=np.zeros_like)

    assert np.array_equal(before, drive.odometry)
    assert drive.estimator.inputs.counts["imu: no acceleration"] == 30
    assert any("exactly zero" in text for text in drive.warnings())
    drive.play(20.3, 30.0)
    assert drive.error(29.99) < 0.5


def test_an_unusable_imu_ends_dead_reckoning_and_its_biases_are_remembered() -> None:
    drive = Drive()
    drive.play(0.0, 30.0)
    running = drive.estimator.navigator.filter
    assert running is not None
    known = running.state.bias_g.copy()

    # WHEN the driver begins to remove gravity
    drive.play(30.0, 34.0, force=lambda f: f - np.array([0.0, 0.0, 9.8]))

    assert not drive.estimator.aligned
    status = drive.status("input")
    assert status.level == 2 and "no gravity" in status.text and "specific force" in status.text
    drive.play(34.0, 50.0)
    assert drive.estimator.aligned and drive.error(49.99) < 0.5
    again = drive.estimator.navigator.filter
    assert again is not None
    assert again.state.bias_g == pytest.approx(known, abs=1e-3)


def test_a_push_over_without_fixes_is_a_motion_until_it_lasts_too_long() -> None:
    # GIVEN a flight in an outage
    drive = Drive(**KNOWN)
    drive.play(0.0, 30.0)
    drive.play(30.0, 34.0, with_fixes=False)

    # WHEN it feels three tenths of gravity for 2 s, as over the top of a loop
    drive.play(34.0, 36.0, force=lambda f: 0.3 * f, with_fixes=False)
    drive.play(36.0, 38.0, with_fixes=False)

    # THEN it has fallen as far as that
    fallen = 0.7 * 9.8 * (0.5 * 2.0**2 + 2.0 * 2.0)
    height = drive.track.position_enu[np.searchsorted(drive.truth.t, 37.99), 2]
    assert drive.estimator.aligned
    assert height - drive.odometry[2] == pytest.approx(fallen, rel=0.15)

    # AND no flight feels it for 6 s
    drive.play(38.0, 44.0, force=lambda f: 0.3 * f, with_fixes=False)
    assert not drive.estimator.aligned
    assert "no gravity" in drive.status("input").text


def pushed_over(duration: float = 30.0) -> Motion:
    """Return a climbing turn that feels a quarter of gravity from 1 s on, for 2 s."""
    t = time_grid(duration)
    weight = np.where((t > 1.0) & (t < 3.0), 0.25, np.where((t > 3.0) & (t < 6.0), 1.4, 1.0))
    climb = 6.0 - integral(9.8 * (1.0 - smoothed(weight, 0.3)))
    course = integral(np.full(len(t), 0.15))
    velocity = velocity_of(np.full(len(t), 15.0), course, climb)
    rpy = np.stack((np.zeros(len(t)), np.zeros(len(t)), course), axis=-1)
    return motion_through(t, velocity, rpy, START_LLA)


def test_a_push_over_before_the_heading_is_known_is_a_motion() -> None:
    drive = Drive(pushed_over())
    drive.play(0.0, 2.0)
    assert not drive.estimator.aligned

    drive.play(2.0, 29.9)

    assert not drive.warnings()
    assert drive.estimator.aligned and drive.error(29.89) < 0.5


@pytest.mark.parametrize("rpy", [(0.0, 0.0, 0.0), (0.0, 0.35, 0.0), (np.pi, 0.0, 0.0)])
def test_a_turn_beyond_the_range_is_noticed_however_the_imu_is_mounted(
    rpy: tuple[float, float, float],
) -> None:
    # GIVEN half a second in which a gyroscope reads as much as it can
    drive = Drive(**KNOWN, **{"imu.mount_rpy": list(rpy)})
    to_own = FLIP @ mount_matrix(rpy)
    drive.force, drive.rate = drive.force @ to_own, drive.rate @ to_own
    beyond = (drive.truth.t > 20.0) & (drive.truth.t < 20.5)
    drive.rate[beyond, 2] = 4.36

    drive.play(0.0, 22.0)

    # THEN it is named, and the attitude is not kept
    assert any("rate on axis z stays at 4.36" in text for text in drive.warnings())
    assert any("a turn beyond the gyroscope's range" in text for text in drive.warnings())


def test_a_receiver_that_repeats_its_position_in_flight_is_not_believed() -> None:
    drive = Drive(**KNOWN)
    drive.play(0.0, 30.0)
    stuck = drive.fix_lla.copy()
    drive.fix_lla[150:165] = stuck[150]

    drive.play(30.0, 33.0)

    assert drive.estimator.inputs.counts["gnss: same position while moving"] == 14
    assert drive.error(32.99) < 2.0


def test_a_receiver_that_holds_its_position_is_not_believed_once_the_vehicle_stops() -> None:
    """
    GIVEN a car whose receiver holds its last position from the entrance of a garage on
    WHEN the car stops 30 m further on
    THEN its position stays where it is.
    """
    values = {**KNOWN, "alignment.yaw": np.pi / 2 - 1.0}
    drive = Drive(car_then_stand(60.0, 1), **values)
    drive.fix_lla[90:] = drive.fix_lla[90]

    drive.play(0.0, 59.9)

    places = drive.track.position_enu[np.searchsorted(drive.truth.t, (18.0, 59.89))]
    away = float(np.linalg.norm(places[1] - places[0]))
    assert away > 25.0
    assert drive.error(59.89) < 0.2 * away
    assert drive.estimator.inputs.counts["gnss: same position while moving"] == 209


def test_a_driver_that_repeats_each_fix_with_new_stamps_is_named_and_its_repeats_are_refused() -> (
    None
):
    """
    GIVEN fixes once a second, which the driver publishes five times a second with new stamps
    WHEN the heading is not known yet
    THEN the state before is given up, the first of each is used, the warning names the remedy.
    """
    drive = Drive(**{"gnss.time_offset.estimate": False})
    drive.fix_lla = drive.fix_lla[np.arange(len(drive.fix_lla)) // 5 * 5]

    drive.play(0.0, 40.0)

    counts = drive.estimator.inputs.counts
    assert counts["gnss: published again with a new stamp"] >= 4 * 33
    assert counts["restart: the driver repeats fixes"] <= 1
    [first, *_] = [text for text in drive.warnings() if "several times, with new stamps" in text]
    assert "publish at the receiver's rate" in first
    assert drive.estimator.aligned
    assert drive.error(39.99) < 0.5


def test_a_filter_that_just_started_reckons_from_its_first_fix() -> None:
    drive = Drive(**GIVEN)
    drive.play(0.0, 1.3)
    texts = [
        status.text
        for report in drive.estimator.pop_reports()
        if isinstance(report.content, Diagnostics)
        for status in report.content.statuses
    ]

    assert drive.published
    assert not any("inf" in text.split() or "dead reckoning" in text for text in texts)
    assert drive.status("filter").text == "aligned, GNSS fused"
    assert drive.status("validity").text == "position good, velocity good, heading good"


@pytest.mark.slow
def test_an_outage_after_the_clock_went_back_is_one() -> None:
    drive = Drive(**KNOWN)
    drive.play(0.0, 10.0)
    drive.shift_ns = -3600 * 10**9
    drive.play(10.0, 20.0)
    drive.play(20.0, 25.0, with_fixes=False)

    assert "dead reckoning for 5 s" in drive.status("filter").text
    assert "position coasting" in drive.status("validity").text


def reported_odometry(drive: Drive) -> list[int]:
    """Return the stamps [ns] of the odometry that was reported since the last call."""
    reports = drive.estimator.reporter.pop()
    return [report.content.t_ns for report in reports if report.topic == "odometry"]


def test_odometry_begins_with_the_first_fix() -> None:
    # GIVEN an IMU AND one fix after a second
    drive = Drive()
    drive.play(0.0, 1.0, with_fixes=False)
    assert not reported_odometry(drive)
    drive.fix(int(np.searchsorted(drive.fix_t, 0.95)))
    # WHEN no other follows
    drive.play(1.0, 2.0, with_fixes=False)
    # THEN odometry comes ten times a second
    stamps = reported_odometry(drive)
    assert (stamps[0] - drive.stamp(1.0)) * 1e-9 == pytest.approx(0.05, abs=0.1)
    assert len(stamps) == pytest.approx(10, abs=1)
    # AND it is said that nothing is known of the motion
    assert drive.status("validity").text.endswith("velocity waiting, heading waiting")
    assert "a second GNSS fix" in drive.status("filter").text


def test_odometry_of_a_search_comes_as_often_as_is_asked_for() -> None:
    drive = Drive()
    drive.play(0.0, 2.0)
    reported_odometry(drive)
    drive.estimator.change({"odometry_rate": 2.0})
    drive.play(2.0, 4.0)
    assert drive.estimator.navigator.filter is None
    assert len(reported_odometry(drive)) == pytest.approx(4, abs=1)


def test_an_outage_says_how_long_and_how_far() -> None:
    drive = Drive(**KNOWN)
    drive.play(0.0, 30.0)
    drive.play(30.0, 40.0, with_fixes=False)
    status = drive.status("filter")
    said = dict(status.values)
    assert status.level == 1 and "dead reckoning for 10 s" in status.text
    assert float(said["since_last_fix"]) == pytest.approx(10.0, abs=0.3)
    assert drive.error(39.99) < 4.0 * float(said["sigma_position_horizontal"]) + 0.1
