"""
Arrays of IMU samples, and the ring buffer of the recent ones.

All stamps are integer nanoseconds on the IMU's clock; all vectors are in the b frame. Samples have
one type, ``SAMPLE_DTYPE``. A live sample is passed as its seven numbers: filtering takes 1.4 times
as long with a named tuple for each, and 6.5 times with an array.
"""

from __future__ import annotations

import struct
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

SPAN = 32  # samples, over which a period is averaged
GAPS, FEWEST_STEPS = 3, 64  # longest steps that may be gaps, and of those left, that show pauses
SAMPLE_DTYPE = np.dtype([("t_ns", np.int64), ("f", np.float64, 3), ("w", np.float64, 3)])


def as_samples(
    t_ns: NDArray[Any], f: NDArray[np.float64], w: NDArray[np.float64]
) -> NDArray[np.void]:
    """Return samples (N,) with stamps (N,) [ns], specific force and angular rate (N, 3)."""
    samples = np.empty(len(t_ns), SAMPLE_DTYPE)
    samples["t_ns"], samples["f"], samples["w"] = t_ns, f, w
    return samples


def as_numbers(samples: NDArray[np.void]) -> NDArray[np.float64]:
    """View samples as floats, (N, 7): the stamps' bits, specific force, angular rate."""
    return samples.view(np.float64).reshape(-1, 7)


def readings_of(samples: NDArray[np.void]) -> NDArray[np.float64]:
    """Return a copy of specific force and angular rate, (N, 6)."""
    return np.ascontiguousarray(as_numbers(samples)[:, 1:])


def steps_since(start_ns: int, t_ns: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the time (N,) [ns] from each stamp's predecessor, the first's being ``start_ns``."""
    steps = np.empty(len(t_ns), np.int64)
    steps[0] = t_ns[0] - start_ns
    np.subtract(t_ns[1:], t_ns[:-1], out=steps[1:])
    return steps


def sample_period(t_ns: NDArray[np.int64]) -> float:
    """
    Return the period [s] of at least two stamps (N,) [ns]; 0 where they stand still.

    It is the median over spans of up to ``SPAN`` steps: samples that arrive together have nearly
    the same stamp from a driver that stamps on receipt, and here and there one is missing.
    """
    span = min(SPAN, max(len(t_ns) // 4, 1))
    ordered = np.sort(t_ns[span:] - t_ns[:-span])  # `np.median` takes eight times as long
    middle = int(ordered[(len(ordered) - 1) // 2]) + int(ordered[len(ordered) // 2])
    return 0.5 * middle / span * 1e-9


def usual_pause(t_ns: NDArray[np.int64]) -> float:
    """
    Return the step [s] between stamps (N,) [ns] that half of their time is spent in, or in shorter.

    It is the period of steady samples, and of those that arrive in bursts the pause between these.
    Some of the longest steps may be gaps, and are left out.
    """
    ordered = np.sort(t_ns[1:] - t_ns[:-1])[:-GAPS]
    if len(ordered) < FEWEST_STEPS:
        return 0.0
    spent = np.cumsum(ordered)
    return float(ordered[int(np.searchsorted(2 * spent, spent[-1]))]) * 1e-9


def interpolate(
    t0_ns: int, reading: NDArray[np.float64], following: NDArray[np.void], t_ns: int
) -> NDArray[np.void]:
    """
    Return the sample (1,) at ``t_ns`` on the line between two consecutive ones.

    Parameters
    ----------
    t0_ns, reading : int, ndarray, shape (6,)
        Stamp [ns], specific force and angular rate of the first.
    following : ndarray of ``SAMPLE_DTYPE``, shape ()
        The second.
    t_ns : int
        Between the two stamps [ns].
    """
    fraction = (t_ns - t0_ns) / (int(following["t_ns"]) - t0_ns)
    f = reading[:3] + fraction * (following["f"] - reading[:3])
    w = reading[3:] + fraction * (following["w"] - reading[3:])
    return np.array([(t_ns, f, w)], SAMPLE_DTYPE)


class Blocks(Protocol):
    """Arrays of one type that are put one after the other: in memory, or in a file."""

    def append(self, block: NDArray[Any]) -> None:
        """Add an array, shape (N, ...)."""
        ...

    def array(self) -> NDArray[Any]:
        """Return all of them as one; it may be a memory map."""
        ...

    def __len__(self) -> int:
        """Return the number of rows so far."""
        ...


class BlockList:
    """`Blocks` in memory."""

    def __init__(self) -> None:
        self._blocks: list[NDArray[Any]] = []

    def append(self, block: NDArray[Any]) -> None:
        """See `Blocks`."""
        self._blocks.append(block)

    def array(self) -> NDArray[Any]:
        """See `Blocks`; there must be at least one."""
        if len(self._blocks) > 1:
            self._blocks = [np.concatenate(self._blocks)]
        return self._blocks[0]

    def __len__(self) -> int:
        """See `Blocks`."""
        return sum(map(len, self._blocks))


class ImuRing:
    """
    Ring buffer of the last ``capacity`` IMU samples, for rewinding and for the noise regressor.

    Parameters
    ----------
    capacity : int
        Number of samples kept.
    """

    def __init__(self, capacity: int = 8192) -> None:
        self.count = 0
        self.capacity = capacity
        self._samples = np.zeros(capacity, SAMPLE_DTYPE)
        self._stamps = self._samples["t_ns"]
        self._bytes = self._samples.view(np.uint8).data
        self._pack = struct.Struct("=q6d").pack_into
        self._size = SAMPLE_DTYPE.itemsize

    def push(
        self, t_ns: int, fx: float, fy: float, fz: float, wx: float, wy: float, wz: float
    ) -> None:
        """Append a sample: stamp [ns], specific force [m/s²], angular rate [rad/s], b frame."""
        offset = (self.count % self.capacity) * self._size
        self._pack(self._bytes, offset, t_ns, fx, fy, fz, wx, wy, wz)
        self.count += 1

    def extend(self, samples: NDArray[np.void]) -> None:
        """Append many samples, an array of ``SAMPLE_DTYPE``."""
        kept = samples[-self.capacity :]
        self.count += len(samples)
        start = (self.count - len(kept)) % self.capacity
        split = min(len(kept), self.capacity - start)
        self._samples[start : start + split] = kept[:split]
        self._samples[: len(kept) - split] = kept[split:]

    def latest(self, n: int) -> NDArray[np.void]:
        """Copy of the last ``n`` samples (fewer if fewer came), oldest first."""
        n = min(n, self.count, self.capacity)
        return self._copy(self.count - n, n)

    def after(self, t_ns: int) -> NDArray[np.void]:
        """Copy of the samples that are younger than ``t_ns``, oldest first."""
        return self.latest(self._count_after(t_ns))

    def between(self, t_ns: int, end_ns: int) -> NDArray[np.void]:
        """Copy of the samples that are younger than ``t_ns`` and no younger than ``end_ns``."""
        n = self._count_after(t_ns)
        return self._copy(self.count - n, max(n - self._count_after(end_ns), 0))

    def has_lost(self, t_ns: int) -> bool:
        """Return whether samples that are younger than ``t_ns`` may have been overwritten."""
        return self._count_after(t_ns) == self.capacity

    def _copy(self, begin: int, n: int) -> NDArray[np.void]:
        """Copy of ``n`` samples from the one on that was the ``begin``-th."""
        begin %= self.capacity
        if begin + n <= self.capacity:
            return self._samples[begin : begin + n].copy()
        return np.concatenate((self._samples[begin:], self._samples[: begin + n - self.capacity]))

    def _count_after(self, t_ns: int) -> int:
        """Return how many samples are younger than ``t_ns``."""
        first = self.count % self.capacity  # behind the youngest: the oldest, in a full ring
        n = first - int(self._stamps[:first].searchsorted(t_ns, side="right"))
        if n == first and self.count >= self.capacity:
            oldest = self._stamps[first:]
            n += len(oldest) - int(oldest.searchsorted(t_ns, side="right"))
        return n

    def clear(self) -> None:
        """Drop all samples."""
        self.count = 0
