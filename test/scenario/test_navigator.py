"""Stamps, gaps, outages, jumps: what a navigator makes of what happens in the field."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import make_interp_spline
from scipy.ndimage import gaussian_filter1d
from support.scenes import Parts, make_navigator, play, scene, stamp

from hybrid_ins.core.filter.filter_noise import FilterNoise
from hybrid_ins.core.filter.ins_filter import NOT_MEASURED
from hybrid_ins.core.imu.health import FaultKind, ImuFault, find_fault
from hybrid_ins.core.imu.samples import SAMPLE_DTYPE
from hybrid_ins.core.imu.standstill import may_be_zero
from hybrid_ins.core.inertial.state import (
    ANTENNA_VARIANCE,
    COVARIANCE,
    DIAGONAL,
    DV,
    LLA,
    VELOCITY,
    covariance,
)
from hybrid_ins.core.navigator.notices import GapBridged, RestartCause, Restarted
from hybrid_ins.core.navigator.stamp_check import StampFault
from hybrid_ins.core.noise.multiple_model import NoiseMultipleModelBank
from hybrid_ins.core.update.measurements import PositionFix
from hybrid_ins.simulation.motions import (
    START_LLA,
    Motion,
    car_drive,
    motion_through,
    quadrotor_flight,
    smoothed,
    static,
    time_grid,
)
from hybrid_ins.simulation.sensors import ImuErrors


def sigma(navigator) -> np.ndarray:
    return np.sqrt(navigator.filter.nav[COVARIANCE][DIAGONAL])


@pytest.fixture(scope="module")
def flight():
    return scene(quadrotor_flight(60.0, 4, heading=0.7), seed=4)


@pytest.fixture
def navigator(flight):
    return make_navigator("parameter", yaw=flight.yaw(0.0))


@pytest.mark.parametrize(
    ("step", "fault"),
    [
        (0.0, StampFault.REPEATED),
        (-0.05, StampFault.OUT_OF_ORDER),
        (0.9, StampFault.JUMP),
        (900.0, StampFault.JUMP),
        (-900.0, StampFault.JUMP),
    ],
)
def test_a_stray_stamp_is_refused_by_name_and_changes_nothing(
    flight, navigator, step: float, fault: StampFault
) -> None:
    play(flight, navigator, stop=10.0)
    flight.notices.clear()
    before = navigator.filter.nav.copy()

    refused = navigator.imu(navigator.last_ns + round(step * 1e9), 1.0, 2.0, 3.0, 4.0, 5.0, 6.0)

    assert refused is fault
    assert np.array_equal(navigator.filter.nav, before)
    play(flight, navigator, start=10.0, stop=12.0)
    assert flight.errors(navigator, 12.0)[0] < 0.3
    assert not flight.notices


def test_stamps_that_stay_behind_are_a_new_beginning_said_once(flight) -> None:
    # GIVEN a bag that is played in a loop
    navigator = make_navigator("parameter", yaw=flight.yaw(0.0))
    play(flight, navigator, stop=20.0)
    flight.notices.clear()

    play(flight, navigator, stop=20.0)

    [notice] = flight.notices
    assert isinstance(notice, Restarted) and notice.cause is RestartCause.STAMPS_WENT_BACK
    assert notice.seconds == pytest.approx(20.0, abs=0.1)
    assert flight.errors(navigator, 20.0)[0] < 0.4
    assert flight.errors(navigator, 20.0)[2] < 0.05


@pytest.mark.parametrize("step", [3.0, 12.0])
def test_a_clock_that_is_set_back_does_not_bring_the_first_heading_back(flight, step) -> None:
    """GIVEN a vehicle that has turned since it began THEN the heading is the motion's to show."""
    navigator = make_navigator("parameter", yaw=flight.yaw(0.0))
    play(flight, navigator, stop=20.0)
    later = replace(flight, t=flight.t - step, fix_t=flight.fix_t - step, notices=[])
    errors = []

    def note(t: float) -> None:
        if navigator.filter is not None:
            errors.append(flight.errors(navigator, t + step)[2])

    play(later, navigator, start=20.0 - step, stop=40.0 - step, after=note)

    [notice] = (notice for notice in later.notices if isinstance(notice, Restarted))
    assert notice.cause is RestartCause.STAMPS_WENT_BACK
    assert len(errors) > 500 and max(errors) < 0.5


def test_what_moves_while_a_clock_set_back_a_little_catches_up_is_uncertain() -> None:
    # GIVEN a car WHEN the clock of all stamps is set back by 0.3 s
    run = scene(car_drive(50.0, 1), seed=1)
    navigator = make_navigator("parameter", yaw=run.yaw(0.0))
    play(run, navigator, stop=30.0)
    later = replace(run, t=run.t - 0.3, fix_t=run.fix_t - 0.3, notices=[], verdicts=[])
    normalised = []

    def note(t: float) -> None:
        if t >= 30.0:  # before, no sample is used
            off, std = run.errors(navigator, t + 0.3), sigma(navigator)
            normalised.append((off[0] / std[:2].max(), off[2] / std[8]))

    play(later, navigator, start=29.7, stop=40.0, after=note)

    # THEN the filter goes on, and knows how little it knows
    [notice] = later.notices
    assert isinstance(notice, GapBridged) and notice.seconds == pytest.approx(0.3, abs=0.02)
    assert np.max(normalised) < 4.0
    assert sum(not verdict.accepted for verdict in later.verdicts) <= 2
    assert run.errors(navigator, 40.3)[0] < 0.2


@pytest.mark.parametrize(
    ("motion", "gap"), [(quadrotor_flight, 0.4), (car_drive, 1.2), (car_drive, 1.8)]
)
def test_gap_is_bridged_with_a_covariance_that_covers_it(
    motion: Callable[[float, int], Motion], gap: float
) -> None:
    normalised = []
    for seed in range(10):
        run = scene(motion(32.0, seed), seed=seed)
        navigator = make_navigator("parameter", yaw=run.yaw(0.0))
        # WHEN IMU samples are missing in motion, and fixes go on
        play(run, navigator, stop=30.06, imu=lambda t: not 30.0 - gap < t < 30.0)

        [notice] = run.notices
        assert notice.seconds == pytest.approx(gap, abs=0.06)
        if isinstance(notice, Restarted):  # it may have turned far
            continue
        off, std = run.errors(navigator, 30.05), sigma(navigator)
        normalised.append((off[0] / std[:2].max(), off[1] / std[3:6].max(), off[2] / std[8]))

    assert len(normalised) >= 8
    assert np.max(normalised) < 4.0
    assert np.sqrt(np.mean(np.square(normalised))) > 0.2


def test_fixes_in_a_long_gap_are_refused_and_those_behind_it_hold_the_state(flight) -> None:
    """Each would have divided the gap, and what was not measured in it with that."""
    navigator = make_navigator("parameter", yaw=flight.yaw(0.0))
    play(flight, navigator, stop=20.0)
    flight.verdicts.clear()
    flight.notices.clear()

    play(flight, navigator, start=20.0, stop=30.0, imu=lambda t: not 24.05 < t < 25.45)

    refused = [verdict for verdict in flight.verdicts if not verdict.accepted]
    assert {verdict.reason for verdict in refused} == {NOT_MEASURED}
    inside = [(verdict.measurement.t_ns - stamp(24.05)) * 1e-9 for verdict in refused]
    assert len(inside) == 7 and min(inside) > 0.0 and max(inside) < 1.5
    assert flight.errors(navigator, 30.0)[0] < 0.2
    assert [type(notice) for notice in flight.notices] == [GapBridged]


def test_heading_does_not_outlast_a_gap_in_a_fast_turn() -> None:
    # GIVEN a car that turns at 0.6 rad/s
    t = time_grid(40.0)
    velocity_n = 8.0 * np.stack((np.cos(0.6 * t), np.sin(0.6 * t), 0.0 * t), axis=1)
    yaw = np.stack((0.0 * t, 0.0 * t, 0.6 * t), axis=1)
    run = scene(motion_through(t, velocity_n, yaw, START_LLA))
    navigator = make_navigator("parameter", yaw=run.yaw(0.0))

    # WHEN it lasts until within an outage THEN the state goes on, and knows how little it knows
    play(run, navigator, stop=35.0, imu=lambda t: not 30.0 < t < 31.5, fix=lambda t: t < 30.0)

    assert [type(notice) for notice in run.notices] == [GapBridged]
    std = sigma(navigator)
    assert std[8] > 0.35 and std[3:5].max() > 0.35 * 8.0
    position, _, heading = run.errors(navigator, 35.0)
    assert position < 3.0 * std[:2].max() and abs(heading) < 3.0 * std[8]

    # AND alignment follows with the next fix
    play(run, navigator, start=35.0, stop=36.1)

    [_, notice] = run.notices
    assert isinstance(notice, Restarted) and notice.cause is RestartCause.NO_SAMPLES
    assert notice.seconds == pytest.approx(1.5, abs=0.1)


def test_long_gap_ends_dead_reckoning_and_alignment_follows(flight) -> None:
    navigator = make_navigator()
    flight.notices.clear()

    play(flight, navigator, imu=lambda t: not 25.0 < t < 29.0)

    [notice] = flight.notices
    assert isinstance(notice, Restarted) and notice.cause is RestartCause.NO_SAMPLES
    assert notice.seconds == pytest.approx(4.0, abs=0.1)
    assert navigator.filter is not None
    assert flight.errors(navigator, 60.0)[0] < 0.4
    assert flight.errors(navigator, 60.0)[2] < 0.1


@pytest.fixture
def found_elsewhere():
    """Return a flight with an antenna that nobody gave, and a navigator that has found it."""

    class Learning(Parts):
        def noise(self, period: float) -> FilterNoise:
            fixed = super().noise(period)
            return FilterNoise(fixed.model, fixed.process, NoiseMultipleModelBank())

    run = scene(quadrotor_flight(70.0, 4, heading=0.7), seed=4, lever_arm_b=(0.8, -0.4, 0.6))
    navigator = make_navigator("auto", parts=Learning())
    play(run, navigator, stop=45.0)
    assert navigator.filter is not None and navigator.filter.lever_arm.is_certain
    return run, navigator


@pytest.mark.parametrize("cause", ["gap", "stamps went back", "by hand"])
def test_an_antenna_that_was_found_is_considered_after_a_restart(found_elsewhere, cause) -> None:
    """GIVEN a restart THEN before the motion shows the antenna again the covariance holds it."""
    run, navigator = found_elsewhere
    before, start = navigator.filter.lever_arm, 48.0 if cause == "gap" else 45.0
    if cause == "by hand":
        navigator.realign()
    elif cause == "stamps went back":
        start = 20.0
    variances = []

    def note(t: float) -> None:
        if navigator.phase.best is not None:
            variances.append(navigator.phase.best.nav[ANTENNA_VARIANCE].copy())

    play(run, navigator, start=start, stop=start + 15.0, after=note)

    size = float(before.error_b @ before.error_b)
    assert len(variances) > 500 and np.min(np.sum(variances, axis=1)) > 0.5 * size
    after = navigator.filter.lever_arm
    assert np.linalg.norm(after.error_b - [0.8, -0.4, 0.6]) < 0.4


@pytest.mark.parametrize("restart", ["reset", "wrong"])
def test_what_a_wrong_filter_has_found_of_the_antenna_is_discarded(
    found_elsewhere, restart
) -> None:
    run, navigator = found_elsewhere
    if restart == "reset":
        navigator.reset()
    else:
        navigator.give_up(RestartCause.REPEATED_RESETS)

    play(run, navigator, start=45.0, stop=48.0)

    assert not navigator.phase.best.nav[ANTENNA_VARIANCE].any()


def test_heading_survives_a_gap_of_a_vehicle_that_stands() -> None:
    run = scene(static(20.0, heading=1.2))
    navigator = make_navigator("parameter", yaw=1.2)

    play(run, navigator, imu=lambda t: not 8.0 < t < 10.0)

    assert [notice.cause for notice in run.notices] == [RestartCause.NO_SAMPLES]
    assert navigator.filter is not None
    assert run.errors(navigator, 20.0)[2] < 0.05


@pytest.mark.parametrize(
    "delay", [lambda t: 0.3, lambda t: 0.5 * abs(np.sin(1e4 * t))], ids=["constant", "reordering"]
)
def test_late_fixes_end_where_punctual_ones_do(flight, delay) -> None:
    states = []
    for late in (lambda t: 0.0, delay):
        navigator = make_navigator("parameter", yaw=flight.yaw(0.0))
        play(flight, navigator, stop=6.0)  # in flight: how a stand is noticed is not rewound
        play(flight, navigator, start=6.0, stop=20.0, delay=late, fix=lambda t: t < 19.4)
        states.append(navigator.filter.nav.copy())

    metres = (states[0][LLA] - states[1][LLA]) * 6.4e6
    assert np.abs(metres).max() < 1e-6
    assert states[0][VELOCITY] == pytest.approx(states[1][VELOCITY], abs=1e-9)


def test_fix_that_is_too_old_is_refused_with_its_age(flight, navigator) -> None:
    play(flight, navigator, stop=10.0)

    navigator.measure(PositionFix(stamp(8.1), START_LLA, np.eye(3), np.zeros(3)))

    [verdict] = navigator.pop_notices()
    assert not verdict.accepted and verdict.reason == "too old"
    assert verdict.age == pytest.approx(1.9, abs=0.02)


def test_fix_from_the_future_and_a_repeated_one_are_refused(flight, navigator) -> None:
    play(flight, navigator, stop=10.0)
    count = len(flight.verdicts)

    for t in (60.0, 9.8):
        navigator.measure(PositionFix(stamp(t), START_LLA, np.eye(3), np.zeros(3)))

    assert len(flight.verdicts) == count
    verdicts = navigator.pop_notices()
    assert [v.reason for v in verdicts] == ["stamped ahead of the IMU", "repeated stamp"]
    assert not any(v.accepted for v in verdicts)


def test_outage_is_dead_reckoned_with_growing_covariance_and_ends_without_a_spike() -> None:
    # GIVEN a car WITHOUT fixes for 30 s
    run = scene(car_drive(80.0, 1), seed=1)
    navigator = make_navigator("parameter", yaw=run.yaw(0.0))
    spread = []

    def note(t: float) -> None:
        if 40.0 <= t < 70.0:
            spread.append(sigma(navigator)[:2].max())

    before = len(run.verdicts)
    play(run, navigator, fix=lambda t: not 40.0 < t < 70.0, after=note)

    assert spread[-1] > 2.0 * spread[10]
    returned = [v for v in run.verdicts[before:] if v.measurement.t_ns >= stamp(70.0)]
    assert all(v.accepted and not v.inflated for v in returned)
    assert run.errors(navigator, 80.0)[0] < 0.4


def test_shift_of_all_fixes_wins_after_the_patience_and_is_said() -> None:
    # GIVEN a reference station that jumps by 40 m for good
    run = scene(quadrotor_flight(60.0, 4), seed=4)
    navigator = make_navigator("parameter", yaw=run.yaw(0.0))

    play(run, navigator, shift=lambda t: 40.0 if t >= 30.0 else 0.0)

    refused = [v for v in run.verdicts if not v.accepted and v.measurement.t_ns >= stamp(30.0)]
    assert 14 <= len(refused) <= 18
    assert sum(v.inflated for v in run.verdicts) == 1
    assert run.errors(navigator, 60.0)[0] == pytest.approx(40.0, abs=0.5)
    assert run.errors(navigator, 60.0)[2] < 0.1


def test_wild_fixes_for_a_while_do_not_move_the_state() -> None:
    run = scene(quadrotor_flight(60.0, 4), seed=4)
    navigator = make_navigator("parameter", yaw=run.yaw(0.0))
    rng = np.random.default_rng(0)

    play(
        run,
        navigator,
        stop=36.0,
        shift=lambda t: rng.normal(0.0, 200.0) if 30.0 <= t < 36.0 else 0.0,
    )
    # WHEN for twice the patience each contradicts the others
    assert not any(v.inflated for v in run.verdicts)
    assert run.errors(navigator, 36.0)[0] < 2.0


def test_wrong_heading_is_found_out_and_given_up() -> None:
    # GIVEN a heading by hand that is wrong by a third of a turn, and claims to be right
    run = scene(quadrotor_flight(60.0, 4), seed=4)
    navigator = make_navigator("parameter", yaw=run.yaw(0.0) + 2.0, yaw_std=0.02)

    play(run, navigator)

    assert run.errors(navigator, 60.0)[2] < 0.1


def test_standing_vehicle_keeps_still_without_fixes() -> None:
    # GIVEN a car that stands, WHEN fixes end for a minute
    run = scene(static(80.0, heading=0.5))
    navigator = make_navigator("parameter", yaw=0.5)

    play(run, navigator, fix=lambda t: t < 20.0)

    assert navigator.monitor.standing
    assert run.errors(navigator, 80.0)[0] < 0.5
    assert run.errors(navigator, 80.0)[1] < 0.03


def test_stop_in_an_outage_is_noticed_by_the_filter() -> None:
    run = scene(car_drive(60.0, 1), seed=1)
    navigator = make_navigator("parameter", yaw=run.yaw(0.0))
    standing = []

    play(run, navigator, after=lambda t: standing.append((t, navigator.monitor.standing)))

    moving = {
        t: float(np.linalg.norm(v))
        for t, v in zip(run.truth.t.round(3), run.truth.velocity_n, strict=True)
    }
    assert not [t for t, stands in standing if stands and moving[round(t, 3)] > 0.3]


def stands_northwards(
    t: np.ndarray, speed: np.ndarray, fixes_end: float, sinking: float | np.ndarray = 0.0
) -> tuple:
    """Return run, navigator, and when it stood, of a motion to the north; fixes end at a time."""
    velocity_n = np.stack((speed, 0.0 * t, sinking + 0.0 * t), axis=-1)
    motion = motion_through(t, velocity_n, np.zeros((len(t), 3)), START_LLA)
    run = scene(motion, seed=5)
    navigator = make_navigator("parameter", yaw=0.0)
    standing = []
    play(
        run,
        navigator,
        fix=lambda t: t < fixes_end,
        after=lambda t: standing.append((t, navigator.monitor.standing)),
    )
    return run, navigator, [t for t, stands in standing if stands]


def test_a_train_that_sets_off_gently_does_not_stand() -> None:
    """
    GIVEN a train that sets off after 20 s, whose acceleration grows to 1 m/s2 over 25 s
    WHEN no fix shows it
    THEN it does not stand, and its acceleration is not taken for a bias.
    """
    t = time_grid(60.0)
    speed = smoothed(np.where(t > 45.0, 30.0, 0.0), 50.0)

    run, navigator, standing = stands_northwards(t, speed, 15.0)

    moving = dict(zip(run.truth.t.round(3), run.truth.velocity_n[:, 0], strict=True))
    assert any(t < 20.0 for t in standing)
    assert not [t for t in standing if moving[round(t, 3)] > 0.3]
    assert run.errors(navigator, 60.0)[1] < 5.0


@pytest.mark.parametrize("stops", [False, True])
def test_a_boat_that_drifts_in_a_calm_does_not_stand_once_its_speed_is_uncertain(
    stops: bool,
) -> None:
    """
    GIVEN a boat that drifts at 0.5 m/s, and touches the quay after 30 s, or does not
    WHEN fixes end after 20 s
    THEN it stands at the quay, and nowhere else.
    """
    t = time_grid(90.0)
    speed = smoothed(np.where((t > 30.0) & stops, 0.0, 0.5), 2.0)

    run, navigator, standing = stands_northwards(t, speed, 20.0)

    assert bool(standing) == stops
    assert run.errors(navigator, 90.0)[0] < 3.0 * np.linalg.norm(sigma(navigator)[:3])


def test_what_cruises_as_calmly_as_it_stands_does_not_stand_while_its_speed_is_uncertain() -> None:
    """
    GIVEN an underwater vehicle that cruises calmly at 1.5 m/s, as fixes show
    WHEN it has dived without fixes, is shaken once, and is calm again
    THEN zero is plausible, but it is not found to stand, and its errors are within their σ.
    """
    t = time_grid(120.0)
    shaken = np.where((t > 60.0) & (t < 64.0), 0.3 * np.sin(2.0 * np.pi * t), 0.0)

    run, navigator, standing = stands_northwards(t, 1.5 + 0.0 * t, 30.0, smoothed(shaken, 0.1))

    velocity, P = navigator.filter.nav[VELOCITY], covariance(navigator.filter.nav)[DV, DV]
    assert may_be_zero(velocity, P)
    assert not standing
    error = run.truth.velocity_n[-1] - velocity
    assert error @ np.linalg.solve(P, error) < 14.2  # chi-square, 3 degrees of freedom, 99.7 %


def test_shaking_sensor_is_not_standing() -> None:
    run = scene(static(10.0), errors=ImuErrors(accelerometer_std=0.6, gyroscope_std=0.03))
    navigator = make_navigator("parameter")

    play(run, navigator)

    assert not navigator.monitor.standing


def drop() -> Motion:
    """Stand for 10 s, fall for two, be caught within another two, and hang."""
    return vertical([10.0, 12.0, 14.0], [0.0, 9.8, -9.8])


def pull_up() -> Motion:
    """Stand for 10 s, be pulled up by 5.5 times gravity for 1.6 s, and climb on."""
    return vertical([10.0, 11.6], [0.0, -44.0])


def coast() -> Motion:
    """Stand for 10 s, be thrown up by three times gravity for 2 s, and fall for seven."""
    return vertical([10.0, 12.0, 19.0], [0.0, -29.4, 9.8])


def vertical(until: list[float], downward: list[float]) -> Motion:
    """Move up and down with accelerations [m/s²] that last until times [s]."""
    t = np.arange(0.0, 20.0, 0.02)
    acceleration = np.select([t < end for end in until], downward, 0.0)
    acceleration = gaussian_filter1d(acceleration, 2.0)
    down = np.cumsum(acceleration) * 0.02
    zero = np.zeros_like(down)
    velocity = make_interp_spline(t, np.stack((zero, zero, down), axis=1), k=5)
    rpy = make_interp_spline(t, np.stack((zero, zero, zero + 1.2), axis=1), k=5)
    return Motion(START_LLA, float(t[-1]), velocity.antiderivative(), rpy)


@pytest.mark.parametrize(("fix_rate", "delay"), [(5.0, 0.0), (1.0, 0.0), (1.0, 0.6)])
@pytest.mark.parametrize("motion", [drop, pull_up, coast])
def test_a_manoeuvre_is_no_fault_of_gravity(motion, fix_rate: float, delay: float) -> None:
    run = scene(motion(), fix_rate=fix_rate)
    navigator = make_navigator("parameter", yaw=1.2)
    seen: list[ImuFault | None] = []
    heights: list[float] = []

    def watch(t: float) -> None:
        if navigator.filter is not None:
            seen.append(navigator.monitor.fault)
            truth = run.truth.lla[round(t * 100.0)]
            heights.append(abs(navigator.filter.nav[LLA][2] - truth[2]))

    play(run, navigator, after=watch, delay=lambda t: delay)

    assert np.ptp(run.truth.lla[:, 2]) > 30.0
    assert not run.notices
    assert seen == [None] * len(seen)
    assert max(heights[500:]) < 0.6


def rolls() -> Motion:
    """Fly level, and roll four times at 1 g along the body's z axis, as in a barrel roll."""
    t = time_grid(40.0)
    starts = np.array([15.0, 18.0, 24.0, 27.0])
    turned = np.clip((t[:, None] - starts) / 1.2, 0.0, 1.0).sum(axis=1)
    roll = 2.0 * np.pi * smoothed(turned, 0.3)
    since = t[:, None] - starts
    wing = smoothed(((since > 1.5) & (since <= 2.7)).any(axis=1) * 1.0, 0.3)
    side_ways, down = 9.81 * np.sin(roll), 9.81 * (1.0 - np.cos(roll)) - 9.81 * wing
    zero = np.zeros_like(t)
    acceleration = np.stack((zero, side_ways, down), axis=1)
    velocity = make_interp_spline(t, acceleration, k=5).antiderivative()
    rpy = make_interp_spline(t, np.stack((roll, zero, zero), axis=1), k=5)
    return Motion(START_LLA, float(t[-1]), velocity.antiderivative(), rpy)


def rocking() -> Motion:
    """Roll to and fro by 0.4 rad in one place, at up to 1 rad/s."""
    t = time_grid(15.0)
    roll = 0.4 * np.sin(2.5 * t)
    return motion_through(
        t, np.zeros((len(t), 3)), np.stack((roll, 0 * t, 0 * t), axis=1), START_LLA
    )


def test_rolls_are_no_rates_in_degrees() -> None:
    """Gravity stays where it is in the body's axes, as it would if it hardly turned."""
    run = scene(rolls())
    navigator = make_navigator("parameter", yaw=0.0)
    faults: list[ImuFault | None] = []

    play(run, navigator, after=lambda t: faults.append(navigator.monitor.fault))

    samples = np.zeros(len(run.t), SAMPLE_DTYPE)
    samples["t_ns"], samples["f"], samples["w"] = [stamp(t) for t in run.t], run.force, run.rate
    found = [find_fault(samples[k : k + 100]) for k in range(1400, 2800, 20)]
    assert any(fault is not None and fault.kind is FaultKind.DEGREES for fault in found)
    assert not any(faults) and not run.notices
    assert run.errors(navigator, 39.9)[0] < 0.1


@pytest.mark.parametrize("fix_rate", [5.0, 1.0])
def test_rates_in_degrees_are_found_beside_a_filter_that_agreed_at_rest(fix_rate: float) -> None:
    run = scene(quadrotor_flight(40.0, 4, heading=0.7), fix_rate=fix_rate)
    run.rate[:] = np.degrees(run.rate)
    navigator = make_navigator("parameter", yaw=run.yaw(0.0))

    play(run, navigator)

    kinds = [e.fault.kind for e in run.notices if isinstance(e, Restarted) and e.fault is not None]
    assert FaultKind.DEGREES in kinds


def test_rates_that_no_gyroscope_measures_are_in_degrees_whatever_fixes_say() -> None:
    run = scene(rocking(), fix_std=(30.0, 30.0, 30.0))
    run.rate[run.t > 10.0] *= np.degrees(1.0)
    navigator = make_navigator("parameter", yaw=0.0)

    play(run, navigator)

    kinds = [e.fault.kind for e in run.notices if isinstance(e, Restarted) and e.fault is not None]
    assert FaultKind.DEGREES in kinds


@pytest.mark.parametrize("fix_rate", [5.0, 1.0])
def test_missing_gravity_is_no_free_fall(fix_rate: float) -> None:
    run = scene(static(20.0, heading=1.2), fix_rate=fix_rate)
    run.force[run.t >= 10.0] -= run.force[:500].mean(axis=0)
    navigator = make_navigator("parameter", yaw=1.2)

    play(run, navigator, stop=12.2)

    [notice] = [notice for notice in run.notices if isinstance(notice, Restarted)]
    assert notice.cause is RestartCause.IMU_UNUSABLE
    assert notice.fault is not None and notice.fault.kind is FaultKind.NO_GRAVITY
    assert navigator.filter is None


def test_covariance_stays_positive_through_everything(flight, navigator) -> None:
    rng = np.random.default_rng(1)
    play(
        flight,
        navigator,
        imu=lambda t: rng.random() > 0.2,
        fix=lambda t: not 20.0 < t < 35.0,
        delay=lambda t: 0.7 * rng.random(),
        shift=lambda t: 30.0 * (rng.random() > 0.9),
    )

    assert np.linalg.eigvalsh(covariance(navigator.filter.nav)).min() > 0.0
    assert np.all(np.isfinite(navigator.filter.nav))


def test_a_saturated_accelerometer_leads_no_further_astray_than_the_covariance_admits() -> None:
    # GIVEN 4 s of vibration beyond the accelerometer's range, noise of which nobody tells
    run = scene(quadrotor_flight(24.0, 3, heading=0.5), seed=3)
    shaken = (run.t >= 12.0) & (run.t < 16.0)
    force = run.force[shaken] + np.random.default_rng(0).normal(0.0, 8.0, (int(shaken.sum()), 3))
    run.force[shaken] = np.clip(force, -16.0, 16.0)
    navigator = make_navigator("parameter", yaw=run.yaw(0.0))
    largest = []

    play(run, navigator, stop=12.0)
    play(
        run,
        navigator,
        start=12.0,
        stop=18.0,
        after=lambda t: largest.append(run.errors(navigator, t)[0]),
    )

    # THEN fixes go on to be fused, and hold the state
    assert max(largest) < 1.5
    refused = [v for v in run.verdicts if not v.accepted]
    assert len(refused) < 10


def test_bounces_beyond_the_range_take_nothing_of_what_is_known_across_them() -> None:
    """A robot that trots, on an IMU with a range of 2 g: each step lacks some upward velocity."""
    run = scene(quadrotor_flight(40.0, 3, heading=0.5), seed=3)
    trot = np.where(run.t > 12.0, 14.0 * np.sin(2.0 * np.pi * 5.0 * run.t), 0.0)
    run.force[:, 2] = np.maximum(run.force[:, 2] - trot, -19.6)
    navigator = make_navigator("parameter", yaw=run.yaw(0.0))
    across, down = [], []

    def note(t: float) -> None:
        std = sigma(navigator)[DV]
        across.append(std[:2].max())
        down.append(std[2])

    play(run, navigator, stop=20.0)
    play(run, navigator, start=20.0, stop=39.0, after=note)

    assert navigator.monitor.fault is not None
    assert max(across) < 0.6 < max(down)


@pytest.mark.parametrize("start", [12.0, 40.0])
def test_a_turn_beyond_the_gyroscopes_range_leaves_no_attitude(start: float) -> None:
    # GIVEN half a second in which the gyroscope reads as much as it can
    run = scene(car_drive(90.0, 1), seed=1)
    run.rate[(run.t >= start) & (run.t < start + 0.5), 2] = 4.36
    navigator = make_navigator()
    claimed = []

    def note(t: float) -> None:
        if navigator.filter is not None:
            error, std = run.errors(navigator, t)[2], navigator.filter.state.P[8, 8] ** 0.5
            claimed.append(error / std)

    play(run, navigator, after=note)

    # THEN alignment begins anew, and no other heading is claimed for more than a moment
    causes = {notice.cause for notice in run.notices if isinstance(notice, Restarted)}
    assert causes == {RestartCause.TURN_UNMEASURED}
    assert np.mean(np.array(claimed) > 6.0) < 0.02
    assert run.errors(navigator, 90.0)[2] < 0.05


def test_first_fixes_that_are_far_off_do_not_spoil_the_start() -> None:
    # GIVEN a receiver whose first fixes are 300 m off, claiming centimetres
    run = scene(car_drive(60.0, 1), seed=1)
    navigator = make_navigator()
    play(run, navigator, shift=lambda t: 300.0 if t < 1.1 else 0.0)
    # THEN alignment begins anew once no hypothesis fits the others, and the start is as ever
    causes = [notice.cause for notice in run.notices if isinstance(notice, Restarted)]
    assert causes == [RestartCause.FIXES_JUMPED]
    assert navigator.filter is not None
    assert run.errors(navigator, 60.0)[0] < 0.1
    assert run.errors(navigator, 60.0)[2] < 0.1
