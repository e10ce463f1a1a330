"""Give back memory that only the start needs, or the hypotheses of an alignment."""

from __future__ import annotations

import ctypes
import gc
import mmap
import re
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

MAPPING = re.compile(r"([0-9a-f]+)-([0-9a-f]+) (\S{4}) \S+ \S+ \S+ +(/.*)")


def release_memory_of_start() -> None:
    """
    Give back what the start has left: free heap, and the libraries' pages, most of the compiler's.

    Loaded kernels need no compiler. A page that is needed after all is read from its file again,
    at most a few hundred of them. Objects that exist now are expected to stay: the garbage
    collector need not traverse them again and again. Where the system is not Linux with glibc,
    only that is done.
    """
    gc.unfreeze()
    gc.collect()
    gc.freeze()
    trim_heap()
    with suppress(OSError, AttributeError):
        libc = ctypes.CDLL(None)
        libc.madvise.argtypes = (ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int)
        for begin, end in _unchanged_mappings():
            libc.madvise(begin, end - begin, mmap.MADV_DONTNEED)


def trim_heap() -> None:
    """Return the free pages of the heap to the system."""
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)


def _unchanged_mappings() -> Iterator[tuple[int, int]]:
    """Yield begin and end of what is in memory as it is in a file, and cannot be written."""
    mapping = None
    for line in Path("/proc/self/smaps").read_text().splitlines():
        found = MAPPING.match(line)
        if found:
            mapping = found
        elif line.startswith("Anonymous:") and mapping is not None:
            begin, end, rights, _ = mapping.groups()
            if rights in ("r-xp", "r--p") and line.split()[1] == "0":
                yield int(begin, 16), int(end, 16)
            mapping = None


class HypothesesHeap:
    """
    Returns the heap of an alignment to the system once its hypotheses are gone.

    They take 100 MB where the clock offset is searched for together with the heading.
    """

    def __init__(self) -> None:
        self._were_many = False

    def update(self, filters: int) -> None:
        """Use the number of filters that run now."""
        if self._were_many and filters <= 1:
            trim_heap()
        self._were_many = filters > 1
