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
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.filter import gap
from hybrid_ins.core.inertial.state import (
    LAST_F,
    LAST_W,
    N_ERROR,
    N_FLAT,
    N_NAV,
    PLACES,
    PSD,
    NavState,
    pack,
)
from hybrid_ins.core.noise.slow_error import NO_GROWTH, change_slow_error
from hybrid_ins.core.smoothing.backward_propagation import run_backward
from hybrid_ins.core.smoothing.constant_errors import (
    MOST_PASSES,
    N_CONSTANTS,
    N_SENSITIVITY,
    ConstantErrors,
)
from hybrid_ins.core.smoothing.segments import Segments, SmootherStart, Update
from hybrid_ins.core.smoothing.step import (
    correction_adjoint,
    propagation_adjoint,
    run_and_keep,
    smoothed_rows,
)
from hybrid_ins.core.update import iterated_update
from hybrid_ins.core.update.inflation import inflate, inflate_to_innovation
from hybrid_ins.core.update.kalman import heading_turn, innovation, update_in_body
from hybrid_ins.core.update.measurements import GNSS

Array = NDArray[np.float64]
Samples = NDArray[np.void]

N_PACKED = N_ERROR * (N_ERROR + 1) // 2
N_STATE = N_NAV + N_SENSITIVITY
N_ADJOINT = N_ERROR + N_PACKED + N_SENSITIVITY
BLOCK = 2048  # rows that are handed out at a time
LONGEST_BEFORE_NS = 30_000_000_000  # that the state is carried back before the start


class Store(Protocol):
    """Rows of numbers by their index: a list, or a file."""

    def __setitem__(self, index: int, row: Array) -> None:
        """Keep a row."""
        ...

    def __getitem__(self, index: int) -> Array:
        """Return a row that was kept."""
        ...


class Smoother:
    """
    Smooths one stretch of a recording in which a filter ran without a restart.

    Parameters
    ----------
    start : SmootherStart
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
        Keep (N_STATE,) and (N_ADJOINT,) numbers for each update.
    progress : callable, optional
        Called with the number of samples done, three times for each sample.
    constants : ConstantErrors, optional
        Estimated, and considered in the covariances.
    """

    def __init__(
        self,
        start: SmootherStart,
        samples: Samples,
        updates: Sequence[Update],
        interval: float,
        long_step_ns: int,
        states: Store,
        adjoints: Store,
        progress: Callable[[int], None] = lambda n: None,
        constants: ConstantErrors | None = None,
    ) -> None:
        self._start = start
        self._constants = constants
        self._interval = interval
        self._long_step_ns = long_step_ns
        self._states = states
        self._adjoints = adjoints
        self._progress = progress
        after = int(np.searchsorted(samples["t_ns"], start.t_ns, side="right"))
        self._before = samples[:after]
        self._after = samples[after:]
        self._updates = updates
        self._divide()
        self._spans: dict[int, float] = {}  # s since the last correction, where one inflates
        self._fused: set[int] = set()
        self._turns: dict[int, Array] = {}  # of the errors with the heading

    def run(self) -> None:
        """Run forward and backward; `first` and `states` are known then."""
        self._forward()
        if self._constants is not None:
            for _ in range(MOST_PASSES):
                if self._constants.finish():
                    break
                self._divide()
                self._forward()
        self._backward()

    def _divide(self) -> None:
        """Divide the stretch at its updates, as they are assumed in this pass."""
        updates = self._updates
        if self._constants is not None:
            self._constants.begin(self._start.state)
            updates = sorted(map(self._constants.assumed, updates), key=lambda u: u.t_ns)
        self._segments = Segments(self._start, self._after, updates, self._long_step_ns)
        self._nodes = self._segments.nodes

    def _forward(self) -> None:
        """Run the filter; keep its state after every update."""
        nav = self._start.state.to_flat()
        nav[LAST_F], nav[LAST_W] = self._start.sample[:3], self._start.sample[3:]
        nav[PSD] = self._start.psd
        if self._start.slow_variance is not None:
            change_slow_error(nav, self._start.slow_variance, 0.0, NO_GROWTH)
        self._corrected_ns = self._start.t_ns
        self._spans.clear()
        self._fused.clear()
        self._turns.clear()
        constants, row = self._constants, np.zeros(N_STATE)
        for k, node in enumerate(self._nodes):
            row[:N_NAV] = nav[:N_NAV]
            if constants is not None:
                row[N_NAV:] = constants.sensitivity.ravel()
            self._states[k] = row.copy()
            steps = self._run(nav, k)
            if constants is not None:
                constants.propagate(*steps[2:4])
            self._progress(self._segments.count(k))
            if node.update is not None:
                self._apply(nav, k, node.update)

    def _apply(self, nav: Array, k: int, update: Update) -> None:
        """Apply an update to the flat state of the forward pass."""
        if update.scale is not None:
            update.scale.apply(nav)
        unchanged = nav[:N_NAV].copy()
        _inflate(nav, update)
        if update.measurement is not None and np.isfinite(nav[:N_NAV]).all():
            measurement = update.measurement
            z, H, R = measurement.linearise(nav)
            R = R * update.r_scale
            fits = innovation(nav, z, H, R)[1] <= update.threshold
            if fits or update.inflates:
                self._fused.add(k)
                if not fits:
                    self._spans[k] = (update.t_ns - self._corrected_ns) * 1e-9
                    inflate_to_innovation(nav, z, H, self._spans[k])
                before = nav.copy()
                K, T = _correct(nav, z, H, R, measurement.in_body)
                if self._constants is not None:
                    self._constants.correct(measurement, before, K, R)
                if T is not None:
                    self._turns[k] = T
                    if self._constants is not None:
                        self._constants.turn(T)
                if measurement.sensor == GNSS:
                    self._corrected_ns = update.t_ns
            else:
                nav[:N_NAV] = unchanged
        nav[PSD] = update.psd

    def _backward(self) -> None:
        """Carry the adjoint from the end to the start; keep it before every update."""
        adjoint, constants = (np.zeros(N_ERROR), np.zeros((N_ERROR, N_ERROR))), self._constants
        if constants is not None:
            constants.begin_adjoint()
        for k in range(len(self._nodes) - 1, -1, -1):
            nav, steps = self._again(k)
            if constants is not None:
                constants.sensitivity = self._states[k][N_NAV:].reshape(N_ERROR, N_CONSTANTS)
                constants.propagate(*steps[3:5])
            adjoint = self._through_update(k, nav.copy(), *adjoint)
            row = np.zeros(N_ADJOINT)
            row[:N_ERROR] = adjoint[0]
            pack(adjoint[1], row[N_ERROR : N_ERROR + N_PACKED])
            if constants is not None:
                row[N_ERROR + N_PACKED :] = constants.smoothed(nav).ravel()
                constants.propagate_adjoint(*steps[3:5])
            self._adjoints[k] = row
            adjoint = propagation_adjoint(*steps[3:5], *adjoint)
            self._progress(self._segments.count(k))
        self._first_adjoint = adjoint
        if constants is not None:
            constants.begin_sensitivity(self._start.state)
            self._first_sensitivity = constants.smoothed(self._start.state.to_flat())

    def _through_update(
        self, k: int, nav: Array, costate: Array, information: Array
    ) -> tuple[Array, Array]:
        """Return the adjoint before an update, given that after it and the state before it."""
        update = self._nodes[k].update
        if update is None:
            return costate, information
        if update.scale is not None:
            update.scale.apply(nav)
        if k in self._fused:
            assert update.measurement is not None
            if k in self._turns:
                costate, information = self._turned_back(self._turns[k], costate, information)
            _inflate(nav, update)
            z, H, R = update.measurement.linearise(nav)
            R, in_body = R * update.r_scale, update.measurement.in_body
            if k in self._spans:
                inflate_to_innovation(nav, z, H, self._spans[k])
            if self._constants is not None:
                self._constants.correct_adjoint(update.measurement, nav, R)
            after = costate, information
            costate, information = correction_adjoint(nav, z, H, R, in_body, *after)
        if update.scale is not None:
            return self._turned_back(update.scale.J, costate, information)
        return costate, information

    def _turned_back(self, T: Array, costate: Array, information: Array) -> tuple[Array, Array]:
        """Return the adjoint before errors are multiplied by T."""
        if self._constants is not None:
            self._constants.turn_adjoint(T)
        return T.T @ costate, T.T @ information @ T

    def states(self) -> Iterator[tuple[NDArray[np.int64], Array]]:
        """
        Yield the smoothed states in order and in blocks: stamps (n,) [ns], states (n, N_NAV).

        The first ones are `before_start`'s.
        """
        waiting = [*self.before_start()]
        if self._constants is not None:
            sensitivity = self._first_sensitivity
        count = sum(len(t) for t, _ in waiting)
        for k in range(len(self._nodes)):
            _, steps = self._again(k)
            row = self._adjoints[k]
            packed = row[N_ERROR : N_ERROR + N_PACKED]
            smoothed = smoothed_rows(*steps, row[:N_ERROR].copy(), packed[PLACES])
            if self._constants is not None and len(smoothed):
                last = row[N_ERROR + N_PACKED :].reshape(N_ERROR, N_CONSTANTS)
                share = np.cumsum(steps[2]) / steps[2].sum()
                self._constants.consider(smoothed, sensitivity, last, share)
                sensitivity = last
            stamps = self._segments.stamps(k)
            waiting.append((stamps, smoothed[: len(stamps)]))
            count += len(stamps)
            self._progress(len(stamps))
            if count >= BLOCK or (k + 1 == len(self._nodes) and count):
                yield tuple(map(np.concatenate, zip(*waiting, strict=True)))  # type: ignore[misc]
                waiting, count = [], 0

    def first(self) -> NavState:
        """Return the smoothed state at the start."""
        return NavState.from_flat(self._first_flat())

    def _first_flat(self) -> Array:
        nav = np.zeros(N_FLAT)
        nav[:N_NAV] = self._states[0][:N_NAV]
        no_steps = np.zeros((0, N_ERROR * N_ERROR)), np.zeros(0), np.zeros(0, np.int64)
        steps = nav[:N_NAV], nav[None, :N_NAV].copy(), np.zeros(1), *no_steps
        costate, information = self._first_adjoint
        out: Array = smoothed_rows(*steps, costate, information)
        if self._constants is not None:
            s = self._first_sensitivity
            self._constants.consider(out, s, s, np.zeros(1))
        nav[:N_NAV] = out[0]
        return nav

    def _again(self, k: int) -> tuple[Array, tuple[Any, ...]]:
        """Run the samples before a node again; return the state there and what the way was."""
        nav = np.zeros(N_FLAT)
        nav[:N_NAV] = self._states[k][:N_NAV]
        first = nav[:N_NAV].copy()
        return nav, (first, *self._run(nav, k))

    def _run(self, nav: Array, k: int) -> tuple[Any, ...]:
        """Advance to a node, see `_advance`."""
        steps, readings = self._segments.readings(k)
        return _advance(nav, steps, readings, self._interval, self._long_step_ns)

    def before_start(self) -> Iterator[tuple[NDArray[np.int64], Array]]:
        """Yield the state at the start's sample and before it, see `run_backward`."""
        nav = self._first_flat()
        nav[LAST_F], nav[LAST_W] = self._start.sample[:3], self._start.sample[3:]
        nav[PSD] = self._start.psd
        first = np.searchsorted(self._before["t_ns"], self._start.t_ns - LONGEST_BEFORE_NS)
        samples = self._before[first:]
        t_ns, rows = run_backward(nav, self._start.t_ns, samples, self._long_step_ns)
        if len(rows):
            yield t_ns, rows


def _correct(nav: Array, z: Array, H: Array, R: Array, in_body: bool) -> tuple[Array, Array | None]:
    """Fuse a measurement; return the gain, and what turns the errors after it, or None."""
    if in_body:
        _, K, T = update_in_body(nav, z, H, R)
        return K, T
    _, K, turn = iterated_update.update(nav, z, H, R)
    return K, heading_turn(turn) if turn else None


def _inflate(nav: Array, update: Update) -> None:
    """Add what is not known any more, before an update's measurement is fused."""
    if update.inflation is not None:
        inflate(nav, update.inflation.std, update.inflation.lever_b)
    if update.split is not None:
        split = update.split
        change_slow_error(nav, split.slow_variance, split.interval, split.claimed_growth)


def _advance(
    nav: Array, steps: NDArray[np.int64], readings: Array, interval: float, long_step_ns: int
) -> tuple[Any, ...]:
    """
    Advance ``nav`` over the samples of a segment; its covariance is up to date then.

    Returns the flat states (n, N_NAV), the steps (n,) [s], and of each covariance step the system
    matrix (m, 225), the length (m,) [s] and the row that it leads to (m,).
    """
    dt, n = steps * 1e-9, len(steps)
    if n == 1 and steps[0] > long_step_ns:
        return _bridge(nav, float(dt[0]), readings[0], interval)
    rows, F = np.empty((n, N_NAV)), np.empty((n, N_ERROR * N_ERROR))
    lengths, at = np.empty(n), np.empty(n, np.int64)
    m = run_and_keep(nav, dt, readings, interval, rows, F, lengths, at)
    return rows, dt, F[:m], lengths[:m], at[:m]


def _bridge(nav: Array, dt: float, reading: Array, interval: float) -> tuple[Any, ...]:
    """Advance over missing samples, as `_advance`."""
    last = np.concatenate((nav[LAST_F], nav[LAST_W]))
    line = gap.line(last, reading, dt)
    n = len(line)
    rows, F = np.empty((n, N_NAV)), np.empty((n, N_ERROR * N_ERROR))
    lengths, at = np.empty(n), np.empty(n, np.int64)
    parts = np.full(n, dt / n)
    m = run_and_keep(nav, parts, line, interval, rows, F, lengths, at)
    gap.inflate(nav, last, reading, dt)
    leads_to = np.full(m, -1)
    leads_to[-1] = 0
    return nav[None, :N_NAV].copy(), np.array([dt]), F[:m], lengths[:m], leads_to
