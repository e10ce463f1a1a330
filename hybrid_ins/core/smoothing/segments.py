"""
A recorded stretch in segments: what happens to a filter, and the IMU samples between.

At the stamp of an update that lies between two samples one is interpolated; a gap in the samples
is a segment of its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.filter.events import CovarianceInflation
from hybrid_ins.core.imu.samples import as_numbers, interpolate, readings_of, steps_since
from hybrid_ins.core.inertial.state import NavState
from hybrid_ins.core.noise.position_scatter import Split
from hybrid_ins.core.sensor_errors.considered_scale import ScaleStep
from hybrid_ins.core.update.measurements import Measurement

Array = NDArray[np.float64]
Samples = NDArray[np.void]

MANY = 65536  # samples whose stamps are searched at a time


@dataclass(frozen=True, slots=True)
class SmootherStart:
    """What a filter begins with."""

    t_ns: int  # ns
    sample: Array  # (6,) the IMU sample then: m/s², rad/s, b
    state: NavState
    psd: Array  # (12,) Qc's diagonal from then on
    slow_variance: Array | None = None  # (m,) m², NED, of the slow error of positions, if any


@dataclass(frozen=True, slots=True)
class Update:
    """
    What happens to the state at one stamp.

    Attributes
    ----------
    t_ns : int
        Stamp [ns].
    psd : ndarray, shape (12,)
        Qc's diagonal from then on.
    measurement : Measurement or None
        Fused, unless its NIS is beyond ``threshold``.
    r_scale : float
        Factor on the measurement's covariance.
    threshold : float
        See above; infinite for a measurement whose acceptance is settled.
    inflates : bool
        Beyond the threshold the covariance is inflated to fit the measurement, which is fused then.
    inflation : CovarianceInflation or None
        Of the covariance.
    split : Split or None
        How a position's covariance was split: that of ``measurement`` is the part that is white.
    scale : ScaleStep or None
        What scale errors of the IMU do to the state before all that.
    """

    t_ns: int
    psd: Array
    measurement: Measurement | None = None
    r_scale: float = 1.0
    threshold: float = np.inf
    inflates: bool = False
    inflation: CovarianceInflation | None = None
    split: Split | None = None
    scale: ScaleStep | None = None


class Node(NamedTuple):
    """Where something other than a plain IMU step happens: before it, samples up to ``stop``."""

    stop: int
    t_ns: int  # its stamp; between two samples one is interpolated there
    update: Update | None  # None: the end of a gap in the samples


class Segments:
    """
    The segments of a stretch.

    Parameters
    ----------
    start : SmootherStart
        What the filter begins with.
    samples : ndarray of SAMPLE_DTYPE
        The IMU's, younger than the start; not copied.
    updates : sequence of Update
        By stamp.
    long_step_ns : int
        A longer step between samples [ns] is a gap.

    Attributes
    ----------
    nodes : list of Node
        The end of each segment.
    """

    def __init__(
        self, start: SmootherStart, samples: Samples, updates: Sequence[Update], long_step_ns: int
    ) -> None:
        self._start = start
        self._samples = samples
        self._long_step_ns = long_step_ns
        self.nodes = self._find_nodes(updates)

    def count(self, k: int) -> int:
        """Return the number of the recording's samples in a segment."""
        return self.nodes[k].stop - (self.nodes[k - 1].stop if k else 0)

    def stamps(self, k: int) -> NDArray[np.int64]:
        """Return their stamps [ns]."""
        stop = self.nodes[k].stop
        return np.array(self._samples["t_ns"][stop - self.count(k) : stop])

    def _find_nodes(self, updates: Sequence[Update]) -> list[Node]:
        samples, last_ns = self._samples, self._start.t_ns
        end_ns = int(samples[-1]["t_ns"]) if len(samples) else last_ns
        updates = [u for u in updates if last_ns <= u.t_ns <= end_ns]
        at = np.array([u.t_ns for u in updates], np.int64)
        stops = np.zeros(len(at), np.int64)
        gaps: set[tuple[int, int]] = set()  # a gap is a stretch of its own
        for low in range(0, len(samples), MANY):
            stamps = np.array(samples["t_ns"][low : low + MANY])
            stops += np.searchsorted(stamps, at, side="right")
            steps = steps_since(last_ns, stamps)
            for k in np.flatnonzero(steps > self._long_step_ns).tolist():
                gaps |= {(low + k, int(stamps[k] - steps[k])), (low + k + 1, int(stamps[k]))}
            last_ns = int(stamps[-1])
        nodes = [Node(int(k), u.t_ns, u) for k, u in zip(stops, updates, strict=True)]
        nodes += [Node(*edge, None) for edge in gaps]
        nodes.sort(key=lambda node: (node.t_ns, node.update is not None))
        return [*nodes, Node(len(samples), end_ns, None)]

    def readings(self, k: int) -> tuple[NDArray[np.int64], Array]:
        """Return steps (n,) [ns] and readings (n, 6) of a segment."""
        begin, since_ns = 0, self._start.t_ns
        if k:
            begin, since_ns = self.nodes[k - 1][:2]
        stop, t_ns, _ = self.nodes[k]
        samples = self._samples[begin:stop]
        last_ns = int(samples[-1]["t_ns"]) if stop > begin else since_ns
        if t_ns > last_ns:
            low_ns, low = self._start.t_ns, self._start.sample
            if stop:
                before = self._samples[stop - 1 : stop]
                low_ns, low = int(before[0]["t_ns"]), as_numbers(before)[0, 1:]
            between = interpolate(low_ns, low, self._samples[stop], t_ns)
            samples = np.concatenate((samples, between))
        if len(samples) == 0:
            return np.empty(0, np.int64), np.empty((0, 6))
        return steps_since(since_ns, samples["t_ns"]), readings_of(samples)
