"""
Replays of many faults that share the flight before the fault.

Most of a replay's time goes into finding heading and clock, before anything is wrong. So the
undisturbed flight is replayed up to the fault once; there the process forks, and each child goes on
with the flight that one fault has made.
"""

from __future__ import annotations

import os
import pickle
import signal
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NoReturn

from hybrid_ins.bags.reader import BagReader, ImuTable
from hybrid_ins.bags.writer import BagWriter

Message = tuple[str, int, bytes]


class AllForked(BaseException):
    """Leaves the replay in the process that has forked; there is nothing more to replay in it."""


class HeldBack:
    """A bag of the output that begins as calls in memory and goes on as a file: see `BagWriter`."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._calls: list[tuple[str, tuple[Any, ...]]] = []
        self._bag: BagWriter | None = None

    def open(self, path: Path) -> None:
        """Write to a file from now on, first what was held back."""
        self._bag = BagWriter(path, overwrite=True)
        for name, arguments in self._calls:
            getattr(self._bag, name)(*arguments)

    def close(self) -> None:
        """Complete the file."""
        assert self._bag is not None
        self._bag.close()

    def write(self, *arguments: Any) -> None:
        """See `BagWriter.write`."""
        self._call("write", arguments)

    def write_raw(self, *arguments: Any) -> None:
        """See `BagWriter.write_raw`."""
        self._call("write_raw", arguments)

    def write_rows(self, *arguments: Any) -> None:
        """See `BagWriter.write_rows`."""
        self._call("write_rows", arguments)

    def _call(self, name: str, arguments: tuple[Any, ...]) -> None:
        if self._bag is None:
            self._calls.append((name, arguments))
        else:
            getattr(self._bag, name)(*arguments)


class ForkingReader(BagReader):
    """
    A flight whose end is another one in each child process: see `BagReader`.

    Parameters
    ----------
    path : Path
        The undisturbed flight.
    from_ns : int
        Log time from which on the others differ.
    others : sequence of callable
        Each makes another flight, that `has_same_start` holds for, in its child.
    on_result : callable
        Called in the parent with the index of each other flight, and with what its child has given
        to `answer`; None where it gave nothing.

    Attributes
    ----------
    index : int or None
        Of the other flight in this process; None in the parent.
    """

    def __init__(
        self,
        path: Path,
        from_ns: int,
        others: Sequence[Callable[[], Path]],
        on_result: Callable[[int, Any], None],
    ) -> None:
        super().__init__(path)
        self._from_ns, self._others, self._on_result = from_ns, others, on_result
        self._table: ImuTable | None = None
        self.index: int | None = None
        self._pipe = -1

    def imu(self, *arguments: Any, **options: Any) -> ImuTable:
        """See `BagReader.imu`; the table changes in a child."""
        self._imu_topic = arguments
        self._table = super().imu(*arguments, **options)
        return self._table

    def raw(self, *topics: str) -> Iterator[Message]:
        """See `BagReader.raw`."""
        for message in super().raw(*topics):
            if message[1] >= self._from_ns:
                break
            yield message
        with BagReader(self._fork()) as other:
            # Frozen to its users: it becomes another one in a child alone.
            vars(self._table).update(vars(other.imu(*self._imu_topic)))
            yield from (message for message in other.raw(*topics) if message[1] >= self._from_ns)

    def _fork(self) -> Path:
        """Return the flight to go on with, in one child for each; the parent leaves."""
        for index, make in enumerate(self._others):
            reading, writing = os.pipe()
            child = os.fork()
            if child == 0:
                os.close(reading)
                self.index, self._pipe = index, writing
                return make()
            os.close(writing)
            try:
                with os.fdopen(reading, "rb") as pipe:
                    data = pipe.read()
            except BaseException:
                os.kill(child, signal.SIGKILL)
                raise
            finally:
                os.waitpid(child, 0)
            self._on_result(index, pickle.loads(data) if data else None)
        raise AllForked

    def answer(self, result: Any) -> NoReturn:
        """Give a result to the parent, and end the child."""
        with os.fdopen(self._pipe, "wb") as pipe:
            pickle.dump(result, pipe)
        os._exit(0)


def has_same_start(path: Path, other: Path, from_ns: int) -> bool:
    """Return whether two flights have the same topics, and are equal before a log time [ns]."""
    starts = []
    for each in (path, other):
        with BagReader(each) as bag:
            frames = bag.imu().frames
            starts.append((bag.topics, frames, [m for m in bag.raw() if m[1] < from_ns]))
    return starts[0] == starts[1]
