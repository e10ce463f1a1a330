"""Two receivers on one topic are named where their fixes are used and rejected in turns."""

import numpy as np
import pytest

from hybrid_ins.core.update.gate import Verdict
from hybrid_ins.core.update.measurements import PositionFix, VelocityFix
from hybrid_ins.ros.reporting.input_log import InputLog
from hybrid_ins.ros.review.alternating_fixes import AlternatingFixes

GATE, SPEED = "innovation beyond the gate", "faster than gnss.max_speed"


def warnings(rejected: list[bool], reason: str) -> list[str]:
    """Return what is said of fixes, with a velocity that is used between any two."""
    log: list[str] = []
    watched = AlternatingFixes(InputLog(lambda level, text: log.append(text)))
    for k, no in enumerate(rejected):
        t_ns = 500_000_000 * (k + 1)
        fix = PositionFix(t_ns, np.zeros(3), np.eye(3), np.zeros(3))
        text = reason if no else ""
        watched.on_verdict(Verdict(fix, not no, text, 0.0, np.nan, 16.0, np.ones(3)))
        velocity = VelocityFix(t_ns, np.zeros(3), np.eye(3), np.zeros(3))
        watched.on_verdict(Verdict(velocity, True, "", 0.0, 3.0, 16.0, np.ones(3)))
    return log


@pytest.mark.parametrize("reason", [GATE, SPEED])
@pytest.mark.parametrize("lost", [0.0, 0.05])
def test_fixes_that_are_rejected_in_turns_are_named(reason: str, lost: float) -> None:
    rng = np.random.default_rng(1)
    in_turns = [k % 2 == 1 for k in range(150) if rng.random() >= lost]

    [text] = warnings(in_turns, reason)

    assert "gnss/fix: " in text and "of the last 40 fixes rejected, in turns" in text
    assert "two receivers or publishers share the topic?" in text


@pytest.mark.parametrize("share", [0.0, 0.25, 0.5, 0.9, 1.0])
def test_fixes_that_are_rejected_at_random_are_not(share: float) -> None:
    rng = np.random.default_rng(2)

    assert warnings([rng.random() < share for _ in range(2000)], GATE) == []


def test_fixes_that_are_refused_for_another_reason_do_not_count() -> None:
    assert warnings([k % 2 == 1 for k in range(150)], "repeated stamp") == []
