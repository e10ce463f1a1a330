"""The pulse at the start of a lift shows that it moves, until the opposite one."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from hybrid_ins.core.imu.lift_watch import LONGEST_RIDE, LiftWatch
from hybrid_ins.core.imu.samples import SAMPLE_DTYPE
from hybrid_ins.core.imu.standstill import is_standing

RATE, PERIOD = 100, 0.5  # Hz, s
Signal = Callable[[np.ndarray], np.ndarray]


def moves(up: Signal, duration: float, roll_rate: Signal = np.zeros_like) -> np.ndarray:
    """Return times [s] and whether the vehicle moves by an acceleration upwards [m/s²]."""
    t = np.arange(0.0, duration, 1.0 / RATE)
    rng = np.random.default_rng(1)
    samples = np.zeros(len(t), SAMPLE_DTYPE)
    samples["t_ns"] = np.round(t * 1e9)
    samples["f"] = rng.normal([0.5, 0.0, -9.7], 0.02, (len(t), 3))
    samples["f"][:, 2] -= up(t)
    samples["w"] = rng.normal(0.0, 0.002, (len(t), 3)) + 0.003
    samples["w"][:, 0] += roll_rate(t)
    watch, found = LiftWatch(), []
    for end in np.arange(RATE, len(t), round(PERIOD * RATE)):
        last = samples[end - RATE : end]
        calm = is_standing(last)
        watch.observe(last[RATE // 2 :], PERIOD, calm)
        if calm and not watch.moves:
            watch.note_stand(last)
        found.append((t[end], watch.moves))
    return np.array(found)


def pulse(t: np.ndarray, begin: float, size: float, length: float = 1.5) -> np.ndarray:
    during = (t >= begin) & (t < begin + length)
    return np.where(during, size * np.sin(np.pi * (t - begin) / length), 0.0)


@pytest.mark.parametrize("size", [0.5, -0.8, 1.0])
def test_a_lift_moves_from_one_pulse_to_the_opposite_one(size: float) -> None:
    t, found = moves(lambda t: pulse(t, 5.0, size) - pulse(t, 40.0, size), 60.0).T

    assert not found[t < 5.0].any()
    assert found[(t > 7.5) & (t < 40.0)].all()
    assert not found[t > 42.5].any()


def test_a_jolt_is_no_lift() -> None:
    _, found = moves(lambda t: 3.0 * np.sin(4.0 * np.pi * t) * (np.abs(t - 20.0) < 2.0), 40.0).T
    assert not found[-10:].any()


def test_a_tilt_ends_it() -> None:
    t, found = moves(lambda t: pulse(t, 5.0, 0.8), 30.0, lambda t: pulse(t, 15.0, 0.1)).T
    assert found[(t > 7.5) & (t < 14.5)].all()
    assert not found[t > 17.0].any()


def test_no_ride_is_so_long() -> None:
    t, found = moves(lambda t: pulse(t, 5.0, 0.8), LONGEST_RIDE + 20.0).T
    assert found[t < LONGEST_RIDE].sum() > 300
    assert not found[t > LONGEST_RIDE + 8.0].any()
