"""Recordings written: rosbag2 directories and single MCAP files."""

from __future__ import annotations

import logging
import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import yaml
from numpy.typing import NDArray

from hybrid_ins.bags.mcap_reader import Channel
from hybrid_ins.bags.mcap_writer import McapWriter
from hybrid_ins.bags.messages import TYPES, Message, absolute, is_standard
from hybrid_ins.errors import InputError

if TYPE_CHECKING:
    from types import TracebackType

    from typing_extensions import Self

LATCHED = ("/datum", "/truth/datum", "/tf_static")  # topics whose last message late readers get

_METADATA = "metadata.yaml"
_FOREVER = {"sec": 9_223_372_036, "nsec": 854_775_807}  # as rosbag2 writes it

_log = logging.getLogger(__name__)


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
            raise ValueError(f"{topic}: {type_name} is no standard message type")
        return self._writer.add_channel(
            Channel(topic, type_name, "cdr"),
            TYPES.generate_msgdef(type_name, ros_version=2)[0],
            {
                "offered_qos_profiles": yaml.safe_dump(_offered_qos(topic), sort_keys=False),
                "topic_type_hash": TYPES.hash_rihs01(type_name),
            },
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
