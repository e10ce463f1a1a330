"""A vehicle has moved when speed or displacement cannot be the fixes' scatter."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from hybrid_ins.core.alignment.motion_evidence import FAR, MotionEvidence
from hybrid_ins.core.inertial.earth import curvature_scale
from hybrid_ins.core.inertial.state import COVARIANCE, DIAGONAL, DV, N_FLAT, VELOCITY
from hybrid_ins.core.update.measurements import PositionFix

Array = NDArray[np.float64]

ORIGIN = np.array([0.8, 0.1, 50.0])
CLAIMED = 3.0  # m


def fix(t: int, offset_n: Array) -> PositionFix:
    lla = ORIGIN + offset_n / curvature_scale(ORIGIN)
    return PositionFix(t * 1_000_000_000, lla, CLAIMED**2 * np.eye(3), np.zeros(3))


def best(t: int, speed: float, speed_std: float) -> Any:
    nav = np.zeros(N_FLAT)
    nav[VELOCITY][0] = speed
    nav[COVARIANCE][DIAGONAL[DV]] = 0.5 * speed_std**2
    return SimpleNamespace(nav=nav, t_ns=t * 1_000_000_000)


def first_shown(speeds: Array, offsets: Array, speed_std: float) -> int | None:
    """Return the second in which motion is shown, by fixes and speeds once a second."""
    evidence = MotionEvidence()
    for t, (speed, offset) in enumerate(zip(speeds, offsets, strict=True)):
        evidence.observe(fix(t, np.array([offset, 0.0, 0.0])), best(t, speed, speed_std))
        if evidence.shown:
            return t
    return None


@pytest.mark.parametrize("seed", range(5))
def test_scatter_and_wander_of_fixes_are_no_motion(seed: int) -> None:
    rng = np.random.default_rng(seed)
    wander = np.cumsum(rng.normal(0.0, 0.1, 300)) + rng.normal(0.0, CLAIMED / np.sqrt(2.0), 300)
    assert first_shown(rng.normal(0.0, 0.2, 300), wander, 0.3) is None


def test_a_speed_has_to_last() -> None:
    speeds = np.array([2.0, 2.0, 0.1, 2.0, 2.0, 2.0])
    assert first_shown(speeds, np.zeros(6), 0.5) == 5


def test_it_says_once_when_a_motion_begins() -> None:
    evidence, still = MotionEvidence(), np.zeros(3)
    begins = [
        evidence.observe(fix(t, still), best(t, speed, 0.5))
        for t, speed in enumerate((0.1, 2.0, 2.0, 0.1, 2.0, 2.0))
    ]
    assert begins == [False, True, False, False, True, False]
    assert not evidence.shown


def test_what_cannot_be_at_rest_shows_its_heading_before_the_fixes_show_a_motion() -> None:
    evidence, still = MotionEvidence(), np.zeros(3)
    assert not evidence.counts and not evidence.shows_heading

    evidence.may_rest = False

    assert evidence.counts and evidence.shows_heading
    assert not any(evidence.observe(fix(t, still), best(t, 2.0, 0.5)) for t in range(2))
    assert evidence.moves and not evidence.shown


def test_a_slow_vehicle_is_shown_by_its_way() -> None:
    t = np.arange(60.0)
    found = first_shown(np.full(60, 0.5), 0.5 * t, 1.0)
    assert found == int(FAR * np.sqrt(2.0) * CLAIMED / 0.5) + 1 + 2


@pytest.mark.parametrize("size", [20.0, 100.0])
def test_one_step_of_the_fixes_is_no_motion(size: float) -> None:
    offsets = np.where(np.arange(60) < 20, 0.0, size)
    assert first_shown(np.zeros(60), offsets, 0.3) is None


def test_a_vehicle_that_goes_on_is_shown_although_its_largest_step_does_not_count() -> None:
    t = np.arange(30.0)
    assert first_shown(np.zeros(30), np.maximum(t - 10.0, 0.0) * 20.0, 0.3) == 14
