"""Which reason is said to keep a filter from starting."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from hybrid_ins.core.update.measurements import PositionFix
from hybrid_ins.ros.messages.conversions import Refused
from hybrid_ins.ros.reporting.input_log import InputLog
from hybrid_ins.ros.review.fix_refusals import FixRefusals

FIX = PositionFix(1, np.zeros(3), np.eye(3), np.zeros(3))
NO_FIX = Refused("gnss: no fix", "status -1 means no fix")
NO_PLACE = Refused("gnss: no position", "latitude NaN is not a position")


@pytest.mark.parametrize(
    ("fixes", "is_blamed"),
    [
        ([FIX, NO_FIX], False),
        ([FIX, FIX, FIX, NO_PLACE, NO_PLACE, NO_PLACE, NO_FIX, NO_FIX, NO_FIX, NO_FIX], False),
        ([FIX, NO_FIX, NO_FIX], True),
        ([NO_FIX], True),
    ],
)
def test_only_what_half_of_the_fixes_suffer_from_is_blamed(
    fixes: list[PositionFix | Refused], is_blamed: bool
) -> None:
    log: list[str] = []
    navigator: Any = SimpleNamespace(filter=None, last_ns=0)
    refusals = FixRefusals(navigator, InputLog(lambda _, text: log.append(text)))

    for fix in 10 * fixes:
        refusals.note(fix)

    assert ("status -1" in refusals.dominant) is is_blamed
    assert len(log) == is_blamed
