"""
The error-state filter in time: IMU samples forward, measurements at their own stamps.

A measurement that is ahead of the IMU waits; one that is behind is put where it belongs by
restoring the last rewind point before it and running the buffered samples and measurements again,
so that the result is that of an in-order run.
"""

from __future__ import annotations

import bisect
import copy
from collections import deque
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core import propagation
from hybrid_ins.core.clock_offset import ClockOffsetObserver
from hybrid_ins.core.filter_noise import FilterNoise
from hybrid_ins.core.gate import Gate, Verdict
from hybrid_ins.core.kalman import correct, inject, innovation
from hybrid_ins.core.measurements import Measurement
from hybrid_ins.core.noise import Correction, NoiseEstimate
from hybrid_ins.core.rotations import matrix_from_quat
from hybrid_ins.core.samples import SAMPLE_DTYPE, ImuRing, readings_of, steps_since
from hybrid_ins.core.state import (
    COVARIANCE,
    DP,
    DV,
    EPS,
    LAST_F,
    LAST_W,
    N_ERROR,
    N_NAV,
    PSD,
    QUAT,
    VELOCITY,
    NavState,
    covariance,
    inflate_covariance,
    pack,
)

Array = NDArray[np.float64]
NO_ROWS = np.empty((0, N_NAV))
NEVER_NS = 2**63 - 1
LONG_STEP = 4.0  # sample periods: a longer step lacks samples
SHORTEST_GAP = 0.025  # s
UNSEEN_FORCE, UNSEEN_RATE = 0.2, 0.02  # m/s², rad/s: of a calm vehicle in a gap, unseen
LARGEST_TURN = 0.2  # rad, of a step that the mechanisation's series take


@dataclass(frozen=True, slots=True)
class FilterSettings:
    """
    What shapes the filter besides its noise.

    Attributes
    ----------
    covariance_interval : float
        The covariance is propagated once this much time is pending [s]; 0: at every sample.
    max_delay : float
        Oldest measurement that is still fused, by rewinding [s].
    clock_std : float
        How far the fixes' clock may be off at the start [s].
    """

    covariance_interval: float = 0.01
    max_delay: float = 1.0
    clock_std: float = 0.5


@dataclass(frozen=True, slots=True)
class NoiseChange:
    """Other noise, from its stamp on."""

    t_ns: int
    noise: FilterNoise
    kind: ClassVar[str] = "noise change"


@dataclass(frozen=True, slots=True)
class ClockShift:
    """Fixes come with so much more added to their stamps, from now on."""

    t_ns: int
    by: float  # s
    kind: ClassVar[str] = "clock shift"


@dataclass(frozen=True, slots=True)
class CovarianceInflation:
    """From its stamp on the errors may be as large as ``std``, whatever was believed before."""

    t_ns: int
    std: Array  # (15,) in the order of the error state; 0 where nothing is doubted
    kind: ClassVar[str] = "doubt"


Change = NoiseEstimate | NoiseChange | ClockShift | CovarianceInflation
Event = Measurement | Change


@dataclass(slots=True)
class Checkpoint:
    """All that changes in a filter, after its first ``n_done`` events."""

    t_ns: int
    n_done: int
    nav: Array
    noise: FilterNoise
    gate: Gate
    clock: ClockOffsetObserver
    corrected_ns: int


class InsFilter:
    """
    A 15-state error-state EKF for INS/GNSS that runs at the IMU's rate.

    Parameters
    ----------
    initial : NavState
        State and covariance at ``t_ns``.
    t_ns : int
        Stamp of the last IMU sample before the first to be processed [ns].
    sample : ndarray, shape (6,)
        That sample: specific force [m/s²] and angular rate [rad/s], b.
    noise : FilterNoise
        Qc, and the factor on the covariance of fixes.
    gate : Gate
        Decides which measurements are fused.
    ring : ImuRing
        Holds the recent IMU samples; its owner pushes each sample before `predict`.
    settings : FilterSettings
        See there.

    Attributes
    ----------
    nav : ndarray, shape (N_FLAT,)
        The flat state after the last sample.
    t_ns : int
        Its stamp [ns].
    long_step_ns : int
        A longer step [ns] is a gap in the samples.
    clock : ClockOffsetObserver
        What the innovations say of the fixes' clock; changes nothing by itself.
    verdicts : deque of Verdict
        One for each measurement submitted, in order of decision; the owner empties it.
    """

    def __init__(
        self,
        initial: NavState,
        t_ns: int,
        sample: Array,
        noise: FilterNoise,
        gate: Gate,
        ring: ImuRing,
        settings: FilterSettings,
    ) -> None:
        self.nav = initial.to_flat()
        self.nav[LAST_F], self.nav[LAST_W] = sample[:3], sample[3:]
        self.t_ns = t_ns
        self.noise = noise
        self.gate = gate
        self.clock = ClockOffsetObserver(settings.clock_std)
        self.ring = ring
        self.verdicts: deque[Verdict] = deque()
        self.long_step_ns = int(max(LONG_STEP * noise.process.period, SHORTEST_GAP) * 1e9)
        self._interval = settings.covariance_interval - 1e-6
        self._horizon_ns = int(settings.max_delay * 1e9)
        self._spacing_ns = max(self._horizon_ns // 4, 50_000_000)
        self._corrected_ns = t_ns
        self._pending: list[Event] = []
        self._done: list[Event] = []  # those after the oldest rewind point
        self._n_done = 0  # all there ever were
        self._points: list[Checkpoint] = []
        self.nav[PSD] = noise.psd()
        self._remember()
        self._schedule()

    @property
    def state(self) -> NavState:
        """Copy of the state after the last sample, its covariance up to date."""
        nav = self.nav.copy()
        propagation.flush(nav)
        return NavState.from_flat(nav)

    @property
    def sample(self) -> Array:
        """The IMU sample at ``t_ns``, shape (6,): specific force [m/s²], angular rate [rad/s]."""
        return np.concatenate((self.nav[LAST_F], self.nav[LAST_W]))

    @property
    def next_event_ns(self) -> int:
        """Stamp of the first measurement that waits for its samples; far ahead if none does."""
        return self._pending[0].t_ns if self._pending else NEVER_NS

    def predict(
        self, t_ns: int, fx: float, fy: float, fz: float, wx: float, wy: float, wz: float
    ) -> None:
        """
        Advance to an IMU sample: stamp [ns], specific force [m/s²], angular rate [rad/s], b.

        The stamp must be younger than ``self.t_ns``.
        """
        if t_ns >= self._next_ns or t_ns - self.t_ns > self.long_step_ns:
            sample = np.array([(t_ns, (fx, fy, fz), (wx, wy, wz))], SAMPLE_DTYPE)
            self._advance(sample, NO_ROWS)
            return
        propagation.step(
            self.nav, (t_ns - self.t_ns) * 1e-9, fx, fy, fz, wx, wy, wz, self._interval
        )
        self.t_ns = t_ns

    def predict_block(self, samples: NDArray[np.void], rows: Array = NO_ROWS) -> None:
        """
        Advance over many IMU samples (``SAMPLE_DTYPE``); the result is that of `predict`.

        ``rows``, shape (N, N_NAV), receives the flat state after each sample; empty: none.
        """
        self._advance(samples, rows)

    def submit(self, event: Event) -> None:
        """
        Take a measurement or a change of the noise: now, when the IMU gets there, or by rewinding.

        Its verdict appears in ``verdicts`` once it is decided.
        """
        last = self._done[-1] if self._done else event
        if event.t_ns > self.t_ns:
            bisect.insort(self._pending, event, key=_order)
            self._schedule()
        elif event.t_ns == self.t_ns and _order(event) >= _order(last):
            self._apply(event)
        elif self.t_ns - event.t_ns <= self._horizon_ns and self._rewind(event):
            pass
        elif isinstance(event, Change):
            self._apply(replace(event, t_ns=self.t_ns))
        else:
            self.verdicts.append(Verdict.rejected(event, "too old", self.age(event)))

    def withdraw(self) -> list[Measurement]:
        """Take back and return the measurements that wait for their samples."""
        waiting = [event for event in self._pending if not isinstance(event, Change)]
        self._pending = [event for event in self._pending if isinstance(event, Change)]
        self._schedule()
        return waiting

    def age(self, event: Event) -> float:
        """Return how far ``event`` lies behind the last IMU sample [s]."""
        return (self.t_ns - event.t_ns) * 1e-9

    def _advance(self, samples: NDArray[np.void], rows: Array) -> None:
        """Run samples and whatever is pending between them, in the order of their stamps."""
        stamps = samples["t_ns"]
        start, end = 0, int(stamps[-1])
        while self._pending and self._pending[0].t_ns <= end:
            event = self._pending.pop(0)
            stop = int(np.searchsorted(stamps, event.t_ns, side="right"))
            self._run(samples[start:stop], rows[start:stop])
            if event.t_ns > self.t_ns:
                self._run(self._between(event.t_ns, samples[stop]), NO_ROWS)
            self._apply(event)
            if len(rows) and stop and stamps[stop - 1] == event.t_ns:
                rows[stop - 1] = self.nav[:N_NAV]
            start = stop
        self._run(samples[start:], rows[start:])
        if self.t_ns - self._points[-1].t_ns >= self._spacing_ns:
            self._remember()
        self._schedule()

    def _schedule(self) -> None:
        """Set when `predict` has to do more than a step."""
        self._next_ns = self._points[-1].t_ns + self._spacing_ns
        if self._pending:
            self._next_ns = min(self._next_ns, self._pending[0].t_ns)

    def _run(self, samples: NDArray[np.void], rows: Array) -> None:
        """Run samples with nothing between them."""
        if len(samples) == 0:
            return
        stamps = samples["t_ns"]
        steps = steps_since(self.t_ns, stamps)
        dt = steps * 1e-9
        readings = readings_of(samples)
        start = 0
        for k in np.flatnonzero(steps > self.long_step_ns).tolist():
            propagation.run(self.nav, dt[start:k], readings[start:k], self._interval, rows[start:k])
            self._bridge(dt[k], readings[k])
            if len(rows):
                rows[k] = self.nav[:N_NAV]
            start = k + 1
        propagation.run(self.nav, dt[start:], readings[start:], self._interval, rows[start:])
        self.t_ns = int(stamps[-1])

    def _bridge(self, dt: float, reading: Array) -> None:
        """Step over missing samples; what may have happened there widens the covariance."""
        nav = self.nav
        last = self.sample
        jump = np.abs(reading - last)
        rate = float(np.linalg.norm(reading[3:]))
        parts = 1 + int(dt * max(rate, float(np.linalg.norm(last[3:]))) / LARGEST_TURN)
        line = last + np.linspace(0.0, 1.0, parts + 1)[1:, None] * (reading - last)
        propagation.run(nav, np.full(parts, dt / parts), line, self._interval, NO_ROWS)
        propagation.flush(nav)
        unseen_f = UNSEEN_FORCE + 0.5 * jump[:3].max() + rate
        unseen_w = UNSEEN_RATE + 0.5 * jump[3:].max() + 0.2 * rate
        P = covariance(nav)
        for block, std in (
            (DP, 0.25 * unseen_f * dt**2),
            (DV, 0.5 * unseen_f * dt),
            (EPS, 0.5 * unseen_w * dt),
        ):
            P[block, block] += std**2 * np.eye(3)
        pack(P, nav[COVARIANCE])
        self.noise.restart(keep_weights=True)

    def _between(self, t_ns: int, following: NDArray[np.void]) -> NDArray[np.void]:
        """Return the IMU sample at ``t_ns`` on the line from the last sample to the following."""
        fraction = (t_ns - self.t_ns) / (int(following["t_ns"]) - self.t_ns)
        f = self.nav[LAST_F] + fraction * (following["f"] - self.nav[LAST_F])
        w = self.nav[LAST_W] + fraction * (following["w"] - self.nav[LAST_W])
        return np.array([(t_ns, f, w)], SAMPLE_DTYPE)

    def _apply(self, event: Event) -> None:
        """Take an event into the state at its own stamp, which is the present one."""
        self._remember()
        self._done.append(event)
        self._n_done += 1
        propagation.flush(self.nav)
        if isinstance(event, NoiseChange):
            self.noise = copy.copy(event.noise)
        elif isinstance(event, NoiseEstimate):
            self.noise.take_estimate(event)
        elif isinstance(event, ClockShift):
            inject(self.nav, self.clock.shift(event.by))
        elif isinstance(event, CovarianceInflation):
            pack(inflate_covariance(covariance(self.nav), event.std), self.nav[COVARIANCE])
            self.noise.restart(keep_weights=True)
        else:
            self._fuse(event)
        self.nav[PSD] = self.noise.psd()

    def _fuse(self, measurement: Measurement) -> None:
        if not np.isfinite(self.nav).all():
            self.verdicts.append(Verdict.rejected(measurement, "the state is lost"))
            return
        z, H, R = measurement.linearise(self.nav)
        if measurement.aiding:
            R = R * self.noise.fix_factor
        S, nis = innovation(self.nav, z, H, R)
        interval = (measurement.t_ns - self._corrected_ns) * 1e-9
        verdict = self.gate.judge(measurement, z, R, S, nis, self.age(measurement), interval)
        self.verdicts.append(verdict)
        before = self.nav.copy()
        dx, K = np.zeros(N_ERROR), np.zeros((N_ERROR, len(z)))
        if verdict.accepted:
            if verdict.inflated:
                inflate_to_innovation(self.nav, z, H, interval)
            dx, K = correct(self.nav, z, H, R)
        if not measurement.aiding:
            return
        if verdict.accepted:
            self._corrected_ns = measurement.t_ns
        if verdict.inflated:
            self.noise.restart(keep_weights=False)
        if verdict.inflated or verdict.jump:
            return
        C_nb = matrix_from_quat(self.nav[QUAT])
        correction = Correction(
            measurement.t_ns, z, S, H, K, dx, C_nb, interval, before, verdict.accepted
        )
        self.clock.update(correction)
        moved = self.noise.take_correction(correction)
        if moved is not None:
            inject(self.nav, moved.dx)
            pack(moved.P, self.nav[COVARIANCE])
            self.clock.restart(self.nav[VELOCITY])

    def _remember(self) -> None:
        """Keep a rewind point, and drop those that no measurement may reach any more."""
        self._points.append(
            Checkpoint(
                self.t_ns,
                self._n_done,
                self.nav[:N_NAV].copy(),
                copy.copy(self.noise),
                copy.copy(self.gate),
                copy.copy(self.clock),
                self._corrected_ns,
            )
        )
        oldest = self.t_ns - self._horizon_ns
        while len(self._points) > 1 and self._points[1].t_ns < oldest:
            del self._points[0]
        del self._done[: len(self._done) - (self._n_done - self._points[0].n_done)]

    def _rewind(self, late: Event) -> bool:
        """Put a late event where it belongs; False when that is out of reach."""
        at = bisect.bisect_left(self._points, late.t_ns, key=lambda point: point.t_ns) - 1
        if at < 0:
            return False
        point = self._points[at]
        samples = self.ring.after(point.t_ns)
        if len(samples) == self.ring.capacity:
            return False
        samples = samples[: np.searchsorted(samples["t_ns"], self.t_ns, side="right")]
        keep = len(self._done) - (self._n_done - point.n_done)
        waiting, again = self._pending, self._done[keep:]
        del self._points[at:], self._done[keep:]
        self.nav[:N_NAV] = point.nav
        self.t_ns, self._n_done, self._corrected_ns = point.t_ns, point.n_done, point.corrected_ns
        self.noise, self.gate, self.clock = point.noise, point.gate, point.clock
        self._remember()
        decided = len(self.verdicts)
        self._pending = sorted([*again, late], key=_order)
        self._advance(samples, NO_ROWS)
        self._pending = waiting
        self._schedule()
        while len(self.verdicts) > decided:
            verdict = self.verdicts.pop()
            if verdict.measurement is late:
                own = verdict
        if not isinstance(late, Change):
            self.verdicts.append(replace(own, age=self.age(late)))
        return True


def inflate_to_innovation(nav: Array, z: Array, H: Array, interval: float) -> None:
    """
    Widen the covariance so that an innovation ``z`` far outside it is believed.

    Position takes all of it; velocity what would have led there since the last correction.

    Parameters
    ----------
    nav : ndarray, shape (N_FLAT,)
        Flat state with nothing pending; its covariance is changed in place.
    z, H : ndarray, shape (m,), (m, 15)
        Innovation and measurement matrix.
    interval : float
        Time since the last correction [s].
    """
    P = covariance(nav)
    spread = np.abs(H[:, :6]).T @ np.abs(z)
    P[DP, DP] += np.diag(spread[:3] ** 2)
    P[DV, DV] += np.diag((spread[:3] / max(interval, 1.0)) ** 2 + spread[3:] ** 2)
    pack(P, nav[COVARIANCE])


def _order(event: Event) -> tuple[int, str]:
    """Events are taken by stamp, those of one stamp by kind."""
    return event.t_ns, event.kind
