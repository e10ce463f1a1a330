"""A clock that nothing is known of is found among many, and nothing else changes by that."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from test_time_offset import SCENE, stamped_early, through_estimator

from hybrid_ins.core import clock_search
from hybrid_ins.core.clock_search import MISLED_SPEED, MISLED_TURN, STEPS, opened
from hybrid_ins.core.earth import curvature_scale
from hybrid_ins.core.state import COVARIANCE, DIAGONAL, DP, DV, EPS, LLA, NavState
from hybrid_ins.estimator import Estimator
from hybrid_ins.offline.montecarlo import Run, draw

SECOND = 1_000_000_000


def until(run: Run, seconds: float) -> Run:
    """Keep the first stretch of a run."""
    end = int(run.samples["t_ns"][0]) + round(seconds * SECOND)
    return replace(run, fixes=tuple(f for f in run.fixes if f.t_ns <= end))


def jumping(run: Run, at: float, by: float) -> Run:
    """Stamp the fixes ``by`` [s] early from ``at`` [s] on."""
    since = int(run.samples["t_ns"][0]) + round(at * SECOND)
    return replace(run, fixes=tuple(
        replace(f, t_ns=f.t_ns - round(by * SECOND)) if f.t_ns > since else f
        for f in run.fixes))


def estimating(run: Run, late: float = 0.0, **values: object) -> Estimator:
    return through_estimator(run, late, **{"gnss.time_offset.estimate": True, **values})


def offset(estimator: Estimator) -> float:
    return estimator._gnss.time_offset


@pytest.mark.parametrize(("true", "late"), [(-0.5, 0.0), (-0.23, 0.3), (0.0, 0.0), (0.35, 0.0)])
def test_any_offset_within_reach_is_found_soon(true: float, late: float) -> None:
    estimator = estimating(until(stamped_early(draw(SCENE, 4), true), 22.0), late)

    assert estimator.navigator.search is None
    assert offset(estimator) == pytest.approx(true, abs=0.02)
    missing, sigma = estimator._clock_found()
    assert sigma < 0.02
    assert abs(offset(estimator) + missing - true) < 4.0 * sigma


def test_the_search_goes_on_beyond_its_edge() -> None:
    estimator = estimating(until(stamped_early(draw(SCENE, 4), 1.1), 30.0))

    assert offset(estimator) == pytest.approx(1.1, abs=0.03)


def test_the_filter_that_takes_over_is_where_it_says() -> None:
    # GIVEN runs whose clock is far off, each long enough to find it
    nees = []
    for seed in range(8):
        run = draw(SCENE, seed)
        estimator = estimating(until(stamped_early(run, -0.3), 25.0))
        running = estimator.navigator.filter
        assert running is not None and estimator.navigator.search is None
        # WHEN its position is held against the truth at the next epoch that is scored
        k = int(np.searchsorted(run.samples["t_ns"][run.scored], running.t_ns))
        now = run.samples["t_ns"][run.scored[k]]
        ahead = run.samples[np.searchsorted(run.samples["t_ns"], running.t_ns) + 1:
                            run.scored[k] + 1]
        if len(ahead):
            running.process_imu_block(ahead)
        assert running.t_ns == now
        off = (run.lla[k] - running.nav[LLA]) * curvature_scale(run.lla[k])
        nees.append(off**2 / running.nav[COVARIANCE][DIAGONAL][:3])
    # THEN it is wrong by what the covariance allows, in the mean of 24 numbers
    assert 0.3 < np.mean(nees) < 2.2


@pytest.mark.parametrize(("value", "true"), [(0.0, 0.35), (0.5, 0.1)])
def test_each_fix_is_told_of_once(value: float, true: float) -> None:
    # GIVEN fixes that wait for their samples, by the clock in force or by the right one
    run = until(stamped_early(draw(SCENE, 4), true), 20.0)
    estimator = estimating(run, **{"gnss.time_offset.value": value})

    assert offset(estimator) == pytest.approx(true, abs=0.02)
    assert (estimator.counts["gnss: clock offset found"] > 0) == (value > true)
    told = sum(topic == "gnss/verdict" for topic, _ in estimator.outbox)
    waiting = estimator.navigator.filter.withdraw()  # type: ignore[union-attr]
    assert told + len(waiting) == len(run.fixes)


@pytest.mark.parametrize(("by", "opened"), [(0.2, 1), (-0.06, 0)])
def test_a_clock_that_jumps_is_found_anew_and_told_once(by: float, opened: int) -> None:
    # GIVEN fixes that come by another clock of a sudden
    run = jumping(draw(replace(SCENE, duration=75.0), 5), 35.0, by)
    estimator = estimating(run)
    # THEN it shows in the state, or in the noise that the IMU would need, and the new one is found
    assert offset(estimator) == pytest.approx(by, abs=0.02)
    assert estimator.counts["gnss: clock offset"] == 1
    assert estimator.counts["gnss: state opened"] == opened


def test_the_filter_that_takes_over_knows_what_all_of_them_did(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    search = estimating(until(stamped_early(draw(SCENE, 4), -0.25), 6.0)).navigator.search
    assert search is not None and len(search.filters) > 1
    assert search.decide() is None
    found = search.found()
    monkeypatch.setattr(clock_search, "DECIDED_STD", 1.0)
    monkeypatch.setattr(clock_search, "DECIDED_NS", 0)
    decision = search.decide()
    assert decision is not None
    by, winner = decision
    assert by + winner.clock.missing == pytest.approx(found[0])
    assert winner.clock.sigma == pytest.approx(found[1])


def test_a_known_clock_stays_known_when_the_filter_starts_anew() -> None:
    # GIVEN a clock that was found, and an IMU that is away for two seconds
    run = until(stamped_early(draw(SCENE, 4), 0.2), 26.0)
    t = (run.samples["t_ns"] - run.samples["t_ns"][0]) * 1e-9
    estimator = estimating(replace(run, samples=run.samples[(t < 19.0) | (t > 21.0)]))
    # THEN the filter that starts after that knows the clock from its beginning
    assert estimator.counts["restart: no IMU samples"] == 1
    assert estimator.navigator.search is None
    missing, sigma = estimator._clock_found()
    assert sigma < 0.06
    assert offset(estimator) + missing == pytest.approx(0.2, abs=0.03)


def test_while_nothing_moves_nothing_is_said() -> None:
    # GIVEN a vehicle that stands
    run = draw(SCENE, 1)
    rng = np.random.default_rng(1)
    samples = run.samples.copy()
    samples["f"] = [0.0, 0.0, -9.8] + 0.02 * rng.standard_normal(samples["f"].shape)
    samples["w"] = 0.002 * rng.standard_normal(samples["w"].shape)
    noise = 0.1 * rng.standard_normal((len(run.fixes), 3))
    fixes = tuple(replace(f, lla=run.fixes[0].lla + dn / curvature_scale(f.lla))
                  for f, dn in zip(run.fixes, noise, strict=True))
    # WHEN its clock is looked for
    estimator = estimating(replace(run, samples=samples, fixes=fixes))
    # THEN it stays open
    assert offset(estimator) == 0.0
    assert estimator._clock_found()[1] > 0.2
    assert estimator.navigator.search is not None
    assert len(estimator.navigator.search.filters) == 2 * STEPS + 1
    # AND diagnostics say so
    assert "the search goes on" in estimator.diagnostics(estimator.navigator.last_ns)[-1].text


def test_nothing_is_searched_for_unasked_and_no_longer_than_asked() -> None:
    run = until(stamped_early(draw(SCENE, 4), 0.1), 5.0)
    assert through_estimator(run).navigator.search is None

    estimator = estimating(run)
    assert estimator.navigator.search is not None
    estimator.change({"gnss.time_offset.estimate": False})
    estimator._clock_ns = 0
    estimator._follow_clock()
    assert estimator.navigator.search is None
    assert estimator.navigator.filters == [estimator.navigator.filter]


def test_a_state_is_opened_to_what_a_wrong_clock_may_have_done() -> None:
    state = NavState(np.array([0.8, 0.2, 100.0]), np.array([10.0, -4.0, 1.0]),
                     np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(3), np.zeros(3),
                     np.diag(np.full(15, 1e-4)))
    there = opened(state, 0.5)

    moved = (there.lla - state.lla) * curvature_scale(state.lla)
    np.testing.assert_allclose(moved, [-5.0, 2.0, -0.5], atol=1e-6)
    std = np.sqrt(np.diag(there.P))
    np.testing.assert_allclose(std[DV], MISLED_SPEED)
    np.testing.assert_allclose(std[EPS], MISLED_TURN)
    np.testing.assert_allclose(std[DP], np.hypot(0.01, 0.5 * MISLED_SPEED))
    # A velocity that was too low has put the state too little back.
    np.testing.assert_allclose(there.P[DP, DV], -0.5 * MISLED_SPEED**2 * np.eye(3))
