"""Flights whose clock offset is searched for, and what has to hold when it is found."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import pytest
from support.runs import stamped_early, through_estimator

from hybrid_ins.core.inertial.earth import curvature_scale
from hybrid_ins.core.inertial.state import COVARIANCE, DIAGONAL, LLA
from hybrid_ins.ros.estimator.estimator import Estimator
from tools.paper.runs import Run, Scenario, draw

SCENE = Scenario("flight", rate=100.0, duration=45.0)
SECOND = 1_000_000_000


def until(run: Run, seconds: float) -> Run:
    """Keep the first stretch of a run."""
    end = int(run.samples["t_ns"][0]) + round(seconds * SECOND)
    return replace(run, fixes=tuple(f for f in run.fixes if f.t_ns <= end))


def estimating(run: Run, late: float = 0.0, **values: object) -> Estimator:
    return through_estimator(run, late, **{"gnss.time_offset.estimate": True, **values})


def offset(estimator: Estimator) -> float:
    return estimator.clock.offset


def told_and_waiting(estimator: Estimator) -> list[int]:
    """Stamps [ns], as the receiver gave them, of all verdicts and of what is not decided yet."""
    verdicts = [r.content for r in estimator.pop_reports() if r.topic == "gnss/verdict"]
    stamps = [int(dict(verdict.values)["stamp"]) for verdict in verdicts]
    waiting = estimator.navigator.filter.withdraw()  # type: ignore[union-attr]
    return sorted([*stamps, *(m.t_ns - round(1e9 * offset(estimator)) for m in waiting)])


def assert_heading_and_clock_are_found(seed: int, value: float, true: float) -> None:
    # GIVEN a flight of which neither is known
    run = until(stamped_early(draw(SCENE, seed), true), 20.0)
    unknown = {"alignment.heading_source": "auto", "gnss.time_offset.value": value}
    estimator = estimating(run, **unknown)
    # THEN both are found, and each fix is told of once
    running = estimator.navigator.filter
    assert running is not None and estimator.navigator.phase.bank is None
    assert offset(estimator) == pytest.approx(true, abs=0.03)
    assert np.sqrt(running.nav[COVARIANCE][DIAGONAL][8]) < 0.1
    told = told_and_waiting(estimator)
    np.testing.assert_allclose(told, [f.t_ns for f in run.fixes], rtol=0, atol=0.05 * SECOND)


def nees_after_takeover(seeds: Iterable[int]) -> list[np.ndarray]:
    """Return the position's NEES by axis of runs whose clock is far off, once it is found."""
    nees = []
    for seed in seeds:
        run = draw(SCENE, seed)
        estimator = estimating(until(stamped_early(run, -0.3), 25.0))
        running = estimator.navigator.filter
        assert running is not None and estimator.navigator.phase.bank is None
        # The truth is there at the next epoch that is scored.
        k = int(np.searchsorted(run.samples["t_ns"][run.scored], running.t_ns))
        now = run.samples["t_ns"][run.scored[k]]
        ahead = run.samples[
            np.searchsorted(run.samples["t_ns"], running.t_ns) + 1 : run.scored[k] + 1
        ]
        if len(ahead):
            running.predict_block(ahead)
        assert running.t_ns == now
        off = (run.lla[k] - running.nav[LLA]) * curvature_scale(run.lla[k])
        nees.append(off**2 / running.nav[COVARIANCE][DIAGONAL][:3])
    return nees
