"""Give back memory that only the start needs."""

from __future__ import annotations

import ctypes
import gc
import mmap
from contextlib import suppress
from pathlib import Path

COMPILER = "libllvmlite"  # numba's: 50 MB of its code are in memory after kernels were loaded


def release_memory_of_start() -> None:
    """
    Give back what the start has left: free heap, and the compiler's code, loaded kernels need none.

    The code is read from its file again should another kernel be compiled. Objects that exist now
    are expected to stay: the garbage collector need not traverse them again and again. Where the
    system is not Linux with glibc, only that is done.
    """
    gc.unfreeze()
    gc.collect()
    gc.freeze()
    with suppress(OSError, AttributeError):
        libc = ctypes.CDLL(None)
        libc.malloc_trim(0)
        libc.madvise.argtypes = (ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int)
        for line in Path("/proc/self/maps").read_text().splitlines():
            span, rights, _, _, _, *name = line.split(maxsplit=5)
            # Pages of code are never written: what is dropped is as it is in the file.
            if rights == "r-xp" and name and COMPILER in name[0]:
                begin, end = (int(bound, 16) for bound in span.split("-"))
                libc.madvise(begin, end - begin, mmap.MADV_DONTNEED)
