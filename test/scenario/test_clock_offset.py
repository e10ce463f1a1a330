"""The clock offset is found while flying, and looking for it changes nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.clock_searches import until
from support.long_stand import assert_standing_shows_nothing_of_the_clock
from support.runs import begin, fly, stamped_early, through_estimator

from hybrid_ins.core.filter.events import ClockInflation, ClockShift
from hybrid_ins.core.inertial.state import N_NAV
from hybrid_ins.core.sensor_errors.clock_offset import ClockOffsetObserver
from hybrid_ins.core.sensor_errors.clock_prior import ClockPrior
from tools.paper.runs import Run, Scenario, draw

SCENE = Scenario("flight", rate=100.0, duration=45.0)


@pytest.mark.parametrize("offset", [0.0, 0.03, -0.05])
def test_offset_is_told_with_its_uncertainty(offset: float) -> None:
    ins, _ = fly(stamped_early(draw(SCENE, 1), offset))
    assert ins.clock.residual == pytest.approx(offset, abs=0.02)
    assert abs(ins.clock.residual - offset) < 3.0 * ins.clock.sigma
    assert ins.clock.sigma < 0.0125


def test_looking_for_it_leaves_the_state_alone_to_the_last_bit(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    run = stamped_early(draw(SCENE, 1), 0.05)
    looking = fly(run, late=0.1)[0]
    assert looking.clock.sigma < 0.02
    unknown = ClockOffsetObserver(0.5).values
    forgetful = property(lambda _: unknown.copy(), lambda *_: None)
    monkeypatch.setattr(ClockOffsetObserver, "values", forgetful)
    blind = fly(run, late=0.1)[0]
    assert blind.clock.residual == 0.0

    assert looking.nav.tobytes() == blind.nav.tobytes()


def test_late_fixes_tell_the_same() -> None:
    run = stamped_early(draw(SCENE, 2), 0.03)
    run = replace(run, fixes=tuple(f for f in run.fixes if f.t_ns < run.samples["t_ns"][-100]))
    in_time, late = fly(run)[0], fly(run, late=0.35)[0]
    assert late.clock.residual == pytest.approx(in_time.clock.residual, abs=1e-9)


@pytest.mark.parametrize("change", [ClockShift, ClockInflation])
def test_a_change_of_the_clock_is_repeated_when_rewound(
    change: type[ClockShift | ClockInflation],
) -> None:
    # GIVEN a filter that ran on, with a change in between
    run = draw(SCENE, 3)
    stamps = run.samples["t_ns"]
    split = int(np.searchsorted(stamps, stamps[0] + 10_000_000_000))
    results = []
    for late in (False, True):
        ins = begin(run)
        ins.ring.extend(run.samples[1:split])
        fixes = [f for f in run.fixes if f.t_ns < stamps[split - 1]]
        changed = change(fixes[-2].t_ns + 1, 0.02)
        # WHEN the last fixes and the change come in order, or after the samples
        for event in (*fixes[:-2], *(() if late else (fixes[-2], changed, fixes[-1]))):
            ins.submit(event)
        ins.predict_block(run.samples[1:split])
        if late:
            for event in (changed, fixes[-1], fixes[-2]):
                ins.submit(event)
        results.append((ins.nav[:N_NAV].copy(), ins.clock.values.copy()))
    # THEN state and clock are the same
    for in_time, rewound in zip(*results, strict=True):
        np.testing.assert_allclose(rewound, in_time, rtol=1e-9, atol=1e-9)


def test_a_clock_that_may_have_changed_is_as_uncertain_as_that() -> None:
    clock = fly(draw(SCENE, 1))[0].clock
    residual, sigma = clock.residual, clock.sigma
    clock.inflate(0.15)
    assert clock.residual == residual
    assert clock.sigma == pytest.approx(np.hypot(sigma, 0.15))


@pytest.mark.slow
def test_estimated_offset_is_applied_to_fixes_and_told() -> None:
    run = stamped_early(draw(SCENE, 4), 0.15)
    estimator = through_estimator(run)
    assert estimator.clock.offset == pytest.approx(0.15, abs=0.03)
    clock = estimator.clock.status()
    assert clock.name.endswith("clock")
    assert float(dict(clock.values)["time_offset"]) == pytest.approx(0.15, abs=0.03)


def test_a_wrong_offset_is_told_and_left_alone_when_not_asked_for() -> None:
    given = {"gnss.time_offset.estimate": False}
    run = stamped_early(draw(SCENE, 5), 0.15)
    estimator = through_estimator(run, **given)
    assert estimator.clock.offset == 0.0
    assert estimator.inputs.counts["gnss: clock offset"] > 0
    assert "run ins_calibrate" in estimator.clock.status().text
    # AND nothing is told of a right one
    assert through_estimator(draw(SCENE, 5), **given).inputs.counts["gnss: clock offset"] == 0


@pytest.mark.slow
def test_standing_shows_nothing_of_the_clock() -> None:
    assert_standing_shows_nothing_of_the_clock(seed=0)


@pytest.mark.parametrize("estimate", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_fixes_behind_by_more_than_the_longest_delay_are_fused(estimate: bool) -> None:
    """Their delay counts from their own stamp, not from the one that an offset gives them."""
    run = stamped_early(draw(replace(SCENE, duration=15.0), 3), -1.2)
    values = {"gnss.time_offset.value": -1.2, "gnss.time_offset.estimate": estimate}
    estimator = through_estimator(run, late=0.2, **values)

    assert (
        estimator.inputs.counts["gnss: too old"] < 10
    )  # those of the time before the filter's start
    assert estimator.reporter.fixes_fused > 40


def test_filters_are_told_when_an_offset_with_a_drift_was_given() -> None:
    run = until(draw(SCENE, 5), 1.5)
    estimator = through_estimator(run, **{"gnss.time_offset.drift": 300.0})
    prior = estimator._parts.settings.clock_prior
    assert prior is not None
    assert abs(prior.t_ns - run.fixes[0].t_ns) < 100_000_000


def without_imu(run: Run, start: float, stop: float) -> Run:
    """Lose the samples between two times [s] after the first."""
    t = (run.samples["t_ns"] - run.samples["t_ns"][0]) * 1e-9
    return replace(run, samples=run.samples[(t < start) | (t >= stop)])


@pytest.mark.slow
def test_what_is_known_of_the_clock_outlasts_a_gap_of_the_imu() -> None:
    # GIVEN a clock that was found, and an IMU that is silent for too long to bridge
    run = without_imu(stamped_early(draw(SCENE, 4), 0.15), 30.0, 33.0)
    first = through_estimator(until(run, 30.0))
    estimator = through_estimator(run)
    # THEN the next filter begins with what the last one knew, and searches for the heading only
    assert estimator.inputs.counts["restart: no IMU samples"] == 1
    assert not estimator.navigator.phases.clock_open
    assert estimator.clock.prior.mean == pytest.approx(first.clock.offset, abs=0.01)
    assert estimator.clock.prior.scale < 0.03
    assert estimator.clock.offset == pytest.approx(0.15, abs=0.03)


@pytest.mark.slow
def test_a_reset_forgets_the_clock() -> None:
    estimator = through_estimator(until(stamped_early(draw(SCENE, 4), 0.15), 30.0))
    assert estimator.clock.offset == pytest.approx(0.15, abs=0.03)

    estimator.reset()

    assert estimator.clock.prior == ClockPrior(0.0, 0.0)
