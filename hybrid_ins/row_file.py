"""Rows of numbers in a temporary file: what is too much for the memory of hours of recording."""

from __future__ import annotations

import tempfile

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class RowFile:
    """
    Rows by index, see `hybrid_ins.core.smoother.Store`; gone with the object.

    Parameters
    ----------
    length : int
        Of each row.
    """

    def __init__(self, length: int) -> None:
        self._file = tempfile.TemporaryFile()  # noqa: SIM115  # open as long as the object lives
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
