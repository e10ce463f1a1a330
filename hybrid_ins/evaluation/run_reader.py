"""Reads one run of the filter from its bags."""

from __future__ import annotations

import math
import re
import struct
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from hybrid_ins import progress
from hybrid_ins.bags.messages import absolute
from hybrid_ins.bags.reader import BagReader
from hybrid_ins.errors import InputError
from hybrid_ins.evaluation.run import Fixes, Run, SensorErrors, Series, Topics, Verdicts
from hybrid_ins.resources import printable
from hybrid_ins.ros.messages import type_names
from hybrid_ins.ros.messages.conversions import stamp_ns as ns_of
from hybrid_ins.ros.messages.trajectory import Array, Stamps, Trajectory, trajectory_from_odometry

_ODOMETRY_DOUBLES = 85  # pose 7, covariance 36, twist 6, covariance 36: they end it
_CHUNK = 10_000  # messages decoded at once
_FIGURE = re.compile(r"[-+]?\d+(?:\.\d+)?")
_LASTING = 10  # s, of diagnostics that the user should know of


def read_run(
    estimate_path: Path | str, truth_path: Path | str | None = None, topics: Topics | None = None
) -> Run:
    """
    Read a run from its bag, and truth and fixes from a second one where they are not in it.

    Parameters
    ----------
    estimate_path
        Bag with the filter's output.
    truth_path
        Bag with the truth; by default the same one.
    topics
        Names, where they differ from the usual ones.

    Returns
    -------
    Run
        Its `truth` is None where `truth_path` is not given and the bag has none.

    Raises
    ------
    InputError
        A bag is unreadable or has no estimate, or the bag given for the truth has no truth.

    """
    topics = topics or Topics()
    notes: list[str] = []
    with BagReader(estimate_path) as reader:
        bag, present = _Bag(reader, topics), set(reader.topics)
        _require_estimate(reader, topics.odometry)
        positions, frames = _trajectory(bag, topics.odometry, "--odometry", topics.datum, notes)
        estimate = _of_known_heading(reader, topics.odometry, positions, notes)
        truth = truth_frames = None
        if truth_path is None and reader.count(topics.truth):
            truth, truth_frames = _trajectory(
                bag, topics.truth, "--truth-topic", topics.truth_datum, notes
            )
        fixes = _fixes(bag, topics.fix)
        verdicts = _verdicts(bag, topics.verdict)
        sensor_errors = _sensor_errors(bag, topics)
        true_sensor_errors = _sensor_errors(bag, topics, "/truth")
        noise_source = _noise_source(bag, topics.diagnostics)
        notes += _lasting(bag, topics.diagnostics)
    if truth_path is not None:
        with BagReader(truth_path) as reader:
            bag, present = _Bag(reader, topics), present | set(reader.topics)
            truth, truth_frames = _trajectory(
                bag, topics.truth, "--truth-topic", topics.truth_datum, notes
            )
            fixes = fixes if len(fixes) else _fixes(bag, topics.fix)
            true_sensor_errors = _sensor_errors(bag, topics, "/truth")
    for name, usual in ((topics.fix, Topics.fix), (topics.verdict, Topics.verdict)):
        if name != usual and absolute(name) not in present:
            raise InputError(f"{estimate_path}: no topic {absolute(name)}")
    if truth_frames is not None and truth_frames != frames:
        notes.append(
            f"the estimate is of {frames[1]!r} in {frames[0]!r}, the truth of {truth_frames[1]!r} "
            f"in {truth_frames[0]!r}: the frames are assumed to be the same"
        )
    return Run(
        printable(Path(estimate_path).name),
        estimate,
        truth,
        fixes,
        verdicts,
        sensor_errors,
        true_sensor_errors,
        noise_source,
        tuple(notes),
        absolute(topics.truth),
        positions if len(positions) > len(estimate) else None,
    )


def _require_estimate(reader: BagReader, topic: str) -> None:
    """Raise `InputError` where a bag is a recording that nothing has estimated from."""
    has_imu = type_names.IMU in reader.topics.values()
    if topic == Topics.odometry and topic not in reader.topics and has_imu:
        raise InputError(
            f"{reader.path}: has IMU messages and no {topic}: a recording, not an estimate: run "
            "ins_replay on it and evaluate the result, or name another estimate with --odometry"
        )


class _Bag:
    """An open bag whose small topics are read in one pass."""

    def __init__(self, reader: BagReader, topics: Topics) -> None:
        self.reader = reader
        small = {absolute(name) for name in vars(topics).values()}
        small |= {f"/truth{name}" for name in small}
        small -= {absolute(topics.odometry), absolute(topics.truth)}
        self._messages: dict[str, list[Any]] = {name: [] for name in small & set(reader.topics)}
        if self._messages:
            for topic, _, message in reader.messages(*self._messages):
                self._messages[topic].append(message)

    def of(self, topic: str, type_name: str) -> list[Any]:
        """Return the messages of an optional topic: none if it is missing or of another type."""
        topic = absolute(topic)
        matches = self.reader.topics.get(topic) == type_name
        return self._messages.get(topic, []) if matches else []


def _trajectory(
    bag: _Bag, topic: str, option: str, datum_topic: str, notes: list[str]
) -> tuple[Trajectory, tuple[str, str]]:
    """Read an Odometry topic and its frames; faults are added to `notes`."""
    path = bag.reader.path
    topic = bag.reader.require(topic, type_names.ODOMETRY, option)
    first = _first(bag.reader, topic)
    if first is None:
        raise InputError(f"{path}: no message on {topic}")
    trajectory, faults = trajectory_from_odometry(*_odometry_rows(bag.reader, topic))
    if not len(trajectory):
        raise InputError(f"{path}: {topic} has no usable message: {'; '.join(faults)}")
    datums = [(m.latitude, m.longitude, m.altitude) for m in bag.of(datum_topic, type_names.FIX)]
    if len(set(datums)) > 1:
        faults.append(f"{datum_topic} changed during the run: the last one is used")
    if datums and np.all(np.isfinite(datums[-1])):
        trajectory = replace(trajectory, datum_lla=_radians(np.array(datums[-1])))
    notes.extend(f"{topic}: {fault}" for fault in faults)
    return trajectory, (first.header.frame_id, first.child_frame_id)


def _first(bag: BagReader, topic: str) -> Any:
    """Return the first message of a topic, or None if there is none."""
    if not bag.count(topic):
        return None
    return next((message for _, _, message in bag.messages(topic)), None)


def _of_known_heading(
    bag: BagReader, topic: str, estimate: Trajectory, notes: list[str]
) -> Trajectory:
    """
    Return the epochs from the first one on ``odometry/local`` on; `notes` says what was left out.

    While the filter searches for its heading it publishes on ``odometry`` only.
    """
    first = _first(bag, f"{absolute(topic)}/local")
    if first is None:
        return estimate
    known = estimate.stamp_ns >= ns_of(first.header.stamp)
    if known.all() or not known.any():
        return estimate
    notes.append(f"{np.count_nonzero(~known)} epochs before the heading was known: not scored")
    return estimate.rows(known)


def _odometry_rows(bag: BagReader, topic: str) -> tuple[Stamps, Array]:
    """
    Return stamps (N,) and the doubles (N, 85) of every Odometry message.

    The frame names have variable length, but the doubles are at the end of the message: it need
    not be decoded field by field.
    """
    stamps: list[int] = []
    tails: list[bytes] = []
    chunks: list[Array] = []
    size = 8 * _ODOMETRY_DOUBLES
    messages = bag.raw(topic)
    for _, _, data in progress.track(messages, f"reading {topic}", total=bag.count(topic)):
        if len(data) < size + 20 or data[:2] != b"\x00\x01":
            raise InputError(
                f"{bag.path}: {topic} holds a message that is not a CDR-encoded Odometry"
            )
        seconds, nanoseconds = struct.unpack_from("<iI", data, 4)
        stamps.append(seconds * 1_000_000_000 + nanoseconds)
        end = len(data) - (len(data) - 4) % 8
        tails.append(data[end - size : end])
        if len(tails) == _CHUNK:
            chunks.append(_doubles(tails))
            tails.clear()
    chunks.append(_doubles(tails))
    return np.array(stamps, np.int64), np.concatenate(chunks)


def _doubles(tails: list[bytes]) -> Array:
    return np.frombuffer(b"".join(tails), "<f8").reshape(-1, _ODOMETRY_DOUBLES)


def _fixes(bag: _Bag, topic: str) -> Fixes:
    rows = [
        (ns_of(m.header.stamp), m.latitude, m.longitude, m.altitude)
        for m in bag.of(topic, type_names.FIX)
        if m.status.status >= 0
    ]
    rows = sorted(r for r in rows if math.isfinite(r[1]) and math.isfinite(r[2]))
    if not rows:
        return Fixes.none()
    return Fixes(
        np.array([r[0] for r in rows], np.int64), _radians(np.array([r[1:] for r in rows], float))
    )


def _verdicts(bag: _Bag, topic: str) -> Verdicts:
    rows = []
    for message in bag.of(topic, type_names.STATUS):
        values = {pair.key: pair.value for pair in message.values}
        if not values.get("stamp", "").isdigit():
            continue
        rows.append(
            (
                int(values["stamp"]),
                values.get("kind", "position"),
                values.get("accepted") == "true",
                values.get("reason", "") or str(message.message),
                *(_number(values, name) for name in ("nis", "dof", "threshold", "time_offset")),
            )
        )
    return Verdicts.of(rows)  # type: ignore[arg-type]


def _sensor_errors(bag: _Bag, topics: Topics, below: str = "") -> SensorErrors:
    return SensorErrors(
        *_biases(bag, below + topics.bias),
        _vectors(bag, below + topics.accelerometer_noise),
        _vectors(bag, below + topics.gyroscope_noise),
    )


def _biases(bag: _Bag, topic: str) -> tuple[Series | None, Series | None]:
    stamps, linear, angular, variances = [], [], [], []
    for message in bag.of(topic, type_names.ACCELERATION):
        accel = message.accel.accel
        stamps.append(ns_of(message.header.stamp))
        linear.append(_xyz(accel.linear))
        angular.append(_xyz(accel.angular))
        variances.append(np.diagonal(np.asarray(message.accel.covariance).reshape(6, 6)))
    if not stamps:
        return None, None
    stamp_ns = np.array(stamps, np.int64)
    sigma = np.sqrt(np.maximum(np.array(variances), 0.0))
    return (
        Series(stamp_ns, np.array(linear), sigma[:, :3]),
        Series(stamp_ns, np.array(angular), sigma[:, 3:]),
    )


def _vectors(bag: _Bag, topic: str) -> Series | None:
    rows = [(ns_of(m.header.stamp), _xyz(m.vector)) for m in bag.of(topic, type_names.VECTOR)]
    if not rows:
        return None
    return Series(np.array([r[0] for r in rows], np.int64), np.array([r[1] for r in rows]))


def _noise_source(bag: _Bag, topic: str) -> tuple[tuple[int, str], ...]:
    changes: list[tuple[int, str]] = []
    for array in bag.of(topic, type_names.DIAGNOSTICS):
        for status in array.status:
            if not status.name.endswith("hybrid_ins: process noise"):
                continue
            for pair in status.values:
                if pair.key != "source" or pair.value == "none":
                    continue
                if not changes or changes[-1][1] != pair.value:
                    changes.append((ns_of(array.header.stamp), pair.value))
    return tuple(changes)


def _lasting(bag: _Bag, topic: str) -> list[str]:
    """Return what diagnostics warned of for many seconds, besides the state of the filter."""
    seconds: Counter[str] = Counter()
    texts: dict[str, str] = {}  # the last, by the text without its figures
    total = 0
    for array in bag.of(topic, type_names.DIAGNOSTICS):
        total += 1
        for status in array.status:
            level = status.level if isinstance(status.level, int) else ord(status.level)
            part = status.name.rpartition("hybrid_ins: ")[2]
            found: list[str] = []
            if level and part == "process noise":
                found = status.message.split("; ")[1:]  # behind the source
            elif level and (part == "clock" or (part == "input" and level > 1)):
                found = [status.message]
            for text in found:
                key = _FIGURE.sub("", text)
                seconds[key] += 1
                texts[key] = text
    return [
        f"diagnostics, for {s} of {total} s: {texts[key]}"
        for key, s in seconds.most_common()
        if s >= _LASTING
    ]


def _xyz(vector: Any) -> tuple[float, float, float]:
    return vector.x, vector.y, vector.z


def _number(values: dict[str, str], key: str) -> float:
    try:
        return float(values.get(key, "nan"))
    except ValueError:
        return math.nan


def _radians(lla_degrees: Array) -> Array:
    lla = lla_degrees.copy()
    lla[..., :2] *= math.pi / 180.0
    return lla
