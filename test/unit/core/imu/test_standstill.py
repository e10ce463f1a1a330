"""Standing is told from vibration, hovering and cruising."""

import numpy as np
import pytest

from hybrid_ins.core.imu.samples import SAMPLE_DTYPE, as_numbers, readings_of
from hybrid_ins.core.imu.standstill import (
    Glides,
    StandingForce,
    is_standing,
    may_be_zero,
    mean_and_std,
    sway,
)

RATE = 200.0


def samples(force_std=0.02, rate_std=0.002, seconds=1.0, force=None, rate=None, seed=0):
    rng = np.random.default_rng(seed)
    n = int(seconds * RATE)
    table = np.zeros(n, SAMPLE_DTYPE)
    t = np.arange(n) / RATE
    table["t_ns"] = np.rint(t * 1e9) + 1
    table["f"] = [0.0, 0.0, -9.8] + force_std * rng.standard_normal((n, 3))
    table["w"] = rate_std * rng.standard_normal((n, 3))
    if force is not None:
        table["f"] += force(t)[:, None]
    if rate is not None:
        table["w"] += rate(t)[:, None]
    return table


def test_a_calm_sensor_stands() -> None:
    assert is_standing(samples())


def test_mean_and_standard_deviation_are_those_of_the_readings() -> None:
    table = samples(force=lambda t: t)
    mean, std = mean_and_std(as_numbers(table))
    readings = readings_of(table)
    np.testing.assert_allclose(mean, readings.mean(axis=0), rtol=1e-13, atol=1e-16)
    np.testing.assert_allclose(std, readings.std(axis=0), rtol=1e-12)


def test_a_biased_sensor_that_stands_stands() -> None:
    assert is_standing(samples(rate=lambda t: 0.01 + 0.0 * t))


@pytest.mark.parametrize(
    ("what", "changes"),
    [
        ("vibration", {"force_std": 0.5}),
        ("a vibrating gyroscope", {"rate_std": 0.05}),
        ("a hovering drone that balances", {"rate": lambda t: 0.015 * np.sin(2 * np.pi * 1.5 * t)}),
        ("speeding up", {"force": lambda t: 0.5 * t}),
        ("a slow turn", {"rate": lambda t: 0.1 + 0.0 * t}),
        ("swaying", {"force": lambda t: 0.2 * np.sin(2 * np.pi * t)}),
    ],
)
def test_motion_is_not_standing(what: str, changes: dict) -> None:
    assert not is_standing(samples(**changes)), what


@pytest.mark.parametrize("period", [2.0, 4.0, 6.0])
def test_a_slow_sway_is_not_taken_for_the_bias(period: float) -> None:
    """GIVEN a hull that sways WHEN a second of it seems to stand THEN its rate may be its own."""
    off = []
    for phase in np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False):

        def rate(t, phase=phase):
            return 0.004 * period * np.sin(2.0 * np.pi * t / period + phase)

        table = samples(rate_std=1e-3, rate=rate)
        if is_standing(table):
            off.append(table["w"].mean(axis=0) / np.hypot(0.002, sway(table)))
    assert len(off) > 4 and np.sqrt(np.mean(np.square(off))) < 4.0


@pytest.mark.parametrize("noise", [1e-4, 1e-3, 0.015])
def test_noise_is_no_sway(noise: float) -> None:
    assert np.all(np.hypot(0.002, sway(samples(rate_std=noise))) < 0.0021)


@pytest.mark.parametrize("noise", [1e-4, 1e-3, 0.015])
def test_noise_is_hardly_any_sway(noise: float) -> None:
    """GIVEN noise alone WHEN its sway is read THEN it is of the size of the mean's own error."""
    found = [sway(samples(rate_std=noise, seed=seed)) for seed in range(50)]
    of_mean = noise / np.sqrt(len(samples()))
    assert np.sqrt(np.mean(np.square(found))) < 2.0 * of_mean


def test_a_turn_that_ends_is_sway() -> None:
    """GIVEN a vehicle that has just been put down WHEN it seems to stand THEN it may still turn."""
    table = samples(rate_std=3e-3, rate=lambda t: 0.008 * np.exp(-2.0 * t))
    assert is_standing(table)
    mean = np.abs(table["w"].mean(axis=0))
    assert np.all(mean > 0.002) and np.all(sway(table) > 0.5 * mean)


def test_too_few_samples_tell_nothing() -> None:
    assert not is_standing(samples(seconds=0.05))


@pytest.mark.parametrize(("jerk", "seconds", "found"), [(0.03, 5.0, True), (0.0, 60.0, False)])
def test_a_gentle_start_changes_the_mean_since_the_stand_began(
    jerk: float, seconds: float, found: bool
) -> None:
    stand = StandingForce()
    begins = np.arange(0.0, seconds, 0.5)

    windows = [samples(force=lambda t, b=b: jerk * (t + b)) for b in begins]

    assert all(is_standing(window) for window in windows)  # one second does not show it
    assert any(stand.changes(window) for window in windows) == found


def test_noise_is_no_change_of_the_mean() -> None:
    stand = StandingForce()
    rng = np.random.default_rng(3)
    for _ in range(200):
        window = samples()
        window["f"] += 0.25 * rng.standard_normal(window["f"].shape)
        assert not stand.changes(window)


@pytest.mark.parametrize(("speed", "plausible"), [(1.0, True), (5.0, False)])
def test_zero_is_plausible_within_the_covariance(speed: float, plausible: bool) -> None:
    assert may_be_zero(np.array([speed, 0.0, 0.0]), np.eye(3)) == plausible


@pytest.mark.parametrize(
    ("seconds", "speed", "std", "shown"),
    [
        (15.0, 1.5, 0.1, True),
        (8.0, 1.5, 0.1, False),  # a stand has to last longer
        (15.0, 0.3, 0.1, False),  # a receiver may drift as fast
        (15.0, 1.5, 0.7, False),
    ],
)
def test_a_calm_may_be_a_glide_where_one_was_shown_and_its_speed_is_plausible(
    seconds: float, speed: float, std: float, shown: bool
) -> None:
    glides, at_ns = Glides(), 1_000_000_000

    for k in range(int(2.0 * seconds)):
        end_ns = at_ns + k * 500_000_000
        glides.observe(end_ns - 1_000_000_000, end_ns, speed, std)

    assert glides.explain(2.0) == shown
    assert not glides.explain(1.0)


def test_the_glide_of_what_brakes_is_as_fast_as_before() -> None:
    glides = Glides()
    for k in range(60):
        end_ns = (k + 2) * 500_000_000
        glides.observe(end_ns - 1_000_000_000, end_ns, 10.0 - k / 6.0, 0.1)

    assert not glides.explain(9.0)
    assert glides.explain(10.0)


def test_glides_of_some_seconds_are_no_long_one() -> None:
    glides = Glides()
    for k in range(200):
        glides.observe(k * 500_000_000, k * 500_000_000 + 1_000_000_000, 1.5, 0.1)
        if k % 10 == 0:
            glides.reset()

    assert not glides.explain(10.0)
