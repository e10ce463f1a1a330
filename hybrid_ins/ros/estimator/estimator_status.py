"""
What an estimator says of itself: diagnostics, what it waits for, a summary.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from hybrid_ins.core.navigator.navigator import Navigator
from hybrid_ins.ros.aids.aids import Aids
from hybrid_ins.ros.estimator.clock_correction import ClockCorrection
from hybrid_ins.ros.estimator.noise_input import NoiseInput
from hybrid_ins.ros.estimator.reporter import Reporter
from hybrid_ins.ros.messages.conversions import Refused
from hybrid_ins.ros.reporting import diagnostics, wording
from hybrid_ins.ros.reporting.input_log import InputLog
from hybrid_ins.ros.reporting.reports import Status
from hybrid_ins.ros.review.input_review import InputReview

LONG_WITHOUT = 10.0  # s without a fix at the end, of which a summary says so


@dataclass(frozen=True, slots=True)
class EstimatorStatus:
    """
    The parts of an estimator that have something to report.

    Attributes
    ----------
    values : mapping
        The parameters in force.
    """

    values: Mapping[str, Any]
    navigator: Navigator
    inputs: InputLog
    review: InputReview
    reporter: Reporter
    clock: ClockCorrection
    noise: NoiseInput
    aids: Aids

    @property
    def waiting_for(self) -> str:
        """What alignment lacks, in words for the user; empty once the filter runs."""
        waiting = wording.waiting_for(self.navigator)
        return "; ".join([waiting, *self.review.causes]) if waiting else ""

    @property
    def fault(self) -> Refused | None:
        """What is wrong with the IMU's axes, units or mount at present, by the motion."""
        return self.review.axes.fault

    def diagnostics(self, t_ns: int, silent: float = 0.0, is_over: bool = False) -> list[Status]:
        """
        Return the statuses for ``/diagnostics`` at a stamp [ns].

        ``silent`` is for how long no IMU sample has come [s], where that is long; ``is_over`` says
        that none will be used any more.
        """
        mode, reporter = self.values["noise.mode"], self.reporter
        moved_b = self.review.axes.moved_b
        return [
            diagnostics.silent_status(self.navigator, silent, reporter.fixes_fused)
            if silent and self.navigator.last_ns
            else diagnostics.filter_status(
                self.navigator, t_ns, reporter.fused_ns, reporter.fixes_fused, self.waiting_for
            ),
            diagnostics.input_status(
                self.navigator, self.inputs, t_ns, self.fault, moved_b, self.review.axes.tilt
            ),
            diagnostics.noise_status(self.navigator, self.noise.reader, mode),
            self.clock.status(),
            *self.aids.statuses(t_ns, is_over or silent > 0.0),
        ]

    def summary(self) -> str:
        """Return a line on what was fused and what was not."""
        refused = ", ".join(f"{name} ×{n}" for name, n in sorted(self.inputs.counts.items()))
        reporter = self.reporter
        without = (self.navigator.last_ns - reporter.fused_ns) * 1e-9 if reporter.fused_ns else 0.0
        ended = f"none in the last {without:.0f} s" if without > LONG_WITHOUT else ""
        wrong = self.fault or self.review.axes.tilt
        fault = f"imu/data: {wrong.text}" if wrong is not None else ""
        lines = f"{reporter.fixes_fused} fixes fused", ended, refused, self.review.summary(), fault
        return "; ".join(filter(None, lines))
