"""A heading that was given is checked by the motion: a wrong one is named and replaced."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from support.scenes import Scene, make_navigator, play, scene

from hybrid_ins.core.ins_filter import InsFilter
from hybrid_ins.core.multiple_model import N_HEADINGS, MultipleModelBank
from hybrid_ins.core.navigator import Navigator
from hybrid_ins.core.navigator_events import HeadingCorrected
from hybrid_ins.core.phases import Running
from hybrid_ins.simulation.motions import car_drive, quadrotor_flight, static

QUARTER = 0.26  # rad, as large a σ as a compass has


def run_with_search(run: Scene, navigator: Navigator) -> list[InsFilter]:
    """Play a run with its search, ten times a second; return the filters that ran, in order."""
    filters: list[InsFilter] = []

    def after(t: float) -> None:
        if round(t * 100.0) % 10 == 0:
            navigator.continue_search()
        running = navigator.filter
        if running is not None and (not filters or filters[-1] is not running):
            filters.append(running)

    play(run, navigator, after=after)
    return filters


def corrections(run: Scene) -> list[HeadingCorrected]:
    return [event for event in run.events if isinstance(event, HeadingCorrected)]


@pytest.mark.parametrize("wrong", [math.pi, 2.0])
@pytest.mark.parametrize("kind", ["car", "quadrotor"])
def test_a_wrong_heading_is_named_and_replaced(kind: str, wrong: float) -> None:
    motion = car_drive(60.0, 1) if kind == "car" else quadrotor_flight(60.0, seed=4)
    run = scene(motion, seed=1, fix_std=(1.0, 1.0, 2.0))
    navigator = make_navigator("parameter", yaw=run.yaw(0.0) + wrong, yaw_std=QUARTER)

    run_with_search(run, navigator)

    assert run.errors(navigator, 60.0)[2] < 0.15
    assert len(corrections(run)) == 1 or wrong < 3.0  # the filter corrects less by itself
    assert all(event.sigma < 0.2 for event in corrections(run))


@pytest.mark.parametrize("seed", range(3))
def test_a_right_heading_stays_with_its_filter(seed: int) -> None:
    run = scene(car_drive(40.0, seed), seed=seed)
    rng = np.random.default_rng(seed)
    yaw = run.yaw(0.0) + QUARTER * rng.standard_normal()
    navigator = make_navigator("parameter", yaw=yaw, yaw_std=QUARTER)

    filters = run_with_search(run, navigator)

    assert corrections(run) == []
    assert len(filters) == 1
    assert isinstance(navigator.phase, Running) and navigator.phase.bank is None


def test_standing_shows_no_heading() -> None:
    run = scene(static(60.0, heading=1.0))
    navigator = make_navigator("parameter", yaw=-2.0, yaw_std=QUARTER)

    filters = run_with_search(run, navigator)

    assert len(filters) == 1
    assert isinstance(navigator.phase, Running) and navigator.phase.bank is not None
    assert len(navigator.phase.bank.filters) > 6


@pytest.mark.parametrize("seed", range(2, 4))
def test_the_course_of_a_car_in_reverse(seed: int) -> None:
    """A heading by course is 180° off where the vehicle drives backwards."""
    run = scene(car_drive(45.0, seed), seed=seed)
    # The IMU is turned by half a turn about up: the car drives backwards.
    run.force[:, :2] *= -1.0
    run.rate[:, :2] *= -1.0
    navigator = make_navigator("course")

    run_with_search(run, navigator)

    assert abs(run.errors(navigator, 45.0)[2] - math.pi) < 0.1
    assert len(corrections(run)) <= 1


@pytest.mark.parametrize("late", [0.05, 0.6])
def test_odometry_waits_for_one_filter_at_a_time(late: float) -> None:
    """WHEN the filters follow between samples THEN few do at each, and the result is the same."""
    run = scene(static(15.0), seed=3)

    def banks(advance: Callable[[Navigator], None]) -> MultipleModelBank:
        navigator = make_navigator("parameter", yaw_std=QUARTER)

        def after(t: float) -> None:
            advance(navigator)
            if round(t * 100.0) % 20 == 0:
                navigator.continue_search()

        play(run, navigator, delay=lambda t: late, after=after)
        assert navigator.phase.bank is not None
        navigator.phase.bank.end_block()
        return navigator.phase.bank

    moved: list[int] = []

    def one_by_one(navigator: Navigator) -> None:
        filters = navigator.phases.filters[1:]
        before = [f.t_ns for f in filters]
        navigator.phases.advance_search()
        moved.append(sum(f.t_ns != t for f, t in zip(filters, before, strict=True)))

    spread, at_once = banks(one_by_one), banks(lambda navigator: None)

    assert len(spread.filters) == N_HEADINGS + 1
    assert max(moved) == 1 and sum(moved) > 50 * (N_HEADINGS + 1)
    np.testing.assert_array_equal(spread.log_weights, at_once.log_weights)
    for one, other in zip(spread.filters, at_once.filters, strict=True):
        np.testing.assert_array_equal(one.nav, other.nav)
