"""
From the first IMU sample to a running filter, and back when the IMU stops.

A navigator admits samples and measurements, checks the IMU, and decides when to restart. Its
`PhaseMachine` runs the filters: `Aligning` waits for a first state, `Searching` runs one filter per
possible heading, `Running` has one filter, and may run others beside it to find the clock offset of
the fixes. What happened comes out of one queue, `Navigator.pop_notices`.
"""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.alignment.alignment import Alignment, AlignmentSettings
from hybrid_ins.core.filter.ins_filter import InsFilter
from hybrid_ins.core.fix_checks.frozen_height import FrozenHeightCheck
from hybrid_ins.core.imu.samples import ImuRing
from hybrid_ins.core.navigator.imu_monitor import ImuMonitor
from hybrid_ins.core.navigator.notices import (
    FaultFound,
    GapBridged,
    Notice,
    RestartCause,
    Restarted,
    TurnedOnTheSpot,
)
from hybrid_ins.core.navigator.phase_machine import PhaseMachine
from hybrid_ins.core.navigator.phases import Aligning, FilterParts, Phase, Searching, speed
from hybrid_ins.core.navigator.restart import ResetCount, UnseenTurn, heading_after
from hybrid_ins.core.navigator.set_back import SetBackWatch
from hybrid_ins.core.navigator.stamp_check import ImuStampCheck, MeasurementCheck, StampFault
from hybrid_ins.core.smoothing.forward_record import RunRecord
from hybrid_ins.core.update.gate import Verdict
from hybrid_ins.core.update.measurements import ASSUMED, GNSS, IMU, Measurement

Array = NDArray[np.float64]

ATTEMPT_NS = 100_000_000  # between two attempts to align
STATE_WAS_WRONG = (
    RestartCause.NOT_FINITE,
    RestartCause.REPEATED_RESETS,
    RestartCause.VELOCITIES_WRONG,
)
"""What makes a state useless, and what it has shown of the antenna."""
IMU_WAS_WRONG = (RestartCause.IMU_UNUSABLE, RestartCause.TURN_UNMEASURED)


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
    phases : PhaseMachine
        The filters, and the phase that they are in.
    """

    def __init__(
        self,
        alignment: AlignmentSettings,
        parts: FilterParts,
        max_gap: float,
        zero_updates: bool = True,
        record: RunRecord | None = None,
    ) -> None:
        self.ring, self.stamps = ImuRing(), ImuStampCheck(max_gap)
        self.monitor = ImuMonitor(parts, zero_updates, alignment.bias_g)
        self._notices: deque[Notice] = deque()
        self.phases = PhaseMachine(parts, self.ring, self.stamps, self._notices, record)
        self._set_back = SetBackWatch(self.ring, self.phases, self._notices.append)
        self._alignment_settings, self._record = alignment, record
        self._heights = FrozenHeightCheck(self._notices.append)
        self._measurements = MeasurementCheck(parts.speed_check)
        self.reset()

    # Phases.

    def reset(self) -> None:
        """Discard everything, and align again."""
        self.monitor.discard_biases()
        self.phases.kept.discard_antenna()
        self._discard_samples()

    def realign(self) -> Alignment:
        """Give up the state, but not the samples; return the alignment that begins."""
        self.monitor.reset()
        self._attempt_ns, self._unseen_turn, self._resets = 0, UnseenTurn(), ResetCount()
        alignment = Alignment(self._alignment_settings, self.ring)
        if self.monitor.biases is not None:
            alignment.remember(self.monitor.biases)
        self.phases.align(alignment)
        return alignment

    def give_up(self, cause: RestartCause, seconds: float = 0.0) -> None:
        """Give up the state for a cause, see `Restarted`, and align again."""
        fault = self.monitor.fault if cause in IMU_WAS_WRONG else None
        self._notices.append(Restarted(cause, seconds, fault))
        if cause in STATE_WAS_WRONG:
            self.phases.kept.discard_antenna()
        self.realign().forget_parameter()
        self.monitor.fault = fault

    def _discard_samples(self) -> Alignment:
        self.ring.clear()
        self.stamps.reset()
        self._measurements.reset()
        return self.realign()

    @property
    def phase(self) -> Phase:
        """Where between no state and one filter it is."""
        return self.phases.phase

    @property
    def alignment(self) -> Alignment | None:
        """The alignment while aligning: it accepts headings."""
        return self.phase.alignment if isinstance(self.phase, Aligning) else None

    @property
    def filter(self) -> InsFilter | None:
        """The filter while running."""
        return self.phases.filter

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
            if (fault := stamps.check(t_ns)) is not None:
                self._set_back.observe(t_ns, (fx, fy, fz, wx, wy, wz))
                return fault
            self._on_odd_step(t_ns, np.array((fx, fy, fz, wx, wy, wz)))
        stamps.last_ns = t_ns
        self.ring.push(t_ns, fx, fy, fz, wx, wy, wz)
        if self._record is not None:
            self._record.sample(t_ns, fx, fy, fz, wx, wy, wz)
        running = self.phases.filter
        if running is not None:
            running.predict(t_ns, fx, fy, fz, wx, wy, wz)
            if running.verdicts:
                self.phases.collect_verdicts(running)
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
        self.phases.predict_block(samples, rows)

    def _on_odd_step(self, t_ns: int, reading: Array) -> None:
        """Bridge a gap before a sample, or restart with a new time base."""
        if self.stamps.last_ns == 0:
            return
        step_ns = t_ns - self.stamps.last_ns
        seconds = abs(step_ns) * 1e-9
        if 0 < step_ns <= self.stamps.max_gap_ns:
            self._notices.append(GapBridged(seconds))
            self._unseen_turn.observe(self.filter, reading, seconds)
        elif step_ns < 0:
            self._notices.append(Restarted(RestartCause.STAMPS_WENT_BACK, seconds))
            self.monitor.discard_biases()
            alignment = self._discard_samples()
            if not self.stamps.begin_anew(t_ns):
                alignment.forget_parameter()
        else:
            kept = heading_after(seconds, self.filter, self.monitor.standing)
            self._notices.append(Restarted(RestartCause.NO_SAMPLES, seconds))
            (alignment := self._discard_samples()).forget_parameter()
            if kept is not None:
                alignment.set_yaw(t_ns, *kept)

    # From no state to one filter.

    def _attempt(self, t_ns: int) -> None:
        """Try to get from the samples and fixes so far to a filter."""
        self._attempt_ns = t_ns + ATTEMPT_NS
        if isinstance(self.phase, Aligning):
            self.phases.try_to_align()
            return
        self.phases.follow_imu(t_ns)
        if isinstance(self.phase, Searching) and self.phase.bank.is_misled:
            self._notices.append(TurnedOnTheSpot())
            self.realign().forget_parameter()
        self.check_imu()
        self.phases.include_clock(self.monitor.may_stand, self.monitor.calm)
        if isinstance(self.phase, Searching) and self.phases.decide():
            self._measurements.forget_stamps()

    def open_clock(self, unknown: bool) -> None:
        """Treat the clock offset of the fixes as unknown, or as known; it may have changed."""
        if self.phases.open_clock(unknown):
            self.realign()

    def continue_search(self) -> None:
        """Check a given heading, search for the clock offset; due some times a second."""
        self.phases.include_clock(self.monitor.may_stand, self.monitor.calm)
        if self.phases.continue_search(self.last_ns):
            self._measurements.forget_stamps()

    # Measurements, and what they show.

    def measure(self, measurement: Measurement) -> None:
        """Use an aiding measurement; its verdict appears among the notices."""
        measurement = self._heights.checked(measurement)
        refused = self._measurements.check(measurement, self.stamps, speed(self.phase))
        if refused is None and (gap := self._unseen_turn.pop(measurement, self.filter)):
            self.give_up(RestartCause.NO_SAMPLES, gap)
        if self._measurements.was_misled and isinstance(self.phase, Searching):
            self.give_up(RestartCause.FIXES_REPEATED)
        if self._measurements.contradiction is not None:
            self._notices.append(self._measurements.contradiction)
            if not isinstance(self.phase, Aligning):
                self.give_up(RestartCause.VELOCITIES_WRONG)
        if refused is None and not self.phases.measure(measurement):
            if self.alignment is not None:
                self.alignment.observe(measurement)
            refused = Verdict.rejected(measurement, "aligning")
        if refused is not None:
            self._notices.append(refused)

    def check_imu(self) -> None:
        """Check the health of the IMU and whether the vehicle stands, where that is due."""
        before, motion = self.monitor.fault, self._measurements.motion
        if not self.monitor.check(self.phases, self.ring, self.last_ns, motion):
            return
        if (fault := self.monitor.fault) is not None and fault != before:
            self._notices.append(FaultFound(fault))
        if self.monitor.restart_cause is not None:
            self.give_up(self.monitor.restart_cause)

    def pop_notices(self) -> list[Notice]:
        """Return what happened since the last call, in order."""
        notices: list[Notice] = []
        while self._notices:
            notice = self._notices.popleft()
            sensor = notice.measurement.sensor if isinstance(notice, Verdict) else None
            if isinstance(notice, Verdict) and sensor == GNSS:
                self._on_verdict(notice)
            if sensor not in (IMU, ASSUMED):
                notices.append(notice)
        return notices

    @property
    def has_notices(self) -> bool:
        """Return whether anything happened since `pop_notices`."""
        return bool(self._notices)

    def _on_verdict(self, verdict: Verdict) -> None:
        """Restart where a covariance reset does not help: the heading is wrong, or all of them."""
        self.monitor.on_verdict(verdict)
        if not verdict.inflated:
            return
        if isinstance(self.phase, Searching):
            self.give_up(RestartCause.FIXES_JUMPED)
        elif self.filter is not None and self._resets.add(verdict, speed(self.phase)):
            self.monitor.discard_biases()
            self.give_up(RestartCause.REPEATED_RESETS)
