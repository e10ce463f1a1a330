"""A heading that was given is checked by the motion: a wrong one is named and replaced."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from support.scenes import Scene, heading_std, make_navigator, play, scene, stamp

from hybrid_ins.core.alignment.multiple_model import N_HEADINGS, MultipleModelBank
from hybrid_ins.core.filter.ins_filter import InsFilter
from hybrid_ins.core.inertial.state import HEADING_DOUBT, total_std
from hybrid_ins.core.navigator.navigator import Navigator
from hybrid_ins.core.navigator.notices import HeadingCorrected
from hybrid_ins.core.navigator.phases import Running, Searching
from hybrid_ins.core.update.measurements import GNSS
from hybrid_ins.simulation.motions import car_drive, quadrotor_flight, static
from hybrid_ins.simulation.vehicles import slow_rover

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
    return [notice for notice in run.notices if isinstance(notice, HeadingCorrected)]


@pytest.mark.parametrize("wrong", [math.pi, 2.0])
@pytest.mark.parametrize("kind", ["car", "quadrotor"])
def test_a_wrong_heading_is_named_and_replaced(kind: str, wrong: float) -> None:
    motion = car_drive(60.0, 1) if kind == "car" else quadrotor_flight(60.0, seed=4)
    run = scene(motion, seed=1, fix_std=(1.0, 1.0, 2.0))
    navigator = make_navigator("parameter", yaw=run.yaw(0.0) + wrong, yaw_std=QUARTER)

    off: list[float] = []  # of the heading that a correction names, over its σ

    def after(t: float) -> None:
        found = corrections(run)[len(off) :]
        turns = [math.remainder(notice.after - run.yaw(t), 2.0 * math.pi) for notice in found]
        off.extend(abs(turn) / notice.sigma for turn, notice in zip(turns, found, strict=True))
        if round(t * 100.0) % 10 == 0:
            navigator.continue_search()

    play(run, navigator, after=after)

    assert run.errors(navigator, 60.0)[2] < 0.15
    assert len(off) == 1 or wrong < 3.0  # the filter corrects less by itself
    assert all(o < 3.0 for o in off)


@pytest.mark.parametrize("unknown", [True, False])
def test_a_change_of_the_clock_does_not_end_the_check(unknown: bool) -> None:
    """GIVEN a wrong heading WHEN a user changes the clock offset THEN it is still corrected."""
    run = scene(car_drive(60.0, 1), seed=1, fix_std=(1.0, 1.0, 2.0))
    navigator = make_navigator("parameter", yaw=run.yaw(0.0) + math.pi, yaw_std=QUARTER)
    checked: list[bool] = []

    def after(t: float) -> None:
        if round(t * 100.0) % 10 == 0:
            navigator.continue_search()
        if round(t * 100.0) == 400:
            assert isinstance(navigator.phase, Running) and navigator.phase.bank is not None
            checked.append(navigator.phase.bank.heading_open)
            navigator.open_clock(unknown)

    play(run, navigator, after=after)

    assert checked == [True]
    assert run.errors(navigator, 60.0)[2] < 0.15
    assert len(corrections(run)) == 1


def test_a_heading_is_given_up_before_another_one_is_known() -> None:
    """
    GIVEN a slow rover and a wrong heading.

    WHEN others become more probable THEN σ says so; WHEN the motion excludes it THEN none is
    claimed.
    """
    run = scene(slow_rover(60.0, 2, 5.0), seed=2, fix_rate=2.0, fix_std=(0.4, 0.4, 0.6))
    navigator = make_navigator("parameter", yaw=run.yaw(0.0) + math.pi, yaw_std=0.1)
    searched: list[float] = []
    reported: list[float] = []  # rad, σ of the heading before
    claimed: list[float] = []  # heading error over its σ, of one filter after the search began

    def after(t: float) -> None:
        if round(t * 100.0) % 10:
            return
        navigator.continue_search()
        if isinstance(navigator.phase, Searching):
            searched.append(t)
        elif not searched and navigator.filter is not None:
            reported.append(float(total_std(navigator.filter.nav)[8]))
        elif searched:
            claimed.append(run.errors(navigator, t)[2] / heading_std(navigator))

    play(run, navigator, after=after)

    doubtful = int(np.argmax(np.asarray(reported) > 0.2))
    assert doubtful > 50 and len(reported) - doubtful > 5
    assert min(reported[doubtful:]) > 1.0  # the error is 3.1
    assert len(searched) > 50
    assert len(claimed) > 50 and max(claimed) < 4.0
    [found] = corrections(run)
    wrong = run.yaw(searched[0]) + math.pi
    assert math.remainder(found.before - wrong, 2.0 * math.pi) == pytest.approx(0.0, abs=0.3)
    assert 0.1 < found.sigma < 2.0
    # AND each fix is told of once, also those that its filter and the others were given
    told = [v.measurement.t_ns for v in run.verdicts if v.measurement.sensor == GNSS]
    assert len(told) == len(set(told))
    assert set(told) >= {stamp(t) for t in run.fix_t if 2.0 < t < 58.0}


@pytest.mark.parametrize("seed", range(3))
def test_a_right_heading_stays_with_its_filter(seed: int) -> None:
    run = scene(car_drive(40.0, seed), seed=seed)
    rng = np.random.default_rng(seed)
    yaw = run.yaw(0.0) + QUARTER * rng.standard_normal()
    navigator = make_navigator("parameter", yaw=yaw, yaw_std=QUARTER)

    filters = run_with_search(run, navigator)

    assert corrections(run) == []
    assert len(filters) == 1 and filters[0].nav[HEADING_DOUBT] == 0.0
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
def test_odometry_waits_for_few_filters_at_a_time(late: float) -> None:
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
    assert max(moved) == 2 and sum(moved) > 50 * (N_HEADINGS + 1)
    np.testing.assert_array_equal(spread.log_weights, at_once.log_weights)
    for one, other in zip(spread.filters, at_once.filters, strict=True):
        np.testing.assert_array_equal(one.nav, other.nav)
