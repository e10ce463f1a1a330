"""Recordings written: rosbag2 directories and single MCAP files."""

from __future__ import annotations

import fcntl
import logging
import shutil
from collections.abc import Sequence
from contextlib import suppress
from itertools import chain, count
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import yaml
from numpy.typing import NDArray

from hybrid_ins.bags.formats import BEGINNINGS, METADATA, is_only_a_bag
from hybrid_ins.bags.mcap_reader import Channel
from hybrid_ins.bags.mcap_writer import McapWriter, is_own
from hybrid_ins.bags.messages import LATCHED, TYPES, Message, absolute, is_standard
from hybrid_ins.errors import InputError
from hybrid_ins.output_file import cannot_be_written, check_output, is_full, private_name

if TYPE_CHECKING:
    from types import TracebackType

    from typing_extensions import Self

_FOREVER = {"sec": 9_223_372_036, "nsec": 854_775_807}  # as rosbag2 writes it

_log = logging.getLogger(__name__)


class BagWriter:
    """
    A new rosbag2 recording in MCAP: a directory, or one file where the path ends in ``.mcap``.

    It is written beside its place, under its name with ``.part`` added, and takes its place when it
    is complete; what was there before is removed only then. A killed process leaves the part, which
    can be read up to its last chunk; the next writer of that bag sets it aside. Nothing is removed
    that this program did not make.

    As a context manager it is completed however the block ends: after an exception or Ctrl-C it
    holds everything written so far, and a warning says that it ends early and where it is: in its
    place if that is free, else beside it, as ``NAME.partial``. Without a message nothing is left.

    Parameters
    ----------
    path
        The bag. Directories above it are made.
    overwrite
        Replace what is there, provided that it is a bag.
    inputs
        Files and bags that are read meanwhile.
    keep_partial
        Whether a bag that ends early is left. Else the part is hidden, and where this process is
        killed the next such writer removes it.

    Raises
    ------
    InputError
        `path` is an input, exists and may not be overwritten, or is being written already; or
        what is in the place of its part is none.

    """

    def __init__(
        self,
        path: Path | str,
        overwrite: bool = False,
        *,
        inputs: Sequence[Path] = (),
        keep_partial: bool = True,
    ) -> None:
        self.path = Path(path)
        check_output(self.path, inputs, overwrite, folder=True)
        _check_replaceable(self.path)
        self._overwrite = overwrite
        self._keep_partial = keep_partial
        self._is_open = True
        self._target = self.path.resolve()  # where a link points to
        hidden = "" if keep_partial else "."
        self._part = self._target.with_name(f"{hidden}{self._target.name}.part")
        self._set_aside_abandoned()
        file = self._part
        try:
            if self.path.suffix != ".mcap":
                self._part.mkdir(parents=True)
                file = self._part / f"{self._target.name}_0.mcap"
            else:
                self._part.parent.mkdir(parents=True, exist_ok=True)
            self._writer = McapWriter(file, self.path)
        except OSError as error:
            raise cannot_be_written(self.path, error) from None
        self._numbers: dict[tuple[str, str], int] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if kind is None:
            self.close()
        elif self._is_open:
            self._abandon()
        if is_full(error):  # as it was for temporary files beside the bag
            raise cannot_be_written(self.path, error) from None

    def close(self) -> None:
        """Complete the bag and put it in its place; closing twice is harmless."""
        if self._is_open:
            self._complete()
            if self._target.exists() and not self._overwrite:
                raise InputError(f"{self.path}: exists meanwhile: the new bag is {self._part}")
            self._take_place()

    def flush(self) -> None:
        """Bring what was written into the file, where it survives that the process is killed."""
        if self._is_open:
            self._writer.flush()

    @property
    def folder(self) -> Path:
        """Where the bag will lie; there is room for temporary files there."""
        return self._target.parent

    def discard(self) -> None:
        """Remove what was written; what was at `path` before stays."""
        self._is_open = False
        self._writer.abandon()
        _remove(self._part)

    def _abandon(self) -> None:
        """Keep what was written where that is of use."""
        if not self._keep_partial:
            self.discard()
            return
        try:
            self._complete()
        except InputError as error:  # the disk is full: this may be why we are here
            _log.warning("%s: is incomplete (%s)", self._part, error)
            return
        written = self._writer.counts.total()
        if not written:
            self.discard()
            return
        if self._target.exists():
            place = _set_aside(self._part)
        else:
            self._take_place()
            place = self.path
        seconds = (self._writer.end_ns - self._writer.start_ns) / 1e9
        _log.warning("%s: ends early, after %d messages (%.1f s)", place, written, seconds)

    def _set_aside_abandoned(self) -> None:
        """Make way where a writer was killed; refuse where one is still at work."""
        part = self._part
        if not part.exists():
            return
        for file in _own_files(part):
            with file.open("rb") as opened, suppress(OSError):  # a file system without locks
                try:
                    fcntl.flock(opened, fcntl.LOCK_EX | fcntl.LOCK_NB)
                except BlockingIOError:
                    raise InputError(f"{self.path}: another process is writing it") from None
        if self._keep_partial:
            place = _set_aside(part)
            _log.warning("%s: what an earlier run wrote before it was killed", place)
        else:
            _remove(part)

    def _complete(self) -> None:
        self._writer.close()
        if self._part.is_dir():
            text = yaml.safe_dump(self._metadata(), sort_keys=False)
            (self._part / METADATA).write_text(text, encoding="utf-8")

    def _take_place(self) -> None:
        old = private_name(self._target)
        if self._target.exists():
            _check_replaceable(self.path)
            self._target.rename(old)
        try:
            self._part.rename(self._target)
        except BaseException:
            if old.exists() and not self._target.exists():
                old.rename(self._target)
            raise
        self._is_open = False
        _remove(old)

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
        data = bytes(TYPES.serialize_cdr(message, type_name, little_endian=True))
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

    def _number(self, topic: str, type_name: str) -> int:
        """Return a topic's channel, made if it is new."""
        number = self._numbers.get((topic, type_name))
        if number is None:
            number = self._numbers[topic, type_name] = self._channel(absolute(topic), type_name)
        return number

    def _channel(self, topic: str, type_name: str) -> int:
        for (known_topic, known_type), number in self._numbers.items():
            if absolute(known_topic) == topic:
                if known_type != type_name:
                    raise ValueError(f"{topic} holds {known_type}, not {type_name}")
                return number
        if not is_standard(type_name):
            raise ValueError(f"{topic}: {type_name} is not a standard message type")
        return self._writer.add_channel(
            Channel(topic, type_name, "cdr"),
            TYPES.generate_msgdef(type_name, ros_version=2)[0],
            {
                "offered_qos_profiles": yaml.safe_dump(_offered_qos(topic), sort_keys=False),
                "topic_type_hash": TYPES.hash_rihs01(type_name),
            },
        )

    def _metadata(self) -> dict[str, Any]:
        """Return the content of ``metadata.yaml`` of a rosbag2 directory, version 9."""
        writer = self._writer
        span = {
            "duration": {"nanoseconds": writer.end_ns - writer.start_ns},
            "starting_time": {"nanoseconds_since_epoch": writer.start_ns},
            "message_count": writer.counts.total(),
        }
        topics = {
            number: {
                "name": absolute(topic),
                "type": type_name,
                "serialization_format": "cdr",
                "offered_qos_profiles": _offered_qos(absolute(topic)),
                "type_description_hash": TYPES.hash_rihs01(type_name),
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


def _offered_qos(topic: str) -> list[dict[str, Any]]:
    """Return the QoS that ``ros2 bag play`` shall offer, as rosbag2 writes it in version 9."""
    return [
        {
            "history": "keep_last",
            "depth": 100,
            "reliability": "reliable",
            "durability": "transient_local" if topic in LATCHED else "volatile",
            "deadline": dict(_FOREVER),
            "lifespan": dict(_FOREVER),
            "liveliness": "automatic",
            "liveliness_lease_duration": dict(_FOREVER),
            "avoid_ros_namespace_conventions": False,
        }
    ]


def _check_replaceable(path: Path) -> None:
    """Raise `InputError` where something exists that is not a bag, or holds more than one."""
    if path.is_dir():
        if not is_only_a_bag(path):
            raise InputError(f"{path}: holds other files than those of one bag: not overwritten")
    elif path.exists():
        is_bag = False
        if path.is_file():
            with path.open("rb") as file:
                head = file.read(16)
            is_bag = not head or head.startswith(BEGINNINGS)
        if not is_bag:
            raise InputError(f"{path}: is not a bag: not overwritten")


def _own_files(part: Path) -> list[Path]:
    """Return the files of an unfinished bag; `InputError` where they are not this program's."""
    files = list(part.iterdir()) if part.is_dir() else [part]
    if not all(file.name == METADATA or (file.is_file() and is_own(file)) for file in files):
        raise InputError(
            f"{part}: is not an unfinished bag of this program, which would be written there: "
            "rename it"
        )
    return files


def _set_aside(part: Path) -> Path:
    """Rename an incomplete bag so that later writers leave it alone; return its new path."""
    name, suffix = part.stem, ""
    if name.endswith(".mcap"):
        name, suffix = name.removesuffix(".mcap"), ".mcap"
    names = (f"{name}.partial{number}{suffix}" for number in chain([""], count(2)))
    place = next(path for path in map(part.with_name, names) if not path.exists())
    return part.rename(place)


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
