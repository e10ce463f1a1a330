"""
MCAP files read in bulk and as far as they are sound.

The library `mcap` reads the format's records. Here is what it lacks: messages without a Python
object for each of their fields, files whose end is missing or that are damaged in the middle, and
bounded memory.

References
----------
MCAP format specification, version 0.

"""

from __future__ import annotations

import logging
import mmap
import zlib
from array import array
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from heapq import merge
from io import BytesIO
from itertools import chain, pairwise
from operator import itemgetter
from pathlib import Path
from struct import Struct
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from lz4.frame import LZ4FrameDecompressor
from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Channel as McapChannel
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from zstandard import ZstdDecompressor

from hybrid_ins.bags.messages import absolute
from hybrid_ins.errors import InputError

MAGIC = b"\x89MCAP0\r\n"
LARGEST_CHUNK = 1 << 27  # bytes, uncompressed; more is a defect or a decompression bomb
BATCH = 4096  # messages of a chunk that become Python objects at a time

RECORD = Struct("<BQ")  # opcode, length of what follows
INDEX = Struct("<BQHI")  # opcode, length, channel, bytes of the entries
_TIMES = Struct("<QQ")  # of a chunk: first and last log time
_FOOTER = Struct("<QQI8s")  # start of the summary, of its offsets, CRC, magic
MESSAGE = np.dtype([("opcode", "u1"), ("length", "<u8"), ("channel", "<u2"), ("sequence", "<u4"),
                    ("log_ns", "<u8"), ("publish_ns", "<u8")])  # fmt: skip
_NO_CHUNKS = "it has no chunks"

_log = logging.getLogger(__name__)

Buffer: TypeAlias = Any  # bytes, or the file's memory map


@dataclass(frozen=True)
class Channel:
    """A stream of messages of one type on one topic."""

    topic: str
    type_name: str
    encoding: str


Record: TypeAlias = tuple[int, Channel, bytes]  # log time [ns], channel, serialised message


class _Chunk(NamedTuple):
    start_ns: int  # log times of the first and the last message
    end_ns: int
    offset: int  # of its record in the file; 0 stands for all messages outside of chunks
    indexes: dict[int, int]  # offset of the message index by channel; empty: none is known


class _DamageError(Exception):
    """The bytes are not what the format promises."""


class McapReader:
    """
    One MCAP file, memory-mapped.

    A chunk that is damaged is left out, with a warning that names the seconds that are missing.

    Attributes
    ----------
    counts : dict
        Number of messages of each channel.
    start_ns, end_ns : int
        First and last log time; both 0 in a file without messages.

    Raises
    ------
    InputError
        The file ends before its first whole message.

    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.start_ns = self.end_ns = 0
        self._schemas: dict[int, str] = {}
        self._channels: dict[int, Channel] = {}
        self._numbers: Counter[int] = Counter()  # of messages, by channel
        self._chunks: list[_Chunk] = []
        self._data_end = len(MAGIC)  # of what `_recover` could read
        self._reported: set[int] = set()
        with path.open("rb") as file:
            self._file: Any = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        try:
            self._read_summary()
        except Exception as error:  # damaged bytes provoke anything in the library
            self._recover(str(error) or type(error).__name__)
        self._chunks.sort(key=itemgetter(0, 2))
        self.counts: dict[Channel, int] = {}
        for number, channel in self._channels.items():
            self.counts[channel] = self.counts.get(channel, 0) + self._numbers[number]

    def close(self) -> None:
        """Unmap the file; messages read from it stay valid."""
        with suppress(BufferError):  # an unfinished iteration still reads it: unmapped with it
            self._file.close()

    def records(self, wanted: Callable[[Channel], bool]) -> Iterator[Record]:
        """
        Yield the messages of all `wanted` channels in the order of their log times.

        Messages of equal log time keep the file's order.
        """
        numbers = {number for number, channel in self._channels.items() if wanted(channel)}
        chunks = [c for c in self._chunks if not c.indexes or numbers & c.indexes.keys()]
        streams = [self._messages(chunk, numbers) for chunk in chunks]
        overlap = any(after.start_ns < before.end_ns for before, after in pairwise(chunks))
        ordered = merge(*streams, key=itemgetter(0)) if overlap else chain.from_iterable(streams)
        for log_ns, number, data in ordered:
            if data:
                yield log_ns, self._channels[number], data

    def _messages(self, chunk: _Chunk, numbers: set[int]) -> Iterator[tuple[int, int, bytes]]:
        """Yield log time, channel and data of a chunk's wanted messages; first an empty one."""
        yield chunk.start_ns, 0, b""  # so that a merge opens the chunk only at its turn
        try:
            content = self._content(chunk.offset)
            try:
                offsets = self._indexed(chunk, numbers)
                heads = _heads(content, offsets)
            except _DamageError:  # or no index at all
                span = (0, len(content)) if chunk.offset else (len(MAGIC), self._data_end)
                walk = (at for opcode, at, _ in _walk(content, *span) if opcode == Opcode.MESSAGE)
                offsets = np.fromiter(walk, np.int64)
                heads = _heads(content, offsets)
        except _DamageError as damage:
            self._report(chunk, damage)
            return
        rows = np.flatnonzero(np.isin(heads["channel"], [*numbers]))
        rows = rows[np.lexsort((offsets[rows], heads["log_ns"][rows]))]
        begins = offsets + MESSAGE.itemsize
        ends = offsets + RECORD.size + heads["length"].astype(np.int64)
        columns = heads["log_ns"], heads["channel"], begins, ends
        for batch in (rows[k : k + BATCH] for k in range(0, len(rows), BATCH)):
            values = (column[batch].tolist() for column in columns)
            for log_ns, number, begin, end in zip(*values, strict=True):
                yield log_ns, number, content[begin:end]

    def _content(self, offset: int) -> Buffer:
        """Return the records in the chunk at an offset."""
        if offset == 0:
            return self._file
        self._file.seek(offset + RECORD.size)
        try:
            if self._file[offset] != Opcode.CHUNK:
                raise _DamageError("the index points beside the data")
            content = _decompressed(records.Chunk.read(ReadDataStream(self._file)))
            begin = offset - offset % mmap.PAGESIZE  # what is read need not stay in memory
            self._file.madvise(mmap.MADV_DONTNEED, begin, self._file.tell() - begin)
            return content
        except _DamageError:
            raise
        except Exception as error:  # damaged bytes provoke anything in the libraries
            raise _DamageError(f"not readable: {error or type(error).__name__}") from None

    def _indexed(self, chunk: _Chunk, numbers: set[int]) -> NDArray[np.int64]:
        """Return where the wanted messages' records are in a chunk, by its message indexes."""
        parts = []
        for number in numbers & chunk.indexes.keys():
            begin = chunk.indexes[number] + INDEX.size
            head = self._file[begin - INDEX.size : begin].ljust(INDEX.size)
            opcode, length, channel, size = INDEX.unpack(head)
            entries = self._file[begin : begin + size]
            if (opcode, channel, length) != (Opcode.MESSAGE_INDEX, number, len(entries) + 6):
                raise _DamageError("an index is damaged")
            parts.append(np.frombuffer(entries, "<i8")[1::2])  # log time, offset, log time, ...
        if not parts:
            raise _DamageError("there is no index")
        return np.concatenate(parts)

    def _report(self, chunk: _Chunk, damage: _DamageError) -> None:
        """Warn of a chunk that is left out, once."""
        if chunk.offset not in self._reported:
            self._reported.add(chunk.offset)
            _log.warning(
                "%s: damaged at byte %d (%s): messages from %.2f to %.2f s are missing",
                *(self.path, chunk.offset, damage),
                *((t_ns - self.start_ns) * 1e-9 for t_ns in (chunk.start_ns, chunk.end_ns)),
            )

    def _read_summary(self) -> None:
        """Learn channels, chunks and times from the summary at the end of the file."""
        end = len(self._file) - _FOOTER.size
        start, _, crc, magic = _FOOTER.unpack_from(self._file, max(end, 0))
        if magic != MAGIC:
            raise _DamageError("it has no end")
        if crc and crc != zlib.crc32(self._file[start : end + 16]):
            raise _DamageError("its index fails its checksum")
        summary = SeekingReader(self._file).get_summary()
        if summary is None or summary.statistics is None:
            raise _DamageError("it has no index")
        statistics, chunks = summary.statistics, summary.chunk_indexes
        self._numbers.update(statistics.channel_message_counts)
        if statistics.message_count and not statistics.chunk_count:
            raise _DamageError(_NO_CHUNKS)
        if len(chunks) != statistics.chunk_count or self._numbers.keys() - summary.channels:
            raise _DamageError("its index is incomplete")
        self._schemas = {schema.id: schema.name for schema in summary.schemas.values()}
        for channel in summary.channels.values():
            self._add_channel(channel)
        self.start_ns, self.end_ns = statistics.message_start_time, statistics.message_end_time
        self._chunks = [
            _Chunk(c.message_start_time, c.message_end_time, c.chunk_start_offset,
                   c.message_index_offsets)
            for c in chunks
        ]  # fmt: skip

    def _recover(self, reason: str) -> None:
        """Learn the same from the data, up to where they break off."""
        self._numbers.clear()
        damaged: list[tuple[_Chunk, _DamageError]] = []
        outside = array("Q")  # log times of messages that are in no chunk
        complete = False
        try:
            for opcode, offset, end in _walk(self._file, len(MAGIC), len(self._file)):
                complete = opcode in (Opcode.DATA_END, Opcode.FOOTER)
                if complete:
                    break
                if opcode == Opcode.CHUNK:
                    try:
                        times, content = array("Q"), self._content(offset)
                        for inner in _walk(content, 0, len(content)):
                            self._learn(content, *inner, times)
                        if times:
                            self._chunks.append(_Chunk(min(times), max(times), offset, {}))
                    except _DamageError as damage:
                        first_ns, last_ns = _TIMES.unpack_from(self._file, offset + RECORD.size)
                        damaged.append((_Chunk(first_ns, last_ns, offset, {}), damage))
                else:
                    self._learn(self._file, opcode, offset, end, outside)
                self._data_end = end
        except _DamageError as damage:
            reason = f"{reason}; {damage}"
        if outside:
            self._chunks.append(_Chunk(min(outside), max(outside), 0, {}))
        if not self._chunks and not complete:
            self.close()
            raise InputError(
                f"{self.path}: breaks off at byte {self._data_end} before the first whole message"
                f" ({reason}): fetch the bag again from where it was recorded"
            )
        self.start_ns = min((chunk.start_ns for chunk in self._chunks), default=0)
        self.end_ns = max((chunk.end_ns for chunk in self._chunks), default=0)
        if not complete or reason != _NO_CHUNKS:
            _log.warning(
                "%s: %s (%s): reading its %d whole messages",
                self.path,
                "the recording has no usable index"
                if complete
                else f"the recording breaks off at byte {self._data_end} of {len(self._file)}",
                reason,
                self._numbers.total(),
            )
        for chunk, error in damaged:
            self._report(chunk, error)

    def _learn(self, buffer: Buffer, opcode: int, offset: int, end: int, times: array[int]) -> None:
        """Learn from a record; a message's log time is added to `times`."""
        body = offset + RECORD.size
        try:
            if opcode == Opcode.MESSAGE:
                head = np.frombuffer(buffer, MESSAGE, 1, offset)[0]
                self._numbers[int(head["channel"])] += 1
                times.append(int(head["log_ns"]))
            elif opcode == Opcode.SCHEMA:
                schema = records.Schema.read(ReadDataStream(BytesIO(buffer[body:end])))
                self._schemas[schema.id] = schema.name
            elif opcode == Opcode.CHANNEL:
                channel = McapChannel.read(ReadDataStream(BytesIO(buffer[body:end])))
                self._add_channel(channel)
        except Exception as error:  # damaged bytes provoke anything in the library
            raise _DamageError(f"a record is not readable: {error}") from None

    def _add_channel(self, channel: McapChannel) -> None:
        self._channels[channel.id] = Channel(
            absolute(channel.topic),
            self._schemas.get(channel.schema_id, ""),
            channel.message_encoding,
        )


def _walk(buffer: Buffer, offset: int, end: int) -> Iterator[tuple[int, int, int]]:
    """Yield opcode, begin and end of the records between two offsets."""
    while offset < end:
        if offset + RECORD.size > end:
            raise _DamageError("a record is cut off")
        opcode, length = RECORD.unpack_from(buffer, offset)
        following = offset + RECORD.size + length
        if opcode == 0 or following > end:
            raise _DamageError("a record is cut off")
        yield opcode, offset, following
        offset = following


def _heads(content: Buffer, offsets: NDArray[np.int64]) -> NDArray[np.void]:
    """Return the heads (N,) of the messages whose records are at `offsets`, checked."""
    size = MESSAGE.itemsize
    if not len(offsets):
        return np.empty(0, MESSAGE)
    if offsets.min() < 0 or offsets.max() > len(content) - size:
        raise _DamageError("an index points beside the messages")
    heads = sliding_window_view(np.frombuffer(content, np.uint8), size)[offsets].view(MESSAGE)
    heads = heads[:, 0]
    room = (len(content) - RECORD.size - offsets).astype(np.uint64)
    length = heads["length"]
    if np.any(
        (heads["opcode"] != Opcode.MESSAGE) | (length < size - RECORD.size) | (length > room)
    ):
        raise _DamageError("an index points beside the messages")
    return heads


def _decompressed(chunk: records.Chunk) -> bytes:
    """Return a chunk's content, checked, without more memory than it claims."""
    size = chunk.uncompressed_size
    if size > LARGEST_CHUNK:
        raise _DamageError(f"a chunk of {size} bytes, more than {LARGEST_CHUNK}")
    if not chunk.compression:
        content = chunk.data
    elif chunk.compression == "zstd":
        decompressor = ZstdDecompressor(max_window_size=LARGEST_CHUNK)
        content = decompressor.stream_reader(chunk.data).read(size + 1)
    elif chunk.compression == "lz4":
        content = LZ4FrameDecompressor().decompress(chunk.data, max_length=size + 1)
    else:
        raise _DamageError(f"compression {chunk.compression!r} is not supported")
    if len(content) != size:
        raise _DamageError("a chunk has another size than it claims")
    if chunk.uncompressed_crc and zlib.crc32(content) != chunk.uncompressed_crc:
        raise _DamageError("a chunk fails its checksum")
    return content
