"""From nothing to a filter: on the ground, in flight, with a heading and without."""

import math

import numpy as np
import pytest
from support.scenes import heading_std, make_navigator, play, scene, stamp

from hybrid_ins.core.alignment.alignment import Biases
from hybrid_ins.core.alignment.multiple_model import HEADING_STD, N_HEADINGS
from hybrid_ins.core.inertial.earth import STANDARD_GRAVITY, curvature_scale
from hybrid_ins.core.inertial.rotations import rpy_from_quat
from hybrid_ins.core.inertial.state import (
    BIAS_A,
    BIAS_G,
    COVARIANCE,
    DIAGONAL,
    DP,
    DV,
    LLA,
    QUAT,
    covariance,
    pack,
    total_std,
)
from hybrid_ins.core.navigator.navigator import Navigator
from hybrid_ins.core.navigator.notices import HeadingOutdated
from hybrid_ins.core.update.measurements import PositionFix, VelocityFix, position_model
from hybrid_ins.ros.reporting.wording import state_of, waiting_for
from hybrid_ins.simulation.motions import (
    START_LLA,
    aircraft_flight,
    car_drive,
    motion_through,
    quadrotor_flight,
    random_motion,
    smoothed,
    static,
    time_grid,
    velocity_of,
)
from hybrid_ins.simulation.sensors import ImuErrors

FIVE_DEGREES = np.radians(5.0)


def test_it_says_what_it_waits_for_in_order() -> None:
    run = scene(static(6.0))
    navigator = make_navigator()
    said = []

    def note(t: float) -> None:
        if not said or said[-1][0] != state_of(navigator):
            said.append((state_of(navigator), waiting_for(navigator)))

    assert state_of(navigator) == "waiting for the IMU" and "IMU" in waiting_for(navigator)
    play(run, navigator, fix=lambda t: t > 2.0, after=note)

    assert [state for state, _ in said] == [
        "waiting for the IMU",
        "waiting for GNSS",
        "finding heading",
    ]
    assert "GNSS" in said[1][1]
    assert "motion" in said[2][1] and "initialpose" in said[2][1]


def test_standing_still_decides_nothing_and_learns_the_gyroscope_bias() -> None:
    # GIVEN a vehicle that stands for half a minute WITHOUT any heading
    run = scene(static(30.0, heading=1.0))
    navigator = make_navigator()

    play(run, navigator)

    # THEN no heading is claimed, but position and biases are known
    assert navigator.filter is None and navigator.monitor.standing
    assert heading_std(navigator) > np.radians(50.0)
    assert run.errors(navigator, 30.0)[0] < 0.1
    assert navigator.phase.best is not None
    assert navigator.phase.best.nav[BIAS_G] == pytest.approx([0.002, -0.003, 0.001], abs=5e-4)


def test_standing_still_tells_no_tilt_from_bias() -> None:
    """Half a minute made tilt and bias twice as certain, though nothing had shown either."""
    run = scene(static(30.0, heading=1.0))
    navigator = make_navigator()

    play(run, navigator, stop=3.0)
    assert navigator.phase.best is not None
    before = np.sqrt(navigator.phase.best.nav[COVARIANCE][DIAGONAL])
    play(run, navigator, 3.0)

    after = np.sqrt(navigator.phase.best.nav[COVARIANCE][DIAGONAL])
    assert after[9:11] == pytest.approx(before[9:11], rel=0.05)
    assert after[6:8] == pytest.approx(before[9] / STANDARD_GRAVITY, rel=0.1)


def test_a_smooth_ride_that_has_begun_teaches_no_gyroscope_bias() -> None:
    # GIVEN a train at 25 m/s in a wide curve, so smooth that its IMU seems to stand
    t = time_grid(6.0)
    course = 0.025 * t
    motion = motion_through(
        t,
        velocity_of(25.0 + 0.0 * t, course, 0.0 * t),
        np.stack((0.0 * t, 0.0 * t, course), axis=-1),
        START_LLA,
    )
    run = scene(motion)
    navigator = make_navigator("parameter")
    # WHEN it is aligned
    play(run, navigator)
    # THEN the curve is no bias of the gyroscope, and its tilt is as unknown as in motion
    assert navigator.filter is not None
    truth = np.array([0.002, -0.003, 0.001])
    std = np.sqrt(navigator.filter.nav[COVARIANCE][DIAGONAL][12:15])
    assert np.all(np.abs(navigator.filter.nav[BIAS_G] - truth) < 4.0 * std)


@pytest.mark.parametrize("acceleration", [1.0, 3.0])
def test_an_imu_that_comes_up_while_the_vehicle_speeds_up(acceleration: float) -> None:
    """The velocity was off by 4.8 m/s with a claim of 0.24."""
    # GIVEN a vehicle that speeds up, and an IMU that is switched on as it has begun to
    t = time_grid(20.0)
    speed = acceleration * t
    level = np.zeros((len(t), 3))
    run = scene(
        motion_through(t, velocity_of(speed, 0.0 * t, 0.0 * t), level, START_LLA),
        fix_rate=1.0,
        fix_std=np.full(3, 0.02),
    )
    navigator = make_navigator("parameter")
    # WHEN it is aligned in motion, by fixes and velocities at 1 Hz
    claims: list[tuple[float, float]] = []

    def compare(now: float) -> None:
        if now in run.fix_t:
            velocity_n = np.array([acceleration * now, 0.0, 0.0])
            navigator.measure(VelocityFix(stamp(now), velocity_n, 0.01 * np.eye(3), np.zeros(3)))
        if navigator.filter is not None:
            std = total_std(navigator.filter.flat_state())[DV]
            claims.append((run.errors(navigator, now)[1], float(np.linalg.norm(std))))

    play(run, navigator, 0.3, after=compare)
    # THEN its velocity is known from the start, and as well as it says
    off, std = np.array(claims).T
    assert np.all(off < 3.0 * std), (off / std).max()
    assert off[-1] < 0.3


def test_a_sway_at_rest_teaches_no_gyroscope_bias() -> None:
    """A kayak's heading was off by 180 degrees for minutes, with a claim of 4."""
    for phase in np.linspace(0.0, 2.0 * np.pi, 6, endpoint=False):
        # GIVEN a boat that drifts and rolls so slowly that within a second it seems to stand
        t = time_grid(3.0)
        roll = 0.016 * np.sin(2.0 * np.pi * t / 6.0 + phase)
        yaw = np.stack((roll, 0.0 * t, 0.0 * t), axis=-1)
        run = scene(motion_through(t, velocity_of(0.2 + 0.0 * t, 0.0 * t, 0.0 * t), yaw, START_LLA))
        navigator = make_navigator("parameter")
        # WHEN it is aligned
        play(run, navigator)
        # THEN the bias of the gyroscopes is as uncertain as that
        assert navigator.filter is not None
        off = navigator.filter.nav[BIAS_G] - [0.002, -0.003, 0.001]
        std = np.sqrt(navigator.filter.nav[COVARIANCE][DIAGONAL][12:15])
        assert np.all(np.abs(off) < 4.0 * std), (phase, off, std)


@pytest.mark.parametrize("turn", [0.0, 0.006, 0.02])
def test_a_slow_turn_at_anchor_is_no_gyroscope_bias_when_the_boat_sails(turn: float) -> None:
    """The heading was off by 150 degrees for minutes, with a claim of 2."""
    # GIVEN a boat that turns evenly while it stands, and then sails
    t = time_grid(90.0)
    speed = 4.0 * np.clip((t - 40.0) / 6.0, 0.0, 1.0)
    course = turn * np.minimum(t, 38.0) + 0.5 * np.sin(0.1 * np.maximum(t - 60.0, 0.0))
    yaw = np.stack((0.0 * t, 0.0 * t, course), axis=-1)
    run = scene(motion_through(t, velocity_of(speed, course, 0.0 * t), yaw, START_LLA))
    navigator = make_navigator()
    # WHEN it has sailed for 10 s and longer
    errors = []
    for start, stop in ((0.0, 56.0), (56.0, 70.0), (70.0, 90.0)):
        play(run, navigator, start, stop)
        error = run.errors(navigator, stop)[2]
        errors.append((np.degrees(error), error / heading_std(navigator)))
    # THEN the heading is as good as it says
    assert max(ratio for _, ratio in errors) < 4.0, errors
    assert errors[-1][0] < 6.0, errors


@pytest.mark.parametrize("turn", [0.0, 0.5, -0.5])
def test_a_slow_turn_that_begins_during_a_stand_is_no_gyroscope_bias(turn: float) -> None:
    """The heading of masts, boats and turntables stayed behind by as much as they turned."""
    # GIVEN a vehicle whose heading and biases motion has shown
    t = time_grid(130.0)
    speed = 4.0 * (np.clip((t - 5.0) / 4.0, 0.0, 1.0) - np.clip((t - 40.0) / 4.0, 0.0, 1.0))
    # WHEN it stands, and after a while turns slowly, with a soft begin
    course = 0.8 * np.sin(0.3 * np.clip(t - 10.0, 0.0, 10.0 * np.pi))
    course += turn * smoothed(np.clip((t - 75.0) / 45.0, 0.0, 1.0), 10.0)
    yaw = np.stack((0.0 * t, 0.0 * t, course), axis=-1)
    run = scene(motion_through(t, velocity_of(speed, course, 0.0 * t), yaw, START_LLA))
    navigator = make_navigator()
    # THEN the heading turns with it
    for start, stop in ((0.0, 70.0), (70.0, 100.0), (100.0, 128.0)):
        play(run, navigator, start, stop)
        error = run.errors(navigator, stop)[2]
        assert error < 4.0 * heading_std(navigator)
        assert np.degrees(error) < 4.0


@pytest.mark.parametrize("known", [False, True])
def test_a_bias_that_an_earlier_run_has_found_is_not_doubted_after_a_stand(known: bool) -> None:
    t = time_grid(34.0)
    speed = 4.0 * np.clip((t - 20.0) / 6.0, 0.0, 1.0)
    straight = np.stack((0.0 * t, 0.0 * t, 0.0 * t), axis=-1)
    run = scene(motion_through(t, velocity_of(speed, 0.0 * t, 0.0 * t), straight, START_LLA))
    navigator = make_navigator("parameter")
    if known:
        bias_g, P = np.array([0.002, -0.003, 0.001]), np.diag(np.repeat((1e-4, 1e-8), 3))
        earlier = Biases(stamp(0.0), np.zeros(3), bias_g, P)
        navigator.monitor.remember(earlier)
        assert navigator.alignment is not None
        navigator.alignment.remember(earlier)

    play(run, navigator, 0.0, 22.0)

    assert navigator.filter is not None
    std = np.sqrt(navigator.filter.nav[COVARIANCE][DIAGONAL][14])
    assert (std < 0.0004) == known


@pytest.mark.parametrize("heading", np.linspace(-2.9, 3.1, 4))
@pytest.mark.parametrize("trajectory", [quadrotor_flight, car_drive])
def test_motion_shows_the_heading(trajectory, heading: float) -> None:
    # GIVEN 4 s standing, then motion
    run = scene(trajectory(28.0, 3, heading=heading), seed=3)
    navigator = make_navigator()

    play(run, navigator)

    assert navigator.filter is not None
    _, _, error = run.errors(navigator, 28.0)
    assert error < FIVE_DEGREES and error < 4.0 * heading_std(navigator)


@pytest.mark.parametrize("start", [9.0, 14.3])
def test_start_in_flight(start: float) -> None:
    run = scene(quadrotor_flight(40.0, 1, heading=2.0), seed=1)
    navigator = make_navigator()

    play(run, navigator, start=start, stop=start + 20.0)

    assert navigator.filter is not None
    position, velocity, error = run.errors(navigator, start + 20.0)
    assert error < FIVE_DEGREES and position < 0.5 and velocity < 0.5


def test_nose_need_not_point_where_it_moves() -> None:
    # GIVEN a vehicle that moves sideways and backwards while it turns
    run = scene(random_motion(30.0, 5, heading=-1.0), seed=5)
    navigator = make_navigator("motion")

    play(run, navigator)

    assert navigator.filter is not None
    assert run.errors(navigator, 30.0)[2] < FIVE_DEGREES


def test_claimed_uncertainty_covers_the_error_when_it_is_decided() -> None:
    normalised = []
    for seed in range(12):
        run = scene(quadrotor_flight(20.0, seed, heading=0.5 * seed), seed=seed)
        navigator = make_navigator()

        def note(t: float, run=run, navigator=navigator, seed=seed) -> None:
            if navigator.filter is not None and len(normalised) == seed:
                normalised.append(run.errors(navigator, t)[2] / heading_std(navigator))

        play(run, navigator, after=note)
        assert len(normalised) == seed + 1

    assert max(normalised) < 4.0 and np.sqrt(np.mean(np.square(normalised))) < 1.6


@pytest.mark.parametrize(
    ("sigma", "after"),
    [(0.08, 1.0), (0.12, 3.0), (0.18, 6.0), (0.25, 10.0), (0.35, None)],
)
def test_a_heading_known_less_well_is_decided_on_later(
    monkeypatch: pytest.MonkeyPatch, sigma: float, after: float | None
) -> None:
    """Clock or lever arm uncalibrated: the mixture stays wider, and one filter narrows it on."""
    navigator = make_navigator()
    play(scene(static(6.0)), navigator)
    bank = navigator.phase.bank
    assert bank is not None
    bank.motion.shown = True
    first_ns, decided = bank.best.t_ns, []
    monkeypatch.setattr(bank, "heading", lambda: (0.5, sigma))

    for t in np.arange(0.0, 20.0, 0.1):
        bank.best.t_ns = first_ns + round(t * 1e9)
        if bank.decide() is not None:
            decided.append(t)

    if after is None:
        assert not decided
    else:
        assert decided[0] == pytest.approx(after, abs=0.11)
        P = bank.best.nav[COVARIANCE][DIAGONAL]
        assert P[8] == pytest.approx(sigma**2 + 0.5**2)


def test_a_stand_shows_nothing_of_the_heading() -> None:
    navigator = make_navigator()

    play(scene(static(40.0)), navigator)

    bank = navigator.phase.bank
    assert bank is not None
    assert len(bank.filters) == N_HEADINGS
    assert np.ptp(bank.log_weights) == 0.0


def test_after_a_stand_the_headings_are_a_cell_wide_again(monkeypatch: pytest.MonkeyPatch) -> None:
    navigator = make_navigator()
    play(scene(static(6.0)), navigator)
    bank = navigator.phase.bank
    assert bank is not None
    for hypothesis in bank.filters:
        P = covariance(hypothesis.nav)
        P[8, :8] = P[:8, 8] = P[8, 9:] = P[9:, 8] = 0.0
        P[8, 8] = 1e-4
        pack(P, hypothesis.nav[COVARIANCE])

    monkeypatch.setattr(bank.motion, "observe", lambda *_: True)
    bank.measure(PositionFix(bank.best.t_ns, START_LLA, np.eye(3), np.zeros(3)))
    bank.end_block()
    for hypothesis in bank.filters:
        assert hypothesis.state.P[8, 8] == pytest.approx(HEADING_STD**2, rel=0.05)


def test_outlier_while_undecided_hurts_nobody() -> None:
    run = scene(quadrotor_flight(25.0, 2, heading=1.0), seed=2)
    navigator = make_navigator()

    play(run, navigator, shift=lambda t: 80.0 if 6.0 < t < 6.3 or 8.0 < t < 8.3 else 0.0)

    assert navigator.filter is not None
    assert run.errors(navigator, 25.0)[2] < FIVE_DEGREES
    assert sum(not v.accepted and "gate" in v.reason for v in run.verdicts) >= 2


def test_late_fixes_serve_the_hypotheses_too() -> None:
    run = scene(quadrotor_flight(25.0, 2, heading=1.0), seed=2)
    navigator = make_navigator()

    play(run, navigator, delay=lambda t: 0.3)

    assert navigator.filter is not None
    assert run.errors(navigator, 25.0)[2] < FIVE_DEGREES


def test_heading_by_parameter_holds_at_the_first_sample_and_is_carried_on() -> None:
    # GIVEN a vehicle that turns from the first sample on
    run = scene(random_motion(4.0, 7, heading=0.8), seed=7)
    navigator = make_navigator("parameter", yaw=run.yaw(0.0), yaw_std=0.02)

    play(run, navigator, stop=1.5)

    assert navigator.filter is not None
    assert run.errors(navigator, 1.5)[2] < 0.06


def test_heading_by_hand_goes_before_all_and_ends_the_search() -> None:
    run = scene(static(6.0, heading=1.0))
    navigator = make_navigator()
    play(run, navigator, stop=4.0)
    assert navigator.filter is None

    navigator.realign().set_yaw(navigator.last_ns, 1.0, 0.02)
    play(run, navigator, start=4.0)

    assert navigator.filter is not None
    assert run.errors(navigator, 6.0)[2] < 0.05


def test_course_is_taken_where_it_is_asked_for() -> None:
    run = scene(aircraft_flight(8.0, 1), seed=1)
    navigator = make_navigator("course")

    play(run, navigator)

    assert navigator.filter is not None
    assert run.errors(navigator, 8.0)[2] < 0.2


def test_imu_heading_is_taken_where_it_is_asked_for() -> None:
    run = scene(static(4.0, heading=-2.0))
    navigator = make_navigator("imu")
    play(run, navigator, stop=2.0)
    assert navigator.filter is None and "orientation" in waiting_for(navigator)

    assert navigator.alignment is not None
    navigator.alignment.observe_yaw(-2.0)
    play(run, navigator, start=2.0)

    assert navigator.filter is not None
    assert run.errors(navigator, 4.0)[2] < 0.05


def test_biases_that_are_given_are_where_the_filter_begins() -> None:
    # GIVEN an IMU whose biases an earlier recording told, in a vehicle that moves from the start
    errors = ImuErrors(accelerometer_bias=(0.5, -0.4, 0.3), gyroscope_bias=(0.2, -0.1, 0.05))
    run = scene(random_motion(4.0, 7, heading=0.8), seed=7, errors=errors)

    def tilt(navigator: Navigator) -> float:
        play(run, navigator, stop=1.0)
        assert navigator.filter is not None
        k = int(np.argmin(np.abs(run.truth.t - 1.0)))
        truth = rpy_from_quat(run.truth.quat_xyzw[k])
        return float(np.max(np.abs((rpy_from_quat(navigator.filter.nav[QUAT]) - truth)[:2])))

    knowing = make_navigator(
        "parameter",
        yaw=run.yaw(0.0),
        bias_a=errors.accelerometer_bias,
        bias_g=errors.gyroscope_bias,
    )
    ignorant = make_navigator("parameter", yaw=run.yaw(0.0))

    # THEN the first state holds them, and is levelled by readings that are freed from them
    assert tilt(knowing) < 0.5 * tilt(ignorant)
    assert knowing.filter is not None
    assert knowing.filter.nav[BIAS_A] == pytest.approx(errors.accelerometer_bias, abs=0.02)
    assert knowing.filter.nav[BIAS_G] == pytest.approx(errors.gyroscope_bias, abs=2e-3)


def test_upside_down_is_an_attitude_like_any_other() -> None:
    run = scene(static(5.0, heading=0.5, roll=np.pi - 0.1))
    navigator = make_navigator("parameter", yaw=0.5)

    play(run, navigator)

    assert navigator.filter is not None
    assert run.errors(navigator, 5.0)[2] < 0.05


@pytest.mark.parametrize(
    ("factor", "words"),
    [(0.001, "gravity seems to be removed"), (1 / 9.80665, "seems to be g"), (9.80665, "unit")],
)
def test_force_in_other_units_is_refused_loudly(factor: float, words: str) -> None:
    run = scene(static(4.0))
    run.force *= factor
    navigator = make_navigator()

    play(run, navigator)

    assert state_of(navigator) == "waiting for the IMU" and words in waiting_for(navigator)


def test_height_may_be_missing() -> None:
    run = scene(static(5.0, heading=0.5))
    run.fix_lla[:, 2] = np.nan
    navigator = make_navigator("parameter", yaw=0.5)

    play(run, navigator)

    assert navigator.filter is not None
    assert np.all(np.isfinite(navigator.filter.nav))


def test_vibration_and_a_smooth_cruise_are_not_standing() -> None:
    shaking = scene(static(8.0), errors=ImuErrors(accelerometer_std=1.0, gyroscope_std=0.05))
    cruise = scene(aircraft_flight(8.0, 0), seed=0)
    for run in (shaking, cruise):
        navigator = make_navigator("parameter", yaw=run.yaw(0.0))
        play(
            run,
            navigator,
            after=lambda t, n=navigator: pytest.fail("stands") if n.monitor.standing else None,
        )


def test_one_fix_is_a_position_without_a_velocity() -> None:
    # GIVEN an aircraft WITH one fix only
    run = scene(aircraft_flight(8.0, 1), seed=1)
    navigator = make_navigator()
    errors, claimed = [], []

    def note(t: float) -> None:
        nav = navigator.phase.nav
        if nav is not None:
            k = int(np.argmin(np.abs(run.truth.t - t)))
            scale = curvature_scale(run.truth.lla[k])
            errors.append((nav[LLA] - run.truth.lla[k]) * scale)
            claimed.append(total_std(nav))

    play(run, navigator, fix=lambda t: t == 2.0, after=note)

    # THEN no filter starts from it, but there is a state for three seconds
    assert state_of(navigator) == "waiting for GNSS" and navigator.filter is None
    assert len(errors) == pytest.approx(300, abs=15)
    # AND its covariance covers a vehicle that may go anywhere
    found, std = np.array(errors), np.array(claimed)
    assert np.linalg.norm(found[0]) < 10.0 < np.linalg.norm(found[-1])
    assert np.all(np.abs(found) < 3.0 * std[:, DP] + 5.0)
    assert std[-1, DP].min() > 100.0
    assert np.all(std[:, DV] > 50.0) and np.all(std[:, 8] > np.radians(90.0))
    # AND there is none any more once that fix is old
    assert navigator.phase.nav is None


def test_a_heading_that_is_awaited_keeps_no_position_back() -> None:
    # GIVEN a vehicle that stands, whose heading is to be its course
    run = scene(static(6.0))
    navigator = make_navigator("course")

    play(run, navigator)

    assert "motion" in waiting_for(navigator) and navigator.phase.best is None
    nav = navigator.phase.nav
    assert nav is not None
    std = total_std(nav)
    assert std[:2].max() < 0.5 and std[3:5].max() < 1.0 and std[8] > np.radians(90.0)


@pytest.mark.parametrize("interval", [5.0, 10.0])
def test_a_receiver_may_be_slow(interval: float) -> None:
    # GIVEN a car with a fix every so many seconds
    run = scene(car_drive(90.0, 3, heading=1.0), fix_rate=1.0 / interval, seed=3)
    navigator = make_navigator()

    play(run, navigator)

    # THEN two of them give the first velocity, AND motion shows the heading
    assert navigator.filter is not None
    _, velocity, error = run.errors(navigator, 90.0)
    assert velocity < 3.0
    assert error < FIVE_DEGREES and error < 4.0 * heading_std(navigator)


LEVER_B = np.array([-3.0, 0.5, -1.0])


def test_filters_start_where_the_imu_is_not_the_antenna() -> None:
    # GIVEN a vehicle on a curve whose antenna is metres away from its IMU, and a given heading
    run = scene(car_drive(40.0, 1), lever_arm_b=LEVER_B)
    navigator = make_navigator("parameter", yaw=run.yaw(0.0), yaw_std=0.2, lever_b=LEVER_B)
    begun: list[tuple[float, float, float]] = []

    def after(t: float) -> None:
        running = navigator.filter
        if running is not None and not begun:
            H = position_model(running.nav, running.nav[LLA], LEVER_B)[1]
            of_antenna = H @ covariance(running.nav) @ H.T
            std_of_imu = math.sqrt(covariance(running.nav)[DP, DP].diagonal()[:2].max())
            begun.append((run.errors(navigator, t)[0], math.sqrt(of_antenna[0, 0]), std_of_imu))

    play(run, navigator, stop=3.0, lever_b=LEVER_B, after=after)
    # THEN the position is the IMU's: known by the heading, where the antenna is known by a fix
    ((error, std_of_antenna, std_of_imu),) = begun
    assert std_of_antenna < 0.2 and std_of_imu > 0.5
    assert error < 3.0 * std_of_imu
    assert all(v.accepted for v in run.verdicts if v.reason != "aligning")


@pytest.mark.parametrize("seed", range(2))
def test_a_long_lever_arm_is_no_evidence_on_the_heading(seed: int) -> None:
    """Inflated beside a position that is known to centimetres, the next fix would settle it."""
    run = scene(car_drive(40.0, 1), seed=seed, lever_arm_b=LEVER_B)
    navigator = make_navigator(lever_b=LEVER_B)
    off: list[float] = []

    def after(t: float) -> None:
        best = navigator.phase.best
        if best is not None and round(t * 100.0) % 10 == 0:
            off.append(run.errors(navigator, t)[2] / heading_std(navigator))

    play(run, navigator, after=after, lever_b=LEVER_B)

    assert max(off) < 4.0
    refused = [v for v in run.verdicts if not v.accepted and v.reason != "aligning"]
    assert refused == []


def test_a_given_heading_that_motion_before_the_fixes_has_blurred_is_said_to_be_of_no_use() -> None:
    # GIVEN a vehicle that moves for 40 s before its receiver finds satellites
    run = scene(random_motion(70.0, 7, heading=0.8), seed=7)
    navigator = make_navigator("parameter", yaw=run.yaw(0.0), yaw_std=0.02)

    play(run, navigator, stop=42.0, fix=lambda t: t > 40.0)

    # THEN the motion is to show the heading, as if none had been given
    assert [e for e in run.notices if isinstance(e, HeadingOutdated)]
    assert navigator.filter is None
    play(run, navigator, start=42.0)
    assert navigator.filter is not None
    assert run.errors(navigator, 70.0)[2] < FIVE_DEGREES
