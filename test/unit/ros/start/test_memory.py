"""After the start the compiler's code is no longer in memory, and comes back when it is needed."""

import gc
import re
import sys
from pathlib import Path

import numpy as np
import pytest
from numba import njit

from hybrid_ins.ros.start.memory import HypothesesHeap, release_memory_of_start

COMPILER = "libllvmlite"  # numba's


def resident_code(rights: str = "r-xp") -> int:
    """Return how much of the compiler's code is in memory [kB]."""
    total, counts = 0, False
    for line in Path("/proc/self/smaps").read_text().splitlines():
        if re.match(r"[0-9a-f]+-[0-9a-f]+ ", line):
            counts = f" {rights} " in line and COMPILER in line
        elif counts and line.startswith("Rss:"):
            total += int(line.split()[1])
    return total


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")
def test_the_compilers_code_is_given_back_and_still_runs() -> None:
    assert njit(lambda x: x + 1.0)(1.0) == 2.0
    before, constants_before = resident_code(), resident_code("r--p")

    release_memory_of_start()

    gc.unfreeze()
    assert resident_code() < 0.2 * before
    assert resident_code("r--p") < constants_before
    assert njit(lambda x: x + 2.0)(1.0) == 3.0


def heap() -> int:
    """Return how much of the memory is no file's [kB]."""
    status = Path("/proc/self/status").read_text()
    return int(status.partition("RssAnon:")[2].split()[0])


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")
def test_the_heap_of_hypotheses_is_returned_once_one_filter_is_left() -> None:
    blocks = [np.ones(10_000) for _ in range(1000)]  # 80 MB, in pieces of the heap
    above = np.ones(10_000)  # so that the system does not get them by themselves
    watch = HypothesesHeap()
    watch.update(156)
    used = heap()
    del blocks

    watch.update(12)
    assert heap() > used - 20_000
    watch.update(1)

    assert heap() < used - 60_000
    assert above.all()
