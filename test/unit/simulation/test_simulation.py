"""Simulated truth obeys the laws of motion on the rotating Earth; errors have the stated size."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hybrid_ins.bags.flight_bag import EPOCH_NS
from hybrid_ins.bags.reader import BagReader
from hybrid_ins.cli.simulate import main
from hybrid_ins.core.inertial import earth
from hybrid_ins.core.inertial.rotations import (
    matrix_from_quat,
    quat_conjugate,
    quat_from_matrix,
    quat_from_rpy,
    quat_multiply,
    rotvec_from_quat,
)
from hybrid_ins.core.inertial.strapdown import mechanise
from hybrid_ins.simulation.motions import (
    GRID_STEP,
    Motion,
    aircraft_flight,
    car_drive,
    quadrotor_flight,
    random_motion,
    static,
)
from hybrid_ins.simulation.sensors import (
    ImuErrors,
    Tone,
    Truth,
    corrupt,
    fixes,
    sample,
    sample_times,
)
from hybrid_ins.simulation.vehicles import VEHICLES

MOTIONS: list[Callable[..., Motion]] = [
    quadrotor_flight,
    car_drive,
    aircraft_flight,
    random_motion,
]
START = np.array([np.radians(-52.0), np.radians(171.0), 300.0])
PERFECT = ImuErrors(
    accelerometer_std=0.0,
    gyroscope_std=0.0,
    accelerometer_bias=0.0,
    gyroscope_bias=0.0,
    accelerometer_bias_walk=0.0,
    gyroscope_bias_walk=0.0,
)
STENCIL = 0.01 * np.arange(-3, 4)  # s
FIRST = np.array([-1, 9, -45, 0, 45, -9, 1]) / 0.6  # sixth-order differences on the stencil
SECOND = np.array([2, -27, 270, -490, 270, -27, 2]) / 0.018


def around(trajectory: Motion, t: float) -> Truth:
    return sample(trajectory, t + STENCIL)


def middle(values: np.ndarray) -> np.ndarray:
    return np.asarray(values[STENCIL.size // 2])


def C_eb(truth: Truth) -> np.ndarray:
    return np.array([earth.C_en(lla) for lla in truth.lla]) @ truth.C_nb


# --- the laws of motion, in the Earth-fixed frame, which sample() does not know ------------------


@pytest.mark.parametrize("motion", MOTIONS)
@given(seed=st.integers(0, 1000), knot=st.integers(5, 1490), heading=st.floats(-7.0, 7.0))
@settings(max_examples=25, deadline=None)
def test_truth_obeys_the_laws_of_motion(
    motion: Callable[..., Motion], seed: int, knot: int, heading: float
) -> None:
    # Between the knots of a spline, differences over several of them err by more than the limits.
    t = knot * GRID_STEP
    truth = around(motion(30.0, seed, start_lla=START, heading=heading), t)
    ecef = earth.lla_to_ecef(truth.lla)
    ecef -= middle(ecef)  # differences of small numbers
    rotation = np.array([0.0, 0.0, earth.EARTH_RATE])
    velocity_e, acceleration_e = FIRST @ ecef, SECOND @ ecef
    C_en, C_nb = earth.C_en(middle(truth.lla)), middle(truth.C_nb)
    lat, _, height = middle(truth.lla)
    gravity_north, gravity_down = earth.normal_gravity(lat, height)
    gravity_e = C_en @ [gravity_north, 0.0, gravity_down]

    force_e = acceleration_e + 2.0 * np.cross(rotation, velocity_e) - gravity_e
    attitude = quat_from_matrix(C_eb(truth))
    turns = rotvec_from_quat(quat_multiply(quat_conjugate(middle(attitude)), attitude))
    rate_eb_b = FIRST @ turns

    np.testing.assert_allclose(middle(truth.velocity_n), C_en.T @ velocity_e, atol=1e-6)
    np.testing.assert_allclose(middle(truth.specific_force_b), C_nb.T @ C_en.T @ force_e, atol=2e-4)
    np.testing.assert_allclose(
        middle(truth.angular_rate_b), rate_eb_b + C_nb.T @ C_en.T @ rotation, atol=1e-6
    )
    np.testing.assert_allclose(middle(truth.angular_rate_eb_b), rate_eb_b, atol=1e-6)


def test_standing_still_feels_gravity_and_the_earths_rotation() -> None:
    truth = sample(
        static(10.0, start_lla=START, heading=0.7, roll=0.1, pitch=-0.2), sample_times(10.0, 10.0)
    )
    lat, _, height = START
    C_nb = matrix_from_quat(quat_from_rpy(0.1, -0.2, 0.7))
    north, down = earth.normal_gravity(lat, height)
    rate_north, rate_down = earth.earth_rate_n(lat)

    np.testing.assert_allclose(truth.velocity_n, 0.0, atol=1e-12)
    np.testing.assert_allclose(truth.lla, np.tile(START, (101, 1)), rtol=1e-15)
    np.testing.assert_allclose(
        truth.specific_force_b, np.tile(-C_nb.T @ [north, 0.0, down], (101, 1)), atol=1e-12
    )
    np.testing.assert_allclose(
        truth.angular_rate_b, np.tile(C_nb.T @ [rate_north, 0.0, rate_down], (101, 1)), atol=1e-15
    )


def test_perfect_imu_integrates_back_to_truth_within_a_millimetre() -> None:
    """60 s at 1 kHz; the remainder falls with the square of the interval (point samples)."""
    truth = sample(quadrotor_flight(60.0), sample_times(60.0, 1000.0))
    lla, velocity = truth.lla[0].copy(), truth.velocity_n[0].copy()
    quat, C, f_n = truth.quat_xyzw[0].copy(), np.zeros(9), np.zeros(3)
    force, rate = truth.specific_force_b.tolist(), truth.angular_rate_b.tolist()

    for k in range(len(force) - 1):
        mechanise(lla, velocity, quat, force[k], rate[k], force[k + 1], rate[k + 1], 1e-3, C, f_n)

    error = (lla - truth.lla[-1]) * earth.curvature_scale(lla)
    assert np.linalg.norm(error) < 2e-3
    assert np.linalg.norm(velocity - truth.velocity_n[-1]) < 2e-4


# --- the motions are what they are called ---------------------------------------------------------


@given(seed=st.one_of(st.none(), st.integers(0, 1000)), rest=st.floats(1.0, 8.0))
@settings(max_examples=20, deadline=None)
def test_vehicles_stand_before_they_move(seed: int | None, rest: float) -> None:
    for motion in (quadrotor_flight, car_drive):
        truth = sample(motion(30.0, seed, rest=rest), sample_times(30.0, 50.0))
        standing, last = truth.t <= rest - 0.3, truth.t > 25.0
        assert np.abs(truth.velocity_n[standing]).max() < 1e-9
        assert np.abs(truth.angular_rate_eb_b[standing]).max() < 1e-9
        np.testing.assert_allclose(truth.specific_force_b[standing, :2], 0.0, atol=1e-4)
        assert np.linalg.norm(truth.velocity_n, axis=1).max() > 3.0
        assert motion is car_drive or np.linalg.norm(truth.velocity_n[last], axis=1).min() > 3.0


@pytest.mark.parametrize("motion", [car_drive, aircraft_flight])
def test_the_nose_follows_the_velocity(motion: Callable[..., Motion]) -> None:
    truth = sample(motion(120.0, 3), sample_times(120.0, 20.0))
    velocity_b = (np.swapaxes(truth.C_nb, 1, 2) @ truth.velocity_n[..., None])[..., 0]

    assert np.abs(velocity_b[:, 1:]).max() < 5e-3 * np.abs(velocity_b[:, 0]).max()


def test_turns_of_an_aircraft_are_coordinated() -> None:
    truth = sample(aircraft_flight(300.0), sample_times(300.0, 10.0))

    assert np.abs(truth.specific_force_b[:, 1]).max() < 0.01
    assert np.ptp(np.degrees(rotvec_from_quat(truth.quat_xyzw)[:, 0])) > 30.0


def test_a_quadrotor_feels_thrust_and_drag_only() -> None:
    truth = sample(quadrotor_flight(60.0), sample_times(60.0, 20.0))
    airspeed_b = (np.swapaxes(truth.C_nb, 1, 2) @ (truth.velocity_n * [1.0, 1.0, 0.0])[..., None])[
        ..., 0
    ]

    side = truth.specific_force_b[:, :2] + 0.25 * airspeed_b[:, :2]

    assert np.abs(side).max() < 0.02
    assert truth.specific_force_b[:, 2].max() < -5.0


def test_the_nominal_flight_flies_eights_with_straight_legs() -> None:
    truth = sample(quadrotor_flight(60.0), sample_times(60.0, 10.0))
    course_rate = np.gradient(
        np.unwrap(np.arctan2(truth.velocity_n[:, 1], truth.velocity_n[:, 0]))[150:], 0.1
    )

    assert (course_rate > 0.5).mean() > 0.15
    assert (course_rate < -0.5).mean() > 0.15
    assert (np.abs(course_rate) < 0.05).mean() > 0.1
    assert np.ptp(truth.lla[:, 2]) == pytest.approx(15.0, abs=2.0)


# --- IMU errors -----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def standing() -> Truth:
    return sample(static(300.0), sample_times(300.0, 200.0))


@pytest.fixture(scope="module")
def flying() -> Truth:
    return sample(quadrotor_flight(60.0), sample_times(60.0, 200.0))


def with_errors(**changes: object) -> ImuErrors:
    return ImuErrors(**{**vars(PERFECT), **changes})  # type: ignore[arg-type]


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def test_a_perfect_imu_reports_the_truth(flying: Truth) -> None:
    imu = corrupt(flying, PERFECT, rng())

    np.testing.assert_array_equal(imu.specific_force, flying.specific_force_b)
    np.testing.assert_array_equal(imu.angular_rate, flying.angular_rate_b)


def test_white_noise_has_the_stated_deviation_and_no_memory(standing: Truth) -> None:
    errors = with_errors(accelerometer_std=(0.02, 0.1, 0.5), gyroscope_std=0.002)
    imu = corrupt(standing, errors, rng())

    force = imu.specific_force - standing.specific_force_b
    rate = imu.angular_rate - standing.angular_rate_b

    np.testing.assert_allclose(force.std(0), (0.02, 0.1, 0.5), rtol=0.02)
    np.testing.assert_allclose(rate.std(0), 0.002, rtol=0.02)
    for noise in (force, rate):
        lagged = np.mean(noise[1:] * noise[:-1], axis=0) / noise.var(0)
        assert np.abs(lagged).max() < 4.5 / np.sqrt(len(noise))
    np.testing.assert_allclose(imu.accelerometer_std[0], (0.02, 0.1, 0.5))


def test_noise_schedule_multiplies_the_white_noise(standing: Truth) -> None:
    errors = with_errors(gyroscope_std=0.01, noise_schedule=[(200.0, 0.5), (100.0, 5.0)])
    imu = corrupt(standing, errors, rng())
    noise = imu.angular_rate - standing.angular_rate_b

    for first, last, factor in ((0, 100, 1.0), (100, 200, 5.0), (200, 300, 0.5)):
        span = (standing.t >= first) & (standing.t < last)
        assert noise[span].std() == pytest.approx(0.01 * factor, rel=0.02)
        np.testing.assert_allclose(imu.gyroscope_std[span], 0.01 * factor)


def test_biases_start_as_given_and_walk_at_the_stated_rate() -> None:
    truth = sample(static(50.0), sample_times(50.0, 20.0))
    errors = with_errors(
        accelerometer_bias=(1.0, 2.0, 3.0),
        accelerometer_bias_walk=0.01,
        gyroscope_bias=0.1,
        gyroscope_bias_walk=(0.0, 0.001, 0.002),
    )
    runs = [corrupt(truth, errors, rng(seed)) for seed in range(300)]
    accelerometer = np.array([run.accelerometer_bias for run in runs])
    gyroscope = np.array([run.gyroscope_bias for run in runs])

    np.testing.assert_array_equal(accelerometer[:, 0], np.tile((1.0, 2.0, 3.0), (300, 1)))
    # 300 x 3 draws: the deviation of a deviation is 1 / sqrt(1800).
    for seconds in (10, 50):
        spread = (accelerometer[:, 20 * seconds] - (1.0, 2.0, 3.0)).std()
        assert spread == pytest.approx(0.01 * np.sqrt(seconds), rel=0.1)
    np.testing.assert_array_equal(gyroscope[:, :, 0], 0.1)
    np.testing.assert_allclose(
        gyroscope[:, -1].std(0),
        np.array([0.0, 0.001, 0.002]) * np.sqrt(50.0),
        rtol=0.15,
        atol=1e-12,
    )
    np.testing.assert_allclose(
        runs[0].specific_force, truth.specific_force_b + runs[0].accelerometer_bias
    )


def test_coloured_noise_forgets_within_its_correlation_time(standing: Truth) -> None:
    errors = with_errors(gyroscope_coloured_std=0.3, coloured_time=0.05)
    noise = corrupt(standing, errors, rng()).angular_rate - standing.angular_rate_b

    assert noise.std() == pytest.approx(0.3, rel=0.03)
    for lag in (1, 10, 20):
        correlation = np.mean(noise[lag:] * noise[:-lag]) / noise.var()
        assert correlation == pytest.approx(np.exp(-lag * 0.005 / 0.05), abs=0.02)


def test_a_tone_stands_at_its_frequency(standing: Truth) -> None:
    errors = with_errors(tones=[Tone(37.0, accelerometer=(0.0, 2.0, 0.0), gyroscope=0.1)])
    imu = corrupt(standing, errors, rng())
    force = imu.specific_force - standing.specific_force_b
    spectrum = np.abs(np.fft.rfft(force[:-1, 1]))

    np.testing.assert_array_equal(force[:, [0, 2]], 0.0)
    assert np.fft.rfftfreq(60_000, 0.005)[np.argmax(spectrum)] == pytest.approx(37.0)
    assert force[:, 1].std() == pytest.approx(2.0 / np.sqrt(2.0), rel=1e-3)
    assert (imu.angular_rate - standing.angular_rate_b).std() == pytest.approx(0.0707, rel=1e-2)


def test_systematic_errors_act_in_the_sensors_axes(flying: Truth) -> None:
    errors = with_errors(
        mount_rpy=(0.0, 0.0, np.pi / 2), accelerometer_scale=(0.01, 0.0, 0.0), g_sensitivity=1e-3
    )
    imu = corrupt(flying, errors, rng())
    # A sensor turned to the right by a quarter sees the body's right as its forward.
    turned = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    force = flying.specific_force_b @ turned.T

    np.testing.assert_allclose(imu.specific_force, force * [1.01, 1.0, 1.0], atol=1e-12)
    np.testing.assert_allclose(
        imu.angular_rate, flying.angular_rate_b @ turned.T + 1e-3 * force, atol=1e-12
    )


def test_same_seed_same_readings_and_each_error_draws_for_itself(flying: Truth) -> None:
    first, again = (corrupt(flying, ImuErrors(), rng(5)) for _ in range(2))
    other = corrupt(flying, ImuErrors(), rng(6))
    steady = corrupt(
        flying, ImuErrors(accelerometer_bias_walk=0.0, gyroscope_coloured_std=1.0), rng(5)
    )

    np.testing.assert_array_equal(first.specific_force, again.specific_force)
    np.testing.assert_array_equal(first.angular_rate, again.angular_rate)
    assert not np.any(first.specific_force == other.specific_force)
    np.testing.assert_allclose(
        first.specific_force - first.accelerometer_bias,
        steady.specific_force - steady.accelerometer_bias,
        atol=1e-12,
    )


@pytest.mark.parametrize("motion", MOTIONS)
def test_same_variant_same_motion(motion: Callable[..., Motion]) -> None:
    times = sample_times(20.0, 10.0)
    first, again, other = (sample(motion(20.0, seed), times) for seed in (4, 4, 5))

    np.testing.assert_array_equal(first.lla, again.lla)
    np.testing.assert_array_equal(first.specific_force_b, again.specific_force_b)
    assert np.abs(first.lla - other.lla).max() > 0.0


# --- GNSS -----------------------------------------------------------------------------------------


def test_fixes_scatter_about_the_antenna() -> None:
    truth = sample(random_motion(600.0, 1), sample_times(600.0, 10.0))
    lever_arm_b = np.array([1.0, -2.0, 0.5])
    gnss = fixes(truth, rng(), (0.1, 0.2, 0.4), lever_arm_b, velocity_std=(0.05, 0.05, 0.1))
    antenna_n = truth.C_nb @ lever_arm_b
    scale = np.array([earth.curvature_scale(lla) for lla in truth.lla])

    position_error = (gnss.lla - truth.lla) * scale - antenna_n
    velocity_n = np.gradient(antenna_n, 0.1, axis=0, edge_order=2) + truth.velocity_n
    assert gnss.velocity_n is not None
    velocity_error = gnss.velocity_n - velocity_n

    np.testing.assert_allclose(position_error.std(0), (0.1, 0.2, 0.4), rtol=0.05)
    np.testing.assert_allclose(position_error.mean(0), 0.0, atol=0.02)
    np.testing.assert_allclose(velocity_error.std(0), (0.05, 0.05, 0.1), rtol=0.05)


def test_a_noise_free_fix_is_the_antenna_exactly() -> None:
    truth = sample(quadrotor_flight(40.0), sample_times(40.0, 100.0))
    gnss = fixes(truth, rng(), 0.0, (0.3, 0.0, -0.2), velocity_std=0.0)
    frame = earth.LocalFrame(truth.lla[0])
    track = frame.position(gnss.lla)
    rate = (track[2:] - track[:-2]) / 0.02
    C = np.array([frame.C_from_n(lla) for lla in truth.lla])

    assert gnss.velocity_n is not None
    np.testing.assert_allclose((C @ gnss.velocity_n[..., None])[1:-1, :, 0], rate, atol=2e-3)


def test_an_outage_takes_its_fixes_and_leaves_the_others() -> None:
    gnss = fixes(sample(static(60.0), sample_times(60.0, 5.0)), rng(), velocity_std=0.1)

    left = gnss.without([(10.0, 5.0), (59.9, 100.0)])

    gone = sorted(set(gnss.t) - set(left.t))
    np.testing.assert_allclose(gone, [*np.arange(10.0, 15.0 - 1e-9, 0.2), 60.0])
    kept = np.isin(gnss.t, left.t)
    np.testing.assert_array_equal(left.lla, gnss.lla[kept])
    assert gnss.velocity_n is not None
    np.testing.assert_array_equal(left.velocity_n, gnss.velocity_n[kept])


# --- the program ----------------------------------------------------------------------------------


def test_an_outage_without_fixes_is_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run(tmp_path / "bag", "--duration 4 --imu-rate 50 --outage 100 10 --outage 2 1")

    warnings = [line for line in capsys.readouterr().err.splitlines() if "warning" in line]
    assert len(warnings) == 1
    assert "--outage 100 10: no fix lies in it: the fixes span 0.0 to 4.0 s" in warnings[0]


def run(out: Path, arguments: str = "") -> Path:
    assert main([str(out), *arguments.split()]) == 0
    return out


def rows(bag: Path, topic: str) -> tuple[np.ndarray, np.ndarray, list[object]]:
    """Header stamps and log times [s after the epoch], and the messages."""
    with BagReader(bag) as reader:
        entries = [(log_ns, m) for _, log_ns, m in reader.messages(topic)]
    stamps = [m.header.stamp.sec * 10**9 + m.header.stamp.nanosec for _, m in entries]
    return (
        (np.array(stamps) - EPOCH_NS) * 1e-9,
        (np.array([log_ns for log_ns, _ in entries]) - EPOCH_NS) * 1e-9,
        [m for _, m in entries],
    )


def xyz(vectors: list[object]) -> np.ndarray:
    return np.array([[v.x, v.y, v.z] for v in vectors])  # type: ignore[attr-defined]


@pytest.mark.slow
def test_the_default_bag_is_the_papers_table_1(tmp_path: Path) -> None:
    bag = run(tmp_path / "bag")
    imu_t, imu_log, imu = rows(bag, "/imu/data")
    fix_t, _, fix = rows(bag, "/gnss/fix")
    truth_t, _, truth = rows(bag, "/truth/odometry")
    _, _, datum = rows(bag, "/truth/datum")

    np.testing.assert_allclose(imu_t, np.arange(60_001) / 1000.0, atol=1e-9)
    np.testing.assert_allclose(imu_log, imu_t, atol=1e-9)
    np.testing.assert_allclose(fix_t, np.arange(301) / 5.0, atol=1e-9)
    np.testing.assert_allclose(truth_t, np.arange(6001) / 100.0, atol=1e-9)
    with BagReader(bag) as reader:
        logs = [log_ns for _, log_ns, _ in reader.raw()]
        assert logs == sorted(logs)
        assert next(iter(reader.raw()))[0] == "/truth/datum"

    force = xyz([m.linear_acceleration for m in imu])[:3000]
    rate = xyz([m.angular_velocity for m in imu])[:3000]
    np.testing.assert_allclose(force.mean(0), (0.05, -0.03, 0.04 + 9.795), atol=0.01)
    np.testing.assert_allclose(force.std(0), 0.02, rtol=0.05)
    np.testing.assert_allclose(rate.std(0), 0.002, rtol=0.06)
    assert {m.header.frame_id for m in imu} == {"imu_link"}
    assert {m.orientation_covariance[0] for m in imu} == {-1.0}

    assert {m.status.status for m in fix} == {0}
    assert {m.position_covariance_type for m in fix} == {2}
    np.testing.assert_allclose(
        np.diag(fix[0].position_covariance.reshape(3, 3)), (0.01, 0.01, 0.02)
    )
    assert fix[0].latitude == pytest.approx(32.1, abs=1e-5)
    assert fix[0].longitude == pytest.approx(34.8, abs=1e-5)
    assert (datum[0].latitude, datum[0].longitude, datum[0].altitude) == (
        fix[0].latitude,
        fix[0].longitude,
        fix[0].altitude,
    )

    # Truth lies where the fixes scatter, in the map whose origin is the first of them.
    frame = earth.LocalFrame(
        np.array([*np.radians([fix[0].latitude, fix[0].longitude]), fix[0].altitude])
    )
    lla = np.array([[np.radians(m.latitude), np.radians(m.longitude), m.altitude] for m in fix])
    position = xyz([m.pose.pose.position for m in truth])
    error = frame.position(lla)[:, [1, 0, 2]] * [1, 1, -1] - position[::20]
    np.testing.assert_allclose(error.std(0), (0.1, 0.1, 0.1414), rtol=0.15)
    assert np.abs(error.mean(0)).max() < 0.04

    # Twist is the derivative of the position, in base_link.
    quat = np.array([[getattr(m.pose.pose.orientation, a) for a in "xyzw"] for m in truth])
    velocity = matrix_from_quat(quat) @ xyz([m.twist.twist.linear for m in truth])[..., None]
    np.testing.assert_allclose(
        velocity[1:-1, :, 0], (position[2:] - position[:-2]) / 0.02, atol=5e-3
    )
    turn = rotvec_from_quat(quat_multiply(quat_conjugate(quat[:-2]), quat[2:])) / 0.02
    np.testing.assert_allclose(turn, xyz([m.twist.twist.angular for m in truth])[1:-1], atol=5e-3)
    np.testing.assert_allclose(quat[0], (0.0, 0.0, 0.5**0.5, 0.5**0.5), atol=1e-6)  # north in ENU


def test_what_the_filter_estimates_is_in_the_bag(tmp_path: Path) -> None:
    bag = run(
        tmp_path / "bag",
        "--trajectory static --duration 20 --imu-rate 100 --gyroscope-bias 0.1 0.2 0.3"
        " --accelerometer-std 0.5 --noise-schedule 0:1,10:2 --gyroscope-bias-walk 0",
    )
    t, _, noise = rows(bag, "/truth/q/accelerometer")
    _, _, bias = rows(bag, "/truth/imu/bias")
    q = xyz([m.vector for m in noise])

    np.testing.assert_allclose(q[t < 9.99], 0.25)
    np.testing.assert_allclose(q[t > 10.01], 1.0)
    np.testing.assert_allclose(
        xyz([m.accel.accel.angular for m in bias]), np.tile((0.1, 0.2, 0.3), (len(bias), 1))
    )


def test_clock_offset_moves_stamps_of_fixes_and_truth_but_not_their_arrival(
    tmp_path: Path,
) -> None:
    options = "--duration 10 --imu-rate 100 --gnss-velocity 0.2 --trajectory car"
    aligned = run(tmp_path / "aligned", options)
    shifted = run(tmp_path / "shifted", options + " --time-offset 0.25")

    for topic in ("/gnss/fix", "/gnss/velocity", "/truth/odometry"):
        (t0, log0, _), (t1, log1, _) = rows(aligned, topic), rows(shifted, topic)
        np.testing.assert_allclose(t1, t0 - 0.25, atol=1e-9)
        np.testing.assert_allclose(log1, log0, atol=1e-9)
    np.testing.assert_array_equal(rows(aligned, "/imu/data")[0], rows(shifted, "/imu/data")[0])


def test_a_vehicle_comes_with_its_sensors(tmp_path: Path) -> None:
    drive, again, other = tmp_path / "drive", tmp_path / "again.mcap", tmp_path / "other.mcap"
    arguments = ["--vehicle", "car, drift 300 ppm", "--duration", "40", "--truth-rate", "10"]
    assert main([str(drive), *arguments, "--seed", "1", "--outage", "10", "5"]) == 0
    receiver = VEHICLES["car, drift 300 ppm"].receiver
    imu_t, _, imu = rows(drive, "/imu/data")
    fix_t, fix_log, fix = rows(drive, "/gnss/fix")
    truth_t, _, truth = rows(drive, "/truth/odometry")
    np.testing.assert_allclose(imu_t, np.arange(4001) / 100.0, atol=1e-9)
    true_t = np.arange(0.35, 39.95)
    true_t = true_t[(true_t < 10.0) | (true_t >= 15.0)]
    np.testing.assert_allclose(fix_t, true_t - 0.02 - 3e-4 * true_t, atol=2e-9)
    late = fix_log - true_t
    assert late.min() >= -2e-9 and late.max() <= 3e-4 * 40.0 + 2e-9
    np.testing.assert_allclose(truth_t, np.arange(401) / 10.0 * (1.0 - 3e-4) - 0.02, atol=2e-9)
    claimed = np.sqrt(fix[0].position_covariance[[4, 0, 8]])  # type: ignore[attr-defined]
    np.testing.assert_allclose(claimed, receiver.claimed_std)
    moved = xyz([m.pose.pose.position for m in truth])  # type: ignore[attr-defined]
    assert np.ptp(moved[truth_t < 10.0]) < 0.1 < 20.0 < np.ptp(moved)
    force = xyz([m.linear_acceleration for m in imu])  # type: ignore[attr-defined]
    assert force[imu_t < 9.0, 0].std() > 0.2  # the engine runs

    for out, seed in ((again, "1"), (other, "2")):
        assert main([str(out), *arguments, "--seed", seed]) == 0
    ways = [
        xyz([m.pose.pose.position for m in rows(bag, "/truth/odometry")[2]])  # type: ignore[attr-defined]
        for bag in (again, other)
    ]
    np.testing.assert_allclose(ways[0], moved, atol=1e-9)
    assert np.abs(ways[1] - ways[0]).max() > 10.0


def test_gnss_velocity_is_enu_with_its_covariance(tmp_path: Path) -> None:
    bag = run(tmp_path / "bag", "--trajectory aircraft --duration 20 --gnss-velocity")
    _, _, velocity = rows(bag, "/gnss/velocity")
    _, _, truth = rows(bag, "/truth/odometry")
    quat = np.array([[getattr(m.pose.pose.orientation, a) for a in "xyzw"] for m in truth[::20]])
    expected = matrix_from_quat(quat) @ xyz([m.twist.twist.linear for m in truth[::20]])[..., None]

    error = xyz([m.twist.twist.linear for m in velocity]) - expected[..., 0]

    assert np.abs(error).max() < 0.25
    assert error.std() == pytest.approx(0.05, rel=0.15)
    covariance = velocity[0].twist.covariance.reshape(6, 6)
    np.testing.assert_allclose(np.diag(covariance), [0.0025] * 3 + [1e6] * 3)


def test_orientation_and_mount(tmp_path: Path) -> None:
    """GIVEN an IMU mounted a quarter turn to the left THEN it shows gravity and attitude so."""
    bag = run(
        tmp_path / "bag",
        "--trajectory static --duration 2 --imu-rate 100 --orientation --heading 90"
        " --mount-rpy 90 0 0 --accelerometer-std 0 --accelerometer-bias 0 0 0"
        " --accelerometer-bias-walk 0",
    )
    _, _, imu = rows(bag, "/imu/data")
    force = xyz([m.linear_acceleration for m in imu])
    quat = np.array([[getattr(m.orientation, a) for a in "xyzw"] for m in imu])

    # Rolled by 90 degrees about forward: the sensor's left axis points up.
    np.testing.assert_allclose(force, np.tile((0.0, 9.795, 0.0), (len(imu), 1)), atol=2e-3)
    up = matrix_from_quat(quat) @ [0.0, 1.0, 0.0]
    assert up[0, 2] > np.cos(np.radians(8.0))
    forward = matrix_from_quat(quat) @ [1.0, 0.0, 0.0]
    assert forward[0, 0] > np.cos(np.radians(15.0))  # east
    np.testing.assert_allclose(
        imu[0].orientation_covariance.reshape(3, 3), np.diag(np.radians([1, 1, 3]) ** 2)
    )


def test_same_seed_same_bytes(tmp_path: Path) -> None:
    options = "--duration 5 --imu-rate 100 --outage 2 1 --trajectory random"
    first = run(tmp_path / "first.mcap", options + " --seed 7")
    again = run(tmp_path / "again.mcap", options + " --seed 7")
    other = run(tmp_path / "other.mcap", options + " --seed 8")

    assert first.read_bytes() == again.read_bytes()
    assert first.read_bytes() != other.read_bytes()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("--duration 0", "--duration"),
        ("--duration 1e9", "samples"),
        ("--imu-rate nan", "--imu-rate"),
        ("--trajectory boat", "--trajectory"),
        ("--outage 5 0", "--outage 5 0"),
        ("--outage 0 100", "no GNSS fix is left"),
        ("--noise-schedule 0:1,5", "--noise-schedule"),
        ("--noise-schedule 0:-1", "--noise-schedule"),
        ("--gnss-noise 1 1", "--gnss-noise"),
        ("--gnss-noise 1 1 -1", "--gnss-noise"),
        ("--start 91 0 0", "--start"),
        ("--seed -1", "--seed"),
        ("--seed 1.5", "--seed"),
        ("--vehicle sleigh", "'slow rover'"),
        ("--vehicle boat --imu-rate 100", "--imu-rate: --vehicle brings motion"),
        ("--vehicle boat --mount-rpy 0 0 5", "--mount-rpy: --vehicle brings motion"),
        ("--vehicle boat --duration 1e9", "samples"),
        ("--vehicle boat --duration 5 --outage 0 100", "no GNSS fix is left"),
    ],
)
def test_wrong_arguments_leave_one_line_and_no_bag(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: str, words: str
) -> None:
    out = tmp_path / "bag"
    try:
        status = main([str(out), *arguments.split()])
    except SystemExit as leave:
        status = leave.code  # type: ignore[assignment]

    assert status == 2
    assert words in capsys.readouterr().err.strip().splitlines()[-1]
    assert not out.exists()


def test_longitudes_in_a_bag_are_within_half_a_turn(tmp_path: Path) -> None:
    """GIVEN starts at 200 degrees and at the date line WHEN simulated THEN fixes and datum fit."""
    drive = "--trajectory car --duration 20 --imu-rate 100 --heading 90"
    for start, expected in (("10 200 0", -160.0), ("10 179.9999999 0", 180.0)):
        bag = run(tmp_path / f"{expected}", f"{drive} --start {start}")
        with BagReader(bag) as reader:
            places = [m.longitude for _, _, m in reader.messages("/gnss/fix", "/truth/datum")]
        assert np.abs(places).max() <= 180.0
        away = (np.array(places) - expected + 180.0) % 360.0 - 180.0
        assert np.abs(away).max() < 0.01
