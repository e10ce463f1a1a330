"""
The error-state filter in time: IMU samples forward, measurements at their own stamps.

An event that is ahead of the IMU waits; one that is behind is applied by going back to a
checkpoint before it and repeating what came since (`rewind`).
"""

from __future__ import annotations

import bisect
import copy
from collections import deque
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.filter import gap
from hybrid_ins.core.filter.events import Change, Event, order
from hybrid_ins.core.filter.filter_noise import FilterNoise
from hybrid_ins.core.filter.filter_record import FilterRecord, FilterStart
from hybrid_ins.core.filter.filter_settings import FilterSettings
from hybrid_ins.core.filter.rewind import Checkpoint, History
from hybrid_ins.core.imu.samples import (
    SAMPLE_DTYPE,
    ImuRing,
    interpolate,
    readings_of,
    steps_since,
    usual_pause,
)
from hybrid_ins.core.inertial import propagation
from hybrid_ins.core.inertial.propagation import NO_ROWS
from hybrid_ins.core.inertial.state import (
    CLOCK_VARIANCE,
    HEADING_DOUBT,
    LAST_SAMPLE,
    N_NAV,
    PSD,
    SENSITIVITY,
    NavState,
)
from hybrid_ins.core.sensor_errors.clock_offset import ClockOffsetObserver
from hybrid_ins.core.sensor_errors.clock_sensitivity import initial_sensitivity
from hybrid_ins.core.sensor_errors.lever_arm import LeverArmError
from hybrid_ins.core.sensor_errors.scale_errors import ScaleErrors
from hybrid_ins.core.update.gate import Gate, Verdict
from hybrid_ins.core.update.measurements import GNSS, Measurement

Array = NDArray[np.float64]
NEVER_NS = 2**63 - 1
LONG_STEP = 4.0  # sample periods: in a longer step samples are missing
MIN_GAP = 0.025  # s
PAUSES = 2.0  # between bursts: likewise, of samples that arrive together
LONGEST_PAUSE = 0.25  # s: longer, and it is a gap
RECENT = 256  # samples that show it
TOO_OLD = "too old"  # the reason of a measurement that comes too late
NOT_MEASURED = "no IMU samples at its time"  # of one that lies in a long gap of them
LONG_GAP_NS = int(gap.LONG_GAP * 1e9)
OWN = slice(0, HEADING_DOUBT)  # what goes back in a rewind: others know how doubtful the heading is


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
        Settings besides the noise.

    Attributes
    ----------
    nav : ndarray, shape (N_FLAT,)
        The flat state after the last sample.
    t_ns : int
        Its stamp [ns].
    long_step_ns : int
        A longer step [ns] is a gap in the samples.
    verdicts : deque of Verdict
        One per measurement submitted, in order of decision; the owner empties it.
    update : MeasurementUpdate
        What decides on measurements and fuses them.
    record : FilterRecord or None
        What became of every event; None unless the settings ask for it.
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
        self.nav[LAST_SAMPLE], self.nav[PSD] = sample, noise.psd()
        self.nav[SENSITIVITY] = initial_sensitivity(initial.velocity_n, np.zeros(3))
        self.t_ns = t_ns
        self.update = settings.update(noise, gate, t_ns)
        self.considers_clock = settings.consider_clock
        self.nav[CLOCK_VARIANCE] = self.clock.missing_variance if self.considers_clock else 0.0
        self.ring = ring
        self.verdicts: deque[Verdict] = deque()
        self.long_step_ns = _long_step_ns(noise.process.period, ring)
        self.covariance_interval = settings.covariance_interval - 1e-6
        self._pending: list[Event] = []  # ahead of the IMU
        self._history = History(settings.max_delay)
        start = FilterStart(t_ns, sample, initial, noise.levels(), settings.lever_std)
        self.record = FilterRecord(start) if settings.keep_record else None
        self._checkpoint()
        self._schedule()

    def __copy__(self) -> InsFilter:
        twin = object.__new__(InsFilter)
        twin.__dict__.update(self.__dict__)
        twin.nav, twin.verdicts, twin._pending = self.nav.copy(), deque(), [*self._pending]
        twin.update, twin._history = copy.copy(self.update), copy.copy(self._history)
        twin.record = copy.copy(self.record)
        return twin

    def flat_state(self) -> Array:
        """Return a copy of the flat state after the last sample, its covariance up to date."""
        nav = self.nav.copy()
        propagation.propagate_covariance(nav)
        return nav

    @property
    def state(self) -> NavState:
        """The same, unpacked."""
        return NavState.from_flat(self.flat_state())

    @property
    def noise(self) -> FilterNoise:
        """The noise in force."""
        return self.update.noise

    @property
    def clock(self) -> ClockOffsetObserver:
        """Clock offset of fixes, estimated beside the state; does not change it by itself."""
        return self.update.clock

    @property
    def lever_arm(self) -> LeverArmError:
        """What the innovations show of the antenna's place; nothing is corrected by it."""
        return self.update.lever_arm.estimate

    @property
    def scale_errors(self) -> ScaleErrors:
        """What the innovations show of the IMU's scale factors and axes; used in outages."""
        return self.update.scale_errors.estimate

    @property
    def sample(self) -> Array:
        """The IMU sample at ``t_ns``, shape (6,): specific force [m/s²], angular rate [rad/s]."""
        return self.nav[LAST_SAMPLE].copy()

    @property
    def next_event_ns(self) -> int:
        """Stamp of the first event that is ahead of the IMU; far ahead if there is none."""
        return self._pending[0].t_ns if self._pending else NEVER_NS

    def predict(
        self, t_ns: int, fx: float, fy: float, fz: float, wx: float, wy: float, wz: float
    ) -> None:
        """
        Advance to an IMU sample: stamp [ns], specific force [m/s²], angular rate [rad/s], b.

        The stamp must be younger than ``self.t_ns``. The equations are those of
        `propagation.step`.
        """
        if t_ns >= self._next_ns or t_ns - self.t_ns > self.long_step_ns:
            self.predict_block(np.array([(t_ns, (fx, fy, fz), (wx, wy, wz))], SAMPLE_DTYPE))
            return
        propagation.step(
            self.nav, (t_ns - self.t_ns) * 1e-9, fx, fy, fz, wx, wy, wz, self.covariance_interval
        )
        self.t_ns = t_ns

    def predict_block(self, samples: NDArray[np.void], rows: Array = NO_ROWS) -> None:
        """
        Advance over many IMU samples (``SAMPLE_DTYPE``); the result is that of `predict`.

        Pending events are applied between them, in the order of their stamps. ``rows``, shape
        (N, N_NAV), receives the flat state after each sample; empty: none.
        """
        stamps = samples["t_ns"]
        start, end = 0, int(stamps[-1])
        while self._pending and self._pending[0].t_ns <= end:
            event = self._pending.pop(0)
            stop = int(stamps.searchsorted(event.t_ns, side="right"))
            self._run(samples[start:stop], rows[start:stop])
            start = stop
            if event.t_ns > self.t_ns:
                if int(stamps[stop]) - self.t_ns > LONG_GAP_NS:
                    self._refuse(event, NOT_MEASURED)
                    continue
                self._run(interpolate(self.t_ns, self.sample, samples[stop], event.t_ns), NO_ROWS)
            self._apply(event)
            if len(rows) and stop and stamps[stop - 1] == event.t_ns:
                rows[stop - 1] = self.nav[:N_NAV]
        self._run(samples[start:], rows[start:])
        if self.t_ns >= self._history.due_ns:
            self._checkpoint()
        self._schedule()

    def submit(self, event: Event) -> None:
        """
        Apply a measurement or a change: now, when the IMU gets there, or by rewinding.

        The verdict on a measurement appears in ``verdicts`` once it is decided.
        """
        last = self._history.last_event or event
        if event.t_ns > self.t_ns:
            bisect.insort(self._pending, event, key=order)
            self._schedule()
        elif event.t_ns == self.t_ns and order(event) >= order(last):
            self._apply(event)
        elif self.t_ns - event.t_ns <= self._history.horizon_ns and self._rewind(event):
            pass
        else:
            self._refuse(event, TOO_OLD)

    def withdraw(self) -> list[Measurement]:
        """Remove and return the measurements that are ahead of the IMU."""
        waiting = [event for event in self._pending if not isinstance(event, Change)]
        self._pending = [event for event in self._pending if isinstance(event, Change)]
        self._schedule()
        return waiting

    def change_settings(self, settings: FilterSettings) -> None:
        """Change ``max_delay``, ``consider_clock``, and what is in `SettingsChange` from now on."""
        self._history.horizon_ns = int(settings.max_delay * 1e9)
        self.considers_clock = settings.consider_clock
        change = settings.change_of(self.update, self.t_ns)
        if change is not None:
            self.submit(change)

    def _schedule(self) -> None:
        """Set the stamp from which on `predict` has to do more than a step."""
        self._next_ns = min(self._history.due_ns, self.next_event_ns)

    def _run(self, samples: NDArray[np.void], rows: Array) -> None:
        """Run samples with no event between them."""
        if len(samples):
            long_step_ns, interval = self.long_step_ns, self.covariance_interval
            if gap.run(self.nav, self.t_ns, samples, long_step_ns, interval, rows):
                self.noise.restart(keep_weights=True)
            self.t_ns = int(samples["t_ns"][-1])

    def _apply(self, event: Event) -> None:
        """Apply an event to the state at its own stamp, which is the present one."""
        self._history.add_event(event)
        propagation.propagate_covariance(self.nav)
        age = _age(event, self.t_ns)
        outcome = self.update.apply(self.nav, event, age, self.considers_clock, self.ring)
        if outcome.verdict is not None:
            self.verdicts.append(outcome.verdict)
        if self.record is not None:
            self.record.add(event, outcome, self.update, self.nav)
        self._checkpoint()

    def _refuse(self, event: Event, reason: str) -> None:
        """Reject a measurement; apply a change to the present state."""
        if isinstance(event, Change):
            self._apply(replace(event, t_ns=self.t_ns))
            return
        verdict = Verdict.rejected(event, reason, max(0.0, _age(event, self.t_ns)))
        self.verdicts.append(verdict)
        if self.record is not None and reason == TOO_OLD:  # with hindsight it can be used
            threshold = self.update.gate.threshold(len(event.linearise(self.nav)[0]))
            self.record.add_too_old(replace(verdict, threshold=threshold), self.update, self.nav)

    def _checkpoint(self) -> None:
        """Keep a checkpoint of the present state."""
        point = Checkpoint(self.t_ns, self.nav[:N_NAV].copy(), copy.copy(self.update))
        self._history.add_checkpoint(point)

    def _rewind(self, late: Event) -> bool:
        """Apply a late event at its own stamp; False when that is out of reach."""
        point = self._history.before(late.t_ns)
        if point is None or self.ring.has_lost(point.t_ns):
            return False
        samples, waiting = self.ring.between(point.t_ns, self.t_ns), self._pending
        again = self._history.rewind(late.t_ns)
        if self.record is not None:
            self.record.rewind(self._history.count)
        self.nav[OWN], self.t_ns, self.update = point.nav[OWN], point.t_ns, point.update
        self._checkpoint()
        decided, self.verdicts = self.verdicts, deque()
        self._pending = sorted([*again, late], key=order)
        self.predict_block(samples)
        self._pending = waiting
        self._schedule()
        age = _age(late, self.t_ns)
        own = [replace(v, age=age) for v in self.verdicts if order(v.measurement) == order(late)]
        self.verdicts = deque((*decided, *own))
        return True


def _age(event: Event, t_ns: int) -> float:
    """Return how far an event lies behind a stamp [s]."""
    return (t_ns - event.t_ns) * 1e-9


def sensitivity_to_scale(running: InsFilter) -> Array:
    """Return d(error)/dm, (15, N_SCALE), after the last sample, see `ScaleErrorObserver`."""
    observer = running.update.scale_errors
    return observer.sensitivity_at(running.flat_state(), running.ring, running.t_ns)


def hand_over(running: InsFilter, winner: InsFilter, by_ns: int) -> list[Measurement]:
    """
    Leave what waits for the IMU to a filter that was given the same, with ``by_ns`` on GNSS stamps.

    What ``running`` has judged already is withdrawn from ``winner``. Returns what waits for the
    first alone: the other one has judged it.
    """
    left = {(m.kind, m.t_ns + (by_ns if m.sensor == GNSS else 0)): m for m in running.withdraw()}
    for measurement in winner.withdraw():
        if left.pop((measurement.kind, measurement.t_ns), None) is not None:
            winner.submit(measurement)
    return list(left.values())


def catch_up(behind: InsFilter) -> None:
    """Let a filter that may be behind the IMU process the samples that it has missed."""
    missed = behind.ring.after(behind.t_ns)
    if len(missed):
        behind.predict_block(missed)


def state_at_imu(behind: InsFilter, nav: Array) -> Array:
    """Return a flat state of a filter that may be behind the IMU at the ring's last sample."""
    samples = behind.ring.after(behind.t_ns)
    if not len(samples):
        return nav
    nav = nav.copy()
    dt = steps_since(behind.t_ns, samples["t_ns"]) * 1e-9
    propagation.run(nav, dt, readings_of(samples), behind.covariance_interval, NO_ROWS)
    return nav


def _long_step_ns(period: float, ring: ImuRing) -> int:
    """Return the step [ns] from which samples are missing, by their period [s] and the last."""
    pause = min(PAUSES * usual_pause(ring.latest(RECENT)["t_ns"]), LONGEST_PAUSE)
    return int(max(LONG_STEP * period, MIN_GAP, pause) * 1e9)
