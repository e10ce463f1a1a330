"""
Two receivers on one topic: their fixes are used and rejected in turns, for as long as both send.
"""

from __future__ import annotations

from itertools import pairwise

from hybrid_ins.core.update.gate import Verdict
from hybrid_ins.core.update.measurements import PositionFix
from hybrid_ins.ros.review.fix_review import FIXES_KEPT, FixReview

CHANGES = 30  # from used to rejected or back; half of them at random make 20 ± 3
ELSEWHERE = ("innovation beyond the gate", "faster than gnss.max_speed")


class AlternatingFixes(FixReview[bool]):
    """
    Warns where fixes are used and rejected in turns, as no receiver alone makes them.

    None of them is rejected for long, so that nothing else says it.
    """

    def on_verdict(self, verdict: Verdict) -> None:
        """Note the verdict on a measurement; only positions that are used, or elsewhere, count."""
        if not isinstance(verdict.measurement, PositionFix):
            return
        if not (verdict.accepted or verdict.reason in ELSEWHERE):
            return
        self._fixes.append(verdict.accepted)
        self._quiet = max(self._quiet - 1, 0)
        if self._quiet or len(self._fixes) < FIXES_KEPT:
            return
        if sum(before != after for before, after in pairwise(self._fixes)) < CHANGES:
            return
        rejected = FIXES_KEPT - sum(self._fixes)
        self._warn(
            "gnss: fixes rejected in turns",
            f"{rejected} of the last {FIXES_KEPT} fixes rejected, in turns with those that are "
            "used: do two receivers or publishers share the topic? Stop or remap all but one",
        )
