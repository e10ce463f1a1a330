"""
MCAP files as rosbag2 writes them: read and written in bulk, and read as far as they go.

A general MCAP library makes an object of every record; here a message costs one `struct` call, so
that a program waits for its filter and not for its bag. Reading needs no index: a recording whose
writer was killed is read up to the point where it breaks off.

References
----------
MCAP format specification, version 0.

"""

from __future__ import annotations

import logging
import mmap
import struct
import sys
import zlib
from bisect import bisect_left
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from operator import itemgetter
from pathlib import Path
from struct import Struct
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray

from hybrid_ins.core.compilation import kernel
from hybrid_ins.errors import InputError

MAGIC = b"\x89MCAP0\r\n"

_HEADER, _FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _MESSAGE_INDEX, _CHUNK_INDEX = range(1, 9)
_STATISTICS, _DATA_END = 0x0B, 0x0F

_RECORD = Struct("<BQ")  # opcode, length of what follows
_MESSAGE_HEAD = Struct("<BQHIQQ")  # opcode, length, channel, sequence, log time, publish time
_CHUNK_HEAD = Struct("<QQQI")  # first and last log time, uncompressed size and its CRC
_CHUNK_INDEX_HEAD = Struct("<QQQQI")  # first and last log time, offset, length, size of offsets
_FOOTER_BODY = Struct("<QQI")  # start of the summary, of the summary offsets, CRC
_STATISTICS_HEAD = Struct("<QHIIIIQQI")  # messages, schemas, channels, ..., chunks, times, size
_RECORD_SIZE, _MESSAGE_SIZE = _RECORD.size, _MESSAGE_HEAD.size
_U16, _U32, _U64 = Struct("<H"), Struct("<I"), Struct("<Q")
_FOOTER_SIZE = _RECORD.size + _FOOTER_BODY.size + len(MAGIC)

_CHUNK_SIZE = 1 << 18  # taken apart in half a millisecond; what a killed writer loses
_LARGEST_CHUNK = 1 << 30  # uncompressed; more is a defect or a decompression bomb

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Channel:
    """A stream of messages of one type on one topic."""

    topic: str
    type_name: str
    encoding: str


Record: TypeAlias = tuple[int, Channel, bytes]  # log time [ns], channel, serialised message
_LOG_TIME = itemgetter(0)


class _Chunk(NamedTuple):
    start_ns: int
    offset: int  # of its record in the file; 0 stands for all messages outside of chunks


class _Block(NamedTuple):
    """Messages of one channel and size, as their records lie in a chunk."""

    channel: int
    first_ns: int
    last_ns: int
    times: bytes  # log times, 64 bits each
    size: int  # of a record
    records: bytes | memoryview


class _DamageError(Exception):
    """The bytes are not what the format promises."""


class McapReader:
    """
    One MCAP file, memory-mapped.

    Attributes
    ----------
    counts : dict
        Number of messages of each channel.
    start_ns, end_ns : int
        First and last log time; both 0 in a file without messages.

    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.counts: dict[Channel, int] = {}
        self.start_ns = self.end_ns = 0
        self._channels: dict[int, Channel] = {}
        self._chunks: list[_Chunk] = []
        with path.open("rb") as file:
            self._file = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        self._view = memoryview(self._file)
        self._data_end = len(self._view)
        try:
            self._read_summary()
        except _DamageError as damage:
            self._scan(str(damage))

    def close(self) -> None:
        """Unmap the file; messages read from it stay valid."""
        with suppress(BufferError):  # an unfinished iteration still looks at it: unmapped with it
            self._view.release()
            self._file.close()

    def records(self, wanted: Callable[[Channel], bool]) -> Iterator[Record]:
        """
        Yield the messages of all `wanted` channels in the order of their log times.

        Messages of equal log time keep the file's order.

        Raises
        ------
        InputError
            A part of the file is damaged; the messages before it have been yielded.

        """
        channels = {number: c for number, c in self._channels.items() if wanted(c)}
        flags = np.zeros(1 << 16, np.bool_)
        flags[list(channels)] = True
        waiting: list[Record] = []
        next_starts = [chunk.start_ns for chunk in self._chunks[1:]]
        for chunk, next_start_ns in zip(self._chunks, [*next_starts, None], strict=True):
            buffer, *found = self._found(chunk, flags)
            content = memoryview(buffer)
            waiting += [
                (log_ns, channels[number], bytes(content[begin:end]))
                for begin, end, number, log_ns in zip(
                    *(column.tolist() for column in found), strict=True
                )
            ]
            waiting.sort(key=_LOG_TIME)
            ready = len(waiting)
            if next_start_ns is not None:
                ready = bisect_left(waiting, next_start_ns, key=_LOG_TIME)
            yield from waiting[:ready]
            del waiting[:ready]

    def rows(
        self, wanted: Callable[[Channel], bool]
    ) -> tuple[NDArray[np.int64], NDArray[np.uint8]] | None:
        """
        Return log times (N,) and bytes (N, size) of messages of one size, ordered as `records`.

        None where there is no message, or where their sizes differ; raises as `records` does.
        """
        flags = np.zeros(1 << 16, np.bool_)
        flags[[number for number, c in self._channels.items() if wanted(c)]] = True
        parts: list[NDArray[np.uint8]] = []
        times: list[NDArray[np.int64]] = []
        for chunk in self._chunks:
            buffer, begins, ends, _, log_ns = self._found(chunk, flags)
            if len(begins):
                if parts and parts[0].shape[1] != ends[0] - begins[0]:
                    return None
                if np.any(ends - begins != ends[0] - begins[0]):
                    return None
                parts.append(_gathered(buffer, begins, ends[0] - begins[0]))
                times.append(log_ns.astype(np.int64))
        if not parts:
            return None
        rows, log_times = np.concatenate(parts), np.concatenate(times)
        if np.any(log_times[1:] < log_times[:-1]):
            order = np.argsort(log_times, kind="stable")
            rows, log_times = rows[order], log_times[order]
        return log_times, rows

    def _found(self, chunk: _Chunk, flags: NDArray[np.bool_]) -> tuple[Any, ...]:
        """Return a chunk's content, and what `_walk` finds there."""
        try:
            content, begin, end = self._content(chunk.offset)
            buffer = np.frombuffer(content, np.uint8)
            reached, begins, ends, numbers, log_ns = _walk(buffer, begin, end, flags)
            if reached != end:
                raise _DamageError("a record is cut off or has a wrong length")
            if len(log_ns) and log_ns.min() < chunk.start_ns:
                raise _DamageError("a message is older than its chunk")
        except _DamageError as damage:
            raise InputError(
                f"{self.path}: damaged at byte {chunk.offset}: {damage};"
                " fetch the bag again from where it was recorded"
            ) from None
        return buffer, begins, ends, numbers, log_ns

    def _read_summary(self) -> None:
        """Learn channels, counts and chunks from the index at the end of the file."""
        start = len(self._view) - _FOOTER_SIZE
        if start < len(MAGIC) or self._view[-len(MAGIC) :] != MAGIC:
            raise _DamageError("it has no end")
        if _RECORD.unpack_from(self._view, start) != (_FOOTER, _FOOTER_BODY.size):
            raise _DamageError("its footer is damaged")
        summary, _, crc = _FOOTER_BODY.unpack_from(self._view, start + _RECORD.size)
        if not len(MAGIC) <= summary <= start:
            raise _DamageError("it has no index")
        if crc and crc != zlib.crc32(self._view[summary : -len(MAGIC) - _U32.size]):
            raise _DamageError("its index fails its checksum")

        schemas: dict[int, str] = {}
        counts: Counter[int] = Counter()
        chunk_count = -1
        try:
            for opcode, body in _records(self._view, summary, start):
                if opcode == _CHUNK_INDEX:
                    first_ns, _, offset, *_ = _CHUNK_INDEX_HEAD.unpack_from(body)
                    self._chunks.append(_Chunk(first_ns, offset))
                elif opcode == _STATISTICS:
                    fields = _STATISTICS_HEAD.unpack_from(body)
                    chunk_count, self.start_ns, self.end_ns = fields[5:8]
                    counts.update(dict(struct.iter_unpack("<HQ", body[_STATISTICS_HEAD.size :])))
                else:
                    self._learn(opcode, body, schemas)
        except struct.error:
            raise _DamageError("its index is damaged") from None
        if not self._chunks or len(self._chunks) != chunk_count:
            raise _DamageError("its index is incomplete")
        self._chunks.sort()
        self._set_counts(counts)

    def _scan(self, reason: str) -> None:
        """Learn the same from the data, up to where they break off."""
        self._channels.clear()
        self._chunks.clear()
        schemas: dict[int, str] = {}
        counts: Counter[int] = Counter()
        times: list[int] = []
        loose_times: list[int] = []
        self._data_end = len(MAGIC)
        completed = False
        try:
            for opcode, body in _records(self._view, len(MAGIC), len(self._view)):
                if opcode in (_DATA_END, _FOOTER):
                    completed = True
                    break
                if opcode == _CHUNK:
                    buffer, begin, end = self._content(self._data_end)
                    inner = list(_records(memoryview(buffer), begin, end))
                else:
                    inner = [(opcode, body)]
                chunk_times: list[int] = []
                for inner_opcode, inner_body in inner:
                    if inner_opcode == _MESSAGE:
                        number, _, log_ns = struct.unpack_from("<HIQ", inner_body)
                        counts[number] += 1
                        chunk_times.append(log_ns)
                    else:
                        self._learn(inner_opcode, inner_body, schemas)
                if opcode != _CHUNK:
                    loose_times += chunk_times
                elif chunk_times:
                    self._chunks.append(_Chunk(min(chunk_times), self._data_end))
                times += chunk_times
                self._data_end += _RECORD.size + len(body)
        except (_DamageError, struct.error) as damage:
            reason = f"{reason}; {damage}"
        if loose_times:
            self._chunks.append(_Chunk(min(loose_times), 0))
        self._chunks.sort()
        self._set_counts(counts)
        if times:
            self.start_ns, self.end_ns = min(times), max(times)
        elif not completed:
            self.close()
            raise InputError(
                f"{self.path}: breaks off at byte {self._data_end} before the first whole message"
                f" ({reason}): fetch the bag again from where it was recorded"
            )
        _log.warning(
            "%s: %s (%s): reading its %d whole messages",
            self.path,
            "the recording has no usable index"
            if completed
            else f"the recording breaks off at byte {self._data_end} of {len(self._view)}",
            reason,
            len(times),
        )

    def _learn(self, opcode: int, body: memoryview, schemas: dict[int, str]) -> None:
        try:
            if opcode == _SCHEMA:
                schemas[_U16.unpack_from(body)[0]], _ = _text(body, _U16.size)
            elif opcode == _CHANNEL:
                number, schema = struct.unpack_from("<HH", body)
                topic, position = _text(body, 2 * _U16.size)
                encoding, _ = _text(body, position)
                self._channels[number] = Channel(topic, schemas.get(schema, ""), encoding)
        except (struct.error, UnicodeDecodeError):
            raise _DamageError("a description of a topic is damaged") from None

    def _set_counts(self, counts: Counter[int]) -> None:
        for number, channel in self._channels.items():
            self.counts[channel] = self.counts.get(channel, 0) + counts[number]

    def _content(self, offset: int) -> tuple[memoryview | bytes, int, int]:
        """Return where the records of a chunk lie: buffer, begin, end."""
        if offset == 0:
            return self._view, len(MAGIC), self._data_end
        try:
            opcode, body = next(_records(self._view, offset, len(self._view)))
            if opcode != _CHUNK:
                raise _DamageError("the index points beside the data")
            _, _, size, crc = _CHUNK_HEAD.unpack_from(body)
            compression, position = _text(body, _CHUNK_HEAD.size)
            (stored_size,) = _U64.unpack_from(body, position)
        except (struct.error, UnicodeDecodeError, StopIteration):
            raise _DamageError("the head of a chunk is damaged") from None
        position += _U64.size
        stored = body[position : position + stored_size]
        if size > _LARGEST_CHUNK:
            raise _DamageError(f"a chunk claims {size} bytes")
        content = _decompressed(stored, compression, size)
        if len(content) != size or (crc and zlib.crc32(content) != crc):
            raise _DamageError("a chunk fails its checksum")
        return content, 0, size


class McapWriter:
    """
    Writes one MCAP file with chunks, checksums and an index.

    What was given is on the disk after `flush` or `close`. Both may be repeated after they were
    interrupted: they write the same bytes at the same place again.
    """

    def __init__(self, path: Path, library: str) -> None:
        self.path = path
        self.start_ns = self.end_ns = 0
        self.counts: Counter[int] = Counter()
        self._schemas: dict[str, int] = {}
        self._definitions = bytearray()  # schemas and channels, repeated in the summary
        self._undefined = bytearray()  # those of them that are in no chunk yet
        self._chunk_indexes: list[bytes] = []
        self._pending: list[_Block] = []
        self._pending_size = 0
        self._file = path.open("xb", buffering=0)  # an interrupted write leaves nothing behind
        self._end = 0
        header = MAGIC + _record(_HEADER, _prefixed(b"ros2") + _prefixed(library.encode()))
        self._put(header)
        self._end = len(header)

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
        number = len(self.counts) + 1
        self.counts[number] = 0
        schema, schema_record = self._schemas.get(channel.type_name, 0), b""
        if not schema:
            schema = self._schemas[channel.type_name] = len(self._schemas) + 1
            schema_record = _record(
                _SCHEMA,
                _U16.pack(schema)
                + _prefixed(channel.type_name.encode())
                + _prefixed(b"ros2msg")
                + _prefixed(definition.encode()),
            )
        pairs = b"".join(_prefixed(text.encode()) for pair in metadata.items() for text in pair)
        description = _record(
            _CHANNEL,
            struct.pack("<HH", number, schema)
            + _prefixed(channel.topic.encode())
            + _prefixed(channel.encoding.encode())
            + _prefixed(pairs),
        )
        self._definitions += schema_record + description
        self._undefined += schema_record + description
        return number

    def write(self, channel: int, log_ns: int, data: bytes) -> None:
        """Append a message; it reaches the disk with its chunk."""
        if log_ns < 0:
            raise ValueError(f"log time {log_ns} ns lies before the epoch")
        size = _MESSAGE_HEAD.size + len(data)
        head = _MESSAGE_HEAD.pack(_MESSAGE, size - _RECORD.size, channel, 0, log_ns, log_ns)
        self._append(_Block(channel, log_ns, log_ns, _U64.pack(log_ns), size, head + data))

    def write_rows(self, channel: int, log_ns: NDArray[np.int64], rows: NDArray[np.uint8]) -> None:
        """Append many messages of one size: log times (N,) and their bytes, a row each."""
        if log_ns.min() < 0:
            raise ValueError(f"log time {log_ns.min()} ns lies before the epoch")
        head = np.dtype(
            {
                "names": [
                    "opcode",
                    "length",
                    "channel",
                    "sequence",
                    "log_ns",
                    "publish_ns",
                    "data",
                ],
                "formats": ["u1", "<u8", "<u2", "<u4", "<u8", "<u8", (np.uint8, rows.shape[1])],
                "offsets": [0, 1, 9, 11, 15, 23, _MESSAGE_HEAD.size],
                "itemsize": _MESSAGE_HEAD.size + rows.shape[1],
            }
        )
        most = max(1, _CHUNK_SIZE // head.itemsize)
        for start in range(0, len(rows), most):
            times = log_ns[start : start + most]
            records = np.empty(len(times), head)
            records["opcode"], records["length"] = _MESSAGE, head.itemsize - _RECORD.size
            records["channel"], records["sequence"] = channel, 0
            records["log_ns"] = records["publish_ns"] = times
            records["data"] = rows[start : start + most]
            self._append(
                _Block(
                    channel,
                    int(times.min()),
                    int(times.max()),
                    times.astype("<u8").tobytes(),
                    head.itemsize,
                    records.view(np.uint8).data,
                )
            )

    def write_many(self, channel: int, log_ns: Sequence[int], messages: Sequence[bytes]) -> None:
        """Append many messages: as `write_rows` where of one size, otherwise as `write`."""
        if len({*map(len, messages)}) == 1:
            rows = np.frombuffer(b"".join(messages), np.uint8).reshape(len(messages), -1)
            self.write_rows(channel, np.array(log_ns, np.int64), rows)
        else:
            for t_ns, data in zip(log_ns, messages, strict=True):
                self.write(channel, t_ns, data)

    def _append(self, block: _Block) -> None:
        self._pending.append(block)
        self._pending_size += len(block.records)
        if self._pending_size > _CHUNK_SIZE:
            self.flush()

    def flush(self) -> None:
        """Write what is pending as one chunk."""
        if not self._pending:
            return
        offset = len(self._undefined)
        times: dict[int, list[bytes]] = {}
        places: dict[int, list[NDArray[np.uint64]]] = {}
        for block in self._pending:
            end = offset + len(block.records)
            times.setdefault(block.channel, []).append(block.times)
            places.setdefault(block.channel, []).append(
                np.arange(offset, end, block.size, dtype="<u8")
            )
            offset = end
        content = b"".join([self._undefined, *(block.records for block in self._pending)])
        first_ns = min(block.first_ns for block in self._pending)
        last_ns = max(block.last_ns for block in self._pending)
        compression = _prefixed(b"") + _U64.pack(len(content))
        head = _CHUNK_HEAD.pack(first_ns, last_ns, len(content), zlib.crc32(content)) + compression
        head = _RECORD.pack(_CHUNK, len(head) + len(content)) + head
        size = len(head) + len(content)
        indexes, offsets = bytearray(), bytearray()
        for channel in times:
            offsets += struct.pack("<HQ", channel, self._end + size + len(indexes))
            pairs = np.stack(
                (np.frombuffer(b"".join(times[channel]), "<u8"), np.concatenate(places[channel])),
                axis=1,
            )
            indexes += _record(_MESSAGE_INDEX, _U16.pack(channel) + _prefixed(pairs.tobytes()))
        entry = _record(
            _CHUNK_INDEX,
            _CHUNK_INDEX_HEAD.pack(first_ns, last_ns, self._end, size, len(offsets))
            + offsets
            + _U64.pack(len(indexes))
            + compression
            + _U64.pack(len(content)),
        )
        self._put(head, content, indexes)

        self.start_ns = first_ns if not self._chunk_indexes else min(self.start_ns, first_ns)
        self.end_ns = max(self.end_ns, last_ns)
        for channel in times:
            self.counts[channel] += sum(map(len, places[channel]))
        self._chunk_indexes.append(entry)
        self._end += size + len(indexes)
        self._undefined.clear()
        self._pending.clear()
        self._pending_size = 0

    def close(self) -> None:
        """Write what is pending, the index and the end of the file."""
        if self._file.closed:
            return
        self.flush()
        ending = _record(_DATA_END, _U32.pack(0))
        summary = bytes(self._definitions) + b"".join(self._chunk_indexes)
        pairs = b"".join(struct.pack("<HQ", *pair) for pair in self.counts.items())
        summary += _record(
            _STATISTICS,
            _STATISTICS_HEAD.pack(
                self.counts.total(),
                len(self._schemas),
                len(self.counts),
                0,
                0,
                len(self._chunk_indexes),
                self.start_ns,
                self.end_ns,
                len(pairs),
            )
            + pairs,
        )
        footer = _RECORD.pack(_FOOTER, _FOOTER_BODY.size) + struct.pack(
            "<QQ", self._end + len(ending), 0
        )
        crc = _U32.pack(zlib.crc32(summary + footer))
        self._put(ending + summary + footer + crc + MAGIC)
        self._file.close()

    def _put(self, *parts: bytes | bytearray) -> None:
        try:
            self._file.seek(self._end)
            for part in parts:
                rest = memoryview(part)
                while rest:
                    rest = rest[self._file.write(rest) :]
        except OSError as error:
            raise InputError(f"{self.path}: cannot be written: {error.strerror}") from None


def _records(view: memoryview, position: int, end: int) -> Iterator[tuple[int, memoryview]]:
    """Yield (opcode, body) of the records between two offsets."""
    while position < end:
        if position + _RECORD.size > end:
            raise _DamageError("a record is cut off")
        opcode, length = _RECORD.unpack_from(view, position)
        position += _RECORD.size
        if opcode == 0 or length > end - position:
            raise _DamageError("a record is cut off")
        yield opcode, view[position : position + length]
        position += length


@kernel()
def _walk(buffer, position, end, wanted):  # type: ignore[no-untyped-def]
    """
    Find the messages among the records between two offsets.

    Parameters
    ----------
    buffer : ndarray of uint8
        Records.
    position, end : int
        Where the first begins and the last ends.
    wanted : ndarray of bool, shape (65536,)
        By channel number.

    Returns
    -------
    reached : int
        ``end``, or where a record is damaged.
    begins, ends, channels, log_ns : ndarray, shape (n,)
        Of the content of each wanted message.
    """
    most = (end - position) // _MESSAGE_SIZE
    begins, ends = np.empty(most, np.int64), np.empty(most, np.int64)
    channels, log_ns = np.empty(most, np.int64), np.empty(most, np.uint64)
    count = 0
    while end - position >= _RECORD_SIZE:
        length = _number(buffer, position + 1, 8)
        following = position + _RECORD_SIZE + np.int64(length)
        if length > end - position or following > end:
            break
        if buffer[position] == _MESSAGE:
            if following - position < _MESSAGE_SIZE:
                break
            channel = _number(buffer, position + 9, 2)
            if wanted[channel]:
                begins[count], ends[count] = position + _MESSAGE_SIZE, following
                channels[count], log_ns[count] = channel, _number(buffer, position + 15, 8)
                count += 1
        position = following
    return position, begins[:count], ends[:count], channels[:count], log_ns[:count]


@kernel()
def _gathered(buffer, begins, size):  # type: ignore[no-untyped-def]
    """Return the bytes (n, size) that begin there."""
    rows = np.empty((len(begins), size), np.uint8)
    for k in range(len(begins)):
        for i in range(size):
            rows[k, i] = buffer[begins[k] + i]
    return rows


@register_jitable
def _number(buffer, position, size):  # type: ignore[no-untyped-def]
    """Read an unsigned number of so many bytes."""
    number = np.uint64(0)
    for k in range(size):
        number |= np.uint64(buffer[position + k]) << np.uint64(8 * k)
    return number


def _decompressed(stored: memoryview, compression: str, size: int) -> memoryview | bytes:
    if not compression:
        return stored
    if compression not in _DECOMPRESSORS:
        raise _DamageError(f"a chunk is compressed with {compression!r}, which is not supported")
    try:
        return _DECOMPRESSORS[compression](stored, size + 1)
    except ImportError as error:
        raise _DamageError(f"a chunk is compressed with {compression} ({error})") from None
    except Exception as error:  # each library has its own kind of error for bad data
        raise _DamageError(f"a chunk cannot be decompressed: {error}") from None


def _decompressed_zstd(stored: memoryview, limit: int) -> bytes:
    if sys.version_info >= (3, 14):
        from compression.zstd import ZstdDecompressor
    else:
        from backports.zstd import ZstdDecompressor
    return ZstdDecompressor().decompress(stored, max_length=limit)


def _decompressed_lz4(stored: memoryview, limit: int) -> bytes:
    from lz4.frame import LZ4FrameDecompressor  # type: ignore[import-untyped]

    content: bytes = LZ4FrameDecompressor().decompress(stored, max_length=limit)
    return content


_DECOMPRESSORS = {"zstd": _decompressed_zstd, "lz4": _decompressed_lz4}


def _text(body: memoryview, position: int) -> tuple[str, int]:
    """Read a length-prefixed string; return it and the offset behind it."""
    (length,) = _U32.unpack_from(body, position)
    position += _U32.size
    if position + length > len(body):
        raise _DamageError("a text is cut off")
    return bytes(body[position : position + length]).decode(), position + length


def _prefixed(data: bytes) -> bytes:
    return _U32.pack(len(data)) + data


def _record(opcode: int, body: bytes, more: bytes = b"") -> bytes:
    return b"".join((_RECORD.pack(opcode, len(body) + len(more)), body, more))
