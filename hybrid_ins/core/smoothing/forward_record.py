"""
What a forward run decided in the end, kept so that a smoother can do the same with hindsight.

A `RunRecord` follows a navigator. It holds, for each stretch between two restarts, the IMU samples
and the filters that ran, whose own records say what became of every measurement once it could not
be rewound any more.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.filter.ins_filter import InsFilter
from hybrid_ins.core.imu.samples import SAMPLE_DTYPE, BlockList, Blocks

Samples = NDArray[np.void]

BLOCK = 4096  # samples that are gathered before they are kept


@dataclass(eq=False)
class Stretch:
    """
    A stretch of a run without a restart, in which a filter ran at the end.

    Attributes
    ----------
    blocks : Blocks of SAMPLE_DTYPE
        The IMU's samples.
    filters : list of (InsFilter, float)
        Those that ran one after the other, and what each one's clock added to the stamps beyond
        its predecessor's [s].
    running_ns : int
        Stamp of the first of them [ns].
    heading_found : bool
        It was started by several headings.
    """

    blocks: Blocks
    filters: list[tuple[InsFilter, float]] = field(default_factory=list)
    running_ns: int = 0
    heading_found: bool = False

    @property
    def samples(self) -> Samples:
        """All samples."""
        return self.blocks.array() if len(self.blocks) else np.empty(0, SAMPLE_DTYPE)


class RunRecord:
    """
    The stretches of a run.

    Parameters
    ----------
    make_blocks : callable
        Returns what keeps the samples of a stretch.

    Attributes
    ----------
    stretches : list of Stretch
        In order; those without a filter hold samples alone.
    """

    def __init__(self, make_blocks: Callable[[], Blocks] = BlockList) -> None:
        self._make_blocks = make_blocks
        self.stretches: list[Stretch] = []
        self._loose: list[tuple[int, tuple[float, ...], tuple[float, ...]]] = []
        self.begin()

    def begin(self) -> None:
        """Begin a new stretch: the state was given up."""
        self._gather()
        if self.stretches and not len(self.stretches[-1].blocks):
            self.stretches.pop()
        self.stretches.append(Stretch(self._make_blocks()))

    def sample(self, t_ns: int, *reading: float) -> None:
        """Append a sample: stamp [ns], specific force [m/s²], angular rate [rad/s], b."""
        self._loose.append((t_ns, reading[:3], reading[3:]))
        if len(self._loose) == BLOCK:
            self._gather()

    def block(self, samples: Samples) -> None:
        """Append many samples."""
        self._gather()
        self.stretches[-1].blocks.append(samples)

    def follow(self, running: InsFilter, offset: float = 0.0, heading_found: bool = False) -> None:
        """Follow the filter that runs from now on, unless it is the last one; see `Stretch`."""
        self._gather()
        stretch = self.stretches[-1]
        if stretch.filters and stretch.filters[-1][0] is running:
            return
        if not stretch.filters:
            stretch.running_ns, stretch.heading_found = running.t_ns, heading_found
        stretch.filters.append((running, offset))

    @property
    def count(self) -> int:
        """Number of samples."""
        return sum(len(stretch.blocks) for stretch in self.finish())

    def finish(self) -> list[Stretch]:
        """Return the stretches in which a filter ran."""
        self._gather()
        return [stretch for stretch in self.stretches if stretch.filters]

    def _gather(self) -> None:
        if self._loose:
            self.stretches[-1].blocks.append(np.array(self._loose, SAMPLE_DTYPE))
            self._loose = []
