"""Readings on a straight line were not measured; others are, whatever made them smooth."""

import numpy as np
import pytest

from hybrid_ins.core.imu.straight_line import follows_line, no_line

RATE = 100.0  # Hz
START_NS = 1_700_000_000_000_000_000


def refused(readings: np.ndarray, rate: float = RATE) -> np.ndarray:
    """Return which of readings (N, 6) at a rate [Hz] are said to lie on a line."""
    line = no_line()
    stamps = START_NS + np.round(np.arange(len(readings)) * 1e9 / rate).astype(np.int64)
    return np.array(
        [
            follows_line(*line, t_ns, tuple(reading))
            for t_ns, reading in zip(stamps.tolist(), readings.tolist(), strict=True)
        ]
    )


def measured(seed: int, count: int = 400) -> np.ndarray:
    """Return readings of a moving vehicle with an IMU's noise."""
    rng = np.random.default_rng(seed)
    t = np.arange(count)[:, None] / RATE
    motion = np.sin(t * [1.0, 1.3, 0.7, 0.9, 1.1, 0.5]) * [1.0, 1.0, 0.5, 0.1, 0.1, 0.3]
    motion[:, 2] += 9.8
    return motion + rng.standard_normal((count, 6)) * np.repeat([0.02, 0.002], 3)


def filled(readings: np.ndarray, begin: int, end: int) -> np.ndarray:
    """Return readings with those between two of them put on a line."""
    readings = readings.copy()
    share = np.linspace(0.0, 1.0, end - begin + 1)[:, None]
    readings[begin : end + 1] = (1.0 - share) * readings[begin] + share * readings[end]
    return readings


@pytest.mark.parametrize("digits", [4, 6, 15])
@pytest.mark.parametrize("precision", [np.float32, np.float64])
def test_a_filled_gap_is_found_after_a_fifth_of_a_second(digits: int, precision: type) -> None:
    """So it is with six decimals, or in single precision; with four the noise of rounding shows."""
    readings = np.round(filled(measured(1), 100, 250), digits).astype(precision).astype(float)

    found = np.flatnonzero(refused(readings))

    expected = [] if digits < 6 else list(range(120, 251))
    assert found.tolist() == expected


@pytest.mark.parametrize("seed", range(20))
def test_measured_readings_are_never_refused(seed: int) -> None:
    assert not refused(measured(seed)).any()


@pytest.mark.parametrize("rate", [50.0, 200.0, 1000.0])
def test_nor_is_an_imu_without_noise(rate: float) -> None:
    """A simulator's vehicle that sways once in twenty seconds, and one that stands."""
    t = np.arange(int(20.0 * rate))[:, None] / rate
    sway = np.sin(0.3 * t + np.arange(6.0))
    sway[:, 2] += 9.8
    assert not refused(sway, rate).any()
    assert not refused(np.tile([0.1, 0.2, 9.8, 1e-4, 2e-4, 3e-4], (len(t), 1)), rate).any()


def test_nor_are_ramps_of_a_simulated_manoeuvre() -> None:
    """It accelerates ever more, and turns ever faster: three axes at most are on a line."""
    t = np.arange(400) / RATE
    still = np.zeros(400)
    ramp = np.stack([0.5 * t, still, still + 9.8, still, 0.1 * t, 0.2 * t], axis=1)
    assert not refused(ramp).any()


def test_nor_are_readings_of_a_slower_imu_between_its_samples() -> None:
    """A driver that publishes at 100 Hz what an IMU measures at 10 Hz loses nothing."""
    slow = measured(3, 41)
    t = np.arange(400) / RATE
    fast = np.stack([np.interp(t, np.arange(41) / 10.0, axis) for axis in slow.T], axis=1)
    assert not refused(fast).any()


def test_the_answer_for_the_same_reading_stays_and_stamps_that_go_back_begin_anew() -> None:
    readings, line = filled(measured(5), 0, 60), no_line()
    stamps = (START_NS + np.arange(400) * 10_000_000).tolist()
    for k in range(41):
        answer = follows_line(*line, stamps[k], tuple(readings[k].tolist()))
    assert answer
    assert follows_line(*line, stamps[40], tuple(readings[40].tolist()))
    assert not follows_line(*line, stamps[20], tuple(readings[20].tolist()))
    for k in range(21, 39):
        assert not follows_line(*line, stamps[k], tuple(readings[k].tolist()))
    assert follows_line(*line, stamps[40], tuple(readings[40].tolist()))
