"""After the start the compiler's code is no longer in memory, and comes back when it is needed."""

import gc
import re
import sys
from pathlib import Path

import pytest
from numba import njit

from hybrid_ins.ros.memory import COMPILER, release_memory_of_start


def resident_code() -> int:
    """Return how much of the compiler's code is in memory [kB]."""
    total, counts = 0, False
    for line in Path("/proc/self/smaps").read_text().splitlines():
        if re.match(r"[0-9a-f]+-[0-9a-f]+ ", line):
            counts = " r-xp " in line and COMPILER in line
        elif counts and line.startswith("Rss:"):
            total += int(line.split()[1])
    return total


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")
def test_the_compilers_code_is_given_back_and_still_runs() -> None:
    assert njit(lambda x: x + 1.0)(1.0) == 2.0
    before = resident_code()

    release_memory_of_start()

    gc.unfreeze()
    assert resident_code() < 0.2 * before
    assert njit(lambda x: x + 2.0)(1.0) == 3.0
