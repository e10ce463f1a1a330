"""
The smoother of a recorded stretch: what the forward run decided, with hindsight.

Measurements, decisions and noise are those of the forward run, but for five things that only later
data show. Measurements that the gate rejected are fused if they fit after all; where the
innovations showed that the noise had been too small for a while, it is raised over that while; the
clock offset of each fix is the one that later fixes confirm; a heading that had to be found is
linearised about the one that was found; and `ConstantErrors` are estimated.

References
----------
.. [1] H. Rauch, F. Tung, C. Striebel, "Maximum likelihood estimates of linear dynamic systems",
       AIAA Journal 3, 1965.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.filter.events import ClockShift, CovarianceInflation, StateRestored
from hybrid_ins.core.filter.filter_record import Decided, FilterRecord, FilterStart
from hybrid_ins.core.filter.ins_filter import InsFilter
from hybrid_ins.core.inertial.rotations import (
    heading_from_quat,
    quat_from_rotvec,
    quat_multiply,
)
from hybrid_ins.core.inertial.state import N_ERROR, NavState
from hybrid_ins.core.noise.slow_error import LASTING
from hybrid_ins.core.noise.weights import MEMORY
from hybrid_ins.core.sensor_errors.clock_prior import ClockPrior
from hybrid_ins.core.smoothing.constant_errors import ConstantErrors
from hybrid_ins.core.smoothing.forward_record import Stretch
from hybrid_ins.core.smoothing.segments import SmootherStart, Update
from hybrid_ins.core.smoothing.smoother import N_ADJOINT, N_STATE, Smoother, Store
from hybrid_ins.core.update.measurements import GNSS, PositionFix, clock_offset_ns

Array = NDArray[np.float64]

LOOSE = 5.0  # times its deviation: how far off a heading may be that is found once more
LEAST_HEADING_STD = 0.05  # rad
HEAD_NS = 20_000_000_000  # after the filter ran: what is smoothed to find the first heading
CLOCK_WALK = 3e-4  # s per sqrt(s), of one clock against the other beside its drift
CLOCK_JUMP = 5.0  # standard deviations
MEMORY_NS = int(MEMORY * 1e9)


class Hindsight:
    """
    What is known in the end of a stretch in which a filter ran.

    Parameters
    ----------
    stretch : Stretch
        Of a `RunRecord`.
    """

    def __init__(self, stretch: Stretch) -> None:
        self._stretch = stretch
        self._steps, self._moved = _steps(stretch.filters)

    def smoother(
        self, make_store: Callable[[int], Store], progress: Callable[[int], None] = lambda n: None
    ) -> tuple[Smoother, ConstantErrors]:
        """
        Return a smoother of the stretch, and the constants that it estimates.

        Parameters
        ----------
        make_store : callable
            Given the length of the rows, returns a `Store`.
        progress : callable
            See `Smoother`.
        """
        stretch, last = self._stretch, self._stretch.filters[-1][0]
        interval, gap_ns = last.covariance_interval, last.long_step_ns
        start, updates = _plan(stretch.filters, self._steps, self._moved)
        samples = stretch.samples
        if stretch.heading_found:
            end = np.searchsorted(samples["t_ns"], stretch.running_ns + HEAD_NS)
            head = Smoother(start, samples[:end], updates, interval, gap_ns, {}, {})
            head.run()
            start = _about_heading(start, head.first())
        stores = make_store(N_STATE), make_store(N_ADJOINT)
        prior = _clock_prior(last, self._steps, self._moved)
        constants = ConstantErrors(_lever_std(last, updates), prior)
        unknown = None if constants.are_known else constants
        smoother = Smoother(start, samples, updates, interval, gap_ns, *stores, progress, unknown)
        return smoother, constants

    def clock_offsets(self, constant: float) -> tuple[NDArray[np.int64], Array]:
        """
        Return the stamps of the fixes by their own clock [ns] and its smoothed offsets [s].

        ``constant`` is what `ConstantErrors` has found of them [s].
        """
        found = [
            (step.decided.verdict.measurement, dt)
            for step, dt in zip(self._steps, self._moved, strict=True)
            if step.decided.verdict is not None and step.decided.verdict.measurement.sensor == GNSS
        ]
        offsets_ns = np.array([clock_offset_ns(measurement) for measurement, _ in found], np.int64)
        stamps = np.array([measurement.t_ns for measurement, _ in found], np.int64) - offsets_ns
        return stamps, offsets_ns * 1e-9 + np.array([dt for _, dt in found]) + constant

    def attitude_by_scale(self) -> tuple[NDArray[np.int64], Array]:
        """
        Return what scale errors do to the attitude, as it was known while filtering.

        Stamps (n,) [ns] and from each on the mean square (n, 6) [rad²] of
        `ScaleErrorObserver.considered`. In an outage it is what was known before.
        """
        decided = [(s.decided.event.t_ns, s.decided.attitude_by_scale) for s in self._steps]
        known = [(t_ns, considered) for t_ns, considered in decided if considered.any()]
        return _columns(known, np.zeros(6))

    def heading_by_noise(self) -> tuple[NDArray[np.int64], Array]:
        """
        Return what motion did not show of the heading, as it was known while filtering.

        Stamps (n,) [ns] and from each on the variance (n,) [rad²], `HeadingInformation.considered`.
        """
        known = [(s.decided.event.t_ns, s.decided.heading_by_noise) for s in self._steps]
        return _columns(known, 0.0)

    def past_positions(self) -> tuple[NDArray[np.int64], Array]:
        """
        Return what positions have shown of their errors, before and, in the end, after it.

        Stamps (n,) [ns] and from each on the variance (n, 3) [m²], NED, `FilterNoise.past_variance`
        or what is left of a later one: which of the positions about a jump are wrong is not known.
        """
        known = [(s.decided.event.t_ns, s.decided.past_variance) for s in self._steps]
        t_ns, variances = _columns(known, np.zeros(3))
        if variances.any():
            left = np.exp(-2e-9 / LASTING * np.diff(t_ns))
            for k in range(len(left) - 1, -1, -1):
                variances[k] = np.maximum(variances[k], left[k] * variances[k + 1])
        return t_ns, variances


def _columns(
    known: Sequence[tuple[int, Array | float]], nothing: Array | float
) -> tuple[NDArray[np.int64], Array]:
    """Return stamps [ns] and values of what was known, or one of ``nothing``."""
    stamps, values = zip(*(known or [(0, nothing)]), strict=True)
    return np.array(stamps, np.int64), np.array(values)


def _lever_std(last: InsFilter, updates: Sequence[Update]) -> Array | None:
    """
    Return the deviation (3,) [m], b, of the lever arm that is given; None where none is.

    It is given where it has a deviation, or any measurement has one other than zero.
    """
    std = _record(last).start.lever_std
    levers = (getattr(update.measurement, "lever_b", None) for update in updates)
    is_given = std.any() or any(lever is not None and lever.any() for lever in levers)
    return std if is_given else None


@dataclass(slots=True)
class _Step:
    """What was decided, with the clock offset applied to it and the noise then in force."""

    decided: Decided
    applied: float  # s, beyond what the first filter's clock added
    levels: Array
    r_scale: float


def _steps(filters: Sequence[tuple[InsFilter, float]]) -> tuple[list[_Step], Array]:
    """Return what was decided in the end, and what is to be added to the stamps of each [s]."""
    steps: list[_Step] = []
    applied, shifted = 0.0, len(filters) > 1
    for running, offset in filters:
        record = _record(running)
        while steps and steps[-1].decided.event.t_ns > record.start.t_ns:
            applied = steps.pop().applied
        applied += offset
        for decided in record.decided:
            if isinstance(decided.event, ClockShift):
                applied += decided.event.by
                shifted = True
            steps.append(_Step(decided, applied, decided.levels, decided.r_scale))
        steps += [_Step(late, applied, late.levels, late.r_scale) for late in record.too_old]
    steps.sort(key=lambda step: step.decided.event.t_ns)
    return steps, _clock(steps) if shifted else np.zeros(len(steps))


def _clock_prior(last: InsFilter, steps: Sequence[_Step], moved: Array) -> ClockPrior | None:
    """Return the prior of what the smoothed clock offsets lack; None where none is estimated."""
    prior = last.clock.prior
    if not last.considers_clock or prior is None:
        return None
    first = next((k for k, step in enumerate(steps) if _is_gnss(step)), None)
    offset = 0.0 if first is None else steps[first].applied + moved[first]  # beyond the given one
    return ClockPrior(-offset, prior.scale)


def _plan(
    filters: Sequence[tuple[InsFilter, float]], steps: Sequence[_Step], moved: Array
) -> tuple[SmootherStart, list[Update]]:
    """Return what the smoother begins with and does, by hindsight."""
    first = _record(filters[0][0])
    psd = filters[0][0].noise.process.psd
    first_levels = _raise(steps, first.start)
    updates: list[Update] = []
    levels = first_levels
    restored = [one for step in steps if isinstance(one := step.decided.event, StateRestored)]
    for step, dt in zip(steps, moved, strict=True):
        is_undone = any(one.since_ns < step.decided.event.t_ns <= one.t_ns for one in restored)
        if is_undone and not _is_gnss(step):
            continue
        update = _update(step, round(dt * 1e9), psd(step.levels))
        if update is not None or not np.array_equal(step.levels, levels):
            updates.append(update or Update(step.decided.event.t_ns, psd(step.levels)))
            levels = step.levels
    slow = next((u.split.slow_variance for u in updates if u.split is not None), None)
    start = SmootherStart(
        first.start.t_ns, first.start.sample, first.start.state, psd(first_levels), slow
    )
    return start, sorted(updates, key=lambda update: update.t_ns)


def _record(running: InsFilter) -> FilterRecord:
    assert running.record is not None, "the filter keeps no record"
    return running.record


def _update(step: _Step, moved_ns: int, psd: Array) -> Update | None:
    event, verdict, scale = step.decided.event, step.decided.verdict, step.decided.scale_step
    if isinstance(event, CovarianceInflation):
        return Update(event.t_ns, psd, inflation=event, scale=scale)
    if verdict is None:
        return None if scale is None else Update(event.t_ns, psd, scale=scale)
    plain, split = verdict.accepted and not verdict.inflated, step.decided.split
    measurement = verdict.measurement
    if isinstance(measurement, PositionFix) and split is not None:
        measurement = replace(measurement, covariance_n=split.white)
    if measurement.sensor == GNSS:
        measurement = replace(measurement, t_ns=measurement.t_ns + moved_ns)  # type: ignore[type-var]
    return Update(
        measurement.t_ns,
        psd,
        measurement,
        step.r_scale / verdict.weight if measurement.sensor == GNSS else 1.0,
        math.inf if plain else verdict.threshold,
        verdict.inflated,
        split=split,
        scale=scale,
    )


def _raise(steps: Sequence[_Step], start: FilterStart) -> Array:
    """
    Raise the noise before each `StateCorrection` to what was found by it; return the first levels.

    It was found from the innovations of so long before.
    """
    levels = start.levels
    for k, step in enumerate(steps):
        if not step.decided.state_moved:
            continue
        since = step.decided.event.t_ns - MEMORY_NS
        after = next((s.r_scale for s in steps[k + 1 :] if _is_gnss(s)), step.r_scale)
        for earlier in steps[:k]:
            if earlier.decided.event.t_ns >= since:
                earlier.levels = np.maximum(earlier.levels, step.levels)
                if _is_gnss(earlier):
                    earlier.r_scale = max(earlier.r_scale, after)
        if start.t_ns >= since:
            levels = np.maximum(levels, step.levels)
    return levels


def _is_gnss(step: _Step) -> bool:
    verdict = step.decided.verdict
    return verdict is not None and verdict.measurement.sensor == GNSS


def _clock(steps: Sequence[_Step]) -> Array:
    """
    Return how much more [s] belongs to each step's stamp, by the smoothed clock offset.

    The offset is a random walk with the drift that was found in the end, estimated forward by
    `ClockOffsetObserver` and smoothed by [1]_; where it jumps (a receiver that was set anew), later
    estimates say nothing of earlier ones.
    """
    moved = np.zeros(len(steps))
    later: tuple[int, float, float] | None = None  # stamp [ns], smoothed offset, variance before it
    drift = 0.0
    for k in range(len(steps) - 1, -1, -1):
        step = steps[k]
        if not _is_gnss(step):
            continue
        missing, variance = step.decided.clock_residual, step.decided.clock_variance
        offset, t_ns = step.applied + missing, step.decided.event.t_ns
        if later is None:
            drift = step.decided.clock_drift
        else:
            dt = max(later[0] - t_ns, 0) * 1e-9
            grown = variance + CLOCK_WALK**2 * dt
            change = later[1] - drift * dt - offset
            if abs(change) < CLOCK_JUMP * math.sqrt(grown + later[2]):
                offset += variance / grown * change
        later = t_ns, offset, variance
        moved[k] = offset - step.applied
    return moved


def _about_heading(start: SmootherStart, found: NavState) -> SmootherStart:
    """
    Return the start with the heading of a state that was smoothed already, and little trust in it.

    The same measurements find it again: what counts twice is one part in ``LOOSE`` squared.
    """
    state, std = start.state, max(LOOSE * math.sqrt(found.P[8, 8]), LEAST_HEADING_STD)
    by = heading_from_quat(found.quat_xyzw) - heading_from_quat(state.quat_xyzw)
    scale = np.ones(N_ERROR)  # the correlations stay, or P might be indefinite
    scale[8] = std / math.sqrt(state.P[8, 8])
    P = state.P * np.outer(scale, scale)
    quat = quat_multiply(quat_from_rotvec([0.0, 0.0, by]), state.quat_xyzw)
    return replace(start, state=replace(state, quat_xyzw=quat, P=P))
