"""The parts of the check of axes that are compiled or vectorised, against their plain forms."""

from dataclasses import replace

import numpy as np
import pytest

from hybrid_ins.core.imu_axes.explanation import BETTER, FITS, MUCH_BETTER, NOISE
from hybrid_ins.core.imu_axes.fit import (
    LEAST_STEP,
    STEP,
    TOLERANCE,
    Fit,
    Motion,
    add_products,
    attitudes,
    change_on_paths,
    fit,
    integrate_force,
    subtract_turned,
    triples_of,
)
from hybrid_ins.core.imu_axes.nuisance import TOLERANT
from hybrid_ins.core.imu_axes.tolerance import times_by_chance
from hybrid_ins.core.inertial.earth import curvature_scale
from hybrid_ins.simulation.motions import quadrotor_flight
from hybrid_ins.simulation.sensors import fixes, sample, sample_times


def plain_triples(t: np.ndarray, interval: float) -> np.ndarray:
    rows, taken = [], -np.inf
    for k in range(1, len(t) - 1):
        first = int(np.argmin(np.abs(t[:k] - (t[k] - interval))))
        last = k + 1 + int(np.argmin(np.abs(t[k + 1 :] - (t[k] + interval))))
        spans = t[k] - t[first], t[last] - t[k]
        low, high = interval * TOLERANCE[0], interval * TOLERANCE[1]
        if low <= min(spans) and max(spans) <= high and t[k] - taken >= LEAST_STEP:
            rows.append((first, k, last))
            taken = t[k]
    return np.array(rows, np.intp).reshape(-1, 3)


@pytest.mark.parametrize("interval", [1.0, 2.5])
@pytest.mark.parametrize("seed", range(10))
def test_triples_are_those_of_a_search_one_by_one(seed: int, interval: float) -> None:
    rng = np.random.default_rng(seed)
    steps = rng.choice([0.05, 0.1, 0.2, 1.0, 4.0], 60, p=[0.2, 0.3, 0.3, 0.15, 0.05])
    t = np.cumsum(steps * rng.uniform(0.9, 1.1, 60))

    np.testing.assert_array_equal(triples_of(t, interval), plain_triples(t, interval))


@pytest.mark.parametrize("count", [3, 4])
def test_few_fixes_have_few_triples(count: int) -> None:
    t = np.arange(count) * 1.0
    np.testing.assert_array_equal(triples_of(t, 1.0), plain_triples(t, 1.0))


@pytest.mark.parametrize("size", [0.0, 0.05, 3.0])
def test_integrated_force_is_that_of_products_of_rotations(size: float) -> None:
    rng = np.random.default_rng(1)
    turns, impulse = rng.normal(0.0, size, (3, 40, 3)), rng.normal(0.0, 1.0, (40, 3))
    paths, arms = np.zeros((3, 41, 3)), np.empty((3, 41, 3))

    integrate_force(turns, impulse, paths, arms)

    force = impulse + 0.5 * np.cross(turns, impulse)
    steps = np.einsum("...ij,...j->...i", attitudes(turns), force)
    velocity = np.cumsum(steps, axis=-2)
    expected = np.cumsum(STEP * (velocity - 0.5 * steps), axis=-2)
    np.testing.assert_allclose(paths[:, 1:], expected, rtol=1e-11, atol=1e-11)
    np.testing.assert_allclose(np.moveaxis(arms[:, :-1], 0, 2), attitudes(turns)[0], atol=1e-11)


def test_changes_on_paths_are_those_of_interpolated_places() -> None:
    rng = np.random.default_rng(2)
    start, offsets = 7.0, np.array([-0.3, 0.0, 0.2])
    fix_t, paths = start + np.arange(0.0, 5.0, 0.2), rng.normal(0.0, 1.0, (2, 81, 3))
    triples = triples_of(fix_t, 1.0)
    changes = np.empty((2, 3, len(triples), 3))

    change_on_paths(paths, start, fix_t, offsets, triples, changes)

    steps = (fix_t + offsets[:, None] - start) / STEP  # also before the first step, after the last
    k = np.clip(steps.astype(int), 0, 79)
    places = paths[:, k] + (steps - k)[..., None] * (paths[:, k + 1] - paths[:, k])
    before, at, after = (places[:, :, of] for of in triples.T)
    t_before, t, t_after = (fix_t[of, None] for of in triples.T)
    expected = (after - at) / (t_after - t) - (at - before) / (t - t_before)
    np.testing.assert_allclose(changes, expected, rtol=1e-11, atol=1e-9)


def test_products_and_what_turned_changes_leave_over_are_those_of_matrices() -> None:
    rng = np.random.default_rng(3)
    change_n, changes, C = (rng.normal(0.0, 1.0, n) for n in ((9, 3), (4, 9, 3), (4, 3, 3)))
    M, misfit = np.zeros((4, 3, 3)), np.empty((4, 9, 3))

    add_products(change_n, changes, M)
    subtract_turned(change_n, C, changes, misfit)

    np.testing.assert_allclose(M, change_n.T @ changes, atol=1e-13)
    np.testing.assert_allclose(misfit, change_n - changes @ C.swapaxes(1, 2), atol=1e-13)


def motion(lever_arm_b: tuple[float, float, float], std: float, offset: float = 0.0) -> Motion:
    """Return 20 s of a quadrotor's figures of eight, without errors of the IMU."""
    flight, begin = quadrotor_flight(40.0, 3), 15.0
    truth = sample(flight, sample_times(40.0, 100.0))
    gnss = fixes(
        sample(flight, sample_times(40.0, 5.0)), np.random.default_rng(1), std, lever_arm_b
    )
    t = begin + STEP * np.arange(round(22.0 / STEP) + 1)  # a second more at both ends
    steps = []
    for readings in (truth.angular_rate_b, truth.specific_force_b):
        mean = 0.5 * (readings[1:] + readings[:-1])
        sums = np.vstack((np.zeros(3), np.cumsum(mean * np.diff(truth.t)[:, None], axis=0)))
        at = np.stack([np.interp(t, truth.t, column) for column in sums.T], axis=1)
        steps.append(np.diff(at, axis=0))
    used = (gnss.t > begin + 1.0) & (gnss.t < begin + 21.0)
    position_n = (gnss.lla[used] - gnss.lla[used][0]) * curvature_scale(gnss.lla[used][0])
    fix_t = gnss.t[used] - offset
    return Motion(t, *steps, fix_t, position_n, triples_of(fix_t, 1.0))


def test_a_lever_arm_and_a_clock_offset_are_found_and_leave_nothing_over() -> None:
    lever_arm = 0.2, -0.1, 0.4

    found = fit(motion(lever_arm, 0.0, 0.13), Fit(1.0, np.eye(3)))

    change = float(np.sum(motion(lever_arm, 0.0).change_n[:, :2] ** 2))
    np.testing.assert_allclose(found.lever_arm, lever_arm, atol=0.08)  # a prior holds it back
    assert found.left < 1e-3 * change


def test_errors_of_right_axes_are_noise_and_those_of_wrong_ones_are_not() -> None:
    flown = motion((0.2, -0.1, 0.4), 0.1)

    assert fit(flown, Fit(1.0, np.eye(3))).correlation < NOISE
    assert fit(flown, Fit(1.0, np.diag([-1.0, 1.0, 1.0]))).correlation > 2.0 * NOISE


def test_ordinary_errors_of_an_imu_are_tolerated_and_wrong_axes_are_not() -> None:
    # GIVEN a long lever arm, an accelerometer's bias, a gyroscope's scales and misaligned axes
    ideal = motion((-2.0, 0.3, 1.0), 0.0)
    errors = np.array([[0.01, -0.01, 0.006], [0.008, -0.01, 0.01], [-0.006, 0.01, 0.008]])
    turn = ideal.turn @ (np.eye(3) + errors).T
    flown = replace(ideal, turn=turn, impulse=ideal.impulse + STEP * np.array([0.1, -0.15, 0.1]))
    change = float(np.sum(flown.change_n[:, :2] ** 2))
    # WHEN they may explain what is left over THEN nothing is, but of wrong axes
    strict = fit(flown, Fit(1.0, np.eye(3)))
    tolerant = fit(flown, strict, TOLERANT)
    reversed_y = fit(flown, Fit(1.0, np.diag([1.0, -1.0, 1.0])))
    accused = fit(flown, reversed_y, TOLERANT)
    assert strict.left > MUCH_BETTER * tolerant.left
    assert tolerant.left < FITS * change < accused.left


def test_few_poor_fixes_leave_less_over_by_chance() -> None:
    flown = motion((0.2, -0.1, 0.4), 0.1)
    few = flown.fix_t[::5]
    poor = replace(flown, fix_t=few, triples=triples_of(few, 5.0))

    assert times_by_chance(flown) < BETTER
    assert times_by_chance(poor) > BETTER
