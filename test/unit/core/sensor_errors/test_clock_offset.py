"""The clock offset's observer: the sensitivity is the filter's own, and sigma stays usable."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from support.analytic_motion import difference
from support.runs import begin, stamped_early

from hybrid_ins.core.filter.events import NoiseChange
from hybrid_ins.core.filter.filter_noise import FilterNoise
from hybrid_ins.core.filter.ins_filter import InsFilter
from hybrid_ins.core.inertial.earth import curvature_scale, normal_gravity
from hybrid_ins.core.inertial.propagation import propagate_covariance, step
from hybrid_ins.core.inertial.state import (
    ACCELERATION,
    AGE_SENSITIVITY,
    CLOCK_VARIANCE,
    COVARIANCE,
    DP,
    DV,
    LAST_F,
    LLA,
    N_ERROR,
    N_FLAT,
    N_NAV,
    SENSITIVITY,
    VELOCITY,
    NavState,
    pack,
    total_std,
    unpack_total,
)
from hybrid_ins.core.noise.process_noise import Correction
from hybrid_ins.core.sensor_errors.clock_offset import (
    AGE_TIME,
    AGE_VARIANCE,
    MARGIN,
    MAX_STD,
    MIN_STD,
    P_PARAMETERS,
    VELOCITY_AGE_STD,
    ClockOffsetObserver,
    predict,
    share_of_motion,
)
from hybrid_ins.core.sensor_errors.clock_prior import ClockDrift
from hybrid_ins.core.sensor_errors.clock_sensitivity import initial_sensitivity, sensitivities
from hybrid_ins.core.update.measurements import VelocityFix
from hybrid_ins.simulation.motions import START_LLA, Motion, motion_through, time_grid
from hybrid_ins.simulation.sensors import ImuErrors
from tools.paper.runs import Run, Scenario, draw

SECOND = 1_000_000_000


def level(velocity_n: np.ndarray) -> np.ndarray:
    """Return the flat state of a vehicle that heads north, its axes level."""
    place, unturned = np.array([0.5, 0.6, 0.0]), np.array([0.0, 0.0, 0.0, 1.0])
    state = NavState(place, velocity_n, unturned, np.zeros(3), np.zeros(3), np.eye(N_ERROR))
    return state.to_flat()


def correction(t_ns: int, velocity_n: np.ndarray, std: float) -> Correction:
    """Return a position fix of a vehicle, fused with no gain, so that nothing holds s back."""
    nav, H = level(velocity_n), np.eye(3, N_ERROR)
    S, K = std**2 * np.eye(3), np.zeros((N_ERROR, 3))
    z = np.full(3, std)
    return Correction(t_ns, z, S, H, K, np.zeros(N_ERROR), np.eye(3), 1.0, nav, True)


def inform(observer: ClockOffsetObserver, fix: Correction) -> None:
    """Let an observer use a correction."""
    observer.update(fix, sensitivities(fix.nav, fix.H)[0], fix.S, 0.0)


@pytest.mark.parametrize("std", [3.0, 1e-3, 1e-9])
def test_sigma_stays_a_number_and_above_what_stamps_resolve(std: float) -> None:
    observer = ClockOffsetObserver(0.5)
    rng = np.random.default_rng(1)
    for k in range(1, 2000):
        velocity_n = rng.normal(0.0, 10.0, 3)
        fix = correction(k * SECOND, velocity_n, std)
        inform(observer, fix)
        assert observer.sigma >= MIN_STD
    assert np.isfinite(observer.residual)


def test_a_huge_sensitivity_leaves_numbers() -> None:
    observer = ClockOffsetObserver(0.5)
    for k, size in enumerate((1e8, 1e100, 1e8), 1):
        fix = correction(k * SECOND, np.ones(3), 1e-3)
        observer.update(fix, np.full((3, 2), size), fix.S, 0.0)
        assert observer.sigma >= MIN_STD
    assert np.isfinite(observer.residual)


class Speed(VelocityFix):
    """A velocity from a sensor that has the IMU's clock."""

    sensor = "wheels"


def filtered(run: Run, speeds: bool) -> InsFilter:
    """Run a filter whose noise is not adapted, over fixes and the speeds of another sensor."""
    ins = begin(run)
    ins.submit(NoiseChange(ins.t_ns, FilterNoise(ins.noise.model, ins.noise.process)))
    ins.ring.extend(run.samples)
    for fix in run.fixes:
        ins.submit(fix)
    for k in range(2, len(run.scored), 7) if speeds else ():
        t_ns = int(run.samples["t_ns"][run.scored[k]])
        ins.submit(Speed(t_ns, run.velocity_n[k], 0.01 * np.eye(3), np.zeros(3)))
    ins.predict_block(run.samples[1:])
    propagate_covariance(ins.nav)
    return ins


@pytest.mark.parametrize("speeds", [False, True])
def test_sensitivity_is_the_derivative_of_the_filter_by_the_clock_offset(speeds: bool) -> None:
    run = draw(Scenario("flight", rate=100.0, duration=20.0, scored_from=0.6), 1)
    run = replace(run, fixes=run.fixes[1:-1])
    late = 2e-3
    right, wrong = filtered(run, speeds), filtered(stamped_early(run, late), speeds)
    s, sigma = right.nav[SENSITIVITY], np.sqrt(np.diag(right.state.P))

    by_difference = difference(right.nav, wrong.nav) / late

    assert np.linalg.norm((by_difference - s) / sigma) < 0.1 * np.linalg.norm(s / sigma)


def test_the_other_sensitivity_is_the_derivative_by_the_age_of_velocities() -> None:
    run = draw(Scenario("flight", rate=100.0, duration=20.0, scored_from=0.6), 1)
    run = replace(run, fixes=run.fixes[1:-1])
    older = 2e-3

    def with_velocities(age: float) -> InsFilter:
        ins = begin(run)
        ins.submit(NoiseChange(ins.t_ns, FilterNoise(ins.noise.model, ins.noise.process)))
        ins.ring.extend(run.samples)
        velocities = [
            VelocityFix(
                int(run.samples["t_ns"][run.scored[k]]) - round(1e9 * age),
                run.velocity_n[k],
                0.01 * np.eye(3),
                np.zeros(3),
            )
            for k in range(2, len(run.scored), 5)
        ]
        for fix in sorted([*run.fixes, *velocities], key=lambda fix: fix.t_ns):
            ins.submit(fix)
        ins.predict_block(run.samples[1:])
        propagate_covariance(ins.nav)
        return ins

    right, wrong = with_velocities(0.0), with_velocities(older)
    u, sigma = right.nav[AGE_SENSITIVITY], np.sqrt(np.diag(right.state.P))
    by_difference = difference(right.nav, wrong.nav) / older

    # the acceleration is a mean over 50 ms, in which it changes by a tenth
    assert np.linalg.norm((by_difference - u) / sigma) < 0.25 * np.linalg.norm(u / sigma)


def cruise(duration: float, seed: int) -> Motion:
    """Go straight, at a speed that hardly changes."""
    t = time_grid(duration)
    velocity_n = np.stack((30.0 + 0.2 * np.sin(0.2 * t + seed), 0.0 * t, 0.0 * t), axis=-1)
    return motion_through(t, velocity_n, np.zeros((len(t), 3)), START_LLA)


def test_noise_of_the_imu_is_no_motion_that_shows_the_clock() -> None:
    """
    GIVEN a vehicle that cruises, with an IMU so noisy that the state follows each fix
    THEN the offset that is found is as far off as its standard deviation says.

    The velocity's noise was taken for changes of the motion: 0.00 ± 0.01 s for 0.2 s.
    """
    noisy = ImuErrors(accelerometer_std=20.0, gyroscope_std=0.02)
    scene = Scenario("cruise", cruise, 100.0, 60.0, 0.6, errors=noisy)
    offset, squares = 0.2, []
    for seed in range(8):
        run = stamped_early(draw(scene, seed), offset)
        ins = begin(run, q=np.repeat([20.0**2, 0.02**2], 3), clock_std=0.2)
        ins.ring.extend(run.samples)
        for fix in run.fixes:
            ins.submit(fix)
        ins.predict_block(run.samples[1:])
        squares.append(((ins.clock.residual - offset) / ins.clock.sigma) ** 2)

    assert np.mean(squares) < 2.0


def test_the_share_of_motion_is_that_of_what_exceeds_noise() -> None:
    """Half of the information is of noise: no offset is drawn to zero, and sigma is right."""
    rng, offset, estimates = np.random.default_rng(8), 0.1, []
    for _ in range(200):
        observer = ClockOffsetObserver(MAX_STD)
        for t in range(1, 61):
            fix = moving(t, rng, offset, 1.0)
            h = fix.nav[VELOCITY] + rng.normal(0.0, 10.0, 3)
            h = np.stack((h, np.zeros(3)), axis=1)
            observer.update(fix, h, fix.S, 3.0 * 10.0**2)
        estimates.append((observer.residual, observer.sigma, share_of_motion(observer.values)))
    found, sigma, share = np.array(estimates).T

    assert np.mean(share) == pytest.approx(0.5, abs=0.05)
    assert np.mean(found) == pytest.approx(offset, abs=0.01)
    assert 0.7 < np.std(found) * MARGIN / np.mean(sigma) < 1.4


def test_a_state_that_was_read_off_late_fixes_stays_as_late() -> None:
    velocity_n, acceleration_n = np.array([8.0, -3.0, 0.5]), np.array([2.0, 1.0, -0.5])
    nav = level(velocity_n)
    f = acceleration_n - [0.0, 0.0, normal_gravity(0.5, 0.0)[1]]
    nav[LAST_F] = f
    nav[SENSITIVITY] = initial_sensitivity(velocity_n, acceleration_n)
    for _ in range(20):
        step(nav, 0.01, *f, 0.0, 0.0, 0.0, 0.0)

    h = sensitivities(nav, np.eye(3, N_ERROR))[0][:, 0]
    assert np.linalg.norm(h) < 0.02 * np.linalg.norm(0.2 * acceleration_n)


def test_a_state_that_the_noise_has_moved_is_one_read_off_the_fixes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    run = draw(Scenario("flight", rate=50.0, duration=10.0, scored_from=0.6), 1)
    nowhere = SimpleNamespace(dx=np.zeros(N_ERROR), P=np.eye(N_ERROR))
    monkeypatch.setattr(FilterNoise, "learn_correction", lambda *_: nowhere)
    ins = begin(run)
    ins.ring.extend(run.samples)
    for fix in run.fixes:
        ins.submit(fix)
    last = int(np.searchsorted(run.samples["t_ns"], run.fixes[-1].t_ns, side="right"))
    ins.predict_block(run.samples[1:last])

    s, nav = ins.nav[SENSITIVITY], ins.nav
    assert np.linalg.norm(nav[ACCELERATION]) > 0.1
    np.testing.assert_allclose(s[DV], -nav[ACCELERATION], atol=0.2)
    np.testing.assert_allclose(s[DP], -nav[VELOCITY], atol=0.2)


def test_without_information_sigma_is_that_of_an_unknown_clock() -> None:
    """
    GIVEN a vehicle that moves for a minute, stands for a day, and moves again
    THEN sigma grows to what it was at the start and no further, and motion shows the offset again.

    With the drift unknown to 1e-4 it grew to ten seconds in a day.
    """
    observer, rng = ClockOffsetObserver(MAX_STD), np.random.default_rng(2)
    largest = 0.0

    def update(t: float, fix: Correction) -> None:
        P = observer.values[P_PARAMETERS].reshape(3, 3)
        assert np.linalg.eigvalsh(P).min() > -1e-12
        inform(observer, fix)

    for t in range(1, 61):
        update(t, moving(t, rng, 0.1, 1.0))
    known = observer.sigma
    for t in range(61, 86_400, 10):
        update(t, replace(moving(t, rng, 0.0, 1.0), nav=np.zeros(N_FLAT)))
        largest = max(largest, abs(observer.residual))
    unknown = observer.sigma
    for t in range(86_400, 86_460):
        update(t, moving(t, rng, -0.3, 1.0))

    assert known < 0.1
    assert largest < 2.0 * MAX_STD
    assert 0.9 * MAX_STD < unknown < 1.1 * MARGIN * MAX_STD
    assert observer.residual == pytest.approx(-0.3, abs=3.0 * observer.sigma)
    assert observer.sigma < 0.1


def moving(t: float, rng: np.random.Generator, tau: float, std: float) -> Correction:
    """Return a fix of a vehicle that changes its velocity all the time, tau late by its stamp."""
    velocity_n = rng.normal(0.0, 10.0, 3)
    z = velocity_n * tau + rng.normal(0.0, std, 3)
    return replace(correction(round(t * SECOND), velocity_n, std), z=z)


def test_a_clock_that_drifts_is_followed() -> None:
    observer, rng = ClockOffsetObserver(0.5), np.random.default_rng(2)
    for t in np.arange(1.0, 400.0):
        fix = moving(t, rng, 0.02 + 2e-4 * t, 0.3)
        inform(observer, fix)

    assert observer.sigma < 0.01
    assert abs(observer.residual - 0.1) < 3.0 * observer.sigma
    assert observer.drift == pytest.approx(2e-4, abs=5e-5)


def test_a_given_drift_is_followed_without_information() -> None:
    """
    GIVEN a drift of 300 ppm known to 20 ppm, and an hour in which nothing shows the clock
    THEN the offset moves by that, and the drift is as well known as it was.
    """
    observer = ClockOffsetObserver(MAX_STD, drift=ClockDrift(3e-4, 2e-5))
    observer.set_estimate(0.02, 0.005)
    std = observer.drift_sigma
    for t in range(0, 3600, 10):
        predict(observer.values, 10.0)
        if t == 590:
            assert observer.residual == pytest.approx(0.02 + 600.0 * 3e-4)
            assert observer.sigma < 0.03
    assert observer.drift == 3e-4
    assert observer.drift_sigma == pytest.approx(std, rel=1e-6)


def test_rejected_fixes_do_not_inform() -> None:
    observer, rng = ClockOffsetObserver(0.5), np.random.default_rng(3)
    for t in np.arange(1.0, 50.0):
        inform(observer, replace(moving(t, rng, 0.1, 0.3), fused=False))

    assert observer.residual == 0.0
    assert observer.sigma >= 0.5


@pytest.mark.parametrize("age", [-0.6, -0.12, 0.0, 0.08])
def test_the_age_of_velocities_is_no_offset_of_positions(age: float) -> None:
    """
    GIVEN velocities that are older than positions, which have drawn the state after them
    THEN the offset is that of the positions, and the age is found beside it, and that such ages
        are usual of this receiver.
    """
    offset, rng = 0.05, np.random.default_rng(6)
    observer = ClockOffsetObserver(0.5)
    for t in np.arange(1.0, 300.0):
        position = moving(t, rng, offset, 0.3)
        nav, H = position.nav, np.eye(3, N_ERROR, 3)
        nav[ACCELERATION] = rng.normal(0.0, 3.0, 3)
        nav[SENSITIVITY][DP] = nav[AGE_SENSITIVITY][DP] = -rng.normal(0.0, 3.0, 3)
        h, g = nav[VELOCITY] + nav[SENSITIVITY][DP], nav[AGE_SENSITIVITY][DP]
        noise = rng.normal(0.0, 0.3, 3)
        inform(observer, replace(position, z=h * offset + g * age + noise))
        noise = rng.normal(0.0, 0.1, 3)
        z = nav[ACCELERATION] * (offset + age) + noise
        inform(observer, replace(position, z=z, H=H, S=0.1**2 * np.eye(3)))

    found, sigma = observer.velocity_age
    assert observer.sigma < 0.01
    assert abs(observer.residual - offset) < 3.0 * observer.sigma
    usual = max(abs(age), VELOCITY_AGE_STD)
    assert sigma < 0.5 * usual
    assert abs(found - age) < 3.0 * sigma
    assert np.sqrt(observer.values[AGE_VARIANCE]) == pytest.approx(usual, rel=0.15)


def test_an_age_that_velocities_had_is_forgotten() -> None:
    observer, rng = ClockOffsetObserver(MIN_STD), np.random.default_rng(7)
    fix = moving(1.0, rng, 0.0, 0.1)
    fix.nav[ACCELERATION] = 3.0
    older = replace(fix, H=np.eye(3, N_ERROR, 3), z=np.full(3, -0.3))
    for k in range(100):
        inform(observer, replace(older, t_ns=fix.t_ns + k * SECOND // 10))
    known = observer.velocity_age[1]
    inform(observer, replace(fix, t_ns=fix.t_ns + round((10 + 5 * AGE_TIME) * SECOND)))

    age, sigma = observer.velocity_age
    assert known < 0.5 * VELOCITY_AGE_STD
    assert abs(age) < 0.01
    assert sigma == pytest.approx(MARGIN * VELOCITY_AGE_STD, rel=0.05)


@pytest.mark.parametrize("by", [2e-3, 0.4])
def test_a_shift_leaves_what_is_not_linear_in_it(by: float) -> None:
    observer, rng = ClockOffsetObserver(0.5), np.random.default_rng(4)
    for t in np.arange(1.0, 100.0):
        fix = moving(t, rng, by, 0.3)
        inform(observer, fix)
    before = observer.sigma
    observer.shift(by, fix.nav)

    grown = np.sqrt(observer.sigma**2 - before**2)
    assert grown < 1e-4 if by < 0.01 else grown > 0.2


def test_what_is_not_known_of_the_clock_is_in_the_covariance() -> None:
    """
    GIVEN fixes whose clock is off by as much as its standard deviation allows
    WHEN the filter considers that, and when it does not
    THEN its covariance covers the error of position, or is far from it.
    """
    nees = {False: [], True: []}  # type: dict[bool, list[float]]
    for seed in range(12):
        offset = 0.15 * float(np.random.default_rng(seed).standard_normal())
        run = draw(Scenario("flight", rate=50.0, duration=8.0, scored_from=0.6), seed)
        for considered, found in nees.items():
            ins = begin(stamped_early(run, offset), clock_std=0.15, consider_clock=considered)
            rows = np.empty((len(run.samples) - 1, N_NAV))
            ins.ring.extend(run.samples)
            for fix in stamped_early(run, offset).fixes:
                ins.submit(fix)
            ins.predict_block(run.samples[1:], rows)
            for k in range(1, len(run.scored)):
                row, P = rows[run.scored[k] - 1], np.empty((N_ERROR, N_ERROR))
                unpack_total(row, P)
                off = (run.lla[k] - row[LLA]) * curvature_scale(run.lla[k])
                found.append(float(off @ np.linalg.solve(P[DP, DP], off)) / 3.0)

    assert 0.3 < np.mean(nees[True]) < 1.8
    assert np.mean(nees[False]) > 3.0


def test_covariance_that_is_reported_has_the_share_of_the_clock() -> None:
    rng = np.random.default_rng(5)
    nav = np.zeros(N_FLAT)
    root = rng.standard_normal((N_ERROR, N_ERROR))
    pack(root @ root.T, nav[COVARIANCE])
    nav[SENSITIVITY], nav[CLOCK_VARIANCE] = rng.standard_normal(N_ERROR), 0.3
    total = np.empty((N_ERROR, N_ERROR))
    unpack_total(nav, total)

    expected = root @ root.T + 0.3 * np.outer(nav[SENSITIVITY], nav[SENSITIVITY])
    np.testing.assert_allclose(total, expected)
    np.testing.assert_allclose(total_std(nav), np.sqrt(np.diag(expected)))
