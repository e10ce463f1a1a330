"""
Recordings: the only module that knows how they lie on the disk.

Reads rosbag2 (MCAP, SQLite3) and ROS 1 bags, writes rosbag2 MCAP. Inside, every message is ROS 2:
CDR bytes, or an object of the Jazzy definitions that ship with `rosbags`; definitions embedded in a
bag are never compiled. Topic names are absolute; look-ups take them with or without the leading
slash. Times are integer nanoseconds.
"""

from __future__ import annotations

import logging
import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from heapq import merge
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias

import numpy as np
import yaml
from numpy.typing import NDArray
from rosbags.interfaces import Nodetype
from rosbags.rosbag1 import Reader as Ros1Reader
from rosbags.rosbag2 import Reader as Rosbag2Reader
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from hybrid_ins.bags import mcap_file
from hybrid_ins.bags.mcap_file import Channel, McapReader, McapWriter, Record
from hybrid_ins.errors import InputError
from hybrid_ins.ros.cdr import ImuDecoder, imu_records, imu_rows
from hybrid_ins.ros.conversions import imu_fields

if TYPE_CHECKING:
    from types import TracebackType

    from typing_extensions import Self

Message: TypeAlias = Any  # its class depends on the topic

IMU = "sensor_msgs/msg/Imu"

_TYPES = get_typestore(Stores.ROS2_JAZZY)
_METADATA = "metadata.yaml"
_METADATA_LIMIT = 1 << 20  # bytes; a recording in a hundred files needs a tenth

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class ImuTable:
    """All samples of one Imu topic in the order of the recording."""

    stamp_ns: NDArray[np.int64]  # (N,) header stamps: IMU clock
    log_ns: NDArray[np.int64]  # (N,) recorder's clock
    specific_force: NDArray[np.float64]  # (N, 3) m/s2, axes of the message (FLU)
    angular_rate: NDArray[np.float64]  # (N, 3) rad/s, axes of the message (FLU)
    orientation_xyzw: NDArray[np.float64]  # (N, 4) in ENU; zeros where the message has none
    has_reading: NDArray[np.bool_]  # (N,) false where a covariance[0] of -1 says there is none
    frames: tuple[tuple[int, str], ...]  # row from which on each frame_id holds

    @property
    def frame_id(self) -> str:
        """The first message's; empty where there is none."""
        return self.frames[0][1] if self.frames else ""


def _changes(names: NDArray[np.bytes_]) -> list[int]:
    """Rows whose name differs from the one before, and the first."""
    return [0, *(1 + np.flatnonzero(names[1:] != names[:-1])).tolist()]


def is_standard(type_name: str) -> bool:
    """Say whether a type is one that bags can hold here: those that come with ROS 2."""
    return type_name in _TYPES.fielddefs


def new_message(type_name: str) -> Message:
    """
    Make a message of a standard ROS 2 type, such as ``"nav_msgs/msg/Odometry"``.

    Numbers are 0, texts empty, fixed-size arrays NumPy zeros, sequences empty; nested messages are
    there and every attribute can be set.
    """
    fields = _TYPES.fielddefs[type_name][1]
    return _TYPES.types[type_name](*(_zero(description) for _, description in fields))


def _zero(description: Any) -> Any:
    kind, detail = description
    if kind == Nodetype.BASE:
        return {"string": "", "bool": False, "float32": 0.0, "float64": 0.0}.get(detail[0], 0)
    if kind == Nodetype.NAME:
        return new_message(detail)
    element, length = detail
    length = 0 if kind == Nodetype.SEQUENCE else length
    if element[0] == Nodetype.BASE and element[1][0] != "string":
        name = element[1][0]
        return np.zeros(length, "uint8" if name in ("byte", "char") else name)
    return [_zero(element) for _ in range(length)]


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
        self._source = _open(self.path)
        channels = {c: n for c, n in self._source.counts.items() if _is_readable(c)}
        self.topics: dict[str, str] = {c.topic: c.type_name for c in reversed(channels)}
        self._counts: dict[str, int] = {}
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
        return self._counts.get(_absolute(topic), 0)

    def require(self, topic: str, type_name: str, option: str) -> str:
        """
        Check that a topic is there and of the right type.

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
        topic = _absolute(topic)
        found = self.topics.get(topic)
        if found == type_name:
            return topic
        wrong = f"{topic} is {found}, not {type_name}" if found else f"no topic {topic}"
        others = [  # a map's origin is no fix, and the truth no estimate
            name for name, other in self.topics.items()
            if other == type_name and name != "/datum" and not name.startswith("/truth/")
        ]  # fmt: skip
        way_out = (
            f"choose {' or '.join(sorted(others))} with {option}"
            if others
            else f"no other is {type_name}; it has {', '.join(sorted(self.topics)) or 'none'}"
        )
        raise InputError(f"{self.path}: {wrong}: {way_out}")

    def raw(self, *topics: str) -> Iterator[tuple[str, int, bytes]]:
        """
        Yield (topic, log time [ns], CDR bytes) in log order; of all topics if none is named.

        Topics that the recording does not have yield nothing: see `require`.
        """
        for log_ns, channel, data in self._records(topics):
            yield channel.topic, log_ns, data

    def messages(self, *topics: str) -> Iterator[tuple[str, int, Message]]:
        """Yield (topic, log time [ns], message object), otherwise like `raw`."""
        for log_ns, channel, data in self._records(topics):
            yield channel.topic, log_ns, self._decoded(log_ns, channel, data)

    def decode(self, topic: str, log_ns: int, data: bytes) -> Message:
        """Return the message object of what `raw` yielded."""
        return self._decoded(log_ns, Channel(topic, self.topics[topic], "cdr"), data)

    def imu(self, topic: str = "/imu/data", option: str = "--imu-topic") -> ImuTable:
        """
        Read a whole Imu topic at once.

        Parameters
        ----------
        topic
            An Imu topic.
        option
            See `require`.

        Returns
        -------
        ImuTable

        Raises
        ------
        InputError
            There is no such topic, or a message is damaged.

        """
        topic = self.require(topic, IMU, option)
        found = None
        if isinstance(self._source, McapReader):
            found = self._source.rows(lambda c: c.topic == topic and _is_readable(c))
        try:
            if found is not None:
                log_ns, table = found[0], imu_rows(found[1])
            else:
                records = list(self._records([topic]))
                log_ns = np.array([record[0] for record in records], np.int64)
                table = imu_records([record[2] for record in records])
        except (ValueError, IndexError):
            records = list(self._records([topic]))
            return self._imu_one_by_one(records)
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
        for row, record in enumerate(records):
            try:
                imu = decoder.decode(record[2])
            except ValueError:
                imu = imu_fields(self._decoded(*record))
            stamps[row] = imu.stamp_ns
            if not frames or frames[-1][1] != imu.frame_id:
                frames.append((row, imu.frame_id))
            vectors[:, row] = imu.specific_force, imu.angular_rate
            if imu.orientation_cov0 != -1.0:
                orientation[row] = imu.orientation_xyzw
            has_reading[row] = -1.0 not in (imu.specific_force_cov0, imu.angular_rate_cov0)
        return ImuTable(
            stamps, log_ns, vectors[0], vectors[1], orientation, has_reading, tuple(frames)
        )

    def _records(self, topics: tuple[str, ...] | list[str]) -> Iterator[Record]:
        wanted = {_absolute(topic) for topic in topics} or self.topics.keys()
        return self._source.records(lambda c: c.topic in wanted and _is_readable(c))

    def _decoded(self, log_ns: int, channel: Channel, data: bytes) -> Message:
        try:
            return _TYPES.deserialize_cdr(data, channel.type_name)
        except Exception as error:  # whatever a damaged message provokes
            raise InputError(
                f"{self.path}: the message on {channel.topic} at {log_ns} ns is no"
                f" {channel.type_name} ({error}): leave the topic out or record it again"
            ) from None


class BagWriter:
    """
    A new rosbag2 recording in MCAP: a directory, or one file where the path ends in ``.mcap``.

    As a context manager it is completed however the block ends. After an exception or Ctrl-C the
    bag holds everything written so far, and a warning says that it ends early; without a message
    written nothing is left. Killed outright it can still be read up to its last chunk.

    Parameters
    ----------
    path
        The bag. Directories above it are made.
    overwrite
        Replace what is there, provided that it is a bag.

    Raises
    ------
    InputError
        `path` exists and may not be overwritten.

    """

    def __init__(self, path: Path | str, overwrite: bool = False) -> None:
        self.path = Path(path)
        self._is_file = self.path.suffix == ".mcap"
        _make_way(self.path, overwrite)
        if self._is_file:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            file = self.path
        else:
            self.path.mkdir(parents=True)
            file = self.path / f"{self.path.resolve().name}_0.mcap"
        self._writer = McapWriter(file, "hybrid_ins")
        self._numbers: dict[tuple[str, str], int] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()
        if kind is None:
            return
        count = self._writer.counts.total()
        if not count:
            shutil.rmtree(self.path) if not self._is_file else self.path.unlink()
        else:
            seconds = (self._writer.end_ns - self._writer.start_ns) / 1e9
            _log.warning("%s: ends early, after %d messages (%.1f s)", self.path, count, seconds)

    def close(self) -> None:
        """Complete the bag; closing twice is harmless."""
        self._writer.close()
        if not self._is_file:
            (self.path / _METADATA).write_text(yaml.safe_dump(self._metadata(), sort_keys=False))

    def write(self, topic: str, message: Message, log_ns: int) -> None:
        """
        Append a message object.

        Parameters
        ----------
        topic
            With or without the leading slash.
        message
            Made by `new_message` or read by `BagReader.messages`.
        log_ns
            Time of the recording.

        """
        type_name = message.__msgtype__
        data = bytes(_TYPES.serialize_cdr(message, type_name, little_endian=True))
        self.write_raw(topic, type_name, data, log_ns)

    def write_raw(self, topic: str, type_name: str, data: bytes, log_ns: int) -> None:
        """Append a serialised (CDR) message of a standard type; otherwise like `write`."""
        self._writer.write(self._number(topic, type_name), log_ns, data)

    def write_rows(
        self, topic: str, type_name: str, rows: NDArray[np.uint8], log_ns: NDArray[np.int64]
    ) -> None:
        """Append many serialised messages of one size: bytes (N, size), log times (N,)."""
        if len(rows):
            self._writer.write_rows(self._number(topic, type_name), log_ns, rows)

    def write_many(
        self, topic: str, type_name: str, messages: Sequence[bytes], log_ns: Sequence[int]
    ) -> None:
        """Append many serialised messages with their log times."""
        if messages:
            self._writer.write_many(self._number(topic, type_name), log_ns, messages)

    def _number(self, topic: str, type_name: str) -> int:
        """Return a topic's channel, made if it is new."""
        number = self._numbers.get((topic, type_name))
        if number is None:
            number = self._numbers[topic, type_name] = self._channel(_absolute(topic), type_name)
        return number

    def _channel(self, topic: str, type_name: str) -> int:
        for (known_topic, known_type), number in self._numbers.items():
            if _absolute(known_topic) == topic:
                if known_type != type_name:
                    raise ValueError(f"{topic} holds {known_type}, not {type_name}")
                return number
        if not is_standard(type_name):
            raise ValueError(f"{topic}: {type_name} is no standard message type")
        return self._writer.add_channel(
            Channel(topic, type_name, "cdr"),
            _TYPES.generate_msgdef(type_name, ros_version=2)[0],
            {"offered_qos_profiles": "", "topic_type_hash": _TYPES.hash_rihs01(type_name)},
        )

    def _metadata(self) -> dict[str, Any]:
        """Return what ``metadata.yaml`` of a rosbag2 directory says, in version 9."""
        writer = self._writer
        span = {
            "duration": {"nanoseconds": writer.end_ns - writer.start_ns},
            "starting_time": {"nanoseconds_since_epoch": writer.start_ns},
            "message_count": writer.counts.total(),
        }
        topics = {
            number: {
                "name": _absolute(topic),
                "type": type_name,
                "serialization_format": "cdr",
                "offered_qos_profiles": [],
                "type_description_hash": _TYPES.hash_rihs01(type_name),
            }
            for (topic, type_name), number in self._numbers.items()
        }
        information = {
            "version": 9,
            "storage_identifier": "mcap",
            **span,
            "topics_with_message_count": [
                {"topic_metadata": topic, "message_count": writer.counts[number]}
                for number, topic in topics.items()
            ],
            "compression_format": "",
            "compression_mode": "",
            "relative_file_paths": [writer.path.name],
            "files": [{"path": writer.path.name, **span}],
            "custom_data": None,
            "ros_distro": "jazzy",
        }
        return {"rosbag2_bagfile_information": information}


class _Source(Protocol):
    """One or several files of a recording."""

    counts: dict[Channel, int]
    start_ns: int
    end_ns: int

    def records(self, wanted: Callable[[Channel], bool]) -> Iterator[Record]: ...

    def close(self) -> None: ...


class _Files:
    """The files of a recording that was split."""

    def __init__(self, paths: list[Path]) -> None:
        self._sources: list[_Source] = []
        try:
            for path in paths:
                self._sources.append(_open(path))
        except BaseException:
            self.close()
            raise
        self.counts: dict[Channel, int] = {}
        for source in self._sources:
            for channel, count in source.counts.items():
                self.counts[channel] = self.counts.get(channel, 0) + count
        filled = [source for source in self._sources if any(source.counts.values())]
        self.start_ns = min((source.start_ns for source in filled), default=0)
        self.end_ns = max((source.end_ns for source in filled), default=0)

    def records(self, wanted: Callable[[Channel], bool]) -> Iterator[Record]:
        return merge(*(source.records(wanted) for source in self._sources), key=itemgetter(0))

    def close(self) -> None:
        for source in self._sources:
            source.close()


class _RosbagsFile:
    """Every other recording, read by `rosbags`."""

    def __init__(self, path: Path, reader: Ros1Reader | Rosbag2Reader) -> None:
        self.path = path
        self._reader = reader
        try:
            reader.open()
        except Exception as error:  # a damaged file provokes anything
            raise self._unreadable(error) from None
        self._is_ros1 = isinstance(reader, Ros1Reader)
        self._channels = {c.id: self._channel(c) for c in reader.connections}
        self.counts = {
            self._channels[number]: sum(
                c.msgcount for c in reader.connections if self._channels[c.id] == channel
            )
            for number, channel in self._channels.items()
        }
        self.start_ns, self.end_ns = reader.start_time, reader.end_time - 1

    def records(self, wanted: Callable[[Channel], bool]) -> Iterator[Record]:
        connections = [c for c in self._reader.connections if wanted(self._channels[c.id])]
        if not connections:
            return
        stream = self._reader.messages(connections)
        while True:
            try:
                connection, log_ns, data = next(stream)
                channel = self._channels[connection.id]
                if self._is_ros1:
                    data = bytes(_TYPES.ros1_to_cdr(data, channel.type_name))
            except StopIteration:
                return
            except SerdeError as error:
                raise InputError(f"{self.path}: a message on {channel.topic}: {error}") from None
            except Exception as error:  # a damaged file provokes anything
                raise self._unreadable(error) from None
            yield log_ns, channel, data

    def close(self) -> None:
        self._reader.close()

    def _channel(self, connection: Any) -> Channel:
        encoding = "cdr" if self._is_ros1 else connection.ext.serialization_format
        if self._is_ros1 and not _translates(connection.msgtype, connection.digest):
            encoding = "ros1"
        return Channel(_absolute(connection.topic), connection.msgtype, encoding)

    def _unreadable(self, error: Exception) -> InputError:
        reason = str(error).strip().rstrip(".") or type(error).__name__
        return InputError(
            f"{self.path}: cannot be read ({reason});"
            " fetch the bag again from where it was recorded"
        )


def _open(path: Path) -> _Source:
    """Find out from the content, not from the name, what a recording is."""
    if not path.exists():
        raise InputError(f"{path}: no such file or directory")
    if path.is_dir():
        return _open_directory(path)
    if not path.is_file():
        raise InputError(f"{path}: is neither a file nor a directory")
    with path.open("rb") as file:
        head = file.read(16)
    if not head:
        raise InputError(f"{path}: is empty (0 bytes): record it again")
    if head.startswith(mcap_file.MAGIC):
        return McapReader(path)
    if head.startswith(b"SQLite format 3\0"):
        if path.suffix != ".db3":
            raise InputError(f"{path}: is an SQLite3 bag: rename it to {path.stem}.db3")
        return _RosbagsFile(path, Rosbag2Reader(path))
    if head.startswith(b"#ROSBAG V"):
        return _RosbagsFile(path, Ros1Reader(path))
    raise InputError(
        f"{path}: is not a bag: give a rosbag2 directory, an .mcap or .db3 file or a ROS 1 .bag"
    )


def _open_directory(path: Path) -> _Source:
    metadata = path / _METADATA
    names: list[str] = []
    trouble = "its metadata.yaml names no file"
    try:
        information = _read_metadata(metadata)
        if information.get("compression_mode", "").lower() not in ("", "none"):
            return _RosbagsFile(path, Rosbag2Reader(path))
        names = [Path(name).name for name in information["relative_file_paths"]]
    except FileNotFoundError:
        trouble = "the recording was not completed: no metadata.yaml"
    except (yaml.YAMLError, RecursionError, UnicodeError, LookupError, TypeError, AttributeError):
        trouble = "its metadata.yaml is damaged"
    if not names:
        found = [*path.glob(f"{path.resolve().name}_*.*")]
        names = sorted(file.name for file in found if file.suffix in (".mcap", ".db3"))
        if not names:
            raise InputError(f"{path}: is no rosbag2 directory ({trouble}): give a bag's directory")
        _log.warning("%s: %s: reading %s", path, trouble, ", ".join(names))
    missing = [name for name in names if not (path / name).is_file()]
    if missing:
        raise InputError(f"{path}: lacks {', '.join(missing)}: copy the whole bag")
    files = [path / name for name in names]
    return _open(files[0]) if len(files) == 1 else _Files(files)


def _read_metadata(path: Path) -> dict[str, Any]:
    # The loader written in C is faster and crashes on deep nesting.
    with path.open("rb") as file:
        content = file.read(_METADATA_LIMIT + 1)
    if len(content) > _METADATA_LIMIT:
        raise LookupError
    information = yaml.load(content, yaml.SafeLoader)["rosbag2_bagfile_information"]
    return dict(information)


def _make_way(path: Path, overwrite: bool) -> None:
    if not path.exists():
        return
    if not overwrite:
        raise InputError(f"{path} exists: give another name, or --overwrite to replace it")
    if path.is_file():
        path.unlink()
        return
    strangers = [p for p in path.iterdir() if p.suffix not in (".mcap", ".db3", ".yaml")]
    if strangers:
        raise InputError(f"{path} holds more than a bag ({strangers[0].name}): not overwritten")
    shutil.rmtree(path)


def _is_readable(channel: Channel) -> bool:
    return channel.encoding == "cdr" and is_standard(channel.type_name)


def _translates(type_name: str, md5sum: str) -> bool:
    """Say whether a ROS 1 type is the well-known one, so that its bytes can become CDR."""
    known = _ros1_types()
    return (
        is_standard(type_name)
        and type_name in known.fielddefs
        and known.generate_msgdef(type_name)[1] == md5sum
    )


@cache
def _ros1_types() -> Typestore:
    return get_typestore(Stores.ROS1_NOETIC)


def _absolute(topic: str) -> str:
    return topic if topic.startswith("/") else f"/{topic}"
