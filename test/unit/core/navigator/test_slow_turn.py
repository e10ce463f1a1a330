"""A turn of a vehicle that stands is told from the drift of its gyroscopes' bias."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from hybrid_ins.core.imu.samples import SAMPLE_DTYPE
from hybrid_ins.core.navigator.slow_turn import SlowTurn, TurnNoticed

BIAS = np.array([0.004, -0.002, 0.003])
UPRIGHT, ON_ITS_SIDE = (0.0, 0.0, -9.8), (0.0, 9.8, 0.0)
RATE = np.radians(0.3)  # rad/s, of a slow turn


def ramp(t: float, begin: float, seconds: float) -> float:
    """Return how much of a turn there is at a time [s], which begins softly."""
    return float(np.clip((t - begin) / seconds, 0.0, 1.0))


def followed(
    rate: Callable[[float], np.ndarray],
    seconds: float,
    force_b: tuple[float, float, float] = UPRIGHT,
    stands: Callable[[float], bool] = lambda t: True,
    noise: float = 1e-3,
    bias_std: float = 3e-4,
) -> tuple[SlowTurn, list[tuple[float, TurnNoticed]], list[tuple[float, bool]]]:
    """Return a stand [s], checked twice a second: turns noticed, whether it turns by time."""
    rng, turn, noticed, turns = np.random.default_rng(2), SlowTurn(), [], []
    for t in np.arange(0.0, seconds, 0.5):
        samples = np.zeros(100, SAMPLE_DTYPE)
        samples["t_ns"] = np.rint((t + np.arange(100) * 0.01) * 1e9)
        samples["f"] = force_b
        samples["w"] = BIAS + rate(t) + noise * rng.standard_normal((100, 3))
        found = turn.follow(samples, stands(t), BIAS, np.full(3, bias_std))
        noticed += [] if found is None else [(t, found)]
        turns.append((t, turn.turns))
    return turn, noticed, turns


@pytest.mark.parametrize(("force_b", "axis"), [(UPRIGHT, 2), (ON_ITS_SIDE, 1)])
@pytest.mark.parametrize("seconds", [0.5, 10.0, 20.0])
def test_a_turn_that_begins_softly_is_noticed_and_the_bias_is_that_of_before(
    force_b: tuple[float, float, float], axis: int, seconds: float
) -> None:
    about = np.eye(3)[axis] * RATE

    _, noticed, turns = followed(lambda t: ramp(t, 40.0, seconds) * about, 90.0, force_b)

    [(at, found)] = noticed
    assert 40.0 < at < 45.0 + 0.7 * seconds
    assert np.all(np.abs(found.stand.rate_b - BIAS) < 2.0 * found.stand.rate_std)
    assert np.max(found.stand.rate_std) < 0.2 * RATE
    assert found.std[12 + axis] > 0.2 * RATE and found.std[8] > 0.0
    assert np.count_nonzero(found.std) == 2
    assert all(is_turning for t, is_turning in turns if t > at)


def test_a_turn_that_lasts_is_one_to_its_end() -> None:
    _, [(at, _)], turns = followed(lambda t: np.array([0.0, 0.0, 0.004 * (t > 40.0)]), 400.0)

    assert all(is_turning for t, is_turning in turns if t > at)


def test_the_turn_is_over_when_the_rate_is_what_it_was() -> None:
    def rate(t: float) -> np.ndarray:
        return np.array([0.0, 0.0, ramp(t, 40.0, 5.0) - ramp(t, 80.0, 20.0)]) * RATE

    _, noticed, turns = followed(rate, 150.0)

    assert len(noticed) == 1
    assert all(is_turning for t, is_turning in turns if 50.0 < t < 100.0)
    assert not any(is_turning for t, is_turning in turns if t > 140.0)


@pytest.mark.parametrize(
    "drift",
    [
        np.array([0.0, 0.0, 1e-5]),  # rad/s²: 0.03°/s in a minute, of a gyroscope that warms up
        np.array([4e-4, -3e-4, 3e-4]),  # as fast as a turn begins, of all three axes
        np.zeros(3),
    ],
)
@pytest.mark.parametrize("noise", [1e-4, 1e-3, 1e-2])
def test_neither_drift_nor_noise_is_a_turn(drift: np.ndarray, noise: float) -> None:
    _, noticed, _ = followed(lambda t: drift * min(t, 60.0), 240.0, noise=noise)

    assert not noticed


@pytest.mark.parametrize(("pause", "goes_on"), [(2.0, True), (8.0, False)])
def test_a_short_interruption_is_the_same_stand(pause: float, goes_on: bool) -> None:
    turn, noticed, _ = followed(
        lambda t: np.array([0.0, 0.0, RATE * (t > 40.0)]),
        60.0,
        stands=lambda t: not 50.0 < t < 50.0 + pause,
    )

    assert len(noticed) == 1
    assert turn.turns == goes_on


@pytest.mark.parametrize("seconds", [0.5, 10.0])
def test_a_turn_that_a_stand_begins_with_is_noticed_when_it_ends(seconds: float) -> None:
    turning = np.array([0.0, 0.0, RATE])

    turn, noticed, _ = followed(lambda t: turning * (1.0 - ramp(t, 40.0, seconds)), 90.0)

    at = noticed[0][0]
    assert 40.0 < at < 45.0 + 0.7 * seconds
    left = [abs(found.stand.rate_b[2] - BIAS[2]) / RATE for _, found in noticed]
    assert left[0] < 0.7 and left[-1] < 0.15
    assert not turn.turns


@pytest.mark.parametrize(("begin", "end"), [(40.0, 999.0), (0.0, 40.0)])
def test_a_turn_leaves_a_bias_that_is_not_known_uncertain(begin: float, end: float) -> None:
    turn, noticed, _ = followed(
        lambda t: np.array([0.0, 0.0, RATE * (begin <= t < end)]), 60.0, bias_std=0.01
    )

    [(_, found)] = noticed
    assert found.stand is None
    assert found.std[14] > 0.9 * RATE
    assert turn.turns == (begin > 0.0)
