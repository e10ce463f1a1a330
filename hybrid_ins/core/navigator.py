"""
From the first IMU sample to a running filter, and back when the IMU stops.

A navigator is in one of three phases: `Aligning` waits for a first state, `Searching` runs one
filter per possible heading, `Running` has one filter, and may run others beside it to find the
clock offset of the fixes. What happens comes out of one queue, `Navigator.pop_events`.
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.alignment import Alignment, AlignmentSettings, Biases, yaw_of
from hybrid_ins.core.events import Change, CovarianceInflation
from hybrid_ins.core.forward_record import RunRecord
from hybrid_ins.core.gate import Verdict
from hybrid_ins.core.imu_monitor import ImuMonitor, error_std_after
from hybrid_ins.core.ins_filter import InsFilter
from hybrid_ins.core.measurements import GNSS, IMU, Measurement, PositionFix, Standstill
from hybrid_ins.core.multiple_model import MultipleModelBank
from hybrid_ins.core.navigator_events import (
    Event,
    FaultFound,
    GapBridged,
    RestartCause,
    Restarted,
)
from hybrid_ins.core.phase_machine import PhaseMachine
from hybrid_ins.core.phases import Aligning, FilterParts, Phase, Searching
from hybrid_ins.core.samples import ImuRing
from hybrid_ins.core.stamp_check import ImuStampCheck, MeasurementCheck, StampFault
from hybrid_ins.core.standstill import FixMotion
from hybrid_ins.core.state import VELOCITY

Array = NDArray[np.float64]

ATTEMPT_NS = 100_000_000  # between two attempts to align
TURN_IN_GAP = 0.5  # rad/s, that a vehicle may have turned by in a gap
HEADING_KEPT_STD = 0.35  # rad; a heading less certain than that is not kept over a gap
BIASES_KEPT = 6  # checks: the estimate that is kept is older than a fault's discovery
RESETS, RESETS_NS = 3, 30_000_000_000  # that many within that time: the heading is wrong


class Navigator:
    """
    Aligns, then filters; restarts after a gap or on request.

    Parameters
    ----------
    alignment : AlignmentSettings
        See there.
    parts : FilterParts
        Builds what a filter is made of.
    max_gap : float
        Longest pause between IMU samples that dead reckoning bridges [s].
    zero_updates : bool
        Use standing as a measurement.
    record : RunRecord, optional
        Filled for a smoother; the filters' settings must ask for records, too.

    Attributes
    ----------
    ring : ImuRing
        Recent IMU samples.
    stamps : ImuStampCheck
        Where the IMU is, and which steps of its stamps need no check.
    monitor : ImuMonitor
        Faults of the IMU and standing, at the last check.
    """

    def __init__(
        self,
        alignment: AlignmentSettings,
        parts: FilterParts,
        max_gap: float,
        zero_updates: bool = True,
        record: RunRecord | None = None,
    ) -> None:
        self.ring = ImuRing()
        self.stamps = ImuStampCheck(max_gap)
        self.monitor = ImuMonitor()
        self._events: deque[Event] = deque()
        self._machine = PhaseMachine(parts, self.ring, self.stamps, self._events, record)
        self._alignment_settings = alignment
        self._zero_updates = zero_updates
        self._record = record
        self._measurements = MeasurementCheck()
        self._fix_motion = FixMotion()
        self.reset()

    # Phases.

    def reset(self) -> None:
        """Discard everything, and align again."""
        self._biases: deque[Biases] = deque(maxlen=BIASES_KEPT)
        self._discard_samples()

    def realign(self) -> None:
        """Give up the state, but not the samples, and align again."""
        self.monitor.reset()
        self._attempt_ns = 0
        self._resets: deque[int] = deque(maxlen=RESETS)
        alignment = Alignment(self._alignment_settings, self.ring)
        if self._biases:
            alignment.remember(self._biases[0])
        self._machine.align(alignment)

    def give_up(self, cause: RestartCause) -> None:
        """Give up the state for a cause, and align again."""
        fault = self.monitor.fault if cause is RestartCause.IMU_UNUSABLE else None
        self._events.append(Restarted(cause, fault=fault))
        self.realign()
        self.monitor.fault = fault
        self._forget_given_heading()

    def _discard_samples(self) -> None:
        self.ring.clear()
        self.stamps.reset()
        self._measurements.reset()
        self._fix_motion = FixMotion()
        self.realign()

    def _forget_given_heading(self) -> None:
        if isinstance(self.phase, Aligning):
            self.phase.alignment.forget_parameter()

    @property
    def phase(self) -> Phase:
        """Where between no state and one filter it is."""
        return self._machine.phase

    @property
    def filter(self) -> InsFilter | None:
        """The filter while running."""
        return self._machine.filter

    @property
    def clock_open(self) -> bool:
        """The clock offset of the fixes is to be found: from `open_clock` on until it is."""
        return self._machine.clock_open

    @property
    def bank(self) -> MultipleModelBank | None:
        """The filters of several hypotheses: of the heading, or of the clock offset."""
        return self.phase.bank

    @property
    def best(self) -> InsFilter | None:
        """The filter, or the likeliest while searching: its position is good already."""
        return self.phase.best

    @property
    def filters(self) -> list[InsFilter]:
        """All filters that run."""
        return self._machine.filters

    @property
    def last_ns(self) -> int:
        """Stamp of the last IMU sample [ns]; 0 before the first."""
        return self.stamps.last_ns

    # IMU samples.

    def imu(
        self, t_ns: int, fx: float, fy: float, fz: float, wx: float, wy: float, wz: float
    ) -> StampFault | None:
        """
        Use a sample: stamp [ns], specific force [m/s²], angular rate [rad/s], b frame.

        Returns why its stamp makes it useless, or None.
        """
        stamps = self.stamps
        if not 0 < t_ns - stamps.last_ns <= stamps.steady_ns:
            fault = stamps.check(t_ns)
            if fault is not None:
                return fault
            self._on_odd_step(t_ns)
        stamps.last_ns = t_ns
        self.ring.push(t_ns, fx, fy, fz, wx, wy, wz)
        if self._record is not None:
            self._record.sample(t_ns, fx, fy, fz, wx, wy, wz)
        running = self._machine.filter
        if running is not None:
            running.predict(t_ns, fx, fy, fz, wx, wy, wz)
            if running.verdicts:
                self._machine.collect_verdicts(running)
        elif t_ns >= self._attempt_ns:
            self._attempt(t_ns)
        return None

    def imu_block(self, samples: NDArray[np.void], rows: Array) -> None:
        """
        Use samples that follow each other within ``stamps.steady_ns``, as `imu` would.

        ``rows``, shape (N, N_NAV), receives the flat state after each sample. The phase must be
        `Running`.
        """
        self.ring.extend(samples)
        if self._record is not None:
            self._record.block(samples)
        self.stamps.last_ns = int(samples["t_ns"][-1])
        self._machine.predict_block(samples, rows)

    def _on_odd_step(self, t_ns: int) -> None:
        """Bridge a gap before a sample, or restart with a new time base."""
        if self.stamps.last_ns == 0:
            return
        step_ns = t_ns - self.stamps.last_ns
        seconds = abs(step_ns) * 1e-9
        if 0 < step_ns <= self.stamps.max_gap_ns:
            self._events.append(GapBridged(seconds))
        elif step_ns < 0:
            self._events.append(Restarted(RestartCause.STAMPS_WENT_BACK, seconds))
            self._biases.clear()
            self._discard_samples()
        else:
            self._events.append(Restarted(RestartCause.NO_SAMPLES, seconds))
            kept = _heading_after(seconds, self.filter, self.monitor.standing)
            self._discard_samples()
            self._forget_given_heading()
            if kept is not None:
                self.set_yaw(t_ns, *kept)

    # Headings for the start.

    def set_yaw(self, t_ns: int, yaw: float, std: float) -> None:
        """While aligning, use a heading [rad from north] that was true at a stamp [ns]."""
        if isinstance(self.phase, Aligning):
            self.phase.alignment.set_yaw(t_ns, yaw, std)

    def observe_yaw(self, yaw: float) -> None:
        """While aligning, use the heading [rad from north] of the IMU's own orientation."""
        if isinstance(self.phase, Aligning):
            self.phase.alignment.observe_yaw(yaw)

    # From no state to one filter.

    def _attempt(self, t_ns: int) -> None:
        """Try to get from the samples and fixes so far to a filter."""
        self._attempt_ns = t_ns + ATTEMPT_NS
        if isinstance(self.phase, Aligning):
            self._machine.try_to_align()
            return
        self._machine.follow_imu(t_ns)
        self.check_imu()
        if not self.monitor.standing:
            for measurement in self._machine.include_clock():
                self._measure(measurement)
        if isinstance(self.phase, Searching) and self._machine.decide():
            self._measurements.forget_stamps()

    def open_clock(self, unknown: bool) -> None:
        """Treat the clock offset of the fixes as unknown, or as known; it may have changed."""
        if self._machine.open_clock(unknown):
            self.realign()

    def find_clock(self) -> None:
        """Continue the search for the clock offset beside the filter; due some times a second."""
        if self._machine.find_clock(self.last_ns):
            self._measurements.forget_stamps()

    # Measurements, and what they show.

    def measure(self, measurement: Measurement) -> None:
        """Use an aiding measurement; its verdict appears among the events."""
        speed = 0.0 if self.filter is None else float(np.linalg.norm(self.filter.nav[VELOCITY]))
        reason = self._measurements.check(measurement, self.stamps, speed)
        if reason == "stamped ahead of the IMU":
            age = (self.last_ns - measurement.t_ns) * 1e-9
            self._events.append(Verdict.rejected(measurement, reason, age))
        elif reason:
            self._events.append(Verdict.rejected(measurement, reason))
        else:
            if isinstance(measurement, PositionFix):
                self._fix_motion.observe(measurement.t_ns, measurement.lla)
            self._measure(measurement)

    def _measure(self, measurement: Measurement) -> None:
        if not self._machine.measure(measurement):
            if isinstance(self.phase, Aligning):
                self.phase.alignment.observe(measurement)
            self._events.append(Verdict.rejected(measurement, "aligning"))

    def submit(self, event: Change) -> None:
        """Change the noise or the covariance of all filters, see `InsFilter.submit`."""
        self._machine.submit(event)

    def check_imu(self) -> None:
        """Check the health of the IMU and whether the vehicle stands, where that is due."""
        running, t_ns, monitor = self.best, self.last_ns, self.monitor
        if running is None or not monitor.is_due(t_ns):
            return
        before = monitor.fault
        for fault in monitor.check_fault(self.ring, t_ns, self.filter is not None):
            std = error_std_after(fault)
            if std is not None:
                self.submit(CovarianceInflation(t_ns, std))
        fault_now = monitor.fault
        if fault_now is not None and fault_now.unusable:
            self.give_up(RestartCause.IMU_UNUSABLE)
        if fault_now is not None and fault_now != before:
            self._events.append(FaultFound(fault_now))
        if fault_now is not None and fault_now.unusable:
            return
        if self.filter is not None and fault_now is None and not monitor.falling:
            self._biases.append(Biases.of(self.filter.state, t_ns))
        samples = monitor.check_standing(t_ns, running, self._fix_motion.speed > 0.0)
        if samples is not None and self._zero_updates:
            self._machine.measure(Standstill.of(samples))

    def pop_events(self) -> list[Event]:
        """Return what happened since the last call, in order."""
        events: list[Event] = []
        while self._events:
            event = self._events.popleft()
            if isinstance(event, Verdict):
                if event.measurement.sensor == IMU:
                    continue
                if event.measurement.sensor == GNSS:
                    self._on_verdict(event)
            events.append(event)
        return events

    @property
    def has_events(self) -> bool:
        """Return whether anything happened since `pop_events`."""
        return bool(self._events)

    def _on_verdict(self, verdict: Verdict) -> None:
        """Restart after repeated covariance resets: the heading is wrong."""
        self.monitor.on_verdict(verdict)
        if not verdict.inflated or self.filter is None:
            return
        t_ns = verdict.measurement.t_ns
        self._resets.append(t_ns)
        speed = float(np.linalg.norm(self.filter.nav[VELOCITY]))
        if len(self._resets) == RESETS and t_ns - self._resets[0] < RESETS_NS and speed > 1.0:
            self._biases.clear()
            self.give_up(RestartCause.REPEATED_RESETS)


def _heading_after(
    gap: float, running: InsFilter | None, standing: bool
) -> tuple[float, float] | None:
    """Heading and its uncertainty [rad] after seconds without samples, if still of use."""
    if running is None:
        return None
    state = running.state
    rate = 0.1 * TURN_IN_GAP if standing else TURN_IN_GAP
    std = math.hypot(math.sqrt(state.P[8, 8]), rate * gap)
    return (yaw_of(state.quat_xyzw), std) if std < HEADING_KEPT_STD else None
