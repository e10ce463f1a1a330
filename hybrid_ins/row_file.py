"""
Temporary files for what is too much for the memory of hours of recording.

They lie in a folder that the caller names, since ``/tmp`` may itself be memory, and are gone with
the objects.
"""

from __future__ import annotations

import pickle
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class RowFile:
    """
    Rows of numbers by index, see `hybrid_ins.core.smoothing.smoother.Store`.

    Parameters
    ----------
    length : int
        Of each row.
    folder : Path, optional
        Where the file lies; the system's folder for temporary files by default.
    """

    def __init__(self, length: int, folder: Path | None = None) -> None:
        self._file = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115  # lives with the object
        self._length = length
        self._size = 8 * length

    def __setitem__(self, index: int, row: Array) -> None:
        self._file.seek(index * self._size)
        self._file.write(np.ascontiguousarray(row, np.float64).tobytes())

    def __getitem__(self, index: int) -> Array:
        self._file.seek(index * self._size)
        data = self._file.read(self._size)
        if len(data) < self._size:
            raise IndexError(f"no row {index}")
        return np.frombuffer(data, np.float64)


class BlockFile:
    """
    Arrays of one type one after the other, see `hybrid_ins.core.imu.samples.Blocks`.

    Parameters
    ----------
    folder : Path, optional
        See `RowFile`.
    """

    def __init__(self, folder: Path | None = None) -> None:
        self._file = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115  # lives with the object
        self._empty: NDArray[Any] = np.empty(0)  # of their type and shape
        self._count = 0

    def append(self, block: NDArray[Any]) -> None:
        """Add an array, shape (N, ...)."""
        if not self._count:
            self._empty = block[:0].copy()
        self._count += len(block)
        self._file.write(np.ascontiguousarray(block).tobytes())

    def array(self) -> NDArray[Any]:
        """Return all of them as one, a map of the file: changes are not written to it."""
        if not self._count:
            return self._empty
        self._file.flush()
        shape = (self._count, *self._empty.shape[1:])
        return np.asarray(np.memmap(self._file, self._empty.dtype, "c", shape=shape))

    def __len__(self) -> int:
        """Return the number of rows so far."""
        return self._count


class ObjectFile:
    """
    Objects in a row.

    Parameters
    ----------
    folder : Path, optional
        See `RowFile`.
    """

    def __init__(self, folder: Path | None = None) -> None:
        self._file = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115  # lives with the object
        self._count = 0

    def append(self, item: object) -> None:
        """Add an object."""
        pickle.dump(item, self._file, pickle.HIGHEST_PROTOCOL)
        self._count += 1

    def __iter__(self) -> Iterator[Any]:
        """Yield them in order."""
        self._file.seek(0)
        for _ in range(self._count):
            yield pickle.load(self._file)  # of our own making
