"""
Receivers whose fixes scatter by far more than they claim, so that most are rejected.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.noise.fix_differences import OF_WHITE, third_differences
from hybrid_ins.core.update.gate import Verdict
from hybrid_ins.core.update.measurements import PositionFix
from hybrid_ins.ros.review.fix_review import FIXES_KEPT, FixReview

Array = NDArray[np.float64]

REJECTED = 0.4  # share of the fixes, from which the receiver is suspected
EXCESS = 5.0  # times the claimed standard deviation
JERK = 3.0  # m/s³, of a vehicle
WENT_BACK_NS = 5_000_000_000  # by more than fixes are late: the stamps have another time base


class FixScatter(FixReview[tuple[int, Array, float, bool]]):
    """Compares the scatter of fixes, from one to the next, with what they claim."""

    def on_verdict(self, verdict: Verdict) -> None:
        """Note the verdict on a fix that was compared with the state."""
        fix = verdict.measurement
        self._quiet = max(self._quiet - 1, 0)
        if not isinstance(fix, PositionFix) or not math.isfinite(verdict.nis):
            return
        if self._fixes and fix.t_ns <= (last_ns := self._fixes[-1][0]):
            if last_ns - fix.t_ns < WENT_BACK_NS:
                return
            self._fixes.clear()
        sigma = float(np.sqrt(0.5 * (fix.covariance_n[0, 0] + fix.covariance_n[1, 1])))
        self._fixes.append((fix.t_ns, fix.lla, sigma, verdict.accepted))
        if self._quiet or verdict.accepted or len(self._fixes) < FIXES_KEPT:
            return
        rejected = sum(not accepted for *_, accepted in self._fixes)
        if rejected < REJECTED * FIXES_KEPT:
            return
        scatter = self._scatter()
        claimed = float(np.median([sigma for _, _, sigma, _ in self._fixes]))
        if scatter > EXCESS * claimed:
            self._warn(
                "gnss: claimed accuracy is not kept",
                f"{rejected} of {FIXES_KEPT} fixes rejected: they scatter by {scatter:.2g} m "
                f"from one to the next, σ {claimed:.2g} m is used: set gnss.position_std_min "
                f"to {_rounded_up(scatter):g}",
            )

    def _scatter(self) -> float:
        """Return the standard deviation of the fixes' white errors [m], per horizontal axis."""
        t_ns = np.array([stamp for stamp, *_ in self._fixes])
        third, even, dt = third_differences(t_ns, np.array([place for _, place, *_ in self._fixes]))
        third = third[even, :2]
        if len(third) < FIXES_KEPT // 3:
            return 0.0
        motion = JERK * dt**3
        variance = (float(np.median(np.abs(third))) / 0.6745) ** 2 - motion**2
        return math.sqrt(max(variance, 0.0) / OF_WHITE)


def _rounded_up(value: float) -> float:
    """Return a value with one digit, not smaller."""
    unit = 10.0 ** math.floor(math.log10(value))
    return math.ceil(value / unit - 1e-9) * unit
