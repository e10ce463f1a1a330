"""One rule admits readings one by one and in stretches."""

import math
from collections import Counter

import numpy as np
import pytest

from hybrid_ins import parameters
from hybrid_ins.core.imu.straight_line import no_line
from hybrid_ins.ros.estimator.estimator import Estimator
from hybrid_ins.ros.estimator.imu_admission import (
    USELESS,
    admitted_readings,
    end_of_stretch,
    judge,
    refusal,
)
from hybrid_ins.ros.messages.cdr import ImuFields

LIMITS = MAX_FORCE, MAX_RATE = 100.0, 10.0
LEVEL, STILL = (0.0, 0.0, 9.8), (0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("t_ns", "force", "rate", "name"),
    [
        (0, LEVEL, STILL, "imu: zero stamp"),
        (-(2**31) * 10**9, LEVEL, STILL, "imu: negative stamp"),
        (1, (0.0, math.nan, 9.8), STILL, "imu: not finite"),
        (1, LEVEL, (math.inf, 0.0, 0.0), "imu: not finite"),
        (1, STILL, STILL, "imu: no acceleration"),
        (1, (0.0, -101.0, 9.8), STILL, "imu: absurd acceleration"),
        (1, LEVEL, (0.0, 0.0, 10.5), "imu: absurd rate"),
    ],
)
def test_what_is_not_usable_is_refused_by_name_and_ends_a_stretch(
    t_ns: int, force: tuple[float, ...], rate: tuple[float, ...], name: str
) -> None:
    assert judge(t_ns, force, rate, *LIMITS, *no_line()) == USELESS
    assert refusal(t_ns, force, rate, MAX_FORCE).name == name
    stamps = np.array([-1, t_ns, t_ns + 1]) + 0
    forces, rates = np.array([LEVEL, force, LEVEL]), np.array([STILL, rate, STILL])
    line = no_line()
    assert end_of_stretch(stamps, forces, rates, 1, t_ns - 1, 5, 10**9, *LIMITS, *line) == 1


@pytest.mark.parametrize(
    ("steps", "until", "end"),
    [
        ([1, 1, 1, 1], 100, 4),
        ([1, 1, 6, 1], 100, 2),
        ([1, 0, 1, 1], 100, 1),
        ([1, -1, 1, 1], 100, 1),
        ([6, 1, 1, 1], 100, 0),
        ([1, 1, 1, 1], 3, 3),
        ([2, 2, 2, 2], 3, 2),
    ],
)
def test_a_stretch_ends_at_an_odd_step_and_behind_the_next_event(
    steps: list[int], until: int, end: int
) -> None:
    stamps = np.cumsum(steps)
    forces, rates = np.tile(LEVEL, (4, 1)), np.tile(STILL, (4, 1))
    assert end_of_stretch(stamps, forces, rates, 0, 0, 5, until, *LIMITS, *no_line()) == end


def readings(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return stamps, specific force, angular rate and has_reading with faults of every kind."""
    rng = np.random.default_rng(seed)
    steps = np.full(600, 10_000_000)
    for step in (0, -20_000_000, 800_000_000, 5_000_000_000, -3_000_000_000):
        steps[rng.integers(0, 600, 2)] = step  # for good: the time base is another then
    stamps = 10**15 + np.cumsum(steps)
    strays = rng.integers(0, 600, 12)
    stamps[strays] += rng.integers(-(2 * 10**12), 2 * 10**12, 12)
    stamps[rng.integers(0, 600, 4)] = 0
    force = np.array(LEVEL) + 0.1 * rng.standard_normal((600, 3))
    rate = 0.1 * rng.standard_normal((600, 3))
    force[rng.integers(0, 600, 4)] = 0.0
    force[rng.integers(0, 600, 4), 1] = math.nan
    rate[rng.integers(0, 600, 4), 2] = 1e3
    begin, end = 200, 260  # in place of a gap
    share = np.linspace(0.0, 1.0, end - begin)[:, None]
    for filled in (force, rate):
        filled[begin:end] = (1.0 - share) * 0.1 + share * [0.2, 0.3, 0.4]
    return stamps, force, rate, rng.random(600) > 0.1


@pytest.mark.parametrize("seed", range(20))
def test_recordings_are_admitted_as_the_estimator_admits_messages(seed: int) -> None:
    """The rows that calibration uses are those that node and replay use, for the same reasons."""
    stamps, force, rate, has_reading = readings(seed)
    values = parameters.defaults()
    estimator = Estimator(values, lambda level, text: None)
    used = []
    for k, (t_ns, given) in enumerate(zip(stamps.tolist(), has_reading, strict=True)):
        before = estimator.inputs.counts.total()
        vectors = tuple(force[k].tolist()), tuple(rate[k].tolist())
        estimator.handle_imu(
            ImuFields(t_ns, *vectors, "imu", specific_force_cov0=0.0 if given else -1.0)
        )
        if estimator.inputs.counts.total() == before:
            used.append(k)

    admitted = admitted_readings(values, stamps, force, rate, has_reading)

    assert admitted.rows.tolist() == used
    counts = Counter({refused.name: count for count, refused in admitted.refused})
    assert counts == estimator.inputs.counts
    assert 300 < len(used) < 560
