"""Odometry in odom: no jumps, the same motion, and transforms that fit both."""

import numpy as np
import pytest
from support.scenes import scene

from hybrid_ins import parameters
from hybrid_ins.bags.messages import new_message
from hybrid_ins.core.inertial.rotations import matrix_from_quat, quat_from_rpy
from hybrid_ins.ros.estimator.estimator import Estimator
from hybrid_ins.ros.messages.cdr import ImuFields
from hybrid_ins.ros.messages.conversions import FLIP, set_stamp
from hybrid_ins.ros.output.odom_frame import advance, map_from_odom, start
from hybrid_ins.simulation.motions import quadrotor_flight

EPOCH_NS = 1_700_000_000_000_000_000
RATE = 100.0


def odometry(position, rpy, velocity=(0.0, 0.0, 0.0), rate=(0.0, 0.0, 0.0)):
    values = np.zeros(85)
    values[:3], values[3:7] = position, quat_from_rpy(*rpy)
    values[43:46], values[46:49] = velocity, rate
    values[7:43], values[49:85] = 0.01 * np.eye(6).ravel(), 0.01 * np.eye(6).ravel()
    return values


@pytest.fixture(scope="module")
def flown():
    """Odometry in map and odom of a flight whose fixes jump by 20 m: rows (N, 85), stamps."""
    flight = scene(quadrotor_flight(60.0, 3), seed=0)
    estimator = Estimator(
        {
            **parameters.defaults(),
            "alignment.heading_source": "parameter",
            "alignment.yaw": np.pi / 2,
            "gnss.time_offset.estimate": False,
        },
        lambda level, text: None,
    )
    message = new_message("sensor_msgs/msg/NavSatFix")
    message.position_covariance = np.diag([0.01, 0.01, 0.02]).ravel()
    message.position_covariance_type = 2
    rows, k = [], 0
    for t, f, w in zip(flight.t, flight.force @ FLIP, flight.rate @ FLIP, strict=True):
        t_ns = EPOCH_NS + round(t * 1e9)
        odometry = estimator.handle_imu(ImuFields(t_ns, tuple(f), tuple(w)))
        if odometry is not None:
            rows.append((t, odometry.in_map, odometry.in_odom))
        estimator.run_periodic()
        while k < len(flight.fix_t) and flight.fix_t[k] <= t:
            set_stamp(message.header.stamp, EPOCH_NS + round(flight.fix_t[k] * 1e9))
            shift = 20.0 if flight.fix_t[k] > 30.0 else 0.0
            message.latitude, message.longitude = np.degrees(flight.fix_lla[k, :2]).tolist()
            message.latitude += shift / 111_000.0
            message.altitude = float(flight.fix_lla[k, 2])
            estimator.handle_fix(message)
            k += 1
    t, in_map, in_odom = zip(*rows, strict=True)
    return np.array(t), np.array(in_map), np.array(in_odom)


@pytest.mark.slow
def test_no_step_is_longer_than_speed_times_time(flown) -> None:
    t, in_map, in_odom = flown
    steps = np.linalg.norm(np.diff(in_odom[:, :3], axis=0), axis=1)
    speed = np.linalg.norm(in_odom[:, 43:46], axis=1)
    bound = np.maximum(speed[1:], speed[:-1]) * np.diff(t)

    assert np.all(steps <= bound + 1e-6)
    # WHILE the map's odometry does jump
    assert np.linalg.norm(np.diff(in_map[:, :3], axis=0), axis=1).max() > 5.0


def test_no_turn_is_larger_than_rate_times_time(flown) -> None:
    t, _, in_odom = flown
    C = matrix_from_quat(in_odom[:, 3:7])
    turn = np.arccos(np.clip((np.einsum("nij,nij->n", C[1:], C[:-1]) - 1.0) / 2.0, -1.0, 1.0))
    rate = np.linalg.norm(in_odom[:, 46:49], axis=1)
    # Tilt is the filter's own: a correction of it shows.
    assert np.quantile(turn - np.maximum(rate[1:], rate[:-1]) * np.diff(t), 0.9) < 1e-4


def test_map_to_odom_to_base_is_map_to_base(flown) -> None:
    _, in_map, in_odom = flown
    for row, local in zip(in_map[::50], in_odom[::50], strict=True):
        origin, yaw = map_from_odom(row, local)
        turn = matrix_from_quat(quat_from_rpy(0.0, 0.0, yaw))
        assert origin + turn @ local[:3] == pytest.approx(row[:3], abs=1e-9)
        np.testing.assert_allclose(
            turn @ matrix_from_quat(local[3:7]), matrix_from_quat(row[3:7]), atol=1e-9
        )


def test_twist_is_that_of_the_map_and_covariances_are_positive(flown) -> None:
    _, in_map, in_odom = flown
    np.testing.assert_array_equal(in_map[:, 43:], in_odom[:, 43:])
    pose = in_odom[:, 7:43].reshape(-1, 6, 6)
    assert np.linalg.eigvalsh(pose).min() > 0.0
    # AND height and yaw are never known better than before; a way that is turned about its
    # beginning ends where it began once the vehicle is back
    assert np.all(np.diff(pose[:, [2, 5], [2, 5]], axis=0) >= 0.0)


def test_uniform_motion_is_followed_exactly() -> None:
    state, out = start(), np.zeros(85)
    for k in range(101):
        advance(
            state,
            0.01 if k else 0.0,
            odometry(
                (5.0 + 0.02 * k, 0.0, 0.0),
                (0.0, 0.0, 0.3),
                (2.0 * np.cos(0.3), -2.0 * np.sin(0.3), 0.0),
            ),
            out,
        )
    # From odom's origin, 1 s at 2 m/s along the map's east, which odom's axes are turned from.
    assert np.linalg.norm(out[:3]) == pytest.approx(2.0, abs=1e-9)


def test_a_correction_of_the_map_does_not_move_odom() -> None:
    state, out = start(), np.zeros(85)
    advance(state, 0.0, odometry((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)), out)
    before = out[:7].copy()
    # WHEN position and heading are corrected between two samples of a standing vehicle
    advance(state, 0.01, odometry((30.0, -4.0, 2.0), (0.0, 0.0, 0.5)), out)
    assert out[:7] == pytest.approx(before, abs=1e-12)


def test_a_new_start_goes_on_from_the_last_pose() -> None:
    state, out = start(), np.zeros(85)
    for k in range(50):
        advance(
            state,
            0.01 if k else 0.0,
            odometry((0.01 * k, 0.0, 0.0), (0.0, 0.0, 0.0), (1.0, 0.0, 0.0)),
            out,
        )
    before = out[:3].copy()
    advance(state, 0.0, odometry((100.0, 0.0, 0.0), (0.0, 0.0, 1.0), (1.0, 0.0, 0.0)), out)
    assert out[:3] == pytest.approx(before)


def test_covariances_are_those_of_a_yaw_that_drifts_while_the_map_is_corrected() -> None:
    # GIVEN vehicles at 10 m/s whose yaw rate is wrong, while fixes hold the yaw of the map
    rng = np.random.default_rng(0)
    runs, walk, fix_std = 200, 1e-5, 0.1  # rad²/s, rad
    t = np.arange(400.0)
    turns = np.where(t > 0.0, 0.02 * np.sin(0.01 * t), 0.0)
    true_yaw = np.cumsum(turns)
    yaw_errors, position_errors, claimed = [], [], []
    for _ in range(runs):
        state, out = start(), np.zeros(85)
        error, variance, odom_yaw = 0.1 * rng.standard_normal(), 0.01, 0.0
        for k, turn in enumerate(turns):
            wrong = np.sqrt(walk) * rng.standard_normal() if k else 0.0
            error, variance = error + wrong, variance + (walk if k else 0.0)
            odom_yaw += turn + wrong
            direction = np.array([np.cos(error), -np.sin(error)])  # that of the map's is right
            row = odometry(np.zeros(3), (0.0, 0.0, true_yaw[k] + error), (*10.0 * direction, 0.0))
            row[7:43], row[49:85], row[42] = 0.0, 0.0, variance
            state[12] = row[48] = turn + wrong
            advance(state, 1.0 if k else 0.0, row, out)
            if k % 20 == 19:
                gain = variance / (variance + fix_std**2)
                error -= gain * (error + fix_std * rng.standard_normal())
                variance *= 1.0 - gain
        yaw_errors.append(odom_yaw - true_yaw[-1])
        way = 10.0 * np.array([np.cos(true_yaw[1:]).sum(), np.sin(true_yaw[1:]).sum()])
        position_errors.append(out[:2] - way)
        claimed.append(out[7:43].reshape(6, 6).copy())
    # THEN odom is as wrong as it claims: 3.5° and 90 m after 4 km
    position, yaw = np.mean(claimed, axis=0)[:2, :2], np.mean(claimed, axis=0)[5, 5]
    assert np.mean(np.square(yaw_errors)) == pytest.approx(yaw, rel=0.3)
    np.testing.assert_allclose(
        np.mean([e @ np.linalg.solve(position, e) for e in position_errors]), 2.0, rtol=0.3
    )


def test_a_corrected_yaw_of_the_map_is_no_drift_of_odom() -> None:
    state, out = start(), np.zeros(85)
    row = odometry(np.zeros(3), np.zeros(3))
    for k in range(100):
        row[42] = 0.04 / (1 + k)
        advance(state, 0.01 if k else 0.0, row, out)
    assert out[42] < 1e-5
