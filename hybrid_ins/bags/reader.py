"""
Recordings read: rosbag2 (MCAP, SQLite3) and ROS 1 bags.

Inside, every message is ROS 2: CDR bytes, or an object of the Jazzy definitions that ship with
`rosbags`; definitions embedded in a bag are never compiled. Topic names are absolute; methods
accept them with or without the leading slash. Times are integer nanoseconds.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, fields
from itertools import chain, islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypedDict

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.bags.formats import open_recording
from hybrid_ins.bags.mcap_reader import Channel, Record
from hybrid_ins.bags.messages import TYPES, Message, absolute, is_standard
from hybrid_ins.core.imu.samples import BlockList, Blocks
from hybrid_ins.errors import InputError
from hybrid_ins.ros.messages.cdr import ImuDecoder, imu_records
from hybrid_ins.ros.messages.conversions import imu_fields
from hybrid_ins.ros.messages.type_names import FIX, GPS_FIX, IMU, TWIST

if TYPE_CHECKING:
    from typing_extensions import Self


IMU_BLOCK = 16_384  # messages that are in memory at a time
INPUT_TOPICS = ("/imu/data", "/gnss/fix")  # where the input is expected
VELOCITY = "/gnss/velocity"  # likewise, where there is any

_log = logging.getLogger(__name__)


class InputTopics(TypedDict):
    """The topics that a recording's input is on, as keywords of those who read it."""

    imu_topic: str
    fix_topic: str
    velocity_topic: str


@dataclass(frozen=True)
class ImuTable:
    """All samples of one Imu topic in the order of the recording."""

    stamp_ns: NDArray[np.int64]  # (N,) header stamps: IMU clock
    log_ns: NDArray[np.int64]  # (N,) recorder's clock
    specific_force: NDArray[np.float64]  # (N, 3) m/s2, axes of the message (FLU)
    angular_rate: NDArray[np.float64]  # (N, 3) rad/s, axes of the message (FLU)
    orientation_xyzw: NDArray[np.float64]  # (N, 4) in ENU; zeros where the message has none
    has_reading: NDArray[np.bool_]  # (N,) false where covariance[0] is -1: no reading
    frames: tuple[tuple[int, str], ...]  # row from which on each frame_id holds

    @property
    def frame_id(self) -> str:
        """The first message's; empty where there is none."""
        return self.frames[0][1] if self.frames else ""

    def times_ns(self, values: Mapping[str, Any]) -> NDArray[np.int64]:
        """Return when the samples were taken (N,) [ns], for checked parameters; see `received`."""
        return self.log_ns if values["use_receive_time"] else self.stamp_ns

    @classmethod
    def joined(cls, parts: Iterable[ImuTable], make_blocks: Callable[[], Blocks]) -> ImuTable:
        """Return consecutive parts, one at least, as one table, whose columns are kept apart."""
        names = [field.name for field in fields(cls) if field.name != "frames"]
        columns = {name: make_blocks() for name in names}
        frames: list[tuple[int, str]] = []
        for part in parts:
            first = len(columns["stamp_ns"])
            for row, name in part.frames:
                if not frames or frames[-1][1] != name:
                    frames.append((first + row, name))
            for name in names:
                columns[name].append(getattr(part, name))
        arrays: dict[str, Any] = {name: columns[name].array() for name in names}
        return cls(**arrays, frames=tuple(frames))


def received(values: Mapping[str, Any], log_ns: int) -> int | None:
    """Return a message's log time [ns] where ``use_receive_time`` lets it replace the stamp."""
    return log_ns if values["use_receive_time"] else None


def _changes(names: NDArray[np.bytes_]) -> list[int]:
    """Rows whose name differs from the one before, and the first."""
    return [0, *(1 + np.flatnonzero(names[1:] != names[:-1])).tolist()]


class BagReader:
    """
    A recording: rosbag2 directory, single ``.mcap`` or ``.db3`` file, or ROS 1 ``.bag``.

    A recording that breaks off is read as far as it goes, with a warning; topics of types that are
    not standard, or not CDR, are left out.

    Attributes
    ----------
    path : Path
        Where it lies.
    topics : dict
        Type name by topic: ``{"/imu/data": "sensor_msgs/msg/Imu"}``.
    start_ns, end_ns : int
        Log times of the first and the last message.

    Raises
    ------
    InputError
        There is nothing readable at `path`.

    """

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        self._source = open_recording(self.path)
        channels = {c: n for c, n in self._source.counts.items() if _is_readable(c)}
        self.topics: dict[str, str] = {c.topic: c.type_name for c in reversed(channels)}
        self._counts: dict[str, int] = {}
        self._replaced: set[str] = set()
        self._sound: set[str] = set()  # topics with a message that could be decoded
        self._damaged: set[str] = set()  # topics with one that could not
        for channel, count in channels.items():
            self._counts[channel.topic] = self._counts.get(channel.topic, 0) + count
        self.start_ns: int = self._source.start_ns
        self.end_ns: int = self._source.end_ns
        if not any(self._source.counts.values()):
            self.close()
            raise InputError(f"{self.path}: holds no messages: record it again")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the files."""
        self._source.close()

    def count(self, topic: str) -> int:
        """Return the number of messages on `topic`, 0 where there is no such topic."""
        return self._counts.get(absolute(topic), 0)

    def require(self, topic: str, type_name: str, option: str) -> str:
        """
        Find a topic of the right type.

        Where an input topic is missing under its usual name and only one topic has its type, that
        one is read, with a warning. Fixes may be of either type, NavSatFix or GPSFix.

        Parameters
        ----------
        topic
            With or without the leading slash.
        type_name
            Type that its messages must have.
        option
            The program's option that names another topic, for the error line.

        Returns
        -------
        str
            The absolute topic name.

        Raises
        ------
        InputError
            It is not; the text lists the topics of that type.

        """
        topic = absolute(topic)
        found = self.topics.get(topic)
        if found == type_name or (found == GPS_FIX and type_name == FIX):
            return topic
        others = self._input_topics(type_name)
        if type_name == FIX and not others:
            others = self._input_topics(GPS_FIX)
        if not found and topic in INPUT_TOPICS and len(others) == 1:
            if topic not in self._replaced:
                self._replaced.add(topic)
                _log.warning(
                    "%s: no topic %s: reading %s, the only %s",
                    *(self.path, topic, others[0], self.topics[others[0]]),
                )
            return others[0]
        wrong = f"{topic} is {found}, not {type_name}" if found else f"no topic {topic}"
        way_out = (
            f"choose {' or '.join(sorted(others))} with {option}"
            if others
            else f"no other is {type_name}; it has {', '.join(sorted(self.topics)) or 'none'}"
        )
        raise InputError(f"{self.path}: {wrong}: {way_out}")

    def _input_topics(self, type_name: str) -> list[str]:
        """Return the topics of a type; neither the map's origin nor the truth is input."""
        found = [name for name, other in self.topics.items() if other == type_name]
        return [name for name in found if name != "/datum" and not name.startswith("/truth/")]

    def raw(self, *topics: str) -> Iterator[tuple[str, int, bytes]]:
        """
        Return (topic, log time [ns], CDR bytes) in log order; of all topics if none is named.

        Topics that the recording does not have yield nothing: see `require`.
        """
        return ((channel.topic, log_ns, data) for log_ns, channel, data in self._records(topics))

    def messages(self, *topics: str) -> Iterator[tuple[str, int, Message]]:
        """Yield (topic, log time [ns], message object), otherwise like `raw`."""
        for log_ns, channel, data in self._records(topics):
            message = self._decoded(log_ns, channel, data)
            if message is not None:
                yield channel.topic, log_ns, message

    def decode(self, topic: str, log_ns: int, data: bytes) -> Message | None:
        """Return the message object of what `raw` yielded; None: it is damaged, and left out."""
        return self._decoded(log_ns, Channel(topic, self.topics[topic], "cdr"), data)

    def imu(
        self,
        topic: str = "/imu/data",
        option: str = "--imu-topic",
        make_blocks: Callable[[], Blocks] = BlockList,
    ) -> ImuTable:
        """
        Read a whole Imu topic at once.

        Parameters
        ----------
        topic
            An Imu topic.
        option
            See `require`.
        make_blocks
            Returns what keeps a column.

        Returns
        -------
        ImuTable

        Raises
        ------
        InputError
            There is no such topic, or a message is damaged.

        """
        topic = self.require(topic, IMU, option)
        records = self._records([topic])
        parts = map(self._imu_part, iter(lambda: list(islice(records, IMU_BLOCK)), []))
        first = next(parts, None)
        if first is None:
            raise InputError(f"{self.path}: no message on {topic} can be read: record it again")
        return ImuTable.joined(chain((first,), parts), make_blocks)

    def _imu_part(self, messages: list[Record]) -> ImuTable:
        log_ns = np.array([record[0] for record in messages], np.int64)
        try:
            table = imu_records([record[2] for record in messages])
        except (ValueError, IndexError):
            return self._imu_one_by_one(messages)
        self._sound.add(messages[0][1].topic)
        return ImuTable(
            table["seconds"].astype(np.int64) * 1_000_000_000 + table["nanoseconds"],
            log_ns,
            np.ascontiguousarray(table["specific_force"]),
            np.ascontiguousarray(table["angular_rate"]),
            np.where(
                table["orientation_covariance"][:, :1] == -1.0, 0.0, table["orientation_xyzw"]
            ),
            (table["angular_rate_covariance"][:, 0] != -1.0)
            & (table["specific_force_covariance"][:, 0] != -1.0),
            tuple(
                (row, table["name"][row].decode(errors="replace"))
                for row in _changes(table["name"])
            ),
        )

    def _imu_one_by_one(self, records: list[Record]) -> ImuTable:
        """Read Imu messages whose layout varies: changing frame_id, byte order, damage."""
        log_ns = np.array([record[0] for record in records], np.int64)
        decoder = ImuDecoder()
        stamps = np.empty(len(records), np.int64)
        vectors = np.empty((2, len(records), 3))
        orientation = np.zeros((len(records), 4))
        has_reading = np.ones(len(records), bool)
        frames: list[tuple[int, str]] = []
        sound = np.ones(len(records), bool)
        for row, record in enumerate(records):
            try:
                imu = decoder.decode(record[2])
                self._sound.add(record[1].topic)
            except ValueError:
                message = self._decoded(*record)
                sound[row] = message is not None
                if message is None:
                    continue
                imu = imu_fields(message)
            stamps[row] = imu.stamp_ns
            if not frames or frames[-1][1] != imu.frame_id:
                frames.append((int(np.count_nonzero(sound[:row])), imu.frame_id))
            vectors[:, row] = imu.specific_force, imu.angular_rate
            if imu.orientation_cov0 != -1.0:
                orientation[row] = imu.orientation_xyzw
            has_reading[row] = -1.0 not in (imu.specific_force_cov0, imu.angular_rate_cov0)
        return ImuTable(
            stamps[sound],
            log_ns[sound],
            vectors[0, sound],
            vectors[1, sound],
            orientation[sound],
            has_reading[sound],
            tuple(frames),
        )

    def _records(self, topics: tuple[str, ...] | list[str]) -> Iterator[Record]:
        wanted = {absolute(topic) for topic in topics} or self.topics.keys()
        return self._source.records(lambda c: c.topic in wanted and _is_readable(c))

    def _decoded(self, log_ns: int, channel: Channel, data: bytes) -> Message | None:
        """Return a message; None where it is damaged, and an earlier one of its topic is not."""
        try:
            message = TYPES.deserialize_cdr(data, channel.type_name)
            self._sound.add(channel.topic)
            return message
        except Exception as error:  # whatever a damaged message provokes
            if channel.topic in self._sound:
                if channel.topic not in self._damaged:
                    self._damaged.add(channel.topic)
                    _log.warning(
                        "%s: damaged messages on %s, the first at %d ns, are left out",
                        *(self.path, channel.topic, log_ns),
                    )
                return None
            raise InputError(
                f"{self.path}: the message on {channel.topic} at {log_ns} ns is not a"
                f" {channel.type_name} ({error}): leave the topic out or record it again"
            ) from None


def velocities_topic(bag: BagReader, topic: str) -> str:
    """
    Return the absolute name of the topic of velocities, which is optional; empty without one.

    One that is asked for by another than its usual name, and is not there, is named.
    """
    name = absolute(topic)
    if topic and name not in (VELOCITY, *bag.topics):
        of_type = [found for found, kind in bag.topics.items() if kind == TWIST]
        _log.warning(
            "%s: has no topic %s: no velocities are used; there is %s",
            *(bag.path, name, ", ".join(of_type) or "none of their type"),
        )
    return name if has_optional(bag, name, TWIST) else ""


def has_optional(bag: BagReader, topic: str, type_name: str) -> bool:
    """Return whether an optional topic is there; one of another type is not used, and named."""
    found = bag.topics.get(topic)
    if found not in (None, type_name):
        _log.warning("%s: %s is %s, not %s: not used", bag.path, topic, found, type_name)
    return found == type_name


def _is_readable(channel: Channel) -> bool:
    return channel.encoding == "cdr" and is_standard(channel.type_name)
