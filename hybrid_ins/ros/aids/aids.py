"""
What helps where fixes are missing (the vehicle's wheels, other sensors), and what is claimed then.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from hybrid_ins.core.filter.missing_height import MissingHeight
from hybrid_ins.core.fix_checks.frozen_height import FrozenHeight
from hybrid_ins.core.navigator.fix_watch import FixWatch
from hybrid_ins.core.navigator.navigator import Navigator
from hybrid_ins.core.navigator.notices import Notice
from hybrid_ins.core.navigator.outage_monitor import OutageMonitor
from hybrid_ins.core.update.gate import Verdict
from hybrid_ins.core.update.measurements import GNSS
from hybrid_ins.ros.aids.aiding_sources import AidingSources
from hybrid_ins.ros.aids.validity import ValidityMonitor
from hybrid_ins.ros.aids.vehicle_input import VehicleInput
from hybrid_ins.ros.placement.sensor_placement import SensorPlacement
from hybrid_ins.ros.reporting.diagnostics import aiding_verdict_status
from hybrid_ins.ros.reporting.input_log import InputLog
from hybrid_ins.ros.reporting.reports import Report, Status


class Aids:
    """
    The constraint of the vehicle, the aiding sensors, and the validity of the estimate.

    Parameters
    ----------
    values : mapping
        Checked parameters.
    navigator : Navigator
    inputs : InputLog
    placement : SensorPlacement

    Attributes
    ----------
    vehicle : VehicleInput
    sources : AidingSources
    validity : ValidityMonitor
    """

    def __init__(
        self,
        values: Mapping[str, Any],
        navigator: Navigator,
        inputs: InputLog,
        placement: SensorPlacement,
    ) -> None:
        self._navigator = navigator
        self._outages, self._fixes, self._height = OutageMonitor(), FixWatch(), MissingHeight()
        self._reports: list[Report] = []
        self.vehicle = VehicleInput(values, navigator, self._fixes, inputs.log)
        self.sources = AidingSources(values, navigator, self._fixes, inputs)
        self.validity = ValidityMonitor(values, navigator, self._fixes)
        self.configure(placement)

    def configure(self, placement: SensorPlacement) -> None:
        """Begin anew with the IMU at its place."""
        self.vehicle.configure(placement.mount, placement.arm_b)
        self.sources.configure(placement.arm_b)

    def restart(self) -> None:
        """Restart, as the filter did."""
        self._fixes.restart()
        self._height.restart()
        self._outages.restart()
        self.vehicle.restart()
        self.sources.restart()

    def on_notice(self, notice: Notice) -> None:
        """Note a fix, or that heights are none; report the verdict on another sensor's reading."""
        if isinstance(notice, FrozenHeight):
            self._navigator.phases.submit(self._height.on_frozen(notice))
        elif not isinstance(notice, Verdict):
            return
        elif notice.measurement.sensor == GNSS:
            self._fixes.on_verdict(notice)
            self._height.on_verdict(notice)
        else:
            self._report("aiding/verdict", aiding_verdict_status(notice))

    def run_periodic(self, t_ns: int) -> list[Report]:
        """Do what is due at a stamp [ns]; return what is to be published."""
        if self._navigator.phase.best is not None:
            self._fixes.on_start(t_ns)
        self._outages.run_periodic(self._navigator.phases, self._fixes, t_ns)
        level = self._height.measurement(t_ns)
        if level is not None:
            self._navigator.measure(level)
        self.vehicle.run_periodic(t_ns)
        self.sources.run_periodic(t_ns)
        changed = self.validity.changed(t_ns)
        if changed is not None:
            self._report("validity", changed)
        reports, self._reports = self._reports, []
        return reports

    def _report(self, topic: str, content: Status) -> None:
        self._reports.append(Report(topic, content, self._navigator.last_ns))

    def statuses(self, t_ns: int, is_silent: bool = False) -> list[Status]:
        """Return the statuses for ``/diagnostics`` at a stamp [ns]; the IMU may be silent."""
        validity = self.validity.status(t_ns, is_silent)
        return [self.vehicle.status(), self.sources.status(t_ns), validity]
