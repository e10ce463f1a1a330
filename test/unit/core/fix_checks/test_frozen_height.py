"""Altitudes that never change are no measurements; rounded ones and short ways are left alone."""

import math
from collections.abc import Callable

import numpy as np
import pytest

from hybrid_ins.core.fix_checks.frozen_height import (
    FEWEST_FIXES,
    LEAST_WAY,
    FrozenHeight,
    FrozenHeightCheck,
)
from hybrid_ins.core.update.measurements import PositionFix, VelocityFix

EAST = 1.0 / 4.45e6  # rad of longitude per metre at this latitude


def fix_at(k: int, metres: float, height: float, std: float = 0.02) -> PositionFix:
    lla = np.array([0.8, 0.2 + metres * EAST, height])
    return PositionFix(k * 200_000_000, lla, std**2 * np.eye(3), np.zeros(3))


def check(
    heights: Callable[[int], float], count: int, *, step: float = 2.0, std: float = 0.02
) -> tuple[list[bool], list[FrozenHeight]]:
    """Return whether each fix of a way keeps its height, and what was told."""
    told: list[FrozenHeight] = []
    checked = FrozenHeightCheck(told.append)
    kept = []
    for k in range(count):
        found = checked.checked(fix_at(k, step * k, heights(k), std))
        assert isinstance(found, PositionFix)
        kept.append(math.isfinite(found.lla[2]))
    return kept, told


@pytest.mark.parametrize("height", [0.0, 123.456])
def test_a_height_that_never_changes_is_taken_away_and_told_once(height: float) -> None:
    kept, told = check(lambda k: height, 500)

    first = kept.index(False)
    assert LEAST_WAY <= 2.0 * first < LEAST_WAY + 25.0
    assert not any(kept[first:])
    assert [one.height for one in told] == [height]
    assert told[0].count == first + 1 and told[0].t_ns == first * 200_000_000


def test_fast_vehicles_need_as_many_fixes() -> None:
    kept, _ = check(lambda k: 5.0, 40, step=50.0)

    assert kept.index(False) == FEWEST_FIXES - 1


def test_the_first_height_that_differs_ends_it() -> None:
    """GIVEN a receiver that finds its height again THEN from the first one on it is used."""
    rng = np.random.default_rng(1)
    kept, told = check(lambda k: 5.0 if k < 100 else rng.normal(7.0, 0.1), 1000)

    assert not kept[99] and all(kept[100:]) and len(told) == 1


def test_a_receiver_that_holds_its_last_height_is_found_out() -> None:
    rng = np.random.default_rng(2)
    kept, told = check(lambda k: rng.normal(7.0, 0.1) if k < 200 else 7.0, 400)

    assert all(kept[:250]) and not any(kept[260:]) and len(told) == 1


@pytest.mark.parametrize(("rounding", "way"), [(0.1, 900.0), (1.0, 9000.0)])
def test_rounded_heights_on_level_ground_are_measurements(rounding: float, way: float) -> None:
    """GIVEN a height that has changed by a digit before THEN it may stay for long."""
    kept, _ = check(lambda k: rounding * (k > 10), round(way / 2.0))

    assert all(kept)


@pytest.mark.parametrize(
    ("count", "step", "std"),
    [(49, 2.0, 0.02), (140, 2.0, 3.0), (28, 50.0, 0.02), (5000, 0.0, 0.02)],
    ids=["short way", "claims metres", "few", "at rest"],
)
def test_one_height_over_a_short_way_is_no_evidence(count: int, step: float, std: float) -> None:
    assert all(check(lambda k: 5.0, count, step=step, std=std)[0])


def test_noise_at_rest_is_no_way() -> None:
    rng, told = np.random.default_rng(3), []
    checked = FrozenHeightCheck(told.append)
    for k in range(3000):
        checked.checked(fix_at(k, rng.normal(0.0, 1.5), 5.0, 1.0))

    assert not told


def test_what_has_no_height_passes_as_it_is() -> None:
    checked = FrozenHeightCheck(lambda found: None)
    velocity = VelocityFix(1, np.zeros(3), np.eye(3), np.zeros(3))
    flat = fix_at(1, 0.0, math.nan)

    assert checked.checked(velocity) is velocity
    assert checked.checked(flat) is flat
