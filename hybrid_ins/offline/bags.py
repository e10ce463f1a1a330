"""Bags: the only module that knows how recordings lie on the disk.

Reads rosbag2 (MCAP, SQLite3) and ROS 1 recordings, writes rosbag2 MCAP. Topic names are absolute
inside; look-ups take them with or without the leading slash. Times are integer nanoseconds.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.highlevel import AnyReader
from rosbags.interfaces import Nodetype
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from hybrid_ins.errors import InputError

Message = Any

_TYPES = get_typestore(Stores.ROS2_JAZZY)


@dataclass(frozen=True)
class ImuTable:
    """All samples of one Imu topic, in the bag's order."""

    stamp_ns: NDArray[np.int64]  # (N,) header stamps, IMU clock
    log_ns: NDArray[np.int64]  # (N,) when the recorder got them
    specific_force: NDArray[np.float64]  # (N, 3) m/s2, sensor frame (FLU), as in the message
    angular_rate: NDArray[np.float64]  # (N, 3) rad/s, sensor frame (FLU), as in the message


def new_message(type_name: str) -> Message:
    """Make a zero message of a ROS 2 type such as ``"nav_msgs/msg/Odometry"``.

    Nested messages are there, fixed-size arrays are NumPy arrays of zeros, sequences are empty.
    """
    return _TYPES.types[type_name](
        *(_zero(description) for _, description in _TYPES.fielddefs[type_name][1])
    )


def _zero(description: Any) -> Any:
    kind, detail = description
    if kind == Nodetype.BASE:
        name = detail[0]
        return {"string": "", "bool": False, "float32": 0.0, "float64": 0.0}.get(name, 0)
    if kind == Nodetype.NAME:
        return new_message(detail)
    element, length = detail
    length = 0 if kind == Nodetype.SEQUENCE else length
    if element[0] == Nodetype.BASE and element[1][0] != "string":
        return np.zeros(length, {"byte": "uint8", "char": "uint8"}.get(*(element[1][0],) * 2))
    return [_zero(element) for _ in range(length)]


class BagReader:
    """A recording: rosbag2 directory, single ``.mcap`` or ``.db3`` file, ROS 1 ``.bag``."""

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        if not self.path.exists():
            raise InputError(f"{self.path}: no such bag")
        try:
            self._reader = AnyReader([self.path], default_typestore=_TYPES)
            self._reader.open()
        except Exception as error:
            raise InputError(f"{self.path}: not a readable bag: {error}") from error
        self.topics: dict[str, str] = {
            _absolute(name): info.msgtype or "" for name, info in self._reader.topics.items()
        }
        self.start_ns: int = self._reader.start_time
        self.end_ns: int = self._reader.end_time

    def __enter__(self) -> "BagReader":
        return self

    def __exit__(self, *_: object) -> None:
        self._reader.close()

    def count(self, topic: str) -> int:
        """Count the messages on `topic` (0 where the bag has no such topic)."""
        return sum(c.msgcount for c in self._connections(topic))

    def messages(self, *topics: str) -> Iterator[tuple[str, int, Message]]:
        """Yield (topic, log time [ns], message) in log order; all topics if none is named."""
        connections = self._connections(*topics)
        if not connections:
            return
        for connection, log_ns, data in self._reader.messages(connections):
            yield (
                _absolute(connection.topic),
                log_ns,
                self._reader.deserialize(data, connection.msgtype),
            )

    def raw(self, *topics: str) -> Iterator[tuple[str, int, bytes]]:
        """Yield (topic, log time [ns], CDR bytes) in log order; all topics if none is named."""
        connections = self._connections(*topics)
        if not connections:
            return
        for connection, log_ns, data in self._reader.messages(connections):
            if not self._reader.is2:
                data = bytes(_TYPES.ros1_to_cdr(data, connection.msgtype))
            yield _absolute(connection.topic), log_ns, data

    def imu(self, topic: str = "/imu/data") -> ImuTable:
        """Read all of an Imu topic at once."""
        rows = [
            (
                m.header.stamp.sec * 1_000_000_000 + m.header.stamp.nanosec,
                log_ns,
                (m.linear_acceleration.x, m.linear_acceleration.y, m.linear_acceleration.z),
                (m.angular_velocity.x, m.angular_velocity.y, m.angular_velocity.z),
            )
            for _, log_ns, m in self.messages(topic)
        ]
        if not rows:
            raise InputError(f"{self.path}: no messages on {topic}")
        stamps, logs, forces, rates = zip(*rows, strict=True)
        return ImuTable(
            np.array(stamps, np.int64), np.array(logs, np.int64), np.array(forces), np.array(rates)
        )

    def _connections(self, *topics: str) -> list[Any]:
        wanted = {_absolute(t) for t in topics}
        return [
            c for c in self._reader.connections if not wanted or _absolute(c.topic) in wanted
        ]


class BagWriter:
    """A new rosbag2 recording in MCAP: a directory, or a single file for a path ``*.mcap``."""

    def __init__(self, path: Path | str, overwrite: bool = False) -> None:
        self.path = Path(path)
        if self.path.exists() and not overwrite:
            raise InputError(f"{self.path} exists: choose another name or allow overwriting it")
        if self.path.exists():
            import shutil

            shutil.rmtree(self.path) if self.path.is_dir() else self.path.unlink()
        self._single = self.path.suffix == ".mcap"
        directory = self.path.with_suffix("") if self._single else self.path
        self._writer = Writer(directory, version=9, storage_plugin=StoragePlugin.MCAP)
        self._writer.open()
        self._connections: dict[str, Any] = {}

    def __enter__(self) -> "BagWriter":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Complete the bag."""
        self._writer.close()
        if self._single:
            import shutil

            directory = self.path.with_suffix("")
            (directory / f"{directory.name}.mcap").rename(self.path)
            shutil.rmtree(directory)

    def write(self, topic: str, message: Message, log_ns: int) -> None:
        """Append a message made by `new_message` (or read from a bag)."""
        type_name = message.__msgtype__
        self.write_raw(topic, type_name, bytes(_TYPES.serialize_cdr(message, type_name)), log_ns)

    def write_raw(self, topic: str, type_name: str, data: bytes, log_ns: int) -> None:
        """Append an already serialised (CDR) message."""
        topic = _absolute(topic)
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(
                topic, type_name, typestore=_TYPES
            )
        self._writer.write(self._connections[topic], log_ns, data)


def _absolute(topic: str) -> str:
    return topic if topic.startswith("/") else f"/{topic}"
