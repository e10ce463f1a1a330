"""
Two receivers on one topic: their fixes are used and rejected in turns, for as long as both send.
"""

from __future__ import annotations

from collections import deque
from itertools import pairwise

from hybrid_ins.core.update.gate import Verdict
from hybrid_ins.core.update.measurements import PositionFix
from hybrid_ins.ros.messages.conversions import Refused
from hybrid_ins.ros.reporting.input_log import InputLog

FIXES_KEPT = 40  # fixes
CHANGES = 30  # from used to rejected or back; half of them at random make 20 ± 3
NEXT_WARNING = 200  # fixes
ELSEWHERE = ("innovation beyond the gate", "faster than gnss.max_speed")


class AlternatingFixes:
    """
    Warns where fixes are used and rejected in turns, as no receiver alone makes them.

    None of them is rejected for long, so that nothing else says it.

    Parameters
    ----------
    inputs : InputLog
        Warns.
    """

    def __init__(self, inputs: InputLog) -> None:
        self._inputs = inputs
        self._accepted: deque[bool] = deque(maxlen=FIXES_KEPT)
        self._quiet = 0  # fixes until the next warning

    def on_verdict(self, verdict: Verdict) -> None:
        """Note the verdict on a measurement; only positions that are used, or elsewhere, count."""
        if not isinstance(verdict.measurement, PositionFix):
            return
        if not (verdict.accepted or verdict.reason in ELSEWHERE):
            return
        self._accepted.append(verdict.accepted)
        self._quiet = max(self._quiet - 1, 0)
        if self._quiet or len(self._accepted) < FIXES_KEPT:
            return
        if sum(before != after for before, after in pairwise(self._accepted)) < CHANGES:
            return
        self._quiet = NEXT_WARNING
        rejected = FIXES_KEPT - sum(self._accepted)
        self._inputs.count_and_warn(
            "gnss/fix",
            Refused(
                "gnss: fixes rejected in turns",
                f"{rejected} of the last {FIXES_KEPT} fixes rejected, in turns with those that are "
                "used: do two receivers or publishers share the topic? Stop or remap all but one",
            ),
        )
