"""Outages by the stamps of fused fixes."""

from dataclasses import replace

import numpy as np

from hybrid_ins.core.navigator.fix_watch import FixWatch
from hybrid_ins.core.update.gate import Verdict
from hybrid_ins.core.update.measurements import PositionFix, Standstill

SECOND = 1_000_000_000


def verdict(t: float, accepted: bool = True) -> Verdict:
    fix = PositionFix(round(t * SECOND), np.zeros(3), np.eye(3), np.zeros(3))
    return replace(Verdict.rejected(fix, ""), accepted=accepted)


def test_an_outage_begins_three_seconds_after_a_fix_and_its_end_shows_for_five() -> None:
    watch = FixWatch()
    assert not watch.started
    assert watch.outage(10 * SECOND)
    for t in range(10, 20):
        watch.on_verdict(verdict(t))
    assert watch.started
    assert not watch.settled(14 * SECOND)
    assert watch.settled(19 * SECOND)
    assert not watch.outage(22 * SECOND)
    assert watch.outage(23 * SECOND)

    watch.on_verdict(verdict(40))

    assert not watch.outage(41 * SECOND)
    assert not watch.settled(41 * SECOND)
    for t in range(41, 46):
        watch.on_verdict(verdict(t))
    assert watch.settled(46 * SECOND)


def test_a_filter_starts_from_a_fix_and_a_restart_forgets_fixes_of_another_clock() -> None:
    watch = FixWatch()
    watch.on_verdict(verdict(5000.0))
    watch.restart()
    assert watch.outage(10 * SECOND)

    watch.on_start(10 * SECOND)
    watch.on_start(20 * SECOND)

    assert not watch.outage(12 * SECOND)
    assert watch.outage(14 * SECOND)


def test_only_fixes_that_were_fused_count() -> None:
    watch = FixWatch()
    watch.on_verdict(verdict(10.0))
    watch.on_verdict(verdict(13.0, accepted=False))
    standing = Standstill(13 * SECOND, np.zeros(3), np.ones(3))
    watch.on_verdict(replace(Verdict.rejected(standing, ""), accepted=True))

    assert watch.outage(14 * SECOND)
