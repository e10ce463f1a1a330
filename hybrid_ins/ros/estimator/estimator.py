"""
The estimator that the node and ``ins_replay`` share: messages in, reports out.

It owns no topic, no file and no clock: time is the stamps of the IMU samples. Its owner hands it
messages, publishes the odometry that it returns and the reports of `Estimator.pop_reports`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.alignment.alignment import Alignment
from hybrid_ins.core.inertial.rotations import heading_from_quat
from hybrid_ins.core.inertial.state import EPS, QUAT, total_std
from hybrid_ins.core.navigator.navigator import Navigator
from hybrid_ins.core.navigator.notices import (
    ClockOffsetFound,
    HeadingCorrected,
    Notice,
    RestartCause,
    Restarted,
)
from hybrid_ins.core.smoothing.forward_record import RunRecord
from hybrid_ins.core.update.gate import Verdict
from hybrid_ins.core.update.measurements import Measurement
from hybrid_ins.resources import shortened
from hybrid_ins.ros.aids.aids import Aids
from hybrid_ins.ros.estimator.clock_correction import ClockCorrection
from hybrid_ins.ros.estimator.estimator_status import EstimatorStatus
from hybrid_ins.ros.estimator.filter_factory import FilterFactory
from hybrid_ins.ros.estimator.fix_input import FixInput
from hybrid_ins.ros.estimator.imu_admission import ImuAdmission
from hybrid_ins.ros.estimator.noise_input import NoiseInput
from hybrid_ins.ros.estimator.reporter import Reporter
from hybrid_ins.ros.messages import conversions
from hybrid_ins.ros.messages.cdr import ImuFields
from hybrid_ins.ros.messages.conversions import MapFrame, Message, Refused, yaw_ned_from_enu
from hybrid_ins.ros.messages.initial_pose import initial_yaw
from hybrid_ins.ros.output.odometry import OdometrySource
from hybrid_ins.ros.placement.sensor_placement import SensorPlacement
from hybrid_ins.ros.reporting import wording
from hybrid_ins.ros.reporting.input_log import InputLog, Log
from hybrid_ins.ros.reporting.reports import Odometry, Report
from hybrid_ins.ros.reporting.wording import STAMP_FAULTS
from hybrid_ins.ros.review.input_review import InputReview

Array = NDArray[np.float64]

REPORT_NS = 100_000_000  # between two reports of the state
SENSOR_MOVED = Refused(
    "restart: a sensor was moved",
    "a sensor was moved, by /tf_static or another frame_id: aligning anew",
)
KEEP_CLOCK = (
    RestartCause.NO_SAMPLES,
    RestartCause.IMU_UNUSABLE,
    RestartCause.TURN_UNMEASURED,
    RestartCause.NOT_FINITE,
)
"""What makes a state useless, but not what is known of the clock offset of the fixes."""


class Estimator:
    """
    An INS/GNSS estimator for ROS messages: the parts that share the work, connected.

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
    placement : SensorPlacement
        Where the sensors are.
    admission : ImuAdmission
        Which Imu readings are used.
    clock : ClockCorrection
        Offset of the fixes' clock.
    odometry : OdometrySource
        The map, and odometry in it.
    noise : NoiseInput
        Noise levels of a regressor.
    reporter : Reporter
        What was reported so far.
    aids : Aids
        Constraint of the vehicle, aiding sensors, validity.
    status : EstimatorStatus
        Diagnostics, and what the estimator waits for.
    due_ns : int
        Stamp [ns] from which on `run_periodic` has something to do.
    """

    def __init__(
        self,
        values: Mapping[str, Any],
        log: Log,
        record: RunRecord | None = None,
    ) -> None:
        self.values = dict(values)
        self.inputs = InputLog(log)
        self._parts = FilterFactory(values, record is not None)
        self.placement = SensorPlacement(values, self.inputs)
        self.navigator = self._parts.navigator(record)
        self.clock = ClockCorrection(values, self.navigator, self.inputs)
        self.odometry = OdometrySource()
        self.admission = ImuAdmission(values, self.navigator.stamps)
        self._review = InputReview(values, self.navigator, self.placement, self.inputs)
        self.reporter = Reporter(self.values, self.navigator, self.inputs, self.odometry)
        self._fixes = FixInput(self.values, self.navigator, self._parts, self.placement, self.clock)
        self.noise = NoiseInput(self.navigator, log)
        self.noise.configure(values, self.placement.mount)
        self.aids = Aids(self.values, self.navigator, self.inputs, self.placement)
        parts = self.inputs, self._review, self.reporter, self.clock, self.noise, self.aids
        self.status = EstimatorStatus(self.values, self.navigator, *parts)
        self._restart(self.clock.forget)
        if values["datum"]:
            self.set_datum(conversions.lla_from_degrees(*values["datum"]), 1)

    def set_datum(self, lla: Array, t_ns: int) -> None:
        """Give the map its origin: latitude, longitude [rad], height [m], shape (3,)."""
        self.odometry.map = MapFrame(lla)
        self.reporter.report_datum(t_ns, lla)

    @property
    def aligned(self) -> bool:
        """The filter runs and odometry is valid."""
        return self.odometry.map is not None and self.navigator.filter is not None

    def pop_reports(self) -> Sequence[Report]:
        """Return what is to be published since the last call."""
        return self.reporter.pop()

    # Control.

    def change(self, changes: Mapping[str, Any]) -> None:
        """Use checked values of run-time parameters without losing the state."""
        self.values.update(changes)
        for name, value in changes.items():
            self.inputs.log("info", f"parameter {name} is {shortened(str(value))} from now on")
        self._parts.change(changes)
        self.clock.change(changes)
        self._fixes.configure(changes)
        self.reporter.set_odometry_rate(self.values["odometry_rate"])
        if any(name.startswith("noise.") for name in changes):
            self.noise.configure(self.values, self.placement.mount)

    def reset(self) -> None:
        """Discard the state and align anew; the map stays where it is."""
        self.inputs.log("info", "reset: aligning anew")
        self.navigator.reset()
        self._restart(self.clock.forget)

    def _restart(self, restart_clock: Callable[[], None]) -> None:
        """Restart everything that reports, as the navigator did."""
        for part in (self.odometry, self.reporter, self.noise, self.aids):
            part.restart()
        restart_clock()
        self._fixes.configure()
        self.due_ns, self._report_ns = 1, 0  # everything at the next sample

    def handle_initial_pose(self, message: Message) -> None:
        """Use a heading by hand, a geometry_msgs/PoseWithCovarianceStamped; aligns anew."""
        yaw = initial_yaw(message, self.values["map_frame"])
        if isinstance(yaw, Refused):
            self.inputs.count_and_warn("initialpose", yaw)
            return
        self.inputs.log("info", f"initialpose: {wording.describe_heading(*yaw)}: aligning anew")
        self.navigator.realign().set_yaw(self.navigator.last_ns, *yaw)
        self._restart(self.clock.keep)

    def handle_static_transforms(self, message: Message) -> None:
        """Use a tf2_msgs/TFMessage of /tf_static."""
        if self.placement.add_transforms(message):
            self._on_moved_sensors()

    def _admits_frame(self, topic: str, frame: str, t_ns: int) -> bool:
        """Use the frame_id of a message that is of use; False: that is refused for it."""
        admitted = self.placement.admits(topic, frame, t_ns)
        if admitted and self.placement.set_frame(topic, frame):
            self._on_moved_sensors()
        return admitted

    def _on_moved_sensors(self) -> None:
        self._fixes.configure()
        self._review.axes.restart()
        self.noise.set_mount(self.placement.mount)
        self.aids.configure(self.placement)
        if self.navigator.ring.count:
            if self.aligned:
                self.inputs.count_and_warn("placement", SENSOR_MOVED)
            _align_moved(self.navigator, self.values)
            self._restart(self.clock.forget)

    # IMU.

    def handle_imu(self, imu: ImuFields, received_ns: int | None = None) -> Odometry | None:
        """
        Use an Imu message; returns the odometry after it, if there is any.

        ``received_ns`` replaces the stamp where it is given: the owner knows ``use_receive_time``.
        `run_periodic` is due once the odometry is published. See `imu_block` for many at once.
        """
        navigator, placement = self.navigator, self.placement
        t_ns = imu.stamp_ns if received_ns is None else received_ns
        refused = self.admission.refused(imu, t_ns)
        if refused is not None:
            self.inputs.count_and_warn("imu/data", refused)
            return None
        is_settled = placement.is_settled("imu/data", imu.frame_id)
        if not is_settled and not self._admits_frame("imu/data", imu.frame_id, t_ns):
            return None
        if self.values["alignment.heading_source"] == "imu" and navigator.alignment is not None:
            _observe_orientation(navigator.alignment, imu, placement.mount)
        force, rate = imu.specific_force, imu.angular_rate
        fault = navigator.imu(t_ns, *placement.to_body(*force), *placement.to_body(*rate))
        if fault is not None:
            self.inputs.count_and_warn("imu/data", STAMP_FAULTS[fault])
            return None
        running = navigator.filter
        if running is None or self.odometry.map is None:
            return None
        rate_variance = running.noise.levels()[3:]
        odometry = self.odometry.make(t_ns, running.nav, placement.arm_b, rate_variance)
        if odometry is None:
            navigator.give_up(RestartCause.NOT_FINITE)
        return odometry

    # GNSS.

    def handle_fix(self, message: Message, received_ns: int | None = None) -> None:
        """Use a sensor_msgs/NavSatFix."""
        fix, frame = self._fixes.position(message, received_ns), message.header.frame_id
        if not isinstance(fix, Refused) and not self.placement.is_settled("gnss/fix", frame):
            if not self._admits_frame("gnss/fix", frame, fix.t_ns):
                return
            fix = self._fixes.position(message, received_ns)  # the antenna may be elsewhere
        if not isinstance(fix, Refused) and self.odometry.map is None:
            self.set_datum(np.nan_to_num(fix.lla), fix.t_ns)
        self._review.on_fix(message, fix)
        self._measure("gnss/fix", fix)

    def handle_velocity(self, message: Message, received_ns: int | None = None) -> None:
        """Use a geometry_msgs/TwistWithCovarianceStamped with ENU components."""
        self._measure("gnss/velocity", self._fixes.velocity(message, received_ns))

    def _measure(self, topic: str, measurement: Measurement | Refused) -> None:
        if not isinstance(measurement, Refused):
            measurement = self._fixes.admit(topic, measurement)
        if isinstance(measurement, Refused):
            self.inputs.count_and_warn(topic, measurement)
            return
        self._review.axes.observe(measurement)
        self.navigator.measure(measurement)
        self._handle_notices()
        self.clock.run_periodic(self._review.axes.are_plausible)
        self._fixes.follow()

    # What happens, and what is due.

    def run_periodic(self) -> None:
        """Do what is not done with every sample; call it after each, once that is published."""
        t_ns = self.navigator.last_ns
        if t_ns < self.due_ns and not self.navigator.has_notices:
            self.navigator.phases.advance_search()
            return
        self._handle_notices()
        self.noise.run_periodic(t_ns)
        if t_ns >= self._report_ns:
            self._report_ns = t_ns + REPORT_NS
            self.reporter.add(self.aids.run_periodic(t_ns))
            self.navigator.check_imu()
            if self._review.run_periodic():
                self._on_moved_sensors()
            self._fixes.follow()  # filters of a search that begins know where the antenna is
            self.navigator.continue_search()
            self._handle_notices()
            self.reporter.report_state(t_ns, self.placement.arm_b)
            if self.reporter.is_diagnostics_due(t_ns):
                self.reporter.report_diagnostics(t_ns, self.status.diagnostics(t_ns))
                self._review.note_second()
        self.due_ns = min(self._report_ns, self.noise.next_ns)

    def _handle_notices(self) -> None:
        for notice in self.navigator.pop_notices():
            self.on_notice(notice)

    def on_notice(self, notice: Notice) -> None:
        """Report what happened in the navigator, and follow it."""
        self.reporter.on_notice(notice)
        self._review.on_notice(notice)
        self.aids.on_notice(notice)
        if isinstance(notice, Verdict):
            self.clock.on_verdict(notice)
        elif isinstance(notice, Restarted):
            self._restart(self.clock.keep if notice.cause in KEEP_CLOCK else self.clock.forget)
        elif isinstance(notice, HeadingCorrected) and self.navigator.filter is None:
            self._restart(self.clock.distrust)
        elif isinstance(notice, ClockOffsetFound):
            self.clock.on_found(notice)
            self._fixes.configure()


def _observe_orientation(alignment: Alignment, imu: ImuFields, mount: Array) -> None:
    """Give the heading of the IMU's own orientation to the alignment; some have none."""
    if imu.orientation_cov0 != -1.0:
        yaw = conversions.imu_yaw(imu.orientation_xyzw, mount)
        if yaw is not None:
            alignment.observe_yaw(yaw)


def _align_moved(navigator: Navigator, values: Mapping[str, Any]) -> None:
    """Align anew with other places of the sensors, by alignment.yaw only if it still holds."""
    running, has_turned = navigator.filter, False
    if running is not None:
        turn = heading_from_quat(running.nav[QUAT]) - yaw_ned_from_enu(values["alignment.yaw"])
        sigma = math.hypot(values["alignment.yaw_std"], float(total_std(running.nav)[EPS][2]))
        has_turned = abs(math.remainder(turn, math.tau)) > 3.0 * sigma
    navigator.reset()
    if has_turned and navigator.alignment is not None:
        navigator.alignment.forget_parameter()
