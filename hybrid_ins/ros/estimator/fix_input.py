"""
Messages of the receiver into measurements.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from hybrid_ins.core.inertial.state import COVARIANCE, DIAGONAL, VELOCITY
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
FAR = 2.0  # times the variances of fix and state: the square of a way that tells leap from delay
EVIDENCE = 5.0  # sum over the fixes, see `FixInput._evidence`, that decides


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
        self._parts.place_sensors(
            placement.mount,
            placement.lever_b,
            placement.antenna_std,
            placement.antenna_is_placed,
        )
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
        if isinstance(measurement, PositionFix):
            leaps.evidence += self._evidence(measurement, leap, now_ns)
        if leaps.confirmed and leaps.evidence < -EVIDENCE:  # the way of the messages has changed
            self._leaps.clear()
            return measurement
        without = replace(measurement, t_ns=measurement.t_ns - leap * SECOND_NS)  # type: ignore[type-var]
        if leaps.confirmed and leaps.evidence > EVIDENCE:
            self._clock.leap(-float(leap))
            return without
        if leap < 0:
            return measurement
        return STAMP_LEAPS if leaps.evidence else without

    def _evidence(self, fix: PositionFix, leap: int, now_ns: int) -> float:
        """
        Return by how much more a position shows a leap [s] of its stamp than another delay.

        That is by how much nearer it is to where the vehicle was at the stamp without the leap,
        squared and in terms of what is known of both; 0 where these places are not far apart.
        """
        nav = self._navigator.phase.nav
        if nav is None:
            return 0.0
        z, _, R = fix.linearise(nav)
        variance = float(np.trace(R[:2, :2])) + float(nav[COVARIANCE][DIAGONAL][:2].sum())
        velocity_n = nav[VELOCITY][:2]
        way = velocity_n * leap
        if way @ way < FAR * variance:
            return 0.0
        as_stamped = z[:2] + velocity_n * (now_ns - fix.t_ns) * 1e-9
        without = as_stamped + way
        return float(as_stamped @ as_stamped - without @ without) / variance
