"""
MCAP files read by the library `mcap`, as far as they are sound.

Here is what it lacks: the messages of a chunk without a Python object for each, and files whose end
is missing or that are damaged in the middle.
"""

from __future__ import annotations

import logging
import mmap
import zlib
from array import array
from collections import Counter
from collections.abc import Callable, Iterator, Set
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
import zstandard
from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Channel as McapChannel
from mcap.stream_reader import get_chunk_data_stream

from hybrid_ins.bags.messages import absolute
from hybrid_ins.errors import InputError

MAGIC = b"\x89MCAP0\r\n"
COMPRESSED = b"\x28\xb5\x2f\xfd"  # begins a message that rosbag2 has compressed; CDR begins with 0
LARGEST_CHUNK = 1 << 27  # bytes, uncompressed; more is a defect or a decompression bomb
BATCH = 4096  # messages of a chunk that become Python objects at a time

_RECORD = Struct("<BQ")  # opcode, length of what follows
_MESSAGE = Struct("<HIQQ")  # channel, sequence, log time, publish time
_MESSAGE_RECORD = Struct("<BQHIQQ")  # both
_TIMES = Struct("<QQ")  # of a chunk: first and last log time
_PLACE = np.dtype([("log_ns", "i8"), ("channel", "i8"), ("begin", "i8"), ("end", "i8")])
_FOOTER = Struct("<Q8xI8x")  # start of the summary, its checksum, which ends before itself
_NO_CHUNKS = "it has no chunks"
_CUT_OFF = "a record is cut off"

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
    channels: set[int]  # empty: nothing is known


class McapReader:
    """
    One MCAP file, memory-mapped.

    A chunk that is damaged is left out, with a warning that names the seconds that are missing.

    Attributes
    ----------
    counts : Counter
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
        self._schemas: dict[int, str] = {}
        self._channels: dict[int, Channel] = {}
        self._numbers: Counter[int] = Counter()  # of messages, by channel
        self._chunks: list[_Chunk] = []
        self._reported: set[int] = set()  # offsets of damaged chunks
        self._end = len(MAGIC)  # of what is sound, where the file had to be recovered
        with path.open("rb") as file:
            self._file: Any = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        try:
            self._read_summary()
        except Exception as error:  # damaged bytes provoke anything in the library
            self._recover(str(error) or type(error).__name__)
        self._chunks.sort(key=itemgetter(0, 2))
        self.start_ns = min((chunk.start_ns for chunk in self._chunks), default=0)
        self.end_ns = max((chunk.end_ns for chunk in self._chunks), default=0)
        self.counts: dict[Channel, int] = Counter()
        for number, channel in self._channels.items():
            self.counts[channel] += self._numbers[number]

    def close(self) -> None:
        """Unmap the file; messages read from it stay valid."""
        with suppress(BufferError):  # an unfinished iteration still reads it: unmapped with it
            self._file.close()

    def records(self, wanted: Callable[[Channel], bool]) -> Iterator[Record]:
        """
        Return the messages of all `wanted` channels in the order of their log times.

        Messages of equal log time keep the file's order.
        """
        channels = {number: c for number, c in self._channels.items() if wanted(c)}
        chunks = [c for c in self._chunks if not c.channels or channels.keys() & c.channels]
        streams = [chain.from_iterable(self._batches(chunk, channels)) for chunk in chunks]
        if not any(after.start_ns < before.end_ns for before, after in pairwise(chunks)):
            return chain.from_iterable(streams)
        ordered = merge(*map(_opened_late, chunks, streams), key=itemgetter(0))
        return (record for _, record in ordered if record is not None)

    def _batches(self, chunk: _Chunk, channels: dict[int, Channel]) -> Iterator[list[Record]]:
        """Yield the messages of some channels of a chunk."""
        try:
            content, begin, end = self._content(chunk.offset)
            places = np.fromiter(_places(content, begin, end, channels.keys()), _PLACE)
        except Exception as error:  # damaged bytes provoke anything in the library
            self._report(chunk, error)
            return
        places = places[np.argsort(places["log_ns"], kind="stable")]
        for k in range(0, len(places), BATCH):
            batch = [
                (log_ns, channels[number], content[begin:end])
                for log_ns, number, begin, end in places[k : k + BATCH].tolist()
            ]
            yield self._decompressed(batch) if batch[0][2].startswith(COMPRESSED) else batch

    def _decompressed(self, batch: list[Record]) -> list[Record]:
        """Return the messages of a recording of which each is compressed, as ``zstd`` does."""
        unpack = zstandard.ZstdDecompressor().decompress
        try:
            return [(log_ns, channel, unpack(data)) for log_ns, channel, data in batch]
        except zstandard.ZstdError as error:
            raise InputError(f"{self.path}: a message cannot be decompressed ({error})") from None

    def _content(self, offset: int) -> tuple[Buffer, int, int]:
        """Return what holds the records of the chunk at an offset, and their begin and end."""
        if offset == 0:
            return self._file, len(MAGIC), self._end
        if self._file[offset] != Opcode.CHUNK:
            raise ValueError("the index points beside the data")
        self._file.seek(offset + _RECORD.size)
        chunk = records.Chunk.read(ReadDataStream(self._file))
        page = offset - offset % mmap.PAGESIZE  # what is read need not stay in memory
        self._file.madvise(mmap.MADV_DONTNEED, page, self._file.tell() - page)
        if chunk.uncompressed_size > LARGEST_CHUNK:
            raise ValueError(f"{chunk.uncompressed_size} bytes, more than {LARGEST_CHUNK}")
        stream, size = get_chunk_data_stream(chunk, validate_crc=True)
        return stream.read(size), 0, size

    def _report(self, chunk: _Chunk, error: Exception) -> None:
        """Warn of a chunk that is left out, once."""
        if chunk.offset not in self._reported:
            self._reported.add(chunk.offset)
            start_ns = min(c.start_ns for c in (*self._chunks, chunk))
            _log.warning(
                "%s: damaged at byte %d (%s): messages from %.2f to %.2f s are missing",
                *(self.path, chunk.offset, str(error) or type(error).__name__),
                *((t_ns - start_ns) * 1e-9 for t_ns in (chunk.start_ns, chunk.end_ns)),
            )

    def _read_summary(self) -> None:
        """Learn channels, chunks and times from the summary at the end of the file."""
        summary = SeekingReader(self._file).get_summary()
        start, crc = _FOOTER.unpack(self._file[-_FOOTER.size :])
        if crc and crc != zlib.crc32(self._file[start:-12]):
            raise ValueError("its index fails its checksum")
        if summary is None or summary.statistics is None:
            raise ValueError("it has no index")
        chunks, statistics = summary.chunk_indexes, summary.statistics
        if statistics.message_count and not statistics.chunk_count:
            raise ValueError(_NO_CHUNKS)
        self._numbers.update(statistics.channel_message_counts)
        known = {0, *summary.schemas}  # 0: none
        if (
            len(chunks) != statistics.chunk_count
            or not self._numbers.keys() <= summary.channels.keys()
            or not all(channel.schema_id in known for channel in summary.channels.values())
        ):
            raise ValueError("its index is incomplete")
        self._schemas = {number: schema.name for number, schema in summary.schemas.items()}
        for channel in summary.channels.values():
            self._add_channel(channel)
        self._chunks = [
            _Chunk(c.message_start_time, c.message_end_time, c.chunk_start_offset,
                   set(c.message_index_offsets))
            for c in chunks
        ]  # fmt: skip

    def _recover(self, reason: str) -> None:
        """Learn the same from the data, up to where they break off."""
        self._numbers.clear()
        self._chunks.clear()
        outside = array("Q")  # log times of messages that are in no chunk
        complete = False
        try:
            for opcode, body, end in _walk(self._file, len(MAGIC), len(self._file)):
                complete = opcode in (Opcode.DATA_END, Opcode.FOOTER)
                if complete:
                    break
                self._learn(self._file, opcode, body, end, outside)
                self._end = end
        except Exception as error:  # damaged bytes provoke anything in the library
            reason = f"{reason}; {error}"
        if outside:
            self._chunks.append(_Chunk(min(outside), max(outside), 0, set()))
        if not self._chunks and not complete:
            self.close()
            raise InputError(
                f"{self.path}: breaks off at byte {self._end} before the first whole message"
                f" ({reason}): fetch the bag again from where it was recorded"
            )
        if not complete or reason != _NO_CHUNKS:
            _log.warning(
                "%s: %s (%s): reading its %d whole messages",
                self.path,
                "the recording has no usable index"
                if complete
                else f"the recording breaks off at byte {self._end} of {len(self._file)}",
                reason,
                self._numbers.total(),
            )

    def _learn(self, buffer: Buffer, opcode: int, body: int, end: int, times: array[int]) -> None:
        """Learn from a record; a message's log time is added to `times`."""
        if opcode == Opcode.MESSAGE:
            number, _, log_ns, _ = _MESSAGE.unpack_from(buffer, body)
            self._numbers[number] += 1
            times.append(log_ns)
        elif opcode == Opcode.SCHEMA:
            schema = records.Schema.read(ReadDataStream(BytesIO(buffer[body:end])))
            self._schemas[schema.id] = schema.name
        elif opcode == Opcode.CHANNEL:
            self._add_channel(McapChannel.read(ReadDataStream(BytesIO(buffer[body:end]))))
        elif opcode == Opcode.CHUNK:
            first_ns, last_ns = _TIMES.unpack_from(buffer, body)
            chunk = _Chunk(first_ns, last_ns, body - _RECORD.size, set())
            inner = array("Q")
            try:
                content, *span = self._content(chunk.offset)
                for record in _walk(content, *span):
                    self._learn(content, *record, inner)
            except Exception as error:  # damaged bytes provoke anything in the library
                self._report(chunk, error)
            else:
                if inner:
                    self._chunks.append(chunk._replace(start_ns=min(inner), end_ns=max(inner)))

    def _add_channel(self, channel: McapChannel) -> None:
        self._channels[channel.id] = Channel(
            absolute(channel.topic),
            self._schemas.get(channel.schema_id, ""),
            channel.message_encoding,
        )


def _walk(buffer: Buffer, begin: int, end: int) -> Iterator[tuple[int, int, int]]:
    """Yield opcode, begin and end of the records between two places."""
    while begin < end:
        if begin + _RECORD.size > end:
            raise ValueError(_CUT_OFF)
        opcode, length = _RECORD.unpack_from(buffer, begin)
        body, begin = begin + _RECORD.size, begin + _RECORD.size + length
        if opcode == 0 or begin > end:
            raise ValueError(_CUT_OFF)
        yield opcode, body, begin


def _opened_late(chunk: _Chunk, messages: Iterator[Record]) -> Iterator[tuple[int, Record | None]]:
    """Yield each message with its log time; first none, so that the chunk is opened at its turn."""
    yield chunk.start_ns, None
    for record in messages:
        yield record[0], record


def _places(
    buffer: Buffer, begin: int, end: int, numbers: Set[int]
) -> Iterator[tuple[int, int, int, int]]:
    """Yield log time, channel, begin and end of the messages of some channels, no empty ones."""
    unpack, size = _MESSAGE_RECORD.unpack_from, _MESSAGE_RECORD.size
    while begin + size <= end:
        opcode, length, number, _, log_ns, _ = unpack(buffer, begin)
        body, begin = begin + size, begin + _RECORD.size + length
        if opcode == 0 or begin > end:
            raise ValueError(_CUT_OFF)
        if opcode == Opcode.MESSAGE and number in numbers and body < begin:
            yield log_ns, number, body, begin
    for _ in _walk(buffer, begin, end):  # too short for a message
        pass
