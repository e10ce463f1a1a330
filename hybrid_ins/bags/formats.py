"""Which format a recording has, and a reader of it: rosbag2 (MCAP, SQLite3) or ROS 1."""

from __future__ import annotations

import errno
import logging
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import cache
from heapq import merge
from operator import itemgetter
from pathlib import Path
from typing import Any, Protocol

import yaml
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from hybrid_ins.bags.mcap_reader import MAGIC, Channel, McapReader, Record
from hybrid_ins.bags.messages import TYPES, absolute, is_standard
from hybrid_ins.errors import InputError

SQLITE, ROS1 = b"SQLite format 3\0", b"#ROSBAG V"
BEGINNINGS = (MAGIC, SQLITE, ROS1)  # of files that are bags

METADATA = "metadata.yaml"
A_BAG = f"a folder with {METADATA}, or an .mcap, .db3 or ROS 1 .bag file"
NO_ROOM = errno.ENOSPC, errno.EDQUOT, errno.EFBIG
_METADATA_LIMIT = 1 << 20  # bytes; a recording in a hundred files needs a tenth

_log = logging.getLogger(__name__)


class Source(Protocol):
    """One or several files of a recording."""

    counts: dict[Channel, int]
    start_ns: int
    end_ns: int

    def records(self, wanted: Callable[[Channel], bool]) -> Iterator[Record]:
        """Yield the messages of the wanted channels in log order."""
        ...

    def close(self) -> None:
        """Close the files."""


class _Files:
    """The files of a recording that was split; one at least can be read."""

    def __init__(self, paths: list[Path]) -> None:
        self._sources: list[Source] = []
        faults: list[InputError] = []
        for path in paths:
            try:
                self._sources.append(open_recording(path))
            except InputError as error:
                faults.append(error)
        if not self._sources:
            raise faults[0]
        for fault in faults:
            _log.warning("%s; the recording's other files are read", fault)
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

    def __init__(self, path: Path, *, is_ros1: bool = False) -> None:
        self.path = path
        self._is_ros1 = is_ros1
        pending = path.with_name(f"{path.name}-wal")
        if pending.is_file() and pending.stat().st_size:
            _log.warning(
                "%s: messages in %s are not read: copy both files, and move the messages by"
                ' sqlite3 %s "PRAGMA wal_checkpoint(TRUNCATE)" in the copy',
                *(path, pending.name, path.name),
            )
        self._reader = reader = _reader_of(path, is_ros1)
        try:
            reader.open()
        except Exception as error:  # a damaged file provokes anything
            raise self._unreadable(error) from None
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
                    data = bytes(TYPES.ros1_to_cdr(data, channel.type_name))
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
        return Channel(absolute(connection.topic), connection.msgtype, encoding)

    def _unreadable(self, error: Exception) -> InputError:
        reason = str(error).strip().rstrip(".") or type(error).__name__
        remedy = "fetch the bag again from where it was recorded"
        if self._is_ros1:
            remedy = f"repair it by rosbag reindex, or {remedy}"
        elif isinstance(error, OSError) and error.errno in NO_ROOM:
            remedy = "set TMPDIR to a folder with room for what it is decompressed to"
        elif any(mark in str(self.path) for mark in "?#%"):
            remedy = "SQLite does not find a file whose path holds ?, # or %: rename it"
        return InputError(f"{self.path}: cannot be read ({reason}); {remedy}")


def _reader_of(path: Path, is_ros1: bool) -> Any:
    """Return the reader by `rosbags`, which is loaded only where a recording needs it."""
    if is_ros1:
        from rosbags.rosbag1 import Reader as Ros1Reader

        return Ros1Reader(path)
    from rosbags.rosbag2 import Reader as Rosbag2Reader

    return Rosbag2Reader(path)


def open_recording(path: Path) -> Source:
    """Open a recording; its format is recognised by the content, not by the name."""
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
    if head.startswith(MAGIC):
        return McapReader(path)
    if head.startswith(SQLITE):
        if path.suffix != ".db3":
            raise InputError(f"{path}: is an SQLite3 bag: rename it to {path.stem}.db3")
        return _RosbagsFile(path)
    if head.startswith(ROS1):
        return _RosbagsFile(path, is_ros1=True)
    raise InputError(f"{path}: is not a bag: give {A_BAG}")


def _open_directory(path: Path) -> Source:
    metadata = path / METADATA
    names: list[str] = []
    trouble = "its metadata.yaml names no file"
    try:
        information = _read_metadata(metadata)
        compression, storage = (
            information.get(name, "").lower() for name in ("compression_mode", "storage_identifier")
        )
        if compression == "file" or (compression == "message" and storage != "mcap"):
            return _RosbagsFile(path)
        names = [Path(name).name for name in information["relative_file_paths"]]
    except FileNotFoundError:
        trouble = "the recording was not completed: no metadata.yaml"
    except (yaml.YAMLError, RecursionError, UnicodeError, LookupError, TypeError, AttributeError):
        trouble = "its metadata.yaml is damaged"
    if not names:
        names = sorted(file.name for file in path.iterdir() if file.suffix in (".mcap", ".db3"))
        packed = " ".join(sorted(file.name for file in path.glob("*.zstd")))
        if not names and packed:
            raise InputError(f"{path}: {trouble}, and its files are compressed: unzstd {packed}")
        if not names:
            raise InputError(f"{path}: is not a bag ({trouble}): give {A_BAG}")
        _log.warning("%s: %s: reading %s", path, trouble, ", ".join(names))
    missing = [name for name in names if not (path / name).is_file()]
    if missing:
        raise InputError(f"{path}: lacks {', '.join(missing)}: copy the whole bag")
    files = [path / name for name in names]
    return open_recording(files[0]) if len(files) == 1 else _Files(files)


def is_only_a_bag(path: Path) -> bool:
    """Return whether a directory holds the files of one rosbag2 recording, and nothing else."""
    names = {METADATA}
    with suppress(Exception):  # damaged or missing
        names.update(_read_metadata(path / METADATA)["relative_file_paths"])
    own = f"{path.resolve().name}_"
    return all(
        file.name in names or (file.name.startswith(own) and file.suffix in (".mcap", ".db3"))
        for file in path.iterdir()
    )


def _read_metadata(path: Path) -> dict[str, Any]:
    # The loader written in C is faster and crashes on deep nesting.
    with path.open("rb") as file:
        content = file.read(_METADATA_LIMIT + 1)
    if len(content) > _METADATA_LIMIT:
        raise LookupError
    information = yaml.load(content, yaml.SafeLoader)["rosbag2_bagfile_information"]
    return dict(information)


def _translates(type_name: str, md5sum: str) -> bool:
    """Return whether a ROS 1 type is the standard one, so that its bytes can be converted."""
    known = _ros1_types()
    return (
        is_standard(type_name)
        and type_name in known.fielddefs
        and known.generate_msgdef(type_name)[1] == md5sum
    )


@cache
def _ros1_types() -> Typestore:
    return get_typestore(Stores.ROS1_NOETIC)
