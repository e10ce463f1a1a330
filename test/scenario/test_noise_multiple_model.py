"""Factors from the innovations: 1 while the model is right, and on what is wrong when it is not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.runs import Q, fly, moved

from hybrid_ins.core.alignment.levelling import tilt_by_bias
from hybrid_ins.core.filter.filter_noise import FilterNoise
from hybrid_ins.core.inertial.earth import curvature_scale
from hybrid_ins.core.inertial.rotations import (
    heading_from_quat,
    matrix_from_quat,
    quat_from_rotvec,
    quat_multiply,
)
from hybrid_ins.core.inertial.state import (
    B_A,
    EPS,
    N_ERROR,
    N_NAV,
    PAST_VARIANCE,
    PLACES,
    QUAT,
    SLOW_VARIANCE,
    covariance,
    total_std,
)
from hybrid_ins.core.noise.hypotheses import COUNT, drifts_beyond_claim
from hybrid_ins.core.noise.multiple_model_step import OFFSETS
from hybrid_ins.core.noise.multiple_model_update import PENDING_G
from hybrid_ins.core.update.measurements import PositionFix, VelocityFix
from hybrid_ins.simulation.motions import START_LLA as LLA0
from hybrid_ins.simulation.motions import (
    Motion,
    car_drive,
    motion_through,
    smoothed,
    time_grid,
    velocity_of,
)
from hybrid_ins.simulation.sensors import gauss_markov
from tools.paper.runs import Scenario, draw

DRIVE = Scenario("drive", car_drive, rate=100.0, scored_from=1.0)
SCENE = Scenario("flight", rate=100.0, duration=50.0)


def drifts(noise: FilterNoise) -> tuple[float, float]:
    return drifts_beyond_claim(noise.slow_error, noise.split.claimed_stds)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_right_model_is_left_alone(seed: int) -> None:
    ins, factors = fly(draw(SCENE, seed))
    assert ins.noise.split.unclaimed_stds[0] == 0.0
    medians = np.median(factors[100:], axis=0)
    assert np.all(medians > 0.6) and np.all(medians < 1.05)
    assert np.all(factors[100:] < 1.5)


@pytest.mark.parametrize("seed", [2, 4])
@pytest.mark.parametrize("axes", [slice(0, 3), slice(3, 6), slice(0, 6)])
def test_a_level_is_an_upper_bound(seed: int, axes: slice) -> None:
    """
    GIVEN levels of accelerometer, gyroscope or both that are read 1000 times too high
    THEN the filter uses less than 50 times the truth, and the level that is right as it is.
    """
    q = Q.copy()
    q[axes] *= 1000.0

    _, factors = fly(draw(SCENE, seed), q=q)

    used = np.median(factors[100:, :2], axis=0) * q[[0, 3]] / Q[[0, 3]]
    raised = q[[0, 3]] > Q[[0, 3]]
    assert np.all(used[raised] < 50.0)
    assert np.all(np.abs(np.log(used[~raised])) < np.log(2.0))


@pytest.mark.parametrize("seed", [0, 3, 4])
def test_an_outage_is_no_evidence_against_the_imu(seed: int) -> None:
    # GIVEN a flight with a right model, and a quarter of a minute without fixes
    _, factors = fly(draw(replace(SCENE, outages=((20.0, 15.0),)), seed))

    assert np.all(factors < 3.0)


@pytest.mark.parametrize(("seed", "error"), [(1, 0.4), (2, 0.4), (7, -0.4)])
def test_an_unknown_heading_is_no_evidence_against_the_imu(seed: int, error: float) -> None:
    # GIVEN a start whose heading is off by 0.4 rad, with a standard deviation that says so
    run = draw(replace(SCENE, duration=30.0), seed)
    P = run.start.P.copy()
    P[8, 8] = 0.5**2
    turn = quat_from_rotvec(np.array([0.0, 0.0, error]))
    quat = quat_multiply(turn, run.start.quat_xyzw)
    # WHEN the filter runs, whose first corrections are far from linear
    _, factors = fly(replace(run, start=replace(run.start, quat_xyzw=quat, P=P)))
    # THEN the noise is not raised: without the filter's linearisation, by 70 to 7000
    assert np.all(factors < 3.0)


def test_a_clock_offset_raises_the_noise_of_the_imu() -> None:
    # GIVEN fixes stamped 0.4 s wrong, which no look at the IMU can tell
    run = draw(SCENE, 1)
    fixes = tuple(
        PositionFix(f.t_ns - 400_000_000, f.lla, f.covariance_n, f.lever_b)
        for f in run.fixes
        if f.t_ns > int(run.samples["t_ns"][0]) + 500_000_000
    )
    # WHEN the filter runs
    ins, factors = fly(replace(run, fixes=fixes))
    # THEN its noise is taken to be many times larger, and the fixes are taken
    assert np.max(factors[50:, :2]) > 30.0
    assert np.mean([v.accepted for v in list(ins.verdicts)[100:]]) > 0.95


def test_a_receiver_that_claims_too_much_is_not_mistaken_for_the_imu() -> None:
    # GIVEN fixes that scatter five times as far as they say
    run = draw(SCENE, 2)
    std = np.sqrt(np.diag(run.fixes[0].covariance_n))
    scatter = np.random.default_rng(0).standard_normal((len(run.fixes), 3)) * std * 24.0**0.5
    # WHEN the filter runs
    _, factors = fly(moved(run, scatter))
    # THEN R is raised by about 25, and the process noise is not
    assert 8.0 < np.median(factors[100:, 2]) < 80.0
    assert np.median(factors[100:, :2]) < 1.5


def test_a_slow_error_that_is_not_claimed_is_found_and_published() -> None:
    # GIVEN fixes that claim decimetres, and whose error wanders by metres within minutes
    run = draw(replace(SCENE, duration=100.0), 2)
    slow = gauss_markov(2.0, np.exp(-0.2 / 100.0), len(run.fixes), np.random.default_rng(1))
    # WHEN the filter runs
    ins, factors = fly(moved(run, slow), scatter=True)
    # THEN neither the IMU nor white noise is taken for it, and its size is published
    assert 0.7 < ins.noise.split.unclaimed_stds[0] < 4.0 and drifts(ins.noise)[0]
    assert np.median(factors[100:, :2]) < 3.0 and np.median(factors[100:, 2]) < 1.5
    assert np.all(
        np.sqrt(ins.nav[SLOW_VARIANCE][:2]) == pytest.approx(ins.noise.split.unclaimed_stds[0])
    )


@pytest.mark.parametrize("scatter", [2.0, 0.8, 0.0])
def test_heights_that_scatter_by_more_than_a_constant_claim_leave_the_rest_alone(
    scatter: float,
) -> None:
    # GIVEN fixes that claim and scatter by 0.2 m, and heights that do by 2 or 0.8 m, or as claimed
    run = draw(replace(SCENE, duration=85.0), 2)
    white = np.random.default_rng(2).normal(0.0, 0.2, (len(run.fixes), 3))
    white[:, 2] += np.random.default_rng(3).normal(0.0, scatter, len(run.fixes))
    run = moved(run, white)
    run = replace(run, fixes=[replace(fix, covariance_n=0.04 * np.eye(3)) for fix in run.fixes])
    # WHEN the filter runs
    ins, factors = fly(run, scatter=True)
    # THEN R of heights is what they scatter by, R of the rest is not raised, nor is the IMU's noise
    across, upward = np.array(ins.noise.split.factors)
    assert 0.5 < across < 2.0 and np.median(factors[150:, 2]) < 1.5
    assert 0.4 < 0.04 * upward / (0.04 + scatter**2) < 2.5
    assert np.median(factors[150:, :2]) < 3.0
    assert ins.noise.split.unclaimed_stds == (0.0, 0.0)


def test_a_slow_error_of_heights_alone_is_found_alone() -> None:
    # GIVEN fixes that claim decimetres, and whose heights wander by metres within minutes
    run = draw(replace(SCENE, duration=100.0), 2)
    slow = gauss_markov(2.0, np.exp(-0.2 / 100.0), len(run.fixes), np.random.default_rng(1))
    slow[:, :2] = 0.0
    # WHEN the filter runs
    ins, factors = fly(moved(run, slow), scatter=True)
    # THEN the heights' covariance holds it, and the rest is known as before
    across, upward = ins.noise.split.unclaimed_stds
    assert across == 0.0 and 0.45 < upward < 4.5
    assert drifts(ins.noise) == (0.0, upward)
    assert ins.noise.found.heights < 2.0 and np.median(factors[100:, 2]) < 1.5
    std = total_std(ins.nav)
    assert std[2] > 0.4 and std[:2].max() < 0.3
    # but one of several hypotheses of a search does not
    assert fly(moved(run, slow))[0].noise.split.unclaimed_stds == (0.0, 0.0)


@pytest.mark.parametrize("slow_std", [1.2, 0.0])
def test_a_slow_error_of_a_few_claims_is_found_and_none_where_there_is_none(
    slow_std: float,
) -> None:
    # GIVEN fixes that claim 0.3 m, and whose error wanders by a metre in a minute, or does not
    run = draw(replace(SCENE, duration=85.0), 2)
    slow = gauss_markov(slow_std, np.exp(-0.2 / 60.0), len(run.fixes), np.random.default_rng(1))
    claimed = np.diag([0.3, 0.3, 0.45]) ** 2
    white = np.random.default_rng(2).normal(0.0, 0.28, (len(run.fixes), 3))
    run = moved(run, slow + white)
    run = replace(run, fixes=[replace(fix, covariance_n=claimed) for fix in run.fixes])
    # WHEN the filter runs
    ins, _ = fly(run, scatter=True)
    # THEN it is known and published, or it is not
    assert (ins.noise.found.slow_probability > 0.5) == (slow_std > 0.0)
    assert any(drifts(ins.noise)) == (slow_std > 0.0)
    assert (ins.noise.split.unclaimed_stds[0] > 0.4) == (slow_std > 0.0)
    assert (total_std(ins.nav)[0] > 0.5) == (slow_std > 0.0)


@pytest.mark.parametrize("std", [0.03, 0.0])
def test_stamps_that_scatter_are_found_and_leave_what_is_across_the_motion(std: float) -> None:
    # GIVEN a car with fixes of 2 cm, which are stamped late by a time that varies, or are not
    run, rng = draw(replace(DRIVE, duration=90.0), 2), np.random.default_rng(3)
    claimed = 4e-4 * np.eye(3)
    late = np.round(1e9 * std * rng.standard_normal(len(run.fixes))).astype(int)
    fixes = []
    for t_ns, lla, by in zip(run.samples["t_ns"][run.scored], run.lla, late, strict=False):
        lla = lla + 0.02 * rng.standard_normal(3) / curvature_scale(lla)
        fixes.append(PositionFix(int(t_ns + by), lla, claimed, np.zeros(3)))
    # WHEN the filter runs
    ins, factors = fly(replace(run, fixes=tuple(fixes)), scatter=True)
    # THEN it knows that, and by how much, and R is not raised for it
    assert (ins.noise.found.stamp_probability > 0.5) == (std > 0.0)
    assert ins.noise.found.stamp_std == pytest.approx(std, abs=0.02)
    assert np.median(factors[100:, 2]) < 1.5
    # but one of several hypotheses of a search does not
    assert not fly(replace(run, fixes=tuple(fixes)))[0].noise.found.stamp_probability > 0.5


@pytest.mark.parametrize(("lag", "std"), [(0.0, 0.05), (0.5, 0.05), (0.0, 0.5)])
def test_velocities_that_lag_or_scatter_are_found_beside_right_positions(
    lag: float, std: float
) -> None:
    # GIVEN a car with RTK positions, and velocities that claim 0.05 m/s and are right, or come out
    # of a filter of half a second, or scatter by ten times as much
    run, rng = draw(replace(DRIVE, duration=90.0), 2), np.random.default_rng(3)
    filtered, fixes = run.velocity_n[0], []
    stamps = run.samples["t_ns"][run.scored].tolist()
    for t_ns, lla, velocity_n in zip(stamps, run.lla, run.velocity_n, strict=True):
        filtered = filtered + (velocity_n - filtered) * (0.2 / lag if lag else 1.0)
        lla = lla + 0.02 * rng.standard_normal(3) / curvature_scale(lla)
        fixes.append(PositionFix(t_ns, lla, 4e-4 * np.eye(3), np.zeros(3)))
        measured = filtered + std * rng.standard_normal(3)
        fixes.append(VelocityFix(t_ns, measured, 25e-4 * np.eye(3), np.zeros(3)))
    # WHEN the filter runs
    ins, factors = fly(replace(run, fixes=tuple(fixes)), scatter=True)
    # THEN that is known, and neither R of positions nor the noise of the IMU is raised for it
    assert ins.noise.found.age_std == pytest.approx(lag, abs=0.2)
    found = ins.noise.found
    on_velocities = found.horizontal_velocity, found.vertical_velocity
    assert [factor > 10.0 for factor in on_velocities] == [std > 0.05] * 2
    assert np.median(factors[200:, 2]) < 1.5 and np.median(factors[200:, :2]) < 1.5
    # but one of several hypotheses of a search does not
    searched = fly(replace(run, fixes=tuple(fixes)))[0].noise
    assert searched.found.age_std == 0.0
    assert searched.found.horizontal_velocity == searched.found.vertical_velocity == 1.0


@pytest.mark.parametrize("std", [0.05, 0.3, 0.5])
@pytest.mark.parametrize("is_search", [False, True])
def test_positions_that_scatter_beside_right_velocities_have_no_slow_error(
    std: float, is_search: bool
) -> None:
    """They were published 10 m off: with the velocities, which were right, no R was left."""
    # GIVEN a car whose positions claim 0.05 m and scatter by 1, 6 or 10 times that
    run, rng = draw(replace(DRIVE, duration=60.0), 2), np.random.default_rng(3)
    stamps, fixes = run.samples["t_ns"][run.scored].tolist(), []
    for t_ns, lla, velocity_n in zip(stamps, run.lla, run.velocity_n, strict=True):
        lla = lla + std * rng.standard_normal(3) / curvature_scale(lla)
        fixes.append(PositionFix(t_ns, lla, 25e-4 * np.eye(3), np.zeros(3)))
        measured = velocity_n + 0.1 * rng.standard_normal(3)
        fixes.append(VelocityFix(t_ns, measured, 0.01 * np.eye(3), np.zeros(3)))
    # WHEN the filter runs
    ins, _ = fly(replace(run, fixes=tuple(fixes)), scatter=not is_search)
    # THEN it is R of the positions that is raised, and that alone, and what the claim is worth then
    # is published, since nothing bounds a slow error any better
    found = ins.noise.found
    assert found.fixes == pytest.approx((std / 0.05) ** 2, rel=0.7)
    of_velocities = np.array([found.horizontal_velocity, found.vertical_velocity])
    np.testing.assert_allclose(found.fixes * of_velocities, 1.0, atol=0.7)
    assert found.slow_std == 0.0
    assert total_std(ins.nav)[:3].max() < 1.3 * std


def test_jumps_that_are_not_claimed_are_published_and_those_of_the_state_are_not() -> None:
    # GIVEN fixes that claim decimetres, and are off by 4 m for a quarter of a minute
    run = draw(replace(SCENE, duration=60.0), 2)
    t = np.array([fix.t_ns - run.fixes[0].t_ns for fix in run.fixes]) * 1e-9
    off = np.outer((t > 20.0) & (t < 35.0), [4.0, -3.0, 1.0])
    # WHEN the filter runs
    ins, _ = fly(moved(run, off))
    # THEN the covariance that is published contains the jump to them and the one back
    assert ins.noise.jumps.size == pytest.approx(np.sqrt(26.0), rel=0.2)
    assert np.all(total_std(ins.nav)[:2] > 2.0)
    # and after an outage, with which the state drifts off, it does not
    ins, _ = fly(draw(replace(SCENE, outages=((20.0, 20.0),)), 2))
    assert ins.noise.jumps.size == 0.0 and np.all(ins.nav[PAST_VARIANCE] == 0.0)


@pytest.mark.parametrize(
    ("claimed", "seconds"),
    [(0.1, 0.5), (0.1, 1.0), (0.1, 3.0), (0.1, 5.0), (0.8, 0.5), (0.8, 1.0), (0.8, 3.0)],
)
def test_fixes_that_glide_off_are_followed_with_a_covariance_that_contains_them(
    claimed: float, seconds: float
) -> None:
    # GIVEN fixes that are off by 15 m within seconds, more than they claim, and stay there
    run = draw(replace(SCENE, duration=35.0), 3)
    fixes = tuple(replace(f, covariance_n=f.covariance_n * (claimed / 0.1) ** 2) for f in run.fixes)
    t = np.array([fix.t_ns - fixes[0].t_ns for fix in fixes]) * 1e-9
    off = np.outer(np.clip((t - 20.0) / seconds, 0.0, 1.0), [-7.0, 11.0, 7.5])
    # WHEN the filter runs for a quarter of a minute more
    ins, _ = fly(moved(replace(run, fixes=fixes), off), scatter=True)
    # THEN the error is within 3σ: what is smooth again seemed right, with σ as they claim
    assert np.all(np.abs(off[-1]) < 3.0 * total_std(ins.nav)[:3])


@pytest.mark.parametrize(("size", "lasts"), [(0.8, 15), (0.8, 1), (0.0, 0)])
def test_a_jump_that_an_error_of_the_imu_could_make_is_told_by_what_follows(
    size: float, lasts: int
) -> None:
    # GIVEN a car with fixes of 2 cm once a second, which are off by 0.8 m for a while, or once
    run, rng = draw(replace(DRIVE, duration=60.0), 2), np.random.default_rng(3)
    fixes = []
    for k, (t_ns, lla) in enumerate(zip(run.samples["t_ns"][run.scored], run.lla, strict=True)):
        if k % 5 == 0:
            off = size * np.array([0.7, -0.7, 0.1]) * (40 <= k // 5 < 40 + lasts)
            lla = lla + (off + 0.02 * rng.standard_normal(3)) / curvature_scale(lla)
            fixes.append(PositionFix(int(t_ns), lla, 4e-4 * np.eye(3), np.zeros(3)))
    # WHEN the filter runs
    ins, _ = fly(replace(run, fixes=tuple(fixes)), scatter=True)
    # THEN only what lasts is a jump
    assert (ins.noise.jumps.count > 0.0) == (lasts > 1)
    assert (total_std(ins.nav)[0] > 0.3) == (lasts > 1)


def test_a_lone_outlier_changes_nothing() -> None:
    # GIVEN one fix that is off by 30 m
    run = draw(SCENE, 3)
    change = np.zeros((len(run.fixes), 3))
    change[150, 0] = 30.0
    # WHEN the filter runs
    _, without = fly(run)
    _, factors = fly(moved(run, change))
    # THEN the factors stay where they were
    assert np.max(factors[150:] / without[150:]) < 1.3


@pytest.mark.parametrize("seed", [2, 4])
def test_a_receiver_that_loses_its_solution_and_does_not_say_so(seed: int) -> None:
    """
    GIVEN fixes that claim 0.1 m, keep to it for 40 s, then scatter by 5 m for 25 s, and are good
    again
    WHEN the filter runs
    THEN R follows within seconds both ways, nothing is inflated, and the IMU is not taken for the
    cause.
    """
    run = draw(replace(SCENE, duration=85.0), seed)
    rng = np.random.default_rng(seed)
    t = np.array([(f.t_ns - run.samples["t_ns"][0]) * 1e-9 for f in run.fixes])
    lost = (t > 40.0) & (t < 65.0)

    ins, factors = fly(moved(run, lost[:, None] * rng.normal(0.0, 5.0, (len(t), 3))))

    assert np.all(factors[(t > 46.0) & lost, 2] > 300.0)
    assert np.median(factors[(t > 46.0) & lost, 0]) < 10.0
    assert np.all(factors[t > 71.0, 2] < 3.0)
    assert not any(v.inflated for v in ins.verdicts)
    assert np.mean([v.accepted for v in ins.verdicts]) > 0.9


def test_late_fixes_give_the_same_factors_and_the_same_state() -> None:
    run = draw(SCENE, 4)
    std = np.sqrt(np.diag(run.fixes[0].covariance_n))
    scatter = np.random.default_rng(1).standard_normal((len(run.fixes), 3)) * std * 4.0
    run = moved(run, scatter)
    run = replace(run, fixes=tuple(f for f in run.fixes if f.t_ns < run.samples["t_ns"][-100]))
    in_time, factors = fly(run)
    late, _ = fly(run, late=0.35)
    assert late.noise.found.fixes == pytest.approx(in_time.noise.found.fixes, rel=1e-9)
    np.testing.assert_allclose(late.nav[:N_NAV], in_time.nav[:N_NAV], rtol=1e-9, atol=1e-9)
    assert np.max(factors) > 3.0


def straight_drive(duration: float, seed: int) -> Motion:
    """Return the motion of a car that stands for 2 s, speeds up to 12 m/s, and never turns."""
    times = time_grid(duration)
    speed = smoothed(np.clip(3.0 * (times - 2.0), 0.0, 12.0), 1.0)
    still = np.zeros_like(times)
    return motion_through(times, velocity_of(speed, still, still), np.zeros((len(times), 3)), LLA0)


@pytest.mark.parametrize("error", [0.3, -0.2])
def test_no_hypothesis_tells_roll_from_bias_on_a_straight_road(error: float) -> None:
    """
    GIVEN a levelled car with unknown accelerometer biases, and a heading that is off by ``error``
    WHEN it drives straight on, and its fixes correct the heading
    THEN every hypothesis on the noise knows its roll as poorly as the running filter does.
    """
    run = draw(Scenario("straight", straight_drive, rate=100.0, duration=20.0), 3)
    quat = quat_multiply(quat_from_rotvec(np.array([0.0, 0.0, error])), run.start.quat_xyzw)
    P, by_bias = run.start.P.copy(), tilt_by_bias(matrix_from_quat(quat))
    P[9:, 9:] = np.diag(np.repeat([0.3, 0.003], 3) ** 2)
    P[EPS, 9:] = by_bias @ P[9:12, 9:]
    P[9:, EPS] = P[EPS, 9:].T
    P[EPS, EPS] = P[EPS, B_A] @ by_bias.T + np.diag([0.003, 0.003, 0.26]) ** 2
    ins, _ = fly(replace(run, start=replace(run.start, quat_xyzw=quat, P=P)))

    bank = ins.noise.factors
    assert bank is not None and bank.estimates is not None
    assert abs(heading_from_quat(ins.nav[QUAT])) < 0.06
    G = bank._values[PENDING_G].reshape(N_ERROR, N_ERROR)
    rolls = [(G @ P[PLACES] @ G.T)[6, 6] for P in bank.estimates[:OFFSETS, :COUNT].T]
    assert np.sqrt(covariance(ins.nav)[6, 6]) > 0.025
    assert np.sqrt(min(rolls)) > 0.025
