"""
The estimator that the node and ``ins_replay`` share: messages in, reports out.

It owns no topic, no file and no clock: time is the stamps of the IMU samples. Its owner hands it
messages, publishes the odometry that it returns and the reports of `Estimator.pop_reports`.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.events import NoiseChange
from hybrid_ins.core.forward_record import RunRecord
from hybrid_ins.core.gate import Verdict
from hybrid_ins.core.measurements import Measurement
from hybrid_ins.core.navigator import Navigator
from hybrid_ins.core.navigator_events import ClockOffsetFound, Event, Restarted
from hybrid_ins.resources import shortened
from hybrid_ins.ros import conversions, diagnostics, wording
from hybrid_ins.ros.aids import Aids
from hybrid_ins.ros.cdr import ImuFields
from hybrid_ins.ros.clock_correction import ClockCorrection
from hybrid_ins.ros.conversions import GnssInput, MapFrame, Message, Refused
from hybrid_ins.ros.filter_factory import FilterFactory
from hybrid_ins.ros.flood_guard import MOST, FloodGuard
from hybrid_ins.ros.imu_input import NO_READING, ImuInput
from hybrid_ins.ros.input_log import InputLog
from hybrid_ins.ros.input_review import InputReview
from hybrid_ins.ros.noise_input import NoiseInput
from hybrid_ins.ros.odometry import OdometrySource
from hybrid_ins.ros.reporter import Reporter
from hybrid_ins.ros.reports import Odometry, OdometryBlock, Report, Status
from hybrid_ins.ros.sensor_placement import SensorPlacement

Array = NDArray[np.float64]

REPORT_NS = 100_000_000  # between two reports of the state


class Estimator:
    """
    An INS/GNSS estimator for ROS messages.

    Parameters
    ----------
    values : mapping
        Checked parameters, see `parameters.check_all`.
    log : callable
        Called with a level (info, warn, error) and a line for the user.
    record : RunRecord, optional
        Filled for a smoother.

    Attributes
    ----------
    values : dict
        Parameters in force.
    navigator : Navigator
        Alignment and filter.
    inputs : InputLog
        Counts of what was refused.
    clock : ClockCorrection
        Offset of the fixes' clock.
    aids : Aids
        Constraint of the vehicle, aiding sensors, validity.
    """

    def __init__(
        self,
        values: Mapping[str, Any],
        log: Callable[[str, str], None],
        record: RunRecord | None = None,
    ) -> None:
        self.values = dict(values)
        self.inputs = InputLog(log)
        self._parts = FilterFactory(values, record is not None)
        self._placement = SensorPlacement(values, self.inputs)
        max_gap, zero_updates = values["imu.max_gap"], values["imu.zero_updates"]
        alignment = self._parts.alignment()
        self.navigator = Navigator(alignment, self._parts, max_gap, zero_updates, record)
        self.clock = ClockCorrection(values, self.navigator, self.inputs)
        self._odometry = OdometrySource()
        self._imu = ImuInput(values, self.navigator, self._placement, self._odometry, self.inputs)
        self._review = InputReview(values, self.navigator, self._placement.mount, self.inputs)
        self._reporter = Reporter(values, self.navigator, self.inputs)
        self._flood = FloodGuard()
        self._noise = NoiseInput(self.navigator, log)
        self._noise.configure(values, self._placement.mount)
        self.aids = Aids(self.values, self.navigator, self.inputs, self._placement.arm_b)
        self._restart_schedule()
        self._convert_gnss()
        if values["datum"]:
            *angles, height = values["datum"]
            self.set_datum(np.array([*map(math.radians, angles), height]), 1)

    def _restart_schedule(self) -> None:
        """Make everything periodic due at the next sample."""
        self._due_ns = 1  # when `run_periodic` has something to do
        self._report_ns = 0

    def _convert_gnss(self) -> None:
        """Convert fixes by the present parameters, placement and clock offset."""
        self._parts.set_clock_offset(self.clock.offset)
        for running in self.navigator.phases.filters:
            running.change_settings(self._parts.settings)
        given, lever_b = GnssInput.from_parameters(self.values), self._placement.lever_b
        self._gnss = replace(given, lever_b=lever_b, time_offset=self.clock.offset)

    def set_datum(self, lla: Array, t_ns: int) -> None:
        """Give the map its origin: latitude, longitude [rad], height [m], shape (3,)."""
        self._odometry.map = MapFrame(lla)
        self._reporter.report_datum(t_ns, lla)

    # What the owner asks.

    @property
    def map_frame(self) -> MapFrame | None:
        """The map, once there is a datum."""
        return self._odometry.map

    @property
    def arm_b(self) -> Array:
        """IMU relative to the base frame's origin [m], b, shape (3,)."""
        return self._placement.arm_b

    @property
    def aligned(self) -> bool:
        """The filter runs and odometry is valid."""
        return self._odometry.map is not None and self.navigator.filter is not None

    @property
    def ever_aligned(self) -> bool:
        """The filter ran at some time."""
        return self._reporter.ever_aligned

    @property
    def fixes_fused(self) -> int:
        """Measurements that the filter fused."""
        return self._reporter.fixes_fused

    @property
    def counts(self) -> Counter[str]:
        """Everything refused or odd, by name."""
        return self.inputs.counts

    @property
    def waiting_for(self) -> str:
        """What alignment lacks, in words for the user; empty once the filter runs."""
        waiting = wording.waiting_for(self.navigator)
        return "; ".join([waiting, *self._review.causes]) if waiting else ""

    def summary(self) -> str:
        """Return a line on what was fused and what was not."""
        refused = ", ".join(f"{name} ×{n}" for name, n in sorted(self.counts.items()))
        lines = (f"{self.fixes_fused} fixes fused", refused, self._review.summary())
        return "; ".join(filter(None, lines))

    def pop_reports(self) -> Sequence[Report]:
        """Return what is to be published since the last call."""
        return self._reporter.pop()

    def diagnostics(self, t_ns: int) -> list[Status]:
        """Return the statuses for ``/diagnostics`` at a stamp [ns]."""
        mode, reporter = self.values["noise.mode"], self._reporter
        return [
            diagnostics.filter_status(
                self.navigator, t_ns, reporter.fused_ns, reporter.fixes_fused, self.waiting_for
            ),
            diagnostics.input_status(self.navigator, self.inputs, t_ns, self._review.axes.fault),
            diagnostics.noise_status(self.navigator, self._noise.reader, mode),
            self.clock.status(),
            *self.aids.statuses(t_ns),
        ]

    def preload(self, t_ns: NDArray[np.int64], force: Array, rate: Array) -> None:
        """Provide what `handle_imu_block` will be given, see `NoiseReader.preload`."""
        self._noise.preload(t_ns, force, rate)

    # Control.

    def change(self, changes: Mapping[str, Any]) -> None:
        """Use checked values of run-time parameters without losing the state."""
        self.values.update(changes)
        for name, value in changes.items():
            self.inputs.log("info", f"parameter {name} is {shortened(str(value))} from now on")
        self._parts.change(changes)
        self.clock.change(changes)
        self._convert_gnss()
        noise_changes = any(name.startswith("noise.") for name in changes)
        for running in self.navigator.phases.filters:
            running.gate = self._parts.gate()
            if noise_changes or any(name.endswith("_bias_walk") for name in changes):
                noise = self._parts.noise(running.noise.process.period)
                running.submit(NoiseChange(running.t_ns, noise))
        if noise_changes:
            self._noise.configure(self.values, self._placement.mount)

    def reset(self) -> None:
        """Discard the state and align anew; the map stays where it is."""
        self.inputs.log("info", "reset: aligning anew")
        self._discard_state()

    def _discard_state(self) -> None:
        self.navigator.reset()
        self._restart()

    def _restart(self) -> None:
        """Restart everything that reports, as the navigator did."""
        self._odometry.restart()
        self._reporter.restart()
        self.clock.restart()
        self._noise.restart()
        self.aids.restart()
        self._restart_schedule()

    def handle_initial_pose(self, message: Message) -> None:
        """Use a heading by hand, a geometry_msgs/PoseWithCovarianceStamped; aligns anew."""
        yaw = conversions.initial_yaw(message, self.values["map_frame"])
        if isinstance(yaw, Refused):
            self.inputs.count_and_warn("initialpose", yaw)
            return
        heading, std = map(math.degrees, yaw)
        self.inputs.log(
            "info",
            f"initialpose: heading {heading % 360.0:.1f}° ± {std:.1f}° from north: aligning anew",
        )
        self.navigator.realign().set_yaw(self.navigator.last_ns, *yaw)
        self._restart()

    def handle_static_transforms(self, message: Message) -> None:
        """Use a tf2_msgs/TFMessage of /tf_static."""
        if self._placement.add_transforms(message):
            self._on_moved_sensors()

    def handle_frame_id(self, topic: str, frame: str) -> None:
        """Use the frame_id of the messages on ``imu/data`` or ``gnss/fix``."""
        if self._placement.set_frame(topic, frame):
            self._on_moved_sensors()

    def _on_moved_sensors(self) -> None:
        self._convert_gnss()
        self._review.axes.set_mount(self._placement.mount)
        self._noise.configure(self.values, self._placement.mount)
        self.aids.configure(self._placement.arm_b)
        if self.navigator.ring.count:
            self._discard_state()

    # IMU.

    def handle_imu(self, imu: ImuFields, received_ns: int | None = None) -> Odometry | None:
        """
        Use an Imu message; returns the odometry after it, if there is any.

        `run_periodic` is due once that is published.
        """
        if imu.frame_id != self._placement.frame_of("imu/data"):
            self.handle_frame_id("imu/data", imu.frame_id)
        if imu.specific_force_cov0 == -1.0 or imu.angular_rate_cov0 == -1.0:
            self.handle_missing_reading()
            return None
        if self._wants_orientation and imu.orientation_cov0 != -1.0:
            self._use_orientation(imu.orientation_xyzw)
        t_ns = imu.stamp_ns
        if received_ns is not None and self.values["use_receive_time"]:
            t_ns = received_ns
        return self._imu.use(t_ns, imu.specific_force, imu.angular_rate)

    def handle_missing_reading(self) -> None:
        """Count an Imu message without a reading, by its covariances."""
        self.inputs.count_and_warn("imu/data", NO_READING)

    def handle_imu_block(
        self,
        t_ns: NDArray[np.int64],
        force: Array,
        rate: Array,
        orientation_xyzw: Array | None = None,
    ) -> list[OdometryBlock]:
        """
        Use many readings, shapes (N,), (N, 3), (N, 3); the result is that of `handle_imu`.

        Returns the odometry of each stretch in which the filter ran. Orientations (N, 4) matter to
        heading_source imu only.
        """
        force, rate = np.ascontiguousarray(force), np.ascontiguousarray(rate)
        done: list[OdometryBlock] = []
        k = 0
        while k < len(t_ns):
            end = self._imu.end_of_stretch(t_ns, force, rate, k, self._due_ns)
            if end > k:
                block = self._imu.use_stretch(t_ns[k:end], force[k:end], rate[k:end])
                if block is not None:
                    done.append(block)
            else:
                end = k + 1
                if orientation_xyzw is not None and self._wants_orientation:
                    self._use_orientation(orientation_xyzw[k].tolist())
                reading = tuple(force[k].tolist()), tuple(rate[k].tolist())
                one = self._imu.use(int(t_ns[k]), *reading)
                if one is not None:
                    done.append(OdometryBlock(t_ns[k:end], one.in_map[None], one.in_odom[None]))
            self.run_periodic()
            k = end
        return done

    @property
    def _wants_orientation(self) -> bool:
        """The Imu messages' orientation is of use now."""
        return self.navigator.filter is None and self.values["alignment.heading_source"] == "imu"

    def _use_orientation(self, quat_xyzw: Sequence[float]) -> None:
        yaw = conversions.imu_yaw(quat_xyzw, self._placement.mount)
        if yaw is not None and self.navigator.alignment is not None:
            self.navigator.alignment.observe_yaw(yaw)

    # GNSS.

    def handle_fix(self, message: Message, received_ns: int | None = None) -> None:
        """Use a sensor_msgs/NavSatFix."""
        if message.header.frame_id != self._placement.frame_of("gnss/fix"):
            self.handle_frame_id("gnss/fix", message.header.frame_id)
        fix = self._gnss.position(message, self._by_receipt(received_ns))
        if not isinstance(fix, Refused) and self._odometry.map is None:
            self.set_datum(np.nan_to_num(fix.lla), fix.t_ns)
        self._review.on_fix(message, fix)
        self._measure("gnss/fix", fix)

    def handle_velocity(self, message: Message, received_ns: int | None = None) -> None:
        """Use a geometry_msgs/TwistWithCovarianceStamped with ENU components."""
        self._measure("gnss/velocity", self._gnss.velocity(message, self._by_receipt(received_ns)))

    def _by_receipt(self, received_ns: int | None) -> int | None:
        return received_ns if self.values["use_receive_time"] else None

    def _measure(self, topic: str, measurement: Measurement | Refused) -> None:
        if not isinstance(measurement, Refused):
            if self._flood.admits(topic, self.navigator.last_ns):
                self._fuse(measurement)
                return
            measurement = Refused(
                "gnss: too many messages",
                f"more than {MOST} in a second: are there several publishers?",
            )
        self.inputs.count_and_warn(topic, measurement)

    def _fuse(self, measurement: Measurement) -> None:
        self._review.axes.observe(measurement)
        self.navigator.measure(measurement)
        self._handle_events()
        self.clock.run_periodic(self._review.axes.are_plausible)
        if self.clock.offset != self._gnss.time_offset:
            self._convert_gnss()

    # What happens, and what is due.

    def run_periodic(self) -> None:
        """Do what is not done with every sample; call it after each, once that is published."""
        t_ns = self.navigator.last_ns
        if t_ns < self._due_ns and not self.navigator.has_events:
            return
        self._handle_events()
        self._noise.run_periodic(t_ns)
        if t_ns >= self._report_ns:
            self._report_ns = t_ns + REPORT_NS
            self._reporter.add(self.aids.run_periodic(t_ns))
            self.navigator.check_imu()
            self._review.axes.run_periodic()
            self.navigator.continue_search()
            self._handle_events()
            self._reporter.report_state(t_ns, self._placement.arm_b)
            if self._reporter.is_diagnostics_due(t_ns):
                self._reporter.report_diagnostics(t_ns, self.diagnostics(t_ns))
                self._review.note_second()
        self._due_ns = min(self._report_ns, self._noise.next_ns)

    def _handle_events(self) -> None:
        for event in self.navigator.pop_events():
            self._on_event(event)

    def _on_event(self, event: Event) -> None:
        self._reporter.on_event(event)
        self._review.on_event(event)
        if isinstance(event, Verdict):
            self.aids.on_verdict(event)
        elif isinstance(event, Restarted):
            self._restart()
        elif isinstance(event, ClockOffsetFound):
            self.clock.on_found(event)
            self._convert_gnss()
