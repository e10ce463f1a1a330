"""
Messages of the receiver into measurements.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any

from hybrid_ins.core.navigator.navigator import Navigator
from hybrid_ins.core.update.measurements import Measurement, PositionFix
from hybrid_ins.ros.estimator.clock_correction import ClockCorrection
from hybrid_ins.ros.estimator.filter_factory import FilterFactory
from hybrid_ins.ros.estimator.flood_guard import FloodGuard
from hybrid_ins.ros.estimator.stamp_leaps import SECOND_NS, StampLeaps
from hybrid_ins.ros.messages.conversions import GnssInput, Message, Refused
from hybrid_ins.ros.placement.sensor_placement import SensorPlacement

STAMP_LEAPS = Refused(
    "gnss: stamp leaps",
    "header.stamp leaps ahead by whole seconds; the fixes are used once the stamps stay there",
)


class FixInput:
    """
    Converts fixes by the parameters, the placement and the clock offset in force.

    Parameters
    ----------
    values : mapping
        The parameters in force: they may change.
    navigator : Navigator
    parts : FilterFactory
        How late fixes may be depends on the clock offset.
    placement : SensorPlacement
        Where the antenna is.
    clock : ClockCorrection
        Offset of the fixes' clock.
    """

    def __init__(
        self,
        values: Mapping[str, Any],
        navigator: Navigator,
        parts: FilterFactory,
        placement: SensorPlacement,
        clock: ClockCorrection,
    ) -> None:
        self._values = values
        self._navigator = navigator
        self._parts = parts
        self._placement = placement
        self._clock = clock
        self._flood = FloodGuard()
        self._leaps: defaultdict[str, StampLeaps] = defaultdict(StampLeaps)
        self.configure()

    def configure(self, changes: Iterable[str] = ()) -> None:
        """Use the present parameters, of which ``changes`` are new, placement and clock offset."""
        if "gnss.time_offset.value" in changes:
            self._leaps.clear()
        placement = self._placement
        is_placed = placement.antenna_is_placed
        self._parts.set_antenna(placement.lever_b, placement.antenna_std, is_placed)
        clock = self._clock
        self._parts.set_clock_offset(clock.offset, clock.prior, clock.drift)
        self._prior = clock.prior
        for running in self._navigator.phases.filters:
            self._parts.change_running(running, changes)
        self._gnss = replace(
            GnssInput.from_parameters(self._values),
            lever_b=self._placement.lever_b,
            time_offset=self._clock.offset,
        )

    def follow(self) -> None:
        """Use the present place of the antenna, clock offset and its prior where they changed."""
        clock, lever_b = self._clock, self._placement.lever_b
        moved = lever_b is not self._gnss.lever_b
        if moved or clock.offset != self._gnss.time_offset or clock.prior != self._prior:
            self.configure()

    def position(self, message: Message, received_ns: int | None) -> PositionFix | Refused:
        """Convert a sensor_msgs/NavSatFix; see `GnssInput.position`."""
        self.follow()
        return self._gnss.position(message, received_ns)

    def velocity(self, message: Message, received_ns: int | None) -> Measurement | Refused:
        """Convert a geometry_msgs/TwistWithCovarianceStamped; see `GnssInput.velocity`."""
        self.follow()
        return self._gnss.velocity(message, received_ns)

    def admit(self, topic: str, measurement: Measurement) -> Measurement | Refused:
        """Return a measurement of a topic, or why it is one too many or waits: its stamp leaps."""
        now_ns = self._navigator.last_ns
        refused = self._flood.check(topic, now_ns, measurement.t_ns)
        if refused is not None or now_ns == 0:
            return refused or measurement
        leaps = self._leaps[topic]
        leap = leaps.observe(measurement.t_ns - round(self._clock.moved * 1e9), now_ns)
        if leap == 0:
            return measurement
        if leaps.confirmed:
            self._clock.leap(-float(leap))
            return replace(measurement, t_ns=measurement.t_ns - leap * SECOND_NS)  # type: ignore[type-var]
        return STAMP_LEAPS if leap > 0 else measurement
