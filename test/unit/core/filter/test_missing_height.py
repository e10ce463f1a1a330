"""What bounds the vertical channel where fixes have no height, and only there."""

from dataclasses import replace

import numpy as np
import pytest
from support.runs import begin

from hybrid_ins.core.filter.missing_height import (
    CLIMB_STD,
    CLIMB_TIME,
    FROZEN_STD,
    MISSING_NS,
    UNKNOWN_HEIGHT_STD,
    LevelMotion,
    MissingHeight,
)
from hybrid_ins.core.fix_checks.frozen_height import FrozenHeight
from hybrid_ins.core.inertial.state import DV, LLA, N_ERROR, NavState, covariance, total_std
from hybrid_ins.core.update.gate import Gate, Verdict
from hybrid_ins.core.update.iterated_update import update
from hybrid_ins.core.update.measurements import PositionFix
from tools.paper.runs import Scenario, draw

SECOND = 1_000_000_000


def _verdict(t: float, height: float, accepted: bool = True) -> Verdict:
    fix = PositionFix(round(t * SECOND), np.array([0.8, 0.2, height]), np.eye(3), np.zeros(3))
    return Verdict(fix, accepted, "", 0.0, 1.0, 9.0, np.ones(2))


def _measured(fixes: list[Verdict], until: float) -> int:
    """Return how often level motion is measured while fixes come."""
    watch, count = MissingHeight(), 0
    for t in np.arange(1.0, until, 0.1):
        for verdict in fixes:
            if 0.0 <= t - verdict.measurement.t_ns * 1e-9 < 0.1:
                watch.on_verdict(verdict)
        count += watch.measurement(round(t * SECOND)) is not None
    return count


def test_it_is_measured_once_a_second_while_fixes_without_a_height_come() -> None:
    every = np.arange(1.0, 60.0, 0.2)

    assert _measured([_verdict(t, np.nan) for t in every], 60.0) == pytest.approx(57, abs=3)
    assert _measured([_verdict(t, 100.0) for t in every], 60.0) == 0
    mixed = [_verdict(t, np.nan if k % 5 else 100.0) for k, t in enumerate(every)]
    assert _measured(mixed, 60.0) == 0
    assert _measured([_verdict(t, np.nan, accepted=False) for t in every], 60.0) == 0


def test_it_ends_in_an_outage_and_when_heights_come() -> None:
    flat = [_verdict(t, np.nan) for t in np.arange(1.0, 20.0, 0.2)]
    high = [_verdict(t, 100.0) for t in np.arange(20.0, 40.0, 0.2)]
    longest = MISSING_NS // SECOND

    assert _measured(flat, 60.0) <= 20 + longest
    assert _measured(flat + high, 60.0) <= 21


def test_a_height_that_was_never_given_is_said_to_be_unknown() -> None:
    watch = MissingHeight()
    watch.on_verdict(_verdict(10.0, np.nan))
    never = watch.measurement(10 * SECOND)
    watch.on_verdict(_verdict(11.0, 500.0))
    watch.on_verdict(_verdict(20.0, np.nan))
    once = watch.measurement(20 * SECOND)

    assert never is not None and never.height_variance == UNKNOWN_HEIGHT_STD**2
    assert once is not None and once.height_variance == 0.0


def test_frozen_heights_were_never_given() -> None:
    """GIVEN a fix with such a height that is fused late THEN it is no height either."""
    watch = MissingHeight()
    watch.on_verdict(_verdict(10.0, 0.0))
    inflation = watch.on_frozen(FrozenHeight(11 * SECOND, 0.0, 40, 120.0))
    watch.on_verdict(_verdict(10.8, 0.0))
    watch.on_verdict(_verdict(11.0, np.nan))
    at_once = watch.measurement(11 * SECOND)
    watch.on_verdict(_verdict(12.0, 80.0))

    assert at_once is not None and at_once.height_variance == UNKNOWN_HEIGHT_STD**2
    assert inflation.t_ns == 11 * SECOND and np.flatnonzero(inflation.std).tolist() == [5]
    assert inflation.std[5] == FROZEN_STD
    assert watch.measurement(12 * SECOND) is None


def test_many_of_them_know_the_mean_climb_as_well_as_climbs_allow() -> None:
    """
    GIVEN a vertical velocity that may be anything WHEN it is constant for five minutes
    THEN its variance is that of the mean of errors with the correlation time of climbs.
    """
    P, level = np.zeros((N_ERROR, N_ERROR)), np.array([0.0, 0.0, 0.0, 1.0])
    P[DV, DV] = 100.0**2 * np.eye(3)
    state = NavState(np.zeros(3), np.zeros(3), level, np.zeros(3), np.zeros(3), P)
    nav, seconds = state.to_flat(), 300
    for k in range(seconds):
        update(nav, *LevelMotion(k * SECOND, 0.0).linearise(nav))

    variance = covariance(nav)[DV, DV].diagonal()
    assert variance[2] == pytest.approx(CLIMB_STD**2 * 2.0 * CLIMB_TIME / seconds, rel=0.05)
    assert variance[:2] == pytest.approx([1e4, 1e4])


def test_the_unknown_height_is_in_the_covariance_until_the_first_one() -> None:
    """GIVEN 2-D fixes WHEN the first height is 500 m off THEN it is taken, and its σ published."""
    run = draw(Scenario("flight", rate=100.0, duration=20.0), 1)
    ins, off = begin(run), run.fixes[0].lla[2]
    ins.update.gate = Gate({1: 20.0, 3: 25.0}, 3.0)
    ins.submit(LevelMotion(ins.t_ns, UNKNOWN_HEIGHT_STD**2))
    assert total_std(ins.nav)[2] > UNKNOWN_HEIGHT_STD

    fix = run.fixes[0]
    at = run.samples[1 : int(np.searchsorted(run.samples["t_ns"], fix.t_ns, side="right"))]
    ins.ring.extend(at)
    ins.predict_block(at)
    ins.submit(replace(fix, lla=fix.lla + np.array([0.0, 0.0, 500.0])))

    [*_, verdict] = ins.verdicts
    assert verdict.accepted and not verdict.inflated
    assert ins.nav[LLA][2] == pytest.approx(off + 500.0, abs=5.0)
    assert total_std(ins.nav)[2] < 5.0
