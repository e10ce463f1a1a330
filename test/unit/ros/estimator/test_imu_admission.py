"""One rule admits readings one by one and in stretches."""

import math

import numpy as np
import pytest

from hybrid_ins.ros.estimator.imu_admission import end_of_stretch, is_usable, refusal

MAX_FORCE, MAX_RATE = 100.0, 10.0
LEVEL, STILL = (0.0, 0.0, 9.8), (0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("t_ns", "force", "rate", "name"),
    [
        (0, LEVEL, STILL, "imu: zero stamp"),
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
    assert not is_usable(t_ns, *force, *rate, MAX_FORCE, MAX_RATE)
    assert refusal(t_ns, force, rate, MAX_FORCE).name == name
    stamps = np.array([-1, t_ns, t_ns + 1]) + 0
    forces, rates = np.array([LEVEL, force, LEVEL]), np.array([STILL, rate, STILL])
    assert end_of_stretch(stamps, forces, rates, 1, t_ns - 1, 5, 10**9, MAX_FORCE, MAX_RATE) == 1


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
    assert end_of_stretch(stamps, forces, rates, 0, 0, 5, until, MAX_FORCE, MAX_RATE) == end
