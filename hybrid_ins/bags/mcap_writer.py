"""
MCAP files written in blocks of messages.

The library `mcap` encodes the format's records. Here is what it lacks: many messages at once, and
a file that is sound after an interruption at any moment.
"""

from __future__ import annotations

import fcntl
import zlib
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from struct import Struct

import numpy as np
from mcap import records
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from numpy.typing import NDArray

from hybrid_ins.bags.mcap_reader import INDEX, MAGIC, MESSAGE, RECORD, Channel
from hybrid_ins.errors import InputError

CHUNK_SIZE = 1 << 18  # bytes; what a killed writer loses

_HEAD = Struct("<BQHIQQ")  # the fields of MESSAGE


class McapWriter:
    """
    Writes one MCAP file with chunks, checksums and an index.

    What was given is on the disk after `flush` or `close`. Both may be repeated after they were
    interrupted: they write the same bytes at the same place again. The file is locked until then.

    Parameters
    ----------
    path : Path
        Of the new file.
    library : str
        Name of the writing program, in the file's header.

    """

    def __init__(self, path: Path, library: str) -> None:
        self.path = path
        self.start_ns = self.end_ns = 0
        self.counts: Counter[int] = Counter()  # of messages, by channel
        self._schemas: dict[str, records.Schema] = {}
        self._channels: list[records.Channel] = []
        self._undefined: list[records.McapRecord] = []  # schemas and channels, in no chunk yet
        self._chunks: list[records.ChunkIndex] = []
        self._pending: list[tuple[int, Sequence[int], bytes]] = []  # channel, log times, records
        self._pending_size = 0
        self._file = path.open("xb", buffering=0)  # an interrupted write leaves nothing behind
        with suppress(OSError):  # a file system without locks
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        self._end = 0
        header = MAGIC + _encoded(records.Header("ros2", library))
        self._put(header)
        self._end = len(header)

    @property
    def written(self) -> int:
        """Number of messages so far, those that are pending included."""
        return self.counts.total() + sum(len(log_ns) for _, log_ns, _ in self._pending)

    def add_channel(self, channel: Channel, definition: str, metadata: dict[str, str]) -> int:
        """
        Announce a channel.

        Parameters
        ----------
        channel
            Topic, type and encoding.
        definition
            The type's message definition with those it builds on, as in ``ros2msg``.
        metadata
            Stored beside the channel.

        Returns
        -------
        int
            The channel's number, for `write`.

        """
        schema = self._schemas.get(channel.type_name)
        if schema is None:
            schema = records.Schema(
                id=len(self._schemas) + 1,
                name=channel.type_name,
                encoding="ros2msg",
                data=definition.encode(),
            )
            self._schemas[channel.type_name] = schema
            self._undefined.append(schema)
        number = len(self._channels) + 1
        record = records.Channel(number, channel.topic, channel.encoding, metadata, schema.id)
        self._channels.append(record)
        self._undefined.append(record)
        self.counts[number] = 0
        return number

    def write(self, channel: int, log_ns: int, data: bytes) -> None:
        """Append a message; it reaches the disk with its chunk."""
        if log_ns < 0:
            raise ValueError(f"log time {log_ns} ns lies before the epoch")
        size = _HEAD.size - RECORD.size + len(data)
        head = _HEAD.pack(Opcode.MESSAGE, size, channel, 0, log_ns, log_ns)
        self._append(channel, (log_ns,), head + data)

    def write_rows(self, channel: int, log_ns: NDArray[np.int64], rows: NDArray[np.uint8]) -> None:
        """Append many messages of one size: log times (N,) and their bytes, a row each."""
        if log_ns.min() < 0:
            raise ValueError(f"log time {log_ns.min()} ns lies before the epoch")
        layout = np.dtype([("head", MESSAGE), ("data", np.uint8, rows.shape[1])])
        most = max(1, CHUNK_SIZE // layout.itemsize)
        for start in range(0, len(rows), most):
            times = log_ns[start : start + most]
            block = np.zeros(len(times), layout)
            head = block["head"]
            head["opcode"], head["length"] = Opcode.MESSAGE, layout.itemsize - RECORD.size
            head["channel"], head["log_ns"], head["publish_ns"] = channel, times, times
            block["data"] = rows[start : start + most]
            self._append(channel, times.tolist(), block.tobytes())

    def _append(self, channel: int, log_ns: Sequence[int], messages: bytes) -> None:
        self._pending.append((channel, log_ns, messages))
        self._pending_size += len(messages)
        if self._pending_size > CHUNK_SIZE:
            self.flush()

    def flush(self) -> None:
        """Write what is pending as one chunk."""
        if not self._pending:
            return
        parts = [_encoded(*self._undefined)]
        offset = len(parts[0])
        entries: dict[int, tuple[list[int], list[int]]] = {}  # log times and offsets in the chunk
        for channel, times, messages in self._pending:
            known_times, offsets = entries.setdefault(channel, ([], []))
            known_times += times
            offsets += range(offset, offset + len(messages), len(messages) // len(times))
            parts.append(messages)
            offset += len(messages)
        content = b"".join(parts)
        tables = {c: np.array(columns, "<u8").T.copy() for c, columns in entries.items()}
        first_ns = min(int(table[:, 0].min()) for table in tables.values())
        last_ns = max(int(table[:, 0].max()) for table in tables.values())
        chunk = _encoded(
            records.Chunk("", content, last_ns, first_ns, zlib.crc32(content), len(content))
        )
        indexes, places = b"", {}
        for channel, table in tables.items():
            places[channel] = self._end + len(chunk) + len(indexes)
            head = INDEX.pack(Opcode.MESSAGE_INDEX, 6 + table.nbytes, channel, table.nbytes)
            indexes += head + table.tobytes()
        self._put(chunk, indexes)

        self.start_ns = min(self.start_ns, first_ns) if self._chunks else first_ns
        self.end_ns = max(self.end_ns, last_ns)
        for channel, table in tables.items():
            self.counts[channel] += len(table)
        self._chunks.append(
            records.ChunkIndex(
                chunk_start_offset=self._end,
                chunk_length=len(chunk),
                message_start_time=first_ns,
                message_end_time=last_ns,
                message_index_offsets=places,
                message_index_length=len(indexes),
                compression="",
                compressed_size=len(content),
                uncompressed_size=len(content),
            )
        )
        self._end += len(chunk) + len(indexes)
        self._undefined.clear()
        self._pending.clear()
        self._pending_size = 0

    def close(self) -> None:
        """Write what is pending, the summary and the end of the file."""
        if self._file.closed:
            return
        self.flush()
        data_end = _encoded(records.DataEnd(0))
        statistics = records.Statistics(
            message_count=self.counts.total(),
            schema_count=len(self._schemas),
            channel_count=len(self._channels),
            attachment_count=0,
            metadata_count=0,
            chunk_count=len(self._chunks),
            message_start_time=self.start_ns,
            message_end_time=self.end_ns,
            channel_message_counts=dict(self.counts),
        )
        summary = _encoded(*self._schemas.values(), *self._channels, statistics, *self._chunks)
        start = self._end + len(data_end)
        crc = zlib.crc32(summary + _encoded(records.Footer(start, 0, 0))[:-4])
        self._put(data_end, summary, _encoded(records.Footer(start, 0, crc)), MAGIC)
        self._file.close()

    def abandon(self) -> None:
        """Close the file as it is."""
        self._file.close()

    def _put(self, *parts: bytes) -> None:
        try:
            self._file.seek(self._end)
            for part in parts:
                rest = memoryview(part)
                while rest:
                    rest = rest[self._file.write(rest) :]
        except OSError as error:
            raise InputError(f"{self.path}: cannot be written: {error.strerror}") from None


def _encoded(*items: records.McapRecord) -> bytes:
    builder = RecordBuilder()
    for item in items:
        item.write(builder)
    encoded: bytes = builder.end()  # type: ignore[no-untyped-call]
    return encoded
