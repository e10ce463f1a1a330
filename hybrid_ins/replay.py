"""
A recording through the node's estimator, without middleware and at file speed.

Messages are handled in the order in which they were recorded, IMU samples in blocks between the
others; the same recording and parameters give the same bytes.
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybrid_ins import kernels, parameters, progress
from hybrid_ins.bags.messages import TRUTH, Message, new_message
from hybrid_ins.bags.reader import BagReader, InputTopics, has_optional, received, velocities_topic
from hybrid_ins.bags.writer import BagWriter
from hybrid_ins.core.smoothing.forward_record import RunRecord
from hybrid_ins.errors import InputError
from hybrid_ins.ros.aids import aiding_sources
from hybrid_ins.ros.estimator.estimator import Estimator
from hybrid_ins.ros.estimator.gps_fix_input import GpsFixInput
from hybrid_ins.ros.estimator.imu_admission import NO_READING
from hybrid_ins.ros.estimator.imu_block import handle_imu_block
from hybrid_ins.ros.messages.cdr import OdometryEncoder
from hybrid_ins.ros.messages.type_names import FIX, GPS_FIX, POSE, TRANSFORMS
from hybrid_ins.ros.output.message_types import OUTPUTS, encode
from hybrid_ins.ros.output.rate_limiter import RateLimiter
from hybrid_ins.ros.reporting.input_log import Log
from hybrid_ins.ros.reporting.reports import Report
from hybrid_ins.row_file import BlockFile, ObjectFile, RowFile

SMOOTHED = ("odometry", "gnss/filtered", "imu/bias", "q/accelerometer", "q/gyroscope")
VERDICT = "gnss/verdict"
MESSAGES_AT_A_TIME = 256  # odometry messages that are written at a time

_LEVELS = {"info": logging.INFO, "warn": logging.WARNING, "error": logging.ERROR}
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Replayed:
    """The result of a replay."""

    estimator: Estimator  # in its last state
    duration: float  # s, of the recording


def replay_bag(
    source: Path,
    target: Path,
    values: Mapping[str, Any],
    topics: InputTopics,
    *,
    overwrite: bool = False,
    keep_partial: bool = True,
    smooth: bool = False,
    log: Log | None = None,
) -> Replayed:
    """
    Run an estimator over the bag `source` and write the bag `target`.

    Parameters
    ----------
    source, target : Path
        See `BagReader` and `BagWriter`.
    values : mapping
        Checked parameters.
    topics : InputTopics
        Where the input is.
    overwrite, keep_partial : bool
        See `BagWriter`. Nothing is kept of a smoothed run, which has no estimate before its end.
    smooth, log
        See `replay`.

    Raises
    ------
    InputError
        A bag cannot be read or written, a topic is missing, or the filter never started, also for
        axes or units of the IMU that are wrong: nothing is written then.

    """
    keep = keep_partial and not smooth
    with (
        BagReader(source) as bag,
        BagWriter(target, overwrite, inputs=[source], keep_partial=keep) as out,
    ):
        estimator = replay(bag, out, values, **topics, smooth=smooth, log=log)
        reporter, waiting = estimator.reporter, estimator.status.waiting_for
        # The position of a vehicle that stands is of use; that by a wrong IMU is not.
        needs_heading = smooth or estimator.status.fault is not None
        if not (reporter.ever_aligned if needs_heading else reporter.ever_located):
            out.discard()
            raise InputError(
                f"{source}: the filter never started: it waited for {waiting}; "
                f"{target} is not written"
            )
        if not reporter.ever_aligned:
            (log or log_message)(
                "warn",
                f"{source}: the heading was never known: it needs {waiting}; /odometry holds "
                "positions at 10 Hz, /odometry/local nothing",
            )
        return Replayed(estimator, (bag.end_ns - bag.start_ns) * 1e-9)


def replay(
    bag: BagReader,
    out: BagWriter,
    values: Mapping[str, Any],
    *,
    imu_topic: str = "/imu/data",
    fix_topic: str = "/gnss/fix",
    velocity_topic: str = "/gnss/velocity",
    smooth: bool = False,
    log: Log | None = None,
) -> Estimator:
    """
    Run an estimator over a recording and write what it publishes.

    Parameters
    ----------
    bag, out : BagReader, BagWriter
        Input; output, on the node's topic names, with the fixes and any truth carried over.
    values : mapping
        Checked parameters.
    imu_topic, fix_topic, velocity_topic : str
        Where the input is.
    smooth : bool
        Write smoothed states in place of filtered ones: each uses all measurements before and
        after it. Verdicts and diagnostics remain those of the filter.
    log : callable, optional
        Called with the level and the text of the estimator's messages; by default they are
        logged.

    Returns
    -------
    Estimator
        In its last state.

    Raises
    ------
    InputError
        A topic is missing or of another type.
    """
    record = RunRecord(partial(BlockFile, out.folder)) if smooth else None
    topics = imu_topic, fix_topic, velocity_topic
    run = _Replay(bag, out, values, *topics, log or log_message, record)
    estimator = run.filter()
    if record is not None and estimator.reporter.ever_aligned:
        run.smooth(record)
    return estimator


class _Replay:
    """One pass of a recording through an estimator."""

    def __init__(
        self,
        bag: BagReader,
        out: BagWriter,
        values: Mapping[str, Any],
        imu_topic: str,
        fix_topic: str,
        velocity_topic: str,
        log: Log,
        record: RunRecord | None,
    ) -> None:
        self._values, self._log, self._is_filtered = values, log, record is None
        self._bag, self._out = bag, out
        self._verdicts = ObjectFile(out.folder)  # (log time [ns], Report): for the smoother
        self._imu = imu = bag.imu(imu_topic, make_blocks=partial(BlockFile, out.folder))
        self._frames, self._frame = deque(imu.frames), ""
        fix_topic = bag.require(fix_topic, FIX, "--fix-topic")
        kernels.prepare(partial(log, "info"), (kernels.SMOOTHING,) if record is not None else ())
        self._estimator = estimator = Estimator(values, log, record)
        rows = slice(None) if imu.has_reading.all() else imu.has_reading
        estimator.noise.preload(
            self._stamps_ns[rows], imu.specific_force[rows], imu.angular_rate[rows]
        )
        self._odometry = [
            _OdometryWriter(out, values, topic, values[frame])
            for topic, frame in (("/odometry", "map_frame"), ("/odometry/local", "odom_frame"))
        ]
        self._handlers: dict[str, Callable[[Message, int], None]] = {}  # given the log time [ns]
        self._carried = {topic: topic for topic in bag.topics if topic.startswith(TRUTH)}
        if bag.topics[fix_topic] == GPS_FIX:
            self._gps_fix = GpsFixInput(estimator, new_message)
            self._handlers[fix_topic] = self._handle_gps_fix
        else:
            self._handlers[fix_topic] = partial(self._measure, estimator.handle_fix)
            self._carried[fix_topic] = "/gnss/fix"
        velocity_topic = velocities_topic(bag, velocity_topic)
        if velocity_topic:
            self._handlers[velocity_topic] = partial(self._measure, estimator.handle_velocity)
            self._carried[velocity_topic] = "/gnss/velocity"
        for name, kind in aiding_sources.TOPICS.items():
            if has_optional(bag, f"/{name}", kind):
                use = partial(estimator.aids.sources.handle, name)
                self._handlers[f"/{name}"] = partial(self._measure, use)
        if has_optional(bag, "/initialpose", POSE):
            self._handlers["/initialpose"] = lambda message, _: estimator.handle_initial_pose(
                message
            )
        if has_optional(bag, "/tf_static", TRANSFORMS):
            handle = estimator.handle_static_transforms
            self._handlers["/tf_static"] = lambda message, _: handle(message)

    @property
    def _stamps_ns(self) -> NDArray[np.int64]:
        return self._imu.times_ns(self._values)

    def filter(self) -> Estimator:
        """Handle every message in the order of the recording."""
        start = 0
        with progress.bar("replay", len(self._imu.log_ns), "sample", unit_scale=True) as bar:
            for topic, log_ns, data in self._bag.raw(*self._handlers, *self._carried):
                if topic in self._handlers:
                    stop = int(self._imu.log_ns.searchsorted(log_ns, side="right"))
                    self._handle_imu(start, max(start, stop))
                    bar.update(max(start, stop) - start)
                    start = max(start, stop)
                    message = self._bag.decode(topic, log_ns, data)
                    if message is None:
                        continue  # nor is it carried over
                    self._handlers[topic](message, log_ns)
                    self._write_reports(log_ns)
                if topic in self._carried:
                    out_topic = self._carried[topic]
                    self._out.write_raw(out_topic, self._bag.topics[topic], data, log_ns)
            stop = len(self._imu.log_ns)
            self._handle_imu(start, stop)
            bar.update(stop - start)
        for writer in self._odometry:
            writer.flush()
        return self._estimator

    def _measure(
        self, handle: Callable[[Message, int | None], None], message: Message, log_ns: int
    ) -> None:
        handle(message, received(self._values, log_ns))

    def _handle_gps_fix(self, message: Message, log_ns: int) -> None:
        """Handle a GPSFix, and write what was made of it, for `ins_evaluate` and viewers."""
        used = self._gps_fix.handle(message, received(self._values, log_ns))
        for made, topic in zip(used, ("/gnss/fix", "/gnss/velocity"), strict=False):
            self._out.write(topic, made, log_ns)

    def _handle_imu(self, start: int, stop: int) -> None:
        """Handle the IMU samples of some rows, split where their frame_id changes."""
        while self._frames and self._frames[0][0] < stop:
            row, name = self._frames.popleft()
            if row > start:
                self._handle_block(slice(start, row))
            self._frame, start = name, row
        self._handle_block(slice(start, stop))

    def _handle_block(self, rows: slice) -> None:
        imu = self._imu
        given = imu.has_reading[rows]
        complete = slice(None) if given.all() else given
        for _ in range(np.count_nonzero(~given)):
            self._estimator.inputs.count_and_warn("imu/data", NO_READING)
        for stamps_ns, *by_frame in handle_imu_block(
            self._estimator,
            self._stamps_ns[rows][complete],
            imu.specific_force[rows][complete],
            imu.angular_rate[rows][complete],
            imu.orientation_xyzw[rows][complete],
            self._frame,
        ):
            if self._is_filtered:
                self._write_odometry(stamps_ns, *by_frame)
        self._write_reports(int(imu.log_ns[max(rows.stop, 1) - 1]), of_imu=True)

    def _write_odometry(self, stamps_ns: NDArray[np.int64], *by_frame: NDArray[np.float64]) -> None:
        for writer, odometry in zip(self._odometry, by_frame, strict=True):
            writer.write(stamps_ns, odometry)

    def _write_reports(self, log_ns: int, *, of_imu: bool = False) -> None:
        """Write reports at a log time [ns]; those of IMU samples each at the sample's stamp."""
        for report in self._estimator.pop_reports():
            known_ns = (of_imu and report.known_ns) or log_ns
            if self._is_filtered or report.topic not in (*SMOOTHED, VERDICT):
                self._write_report(report, known_ns)
            elif report.topic == VERDICT:
                self._verdicts.append((known_ns, report))

    def _write_report(self, report: Report, log_ns: int) -> None:
        data = encode(report, f"/{parameters.NODE_NAME}")
        topic, type_name = "/" + report.topic.lstrip("/"), OUTPUTS[report.topic]
        self._out.write_raw(topic, type_name, data, log_ns)

    def smooth(self, record: RunRecord) -> None:
        """Write the smoothed run, after `filter`."""
        # Its kernels are compiled here only: a node that filters does not wait for them.
        from hybrid_ins.ros.estimator.smoothed import SmoothedRun

        total = 3 * record.count
        with progress.bar("smooth", total, "sample", unit_scale=True) as bar:
            make_store = partial(RowFile, folder=self._out.folder)
            smoothed = SmoothedRun(self._estimator, record, make_store, bar.update)
            for block, reports in smoothed.states():
                self._write_odometry(*block)
                for stamp_ns, report in reports:
                    self._write_report(report, stamp_ns)
        for writer in self._odometry:
            writer.flush()
        for log_ns, report in smoothed.verdicts(self._verdicts):
            self._write_report(report, log_ns)


class _OdometryWriter:
    """Writes odometry of one frame at the rate that the parameters ask for, in blocks."""

    def __init__(self, out: BagWriter, values: Mapping[str, Any], topic: str, frame: str) -> None:
        self._out = out
        self._topic = topic
        self._encoder = OdometryEncoder(frame, values["base_frame"])
        self._limiter = RateLimiter(values["odometry_rate"]) if values["odometry_rate"] else None
        self._pending: list[tuple[NDArray[np.int64], NDArray[np.float64]]] = []
        self._count = 0

    def write(self, stamps_ns: NDArray[np.int64], values: NDArray[np.float64]) -> None:
        """Add odometry (N, 85) with its stamps; it is written once a block is full."""
        if self._limiter is not None:
            due = [k for k, t_ns in enumerate(stamps_ns.tolist()) if self._limiter.is_due(t_ns)]
            stamps_ns, values = stamps_ns[due], values[due]
        self._pending.append((stamps_ns, values))
        self._count += len(stamps_ns)
        if self._count >= MESSAGES_AT_A_TIME:
            self.flush()

    def flush(self) -> None:
        """Write what is pending."""
        if self._count:
            stamps_ns, values = map(np.concatenate, zip(*self._pending, strict=True))
            rows = self._encoder.messages(stamps_ns, values)
            self._out.write_rows(self._topic, OUTPUTS["odometry"], rows, stamps_ns)
        self._pending.clear()
        self._count = 0


def log_message(level: str, text: str) -> None:
    """Log a text at the level "info", "warn" or "error"."""
    _log.log(_LEVELS[level], text)
