"""MCAP files written by the library `mcap`, in a thread that Ctrl-C does not interrupt."""

from __future__ import annotations

import fcntl
from collections import Counter, deque
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import CompressionType, Writer
from numpy.typing import NDArray

from hybrid_ins.bags.mcap_reader import MAGIC, Channel
from hybrid_ins.output_file import cannot_be_written

CHUNK_SIZE = 1 << 18  # bytes; a killed writer loses two at most
PROFILE, LIBRARY = "ros2", "hybrid_ins"  # of the header, which tells whose file it is


def is_own(path: Path) -> bool:
    """Return whether a file is one that `McapWriter` has begun; an empty one may be."""
    with path.open("rb") as file:
        head = file.read(64)
    return not head or (head.startswith(MAGIC) and LIBRARY.encode() in head)


class McapWriter:
    """
    Writes one MCAP file with chunks, checksums and an index; errors call it ``name``.

    What was given is on the disk after `close`, which may be repeated after an interruption. The
    file is locked until then, and the attributes are those of what is written.

    """

    def __init__(self, path: Path, name: Path) -> None:
        self.path, self._name = path, name
        self.start_ns = self.end_ns = 0
        self.counts: Counter[int] = Counter()  # of messages, by channel
        self._channels = 0
        self._schemas: dict[str, int] = {}
        self._file = path.open("xb")
        with suppress(OSError):  # a file system without locks
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        self._writer = Writer(self._file, CHUNK_SIZE, CompressionType.NONE)
        self._tasks: deque[tuple[Callable[..., Any], tuple[Any, ...]]] = deque()
        self._tasks.append((self._writer.start, (PROFILE, LIBRARY)))
        self._size = 0  # bytes of the tasks' messages
        self._error: OSError | None = None
        self._thread = ThreadPoolExecutor(1)

    def add_channel(self, channel: Channel, definition: str, metadata: dict[str, str]) -> int:
        """Announce a channel and its type's definition (``ros2msg``); return its number."""
        schema = self._schemas.get(channel.type_name)
        if schema is None:  # the library numbers them in this order
            schema = self._schemas[channel.type_name] = len(self._schemas) + 1
            schema_arguments = (channel.type_name, "ros2msg", definition.encode())
            self._tasks.append((self._writer.register_schema, schema_arguments))
        self._channels += 1
        channel_arguments = (channel.topic, channel.encoding, schema, metadata)
        self._tasks.append((self._writer.register_channel, channel_arguments))
        return self._channels

    def write(self, channel: int, log_ns: int, data: bytes) -> None:
        """Append a message."""
        self._append(channel, (log_ns,), (data,), len(data))

    def write_rows(self, channel: int, log_ns: NDArray[np.int64], rows: NDArray[np.uint8]) -> None:
        """Append many messages: log times (N,) and their bytes, a row each."""
        self._append(channel, log_ns.tolist(), map(bytes, rows), rows.nbytes)

    def flush(self) -> None:
        """Write what is pending as a chunk, which can be read although the file has no end yet."""
        self._tasks.append((self._flush, ()))
        self._hand_over()

    def close(self) -> None:
        """Write what is pending, the summary and the end of the file."""
        self._tasks.append((self._finish, ()))
        self._hand_over()

    def abandon(self) -> None:
        """Close the file as it is."""
        self._tasks.clear()
        self._thread.shutdown()
        self._file.close()

    def _append(
        self, channel: int, log_ns: Sequence[int], messages: Iterable[bytes], size: int
    ) -> None:
        if min(log_ns) < 0:
            raise ValueError(f"log time {min(log_ns)} ns lies before the epoch")
        self._tasks.append((self._add, (channel, log_ns, messages)))
        self._size += size
        if self._size > CHUNK_SIZE:
            self._hand_over()

    def _hand_over(self) -> None:
        """Wait until the thread has done the tasks."""
        self._size = 0
        self._thread.submit(self._work).result()
        if self._error is not None:
            raise cannot_be_written(self._name, self._error)

    def _work(self) -> None:
        """Do the tasks; after an error, none."""
        while self._tasks:
            function, arguments = self._tasks.popleft()
            try:
                if self._error is None:
                    function(*arguments)
            except OSError as error:
                self._error = error

    def _add(self, channel: int, log_ns: Sequence[int], messages: Iterable[bytes]) -> None:
        first_ns, last_ns = min(log_ns), max(log_ns)
        self.start_ns = min(self.start_ns, first_ns) if self.counts else first_ns
        self.end_ns = max(self.end_ns, last_ns)
        self.counts[channel] += len(log_ns)
        for time_ns, data in zip(log_ns, messages, strict=True):
            self._writer.add_message(channel, time_ns, data, time_ns)

    def _flush(self) -> None:
        if not self._file.closed:
            with suppress(AttributeError):  # early releases end a chunk only when it is full
                self._writer.flush()  # type: ignore[no-untyped-call]
            self._file.flush()

    def _finish(self) -> None:
        if not self._file.closed:
            self._writer.finish()  # type: ignore[no-untyped-call]
            self._file.close()
