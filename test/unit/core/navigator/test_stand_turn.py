"""What a stand leaves unknown of the gyroscopes' bias."""

from __future__ import annotations

import numpy as np
import pytest

from hybrid_ins.core.imu.samples import SAMPLE_DTYPE
from hybrid_ins.core.navigator.stand_turn import MOVED_NS, StandTurn

PERIOD_NS = 500_000_000
UPRIGHT, ON_ITS_SIDE = (0.0, 0.0, -9.8), (0.0, 9.8, 0.0)


def readings(rate_b, force_b=UPRIGHT):
    samples = np.zeros(100, SAMPLE_DTYPE)
    samples["f"], samples["w"] = force_b, rate_b
    return samples


@pytest.mark.parametrize(("force_b", "axis"), [(UPRIGHT, 2), (ON_ITS_SIDE, 1)])
def test_half_of_the_rate_about_the_vertical_is_allowed_for_after_a_stand(force_b, axis) -> None:
    turn = StandTurn(np.array([0.001, 0.002, 0.003]))
    rate = np.array([0.021, 0.022, 0.023])  # 0.02 beyond the given bias about every axis

    found = [turn.follow(readings(rate, force_b), True, False, PERIOD_NS) for _ in range(3)]
    found += [turn.follow(readings(rate, force_b), False, False, PERIOD_NS) for _ in range(3)]

    expected = np.zeros(15)
    expected[12 + axis] = 0.01
    assert [one is None for one in found] == [True] * 4 + [False, True]
    assert found[4] == pytest.approx(expected)


def test_a_turn_that_ended_before_the_stand_counts() -> None:
    turn = StandTurn(np.zeros(3))
    for rate in (0.02, 0.0):
        turn.follow(readings((0.0, 0.0, rate)), True, False, PERIOD_NS)

    found = [turn.follow(readings((0.0, 0.0, 0.0)), False, False, PERIOD_NS) for _ in range(2)][1]

    assert found is not None and found[14] == pytest.approx(0.01)


@pytest.mark.parametrize("forgotten", [False, True])
def test_motion_shows_the_bias_until_it_is_forgotten(forgotten: bool) -> None:
    turn = StandTurn(np.zeros(3))
    for _ in range(MOVED_NS // PERIOD_NS):
        turn.follow(readings((0.0, 0.0, 0.0)), False, True, PERIOD_NS)
    if forgotten:
        turn.forget()

    turn.follow(readings((0.0, 0.0, 0.02)), True, False, PERIOD_NS)
    found = [turn.follow(readings((0.0, 0.0, 0.0)), False, True, PERIOD_NS) for _ in range(2)][1]

    assert (found is not None) == forgotten
