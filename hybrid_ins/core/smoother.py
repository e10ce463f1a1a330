"""
Fixed-interval smoothing: the state at every time, given all measurements before and after it.

The forward filter is run once more over a recorded stretch, with the measurements, decisions and
noise levels of the first run. A backward recursion then carries what the later measurements say as
an adjoint (lambda, Lambda): the smoothed error of a forward state with covariance P is P lambda,
its covariance P - P Lambda P. Between measurements the adjoint moves with the transpose of the
transition matrix alone, so process noise, covariance inflations and gaps need no inverse and no
treatment of their own; at a measurement it takes the innovation in. This is the form of Bryson and
Frazier, [1]_, algebraically equal to that of Rauch, Tung and Striebel, [2]_.

Between two covariance steps the smoothed error is interpolated linearly. States at the nodes and
adjoints are kept in a store, which may lie on a disk; everything at the IMU's rate is computed
again where it is needed, so that the memory used does not grow with the recording.

References
----------
.. [1] G. Bierman, "Fixed interval smoothing with discrete measurements", International Journal of
       Control 18, 1973.
.. [2] H. Rauch, F. Tung, C. Striebel, "Maximum likelihood estimates of linear dynamic systems",
       AIAA Journal 3, 1965.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core import gap, iterated_update
from hybrid_ins.core.backward_propagation import run_backward
from hybrid_ins.core.inflation import inflate_covariance, inflate_to_innovation
from hybrid_ins.core.kalman import innovation
from hybrid_ins.core.measurements import GNSS, Measurement
from hybrid_ins.core.samples import SAMPLE_DTYPE, insert_stamps, readings_of, steps_since
from hybrid_ins.core.smoother_step import (
    correction_adjoint,
    propagation_adjoint,
    run_and_keep,
    smoothed_rows,
)
from hybrid_ins.core.state import (
    COVARIANCE,
    LAST_F,
    LAST_W,
    N_ERROR,
    N_FLAT,
    N_NAV,
    PLACES,
    PSD,
    NavState,
    covariance,
    pack,
)

Array = NDArray[np.float64]
Samples = NDArray[np.void]

N_PACKED = N_ERROR * (N_ERROR + 1) // 2
N_ADJOINT = N_ERROR + N_PACKED
BLOCK = 2048  # rows that are handed out at a time
LONGEST_BEFORE_NS = 30_000_000_000  # that the state is carried back before the start


@dataclass(frozen=True, slots=True)
class Start:
    """What a filter begins with."""

    t_ns: int  # ns
    sample: Array  # (6,) the IMU sample then: m/s², rad/s, b
    state: NavState
    psd: Array  # (12,) Qc's diagonal from then on


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
    std : ndarray, shape (15,), or None
        The covariance is inflated to at least these standard deviations.
    """

    t_ns: int
    psd: Array
    measurement: Measurement | None = None
    r_scale: float = 1.0
    threshold: float = np.inf
    inflates: bool = False
    std: Array | None = None


class Store(Protocol):
    """Rows of numbers by their index: a list, or a file."""

    def __setitem__(self, index: int, row: Array) -> None:
        """Keep a row."""
        ...

    def __getitem__(self, index: int) -> Array:
        """Return a row that was kept."""
        ...


class _Node(NamedTuple):
    """Where something other than a plain IMU step happens: before it, samples up to ``stop``."""

    stop: int
    update: Update | None  # None: the end of a gap in the samples


class Smoother:
    """
    Smooths one stretch of a recording in which a filter ran without a restart.

    Parameters
    ----------
    start : Start
        What the filter begins with.
    samples : ndarray of SAMPLE_DTYPE
        The IMU's; those that are not younger than the start serve `before_start` alone.
    updates : sequence of Update
        By stamp.
    interval : float
        The covariance is propagated once this much time is pending [s], as in the filter.
    long_step_ns : int
        A longer step between samples [ns] is a gap.
    states, adjoints : Store
        Keep (N_NAV,) and (135,) numbers for each update.
    progress : callable, optional
        Called with the number of samples done, three times for each sample.
    """

    def __init__(
        self,
        start: Start,
        samples: Samples,
        updates: Sequence[Update],
        interval: float,
        long_step_ns: int,
        states: Store,
        adjoints: Store,
        progress: Callable[[int], None] = lambda n: None,
    ) -> None:
        self._start = start
        self._interval = interval
        self._long_step_ns = long_step_ns
        self._states = states
        self._adjoints = adjoints
        self._progress = progress
        after = int(np.searchsorted(samples["t_ns"], start.t_ns, side="right"))
        self._before = samples[:after]
        samples = samples[after:]
        end_ns = int(samples["t_ns"][-1]) if len(samples) else start.t_ns
        updates = [u for u in updates if start.t_ns <= u.t_ns <= end_ns]
        first = np.array([(start.t_ns, start.sample[:3], start.sample[3:])], SAMPLE_DTYPE)
        stamps = np.array([u.t_ns for u in updates], np.int64)
        self._samples = insert_stamps(first, samples, stamps)
        self._own = np.isin(self._samples["t_ns"], samples["t_ns"])
        self._steps = np.empty(0, np.int64)
        if len(self._samples):
            self._steps = steps_since(start.t_ns, self._samples["t_ns"])
        self._nodes = self._find_nodes(updates)
        self._spans: dict[int, float] = {}  # s since the last correction, where one inflates
        self._fused: set[int] = set()

    def _find_nodes(self, updates: Sequence[Update]) -> list[_Node]:
        stamps = self._samples["t_ns"]
        nodes = [_Node(int(np.searchsorted(stamps, u.t_ns, side="right")), u) for u in updates]
        gaps = np.flatnonzero(self._steps > self._long_step_ns).tolist()
        starts = {int(k) for k in gaps}  # a gap is a stretch of its own
        nodes += [_Node(k, None) for k in starts] + [_Node(k + 1, None) for k in starts]
        nodes.sort(key=lambda node: (node.stop, node.update is not None))
        return [*nodes, _Node(len(stamps), None)]

    def smooth(self) -> Iterator[tuple[NDArray[np.int64], Array]]:
        """
        Yield the smoothed states in order: stamps (n,) [ns] and flat states (n, N_NAV).

        The first ones are `before_start`'s.
        """
        self.run()
        yield from self._output()

    def run(self) -> None:
        """Run forward and backward; `first` is known then, and `smooth` has only to write down."""
        self._forward()
        self._backward()

    def _forward(self) -> None:
        """Run the filter; keep its state after every update."""
        nav = self._start.state.to_flat()
        nav[LAST_F], nav[LAST_W] = self._start.sample[:3], self._start.sample[3:]
        nav[PSD] = self._start.psd
        corrected_ns, begin = self._start.t_ns, 0
        for k, node in enumerate(self._nodes):
            self._states[k] = nav[:N_NAV].copy()
            self._run(nav, begin, node.stop)
            self._progress(node.stop - begin)
            begin = node.stop
            if node.update is None:
                continue
            update = node.update
            if update.std is not None:
                pack(inflate_covariance(covariance(nav), update.std), nav[COVARIANCE])
            if update.measurement is not None and np.isfinite(nav[:N_NAV]).all():
                z, H, R = update.measurement.linearise(nav)
                R = R * update.r_scale
                fits = innovation(nav, z, H, R)[1] <= update.threshold
                if fits or update.inflates:
                    self._fused.add(k)
                    if not fits:
                        self._spans[k] = (update.t_ns - corrected_ns) * 1e-9
                        inflate_to_innovation(nav, z, H, self._spans[k])
                    iterated_update.update(nav, z, H, R)
                    if update.measurement.sensor == GNSS:
                        corrected_ns = update.t_ns
            nav[PSD] = update.psd

    def _backward(self) -> None:
        """Carry the adjoint from the end to the start; keep it before every update."""
        adjoint = np.zeros(N_ERROR), np.zeros((N_ERROR, N_ERROR))
        for k in range(len(self._nodes) - 1, -1, -1):
            nav, steps = self._again(k)
            if k in self._fused:
                adjoint = self._through_update(k, nav, *adjoint)
            row = np.empty(N_ADJOINT)
            row[:N_ERROR] = adjoint[0]
            pack(adjoint[1], row[N_ERROR:])
            self._adjoints[k] = row
            adjoint = propagation_adjoint(*steps[3:5], *adjoint)
            self._progress(len(steps[1]))
        self._first_adjoint = adjoint

    def _through_update(
        self, k: int, nav: Array, costate: Array, information: Array
    ) -> tuple[Array, Array]:
        """Return the adjoint before an update, given that after it and the state before it."""
        update = self._nodes[k].update
        assert update is not None and update.measurement is not None
        if update.std is not None:
            pack(inflate_covariance(covariance(nav), update.std), nav[COVARIANCE])
        z, H, R = update.measurement.linearise(nav)
        if k in self._spans:
            inflate_to_innovation(nav, z, H, self._spans[k])
        before: tuple[Array, Array] = correction_adjoint(
            nav, z, H, R * update.r_scale, costate, information
        )
        return before

    def _output(self) -> Iterator[tuple[NDArray[np.int64], Array]]:
        """Yield stamps and smoothed states, in blocks."""
        waiting = [*self.before_start()]
        count, begin = sum(len(t) for t, _ in waiting), 0
        for k, node in enumerate(self._nodes):
            _, steps = self._again(k)
            row = self._adjoints[k]
            smoothed = smoothed_rows(*steps, row[:N_ERROR].copy(), _full(row[N_ERROR:]))
            own = self._own[begin : node.stop]
            waiting.append((self._samples["t_ns"][begin : node.stop][own], smoothed[own]))
            count += int(own.sum())
            self._progress(node.stop - begin)
            begin = node.stop
            if count >= BLOCK or (k + 1 == len(self._nodes) and count):
                yield tuple(map(np.concatenate, zip(*waiting, strict=True)))  # type: ignore[misc]
                waiting, count = [], 0

    def first(self) -> NavState:
        """Return the smoothed state at the start."""
        return NavState.from_flat(self._first_flat())

    def _first_flat(self) -> Array:
        nav = np.zeros(N_FLAT)
        nav[:N_NAV] = self._states[0]
        row = np.tile(nav[:N_NAV], (1, 1))
        steps = (
            nav[:N_NAV],
            row,
            np.zeros(1),
            np.zeros((0, 225)),
            np.zeros(0),
            np.zeros(0, np.int64),
        )
        costate, information = self._first_adjoint
        out: Array = smoothed_rows(*steps, costate, information)[0]
        nav[:N_NAV] = out
        return nav

    def _again(self, k: int) -> tuple[Array, tuple[Any, ...]]:
        """Run the samples before a node again; return the state there and what the way was."""
        nav = np.zeros(N_FLAT)
        nav[:N_NAV] = self._states[k]
        begin = self._nodes[k - 1].stop if k else 0
        first = nav[:N_NAV].copy()
        return nav, (first, *self._run(nav, begin, self._nodes[k].stop))

    def _run(self, nav: Array, begin: int, stop: int) -> tuple[Any, ...]:
        """
        Advance ``nav`` over samples; its covariance is up to date then.

        Returns the flat states (n, N_NAV), the steps (n,) [s], and of each covariance step the
        system matrix (m, 225), the length (m,) [s] and the row that it leads to (m,).
        """
        readings = readings_of(self._samples[begin:stop]) if stop > begin else np.empty((0, 6))
        dt = self._steps[begin:stop] * 1e-9
        if stop - begin == 1 and self._steps[begin] > self._long_step_ns:
            return self._bridge(nav, float(dt[0]), readings[0])
        n = len(dt)
        rows, F = np.empty((n, N_NAV)), np.empty((n, N_ERROR * N_ERROR))
        lengths, at = np.empty(n), np.empty(n, np.int64)
        m = run_and_keep(nav, dt, readings, self._interval, rows, F, lengths, at)
        return rows, dt, F[:m], lengths[:m], at[:m]

    def _bridge(self, nav: Array, dt: float, reading: Array) -> tuple[Any, ...]:
        """Advance over missing samples, as `_run`."""
        last = np.concatenate((nav[LAST_F], nav[LAST_W]))
        line = gap.line(last, reading, dt)
        n = len(line)
        rows, F = np.empty((n, N_NAV)), np.empty((n, N_ERROR * N_ERROR))
        lengths, at = np.empty(n), np.empty(n, np.int64)
        parts = np.full(n, dt / n)
        m = run_and_keep(nav, parts, line, self._interval, rows, F, lengths, at)
        gap.inflate(nav, last, reading, dt)
        leads_to = np.full(m, -1)
        leads_to[-1] = 0
        return nav[None, :N_NAV].copy(), np.array([dt]), F[:m], lengths[:m], leads_to

    def before_start(self) -> Iterator[tuple[NDArray[np.int64], Array]]:
        """Yield the state at the start's sample and before it, see `run_backward`."""
        nav = self._first_flat()
        nav[LAST_F], nav[LAST_W] = self._start.sample[:3], self._start.sample[3:]
        nav[PSD] = self._start.psd
        samples = self._before[self._before["t_ns"] >= self._start.t_ns - LONGEST_BEFORE_NS]
        t_ns, rows = run_backward(nav, self._start.t_ns, samples, self._long_step_ns)
        if len(rows):
            yield t_ns, rows


def _full(packed: Array) -> Array:
    """Return the symmetric matrix (15, 15) of an upper triangle (120,)."""
    return np.asarray(packed[PLACES])
