"""
Causes of trouble that lie in the input: IMU axes, clocks, covariances, a receiver's claims.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from hybrid_ins.core.navigator.navigator import Navigator
from hybrid_ins.core.navigator.notices import Notice
from hybrid_ins.core.update.gate import Verdict
from hybrid_ins.core.update.measurements import PositionFix
from hybrid_ins.ros.messages.conversions import Message, Refused, missing_covariance
from hybrid_ins.ros.messages.gps_fix import fix_type
from hybrid_ins.ros.placement.sensor_placement import SensorPlacement
from hybrid_ins.ros.reporting import diagnostics
from hybrid_ins.ros.reporting.input_log import InputLog
from hybrid_ins.ros.reporting.lasting import LastingConditions
from hybrid_ins.ros.review.alternating_fixes import AlternatingFixes
from hybrid_ins.ros.review.antenna_correction import AntennaCorrection
from hybrid_ins.ros.review.axes_monitor import AxesMonitor
from hybrid_ins.ros.review.fix_refusals import FixRefusals
from hybrid_ins.ros.review.fix_scatter import FixScatter
from hybrid_ins.ros.review.input_units import InputUnits


class InputReview:
    """
    Finds out what is wrong with the input over seconds and minutes, and warns of it.

    Parameters
    ----------
    values : mapping
        Checked parameters.
    navigator : Navigator
    placement : SensorPlacement
        Where the sensors are.
    inputs : InputLog

    Attributes
    ----------
    axes : AxesMonitor
        Checks the IMU's axes and units.
    """

    def __init__(
        self,
        values: Mapping[str, Any],
        navigator: Navigator,
        placement: SensorPlacement,
        inputs: InputLog,
    ) -> None:
        self._values = values
        self._navigator = navigator
        self._inputs = inputs
        self.axes = AxesMonitor(navigator, placement, inputs)
        self._antenna = AntennaCorrection(navigator, placement, inputs)
        self._refusals = FixRefusals(navigator, inputs)
        self._scatter = FixScatter(inputs)
        self._alternating = AlternatingFixes(inputs)
        self._units = InputUnits(inputs)
        self._lasting = LastingConditions(inputs.log)

    @property
    def causes(self) -> list[str]:
        """Why no filter starts, as far as the input shows it."""
        fault, refusals, unused = self.axes.fault, self._refusals.dominant, ""
        if self._navigator.last_ns == 0:  # no sample was of use
            unused = self._inputs.last_refused.get("imu/data", "")
        return [text for text in (unused, refusals, "" if fault is None else fault.text) if text]

    def on_fix(self, message: Message, fix: PositionFix | Refused) -> None:
        """Note a NavSatFix, and what it was converted to."""
        self._refusals.note(fix)
        self._units.on_fix(message, fix)
        self._inputs.receiver["fix_type"] = fix_type(int(message.status.status))
        missing = "" if isinstance(fix, Refused) else missing_covariance(message)
        if missing:
            std = ", ".join(f"{s:g}" for s in self._values["gnss.position_std_default"])
            self._inputs.note(
                "gnss: covariance",
                f"gnss/fix: {missing}: gnss.position_std_default, {std} m, is used instead",
            )

    def run_periodic(self) -> bool:
        """Do what is due, some times a second; return whether alignment has to begin again."""
        if self._antenna.run_periodic():
            self.axes.restart()
        return self.axes.run_periodic()

    def on_notice(self, notice: Notice) -> None:
        """Note what happened to the navigator."""
        if isinstance(notice, Verdict):
            self._scatter.on_verdict(notice)
            self._alternating.on_verdict(notice)

    def note_second(self) -> None:
        """Note what has lasted for another second."""
        navigator = self._navigator
        alignment = diagnostics.alignment_conditions(navigator)
        conditions = diagnostics.noise_conditions(navigator)
        self._units.check_rate(navigator.ring)
        antenna = diagnostics.antenna_conditions(navigator, self.axes.moved_b)
        self._lasting.note({**alignment, **conditions, **antenna})

    def summary(self) -> str:
        """Return what lasted, for the end of a run."""
        return self._lasting.summary()
