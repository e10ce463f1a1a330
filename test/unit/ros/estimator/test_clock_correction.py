"""The clock offset in force: chance leaves the given one, evidence moves it, also back."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from hybrid_ins import parameters
from hybrid_ins.core.filter.events import ClockShift
from hybrid_ins.core.inertial.state import N_FLAT
from hybrid_ins.core.navigator.notices import ClockOffsetFound
from hybrid_ins.core.sensor_errors.clock_offset import DRIFT, MARGIN, P_DRIFT, ClockOffsetObserver
from hybrid_ins.core.sensor_errors.clock_prior import ClockDrift, ClockPrior
from hybrid_ins.ros.estimator.clock_correction import ClockCorrection
from hybrid_ins.ros.reporting.input_log import InputLog

GIVEN, STD = 0.05, 0.004


class Running:
    """A filter of which only the clock matters."""

    def __init__(self, std: float = STD) -> None:
        self.clock = ClockOffsetObserver(0.5, ClockPrior(0.0, std))
        self.noise = SimpleNamespace(imu_factors=(1.0, 1.0))
        self.t_ns = 0

    def submit(self, event: Any) -> None:
        assert isinstance(event, ClockShift)
        self.clock.shift(event.by, np.zeros(N_FLAT))

    def show(self, offset: float, in_force: float, sigma: float = 0.004) -> None:
        """Let the innovations show an offset and its σ [s]."""
        self.clock.set_estimate(offset - in_force, sigma)
        self.t_ns += 2_000_000_000


@pytest.fixture
def running() -> Running:
    return Running()


def correction(running: Running, **values: float) -> tuple[ClockCorrection, Any]:
    """Return a correction and the navigator whose clock it opens."""
    phases = SimpleNamespace(clock_open=False, submit=running.submit)
    navigator: Any = SimpleNamespace(
        filter=running,
        phase=SimpleNamespace(bank=None, is_provisional=False),
        phases=phases,
        last_ns=0,
        open_clock=lambda unknown: setattr(phases, "clock_open", unknown),
    )
    every = {**parameters.defaults(), **values}
    return ClockCorrection(every, navigator, InputLog(lambda level, text: None)), navigator


@pytest.fixture
def clock(running: Running) -> ClockCorrection:
    given = {"gnss.time_offset.value": GIVEN, "gnss.time_offset.std": STD}
    return correction(running, **given)[0]


def test_chance_does_not_move_a_given_offset(clock: ClockCorrection, running: Running) -> None:
    for offset in (GIVEN + 0.01, GIVEN - 0.01):
        running.show(offset, clock.offset)
        clock.run_periodic()
    assert clock.offset == GIVEN


def test_an_offset_that_was_moved_returns_when_the_innovations_do(
    clock: ClockCorrection, running: Running
) -> None:
    running.show(GIVEN - 0.03, clock.offset)
    clock.run_periodic()
    assert clock.offset == pytest.approx(GIVEN - 0.03, abs=0.005)

    running.show(GIVEN + 0.002, clock.offset)
    clock.run_periodic()

    assert clock.offset == pytest.approx(GIVEN, abs=0.003)


def test_the_step_that_a_search_puts_in_force_is_corrected_towards_a_right_given_offset() -> None:
    # GIVEN a search that has put the nearest of its steps in force
    running = Running(0.0)
    clock, navigator = correction(running)
    clock.on_found(ClockOffsetFound(0.1, -0.09, 0.04))
    navigator.phases.clock_open = False
    running.clock.prior = ClockPrior(-0.1, 0.0)
    # WHEN the innovations agree with the given offset
    running.show(0.01, 0.1, 0.02)
    clock.run_periodic()
    # THEN what they make likely is in force
    assert clock.offset == pytest.approx(0.0, abs=0.01)


def test_fixes_that_jump_about_are_no_clock_that_is_seconds_off() -> None:
    lines: list[str] = []
    running = Running(0.0)
    clock, navigator = correction(running)
    clock._inputs = InputLog(lambda level, text: lines.append(text))
    navigator.phases.clock_open = False  # the search has ended
    running.show(0.0, 0.0, 0.005)
    clock.run_periodic()

    running.show(2.4, 0.0, 0.02)
    clock.run_periodic()
    assert clock.offset == 0.0 and lines == []

    for in_force in (0.0, 0.2):
        running.show(0.2, in_force, 0.005)
        clock.run_periodic()
    assert clock.offset == pytest.approx(0.2, abs=0.01)
    assert any("the clock offset moved from +0.000 s" in line for line in lines)


def test_an_offset_that_is_not_in_force_yet_has_not_moved() -> None:
    # GIVEN innovations that begin to show an offset, by too little to leave the given one
    lines: list[str] = []
    running = Running(0.0)
    clock, navigator = correction(running)
    clock._inputs = InputLog(lambda level, text: lines.append(text))
    navigator.phases.clock_open = False
    running.show(0.031, 0.0, 0.0105)
    clock.run_periodic()
    assert clock.offset == 0.0
    # WHEN they show it well
    running.show(0.04, 0.0, 0.004)
    clock.run_periodic()
    # THEN it is in force, and was so before
    assert clock.offset == pytest.approx(0.04, abs=0.005) and lines == []


def test_what_a_filter_has_found_is_the_prior_of_the_next() -> None:
    running = Running(0.0)
    clock, navigator = correction(running)
    clock.on_found(ClockOffsetFound(0.2, 0.0, 0.01))
    navigator.phases.clock_open = False
    running.clock.prior = ClockPrior(-0.2, 0.0)
    running.show(0.2, 0.2, 0.01)
    clock.run_periodic()
    navigator.open_clock(True)  # a search on a suspicion has begun

    clock.keep()

    assert not navigator.phases.clock_open
    assert clock.prior.mean == pytest.approx(0.2, abs=0.005)
    assert 0.005 < clock.prior.scale < 0.03


@pytest.mark.parametrize(("sigma", "keep"), [(0.3, True), (0.01, False)])
def test_what_is_not_known_or_of_other_clocks_is_forgotten(sigma: float, keep: bool) -> None:
    # GIVEN a search that has found an offset, which a filter has not confirmed, or has
    running = Running(0.0)
    clock, navigator = correction(running)
    navigator.open_clock(False)
    clock.on_found(ClockOffsetFound(0.2, 0.0, 0.05))
    running.show(0.2, 0.2, sigma)
    clock.run_periodic()
    assert clock.offset == pytest.approx(0.2)

    # WHEN another filter begins, of the same clocks or of others
    (clock.keep if keep else clock.forget)()

    # THEN it begins as the first one did
    assert navigator.phases.clock_open
    assert clock.offset == 0.0
    assert clock.prior == ClockPrior(0.0, 0.0)


def test_after_a_wrong_heading_the_offset_in_force_stays() -> None:
    running = Running(0.0)
    clock, navigator = correction(running)
    navigator.open_clock(False)
    clock.on_found(ClockOffsetFound(0.2, 0.0, 0.05))
    running.show(0.2, 0.2, 0.01)
    clock.run_periodic()

    clock.distrust()

    assert clock.offset == pytest.approx(0.2) and not navigator.phases.clock_open
    assert clock.prior == ClockPrior(0.0, 0.0)


GIVEN_DRIFT = {"gnss.time_offset.drift": 300.0, "gnss.time_offset.drift_std": 50.0}


def test_an_offset_given_with_a_drift_is_that_of_the_first_fix() -> None:
    clock, navigator = correction(Running())
    steady, navigator.last_ns = clock.prior, 1_000_000_000
    clock.run_periodic()
    assert clock.prior == steady and clock.drift == ClockDrift(0.0, 1e-4)

    clock, navigator = correction(Running(), **GIVEN_DRIFT)
    assert clock.drift == pytest.approx((3e-4, 5e-5))
    navigator.filter = None  # it does not run yet
    for seconds in (7, 9):
        navigator.last_ns = seconds * 1_000_000_000
        clock.run_periodic()
    assert clock.prior == ClockPrior(0.0, 0.0, 7_000_000_000)


def test_a_given_drift_is_corrected_before_the_innovations_contradict_the_given_offset() -> None:
    for given, expected in (({}, GIVEN), (GIVEN_DRIFT, GIVEN + 0.006)):
        running = Running()
        offset = {"gnss.time_offset.value": GIVEN, "gnss.time_offset.std": STD}
        clock, navigator = correction(running, **offset, **given)
        navigator.phases.clock_open = False
        running.clock.prior = ClockPrior(0.006, STD)  # the filter's: it has moved with the drift

        running.show(GIVEN + 0.006, clock.offset)
        clock.run_periodic()

        assert clock.offset == pytest.approx(expected, abs=1e-4)


def test_a_drift_is_followed_as_given_where_nothing_is_to_be_estimated() -> None:
    running = Running()
    clock, navigator = correction(running, **GIVEN_DRIFT, **{"gnss.time_offset.estimate": False})
    navigator.last_ns = 1_000_000_000
    for _ in range(50):
        running.show(0.0, clock.offset)
        clock.run_periodic()
    assert running.t_ns == 100_000_000_000
    assert clock.offset == pytest.approx(99.0 * 3e-4, abs=1e-3)


@pytest.mark.parametrize(("given", "is_told"), [({}, True), (GIVEN_DRIFT, False)])
def test_a_clock_that_moves_as_the_given_drift_says_is_no_fault(
    given: dict[str, float], is_told: bool
) -> None:
    running = Running(0.0)
    clock, navigator = correction(running, **given)
    lines: list[str] = []
    clock._inputs = InputLog(lambda level, text: lines.append(text))
    navigator.phases.clock_open = False
    running.t_ns = 1_000_000_000
    for seconds in (1, 151):
        running.t_ns = seconds * 1_000_000_000
        running.show(3e-4 * seconds, clock.offset, 0.003)
        clock.run_periodic()
    assert any("the clock offset moved" in line for line in lines) == is_told


def test_the_drift_that_was_found_outlasts_a_restart() -> None:
    running = Running(0.0)
    clock, navigator = correction(running)
    navigator.phases.clock_open = False
    of_unknown_clocks = 1e-4  # what was found is no wider
    for variance, std in ((5e-5**2, MARGIN * 5e-5), (1e-4**2, of_unknown_clocks)):
        running.show(0.05, clock.offset, 0.01)
        running.clock.values[[DRIFT, P_DRIFT]] = 2e-4, variance
        clock.run_periodic()

        clock.keep()

        assert clock.drift == pytest.approx((2e-4, std))
        assert clock.prior.t_ns == running.t_ns

    clock.change({"gnss.time_offset.value": 0.1})
    assert clock.drift == ClockDrift(0.0, 1e-4)


@pytest.mark.parametrize("estimate", [True, False])
def test_what_a_filter_has_found_missing_is_in_force_once_it_is_given(estimate: bool) -> None:
    # GIVEN a filter that has found the given offset to be wrong
    running = Running()
    clock, _ = correction(running, **{"gnss.time_offset.estimate": estimate})
    running.show(0.1, clock.offset, 0.01)
    # WHEN the user corrects it
    clock.change({"gnss.time_offset.value": 0.09})
    # THEN the filter has only the rest left to find, as sure of it as the step was large
    assert clock.offset == 0.09
    assert running.clock.residual == pytest.approx(0.01)
    assert 0.01 < running.clock.sigma < 0.03


def test_another_uncertainty_of_the_given_offset_changes_its_prior(clock: ClockCorrection) -> None:
    clock.change({"gnss.time_offset.std": 0.01})

    assert clock.prior == ClockPrior(GIVEN, 0.01)
