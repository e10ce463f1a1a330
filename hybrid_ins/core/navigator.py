"""
From the first IMU sample to a running filter, and back when the IMU goes away.

Owns the ring of samples, the alignment, the hypotheses it ends in, and the filter once there is
one; owns no topic and no message. Bad stamps are named results, not exceptions.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.alignment import Alignment, AlignmentSettings, Biases, yaw_of
from hybrid_ins.core.clock_search import ClockSearch
from hybrid_ins.core.events import Change, CovarianceInflation, NoiseChange
from hybrid_ins.core.filter_noise import FilterNoise
from hybrid_ins.core.gate import Gate, Verdict
from hybrid_ins.core.imu_health import NO_GRAVITY, UNUSABLE, Fault, find_fault
from hybrid_ins.core.ins_filter import FilterSettings, InsFilter
from hybrid_ins.core.measurements import Measurement, PositionFix, Standstill
from hybrid_ins.core.multiple_model import Decision, FilterFactory, MultipleModelBank
from hybrid_ins.core.noise import NoiseEstimate
from hybrid_ins.core.samples import ImuRing
from hybrid_ins.core.standstill import is_standing
from hybrid_ins.core.state import (
    B_A,
    B_G,
    DV,
    EPS,
    N_ERROR,
    VELOCITY,
    NavState,
    covariance,
)

Array = NDArray[np.float64]

ATTEMPT_NS = 100_000_000  # between two attempts to align
STANDSTILL_NS = 500_000_000  # between two looks whether the vehicle stands
AHEAD_NS = 1_000_000_000  # a measurement may be that far ahead of the IMU
JUMP_CONFIRMED = 5  # samples in a row that make a jump of the stamps a new time
SPEED_NIS_STANDING = 7.8  # chi-square, 3 degrees of freedom, 95 %
TURN_IN_GAP = 0.5  # rad/s, that a vehicle may have turned by in a gap, unseen
HEADING_KEPT_STD = 0.35  # rad; a heading less certain than that is not carried over a gap
BIASES_KEPT = 6  # looks: what is remembered is older than a fault's discovery
UNKNOWN_BIAS_STD_A, UNKNOWN_BIAS_STD_G = 0.3, 0.01  # m/s², rad/s: after misleading readings
MISLED_SPEED, MISLED_TURN = 1.5, 0.1  # m/s, rad: between two looks at such readings
MOVING = 1.0  # m/s, at which a receiver cannot report the same position twice
LONGEST_FALL_NS = 5_000_000_000  # without weight
LAST_FIX_NS = 1_100_000_000  # age of the last fix that tells of a fall
REOPENINGS, REOPENING_NS = 3, 30_000_000_000  # states opened that often are wrong in heading

MISLEADING = {
    "imu: saturated acceleration": B_A,
    "imu: saturated rate": B_G,
    "imu: spikes in acceleration": B_A,
    "imu: spikes in rate": B_G,
}
STAMP_FAULTS = {
    "imu: repeated stamp": "header.stamp repeats: a driver that stamps twice, or two publishers "
    "on one topic",
    "imu: stamp out of order": "header.stamp goes back a little: a driver that stamps on receipt, "
    "or two publishers on one topic",
    "imu: stamp jumps": "header.stamp jumps; the filter starts anew if it stays there",
}


class Navigator:
    """
    Aligns, then filters; starts over after a gap or when told to.

    Parameters
    ----------
    alignment, settings : AlignmentSettings, FilterSettings
        See there.
    make_noise : callable
        Given the IMU's sample period [s], returns fresh noise for a new filter.
    make_gate : callable
        Returns a fresh gate.
    max_gap : float
        Longest pause between IMU samples that dead reckoning bridges [s].
    zero_updates : bool
        Tell the filter when the vehicle stands.
    on_restart : callable
        Called with the reason each time the state was given up.
    on_clock : callable
        Called with the decision on the fixes' clock once there is one, see ``clock_open``: after
        the last verdict by the old clock, before the first by the new one.

    Attributes
    ----------
    filter : InsFilter or None
        None while aligning.
    bank : MultipleModelBank or None
        The hypotheses while the heading is open and there is no filter, or the fixes' clock beside
        one.
    clock_open : bool
        The fixes' clock is to be found: from `open_clock` on until it is.
    counts : Counter
        Remarkable events, by name.
    refusal : str
        Why the last sample was refused, a key of ``STAMP_FAULTS``.
    standing : bool
        The vehicle stood at the last look.
    fault : (str, str) or None
        What the readings showed to be wrong with the IMU at the last look, see `health`.
    verdicts : deque of Verdict
        Decided since the owner last emptied it.
    """

    def __init__(
        self,
        alignment: AlignmentSettings,
        settings: FilterSettings,
        make_noise: Callable[[float], FilterNoise],
        make_gate: Callable[[], Gate],
        max_gap: float,
        zero_updates: bool = True,
        on_restart: Callable[[str], None] = lambda reason: None,
        on_clock: Callable[[Decision], None] = lambda decision: None,
    ) -> None:
        self.ring = ImuRing()
        self.counts: Counter[str] = Counter()
        self.verdicts: deque[Verdict] = deque()
        self.refusal = ""
        self._alignment_settings = alignment
        self._settings = settings
        self._make_noise = make_noise
        self._make_gate = make_gate
        self.max_gap_ns = int(max_gap * 1e9)
        self._zero_updates = zero_updates
        self._on_restart = on_restart
        self._on_clock = on_clock
        self.clock_open = False
        self.reset()

    def reset(self) -> None:
        """Forget everything but the counters, and align anew."""
        self._biases: deque[Biases] = deque(maxlen=BIASES_KEPT)
        self._begin()

    def _begin(self) -> None:
        """Forget the samples and the state."""
        self.ring.clear()
        self.last_ns = 0
        self._jumped_ns = self._jumps = 0
        self._seen: deque[tuple[str, int]] = deque(maxlen=64)
        self._last_lla: Array | None = None
        self.realign()

    def realign(self) -> None:
        """Give up the state, but not the samples, and align anew."""
        self.filter: InsFilter | None = None
        self.bank: MultipleModelBank | None = None
        self.standing = False
        self.fault: Fault | None = None
        self.steady_ns = self.max_gap_ns  # steps up to that are plain
        self._attempt_ns = self._look_ns = 0
        self._agreed_ns = self._weighed_ns = 0  # last fix that fits the state; last look at weight
        self._opened: deque[int] = deque(maxlen=REOPENINGS)
        self.alignment = Alignment(self._alignment_settings, self.ring)
        if self._biases:
            self.alignment.remember(self._biases[0])

    @property
    def state(self) -> str:
        """Where between nothing and a running filter: imu, gnss, levelling, heading, aligned."""
        if self.filter is not None:
            return "aligned"
        return "heading" if self.bank is not None else self.alignment.stage

    @property
    def waiting_for(self) -> str:
        """What alignment lacks; empty once a filter runs."""
        if self.filter is not None:
            return ""
        return self.bank.waiting_for if self.bank is not None else self.alignment.waiting_for

    @property
    def best(self) -> InsFilter | None:
        """The filter, or the likeliest while the heading is open: its position is good already."""
        return self.bank.best if self.filter is None and self.bank is not None else self.filter

    @property
    def filters(self) -> list[InsFilter]:
        """All filters that run: one, or one for each hypothesis, or all of them, or none."""
        running = [] if self.filter is None else [self.filter]
        return running if self.bank is None else [*running, *self.bank.filters]

    def imu(
        self, t_ns: int, fx: float, fy: float, fz: float, wx: float, wy: float, wz: float
    ) -> bool:
        """
        Take a sample: stamp [ns], specific force [m/s²], angular rate [rad/s], b frame.

        Returns False when its stamp makes it useless; ``refusal`` says why.
        """
        if not 0 < t_ns - self.last_ns <= self.steady_ns and not self._admit(t_ns):
            return False
        self.last_ns = t_ns
        self.ring.push(t_ns, fx, fy, fz, wx, wy, wz)
        if self.filter is not None:
            self.filter.predict(t_ns, fx, fy, fz, wx, wy, wz)
        elif t_ns >= self._attempt_ns:
            self._attempt(t_ns)
        return True

    def imu_block(self, samples: NDArray[np.void], rows: Array) -> None:
        """Take samples that follow each other closely while the filter runs, as `imu` would."""
        assert self.filter is not None
        self.ring.extend(samples)
        self.last_ns = int(samples["t_ns"][-1])
        self.filter.predict_block(samples, rows)

    def _admit(self, t_ns: int) -> bool:
        """Deal with a stamp that does not follow the last one closely."""
        step = t_ns - self.last_ns
        if self.ring.count == 0:
            return True
        if 0 < step <= self.max_gap_ns:
            self.counts["imu: gaps bridged"] += 1
            self._jumps = 0
            return True
        if -self.max_gap_ns < step <= 0:
            self.refusal = "imu: repeated stamp" if step == 0 else "imu: stamp out of order"
            return False
        # One stray stamp is the driver's fault; several in a row are a gap, a loop, a new clock.
        follows = self._jumps > 0 and 0 < t_ns - self._jumped_ns <= self.max_gap_ns
        self._jumps = self._jumps + 1 if follows else 1
        self._jumped_ns = t_ns
        if self._jumps < JUMP_CONFIRMED:
            self.refusal = "imu: stamp jumps"
            return False
        if step < 0:
            self._biases.clear()
            self._restart(f"the IMU's stamps went back by {-step * 1e-9:.1f} s")
        else:
            kept = self._heading_after(step * 1e-9)
            self._restart(f"no IMU samples for {step * 1e-9:.1f} s")
            self.alignment.forget_parameter()
            if kept is not None:
                self.alignment.set_yaw(t_ns, *kept)
        return True

    def _heading_after(self, gap: float) -> tuple[float, float] | None:
        """Heading and its uncertainty [rad] after seconds without samples, if still of use."""
        if self.filter is None:
            return None
        state = self.filter.state
        rate = 0.1 * TURN_IN_GAP if self.standing else TURN_IN_GAP
        std = math.hypot(math.sqrt(state.P[8, 8]), rate * gap)
        return (yaw_of(state.quat_xyzw), std) if std < HEADING_KEPT_STD else None

    def _restart(self, reason: str) -> None:
        self.counts[f"restart: {reason.split(' for ')[0].split(' by ')[0]}"] += 1
        self._begin()
        self._on_restart(reason)

    def give_up(self, reason: str) -> None:
        """Give up the state for a reason, and align anew."""
        self.counts[f"restart: {reason.split(':')[0]}"] += 1
        self.realign()
        self.alignment.forget_parameter()
        self._on_restart(reason)

    def _attempt(self, t_ns: int) -> None:
        """Come closer to a filter: a first state, or hypotheses that have learnt since."""
        self._attempt_ns = t_ns + ATTEMPT_NS
        if self.bank is None:
            start = self.alignment.attempt()
            if start is None:
                return
            stamps = self.ring.latest(256)["t_ns"]
            period = float(np.median(np.diff(stamps))) * 1e-9
            begin = self._beginning(start.t_ns, start.sample, period)
            if len(start.states) == 1:
                self._run(begin(start.states[0], self._settings))
            else:
                self.bank = MultipleModelBank(start.states, begin, self._settings)
            return
        self.verdicts.extend(self.bank.advance(self.ring, t_ns))
        self.look()
        if self.bank is None:
            return
        if self.clock_open and not self.bank.clock_open and not self.standing:
            waiting = self.bank.filters[0].withdraw()
            self.bank = self._by_many_clocks(self.bank.filters)
            for measurement in waiting:
                self._take(measurement)
        self._decide(self.bank)

    def _by_many_clocks(self, filters: Sequence[InsFilter]) -> MultipleModelBank:
        """Return what has an open clock around filters of one time and one clock."""
        first = filters[0]
        begin = self._beginning(first.t_ns, first.sample, first.noise.process.period)
        return ClockSearch([known.state for known in filters], begin, self._settings)

    def open_clock(self, unknown: bool) -> None:
        """Take the fixes' clock for unknown, or for known; it may be another than before."""
        self.clock_open = unknown
        if self.filter is not None:
            self.bank = None
        elif self.bank is not None and self.bank.clock_open:
            self.realign()

    def find_clock(self) -> None:
        """Go on with the search for the fixes' clock beside the filter; due some times a second."""
        if self.filter is None:
            return
        if self.bank is None and self.clock_open:
            self.bank = self._by_many_clocks([self.filter])
        elif self.bank is not None:
            self.bank.advance(self.ring, self.last_ns)
            self._decide(self.bank)

    def _beginning(self, t_ns: int, sample: Array, period: float) -> FilterFactory:
        """Return what starts a filter at an IMU sample."""

        def begin(state: NavState, settings: FilterSettings) -> InsFilter:
            return InsFilter(
                state,
                t_ns,
                sample,
                self._make_noise(period),
                self._make_gate(),
                self.ring,
                settings,
            )

        return begin

    def _decide(self, bank: MultipleModelBank) -> None:
        """Let the hypotheses become one filter, if they have."""
        decision = bank.decide()
        if decision is None:
            return
        winner = decision.filter
        missed = self.ring.after(winner.t_ns)
        if len(missed):
            winner.predict_block(missed)
        if self.filter is not None:  # It has told of each fix already, but for those that wait.
            winner.withdraw()
            winner.verdicts.clear()
            self.verdicts.extend(
                Verdict.rejected(measurement, "clock offset found")
                for measurement in self.filter.withdraw()
            )
        if bank.clock_open:
            self.clock_open = decision.at_edge
            self._seen.clear()
            self._on_clock(decision)
        self.verdicts.extend(winner.verdicts)
        self._run(winner)

    def _run(self, winner: InsFilter) -> None:
        self.bank = None
        self.filter = winner
        self.filter.verdicts = self.verdicts
        self.steady_ns = min(winner.long_step_ns, self.max_gap_ns)

    def measure(self, measurement: Measurement) -> None:
        """Take an aiding measurement; its verdict appears in ``verdicts``."""
        key = (measurement.kind, measurement.t_ns)
        if key in self._seen:
            self.verdicts.append(Verdict.rejected(measurement, "repeated stamp"))
            return
        if self.ring.count and measurement.t_ns - self.last_ns > self.max_gap_ns + AHEAD_NS:
            self.verdicts.append(
                Verdict.rejected(
                    measurement,
                    "stamped ahead of the IMU",
                    (self.last_ns - measurement.t_ns) * 1e-9,
                )
            )
            return
        self._seen.append(key)
        if self._stands_still(measurement):
            self.verdicts.append(Verdict.rejected(measurement, "same position while moving"))
            return
        self._take(measurement)

    def _take(self, measurement: Measurement) -> None:
        if not self._give(measurement):
            self.alignment.observe(measurement)
            self.verdicts.append(Verdict.rejected(measurement, "aligning"))

    def _give(self, measurement: Measurement) -> bool:
        """Give a measurement to all that run; False if there is none, or none so old."""
        if self.filter is not None:
            self.filter.submit(measurement)
        taken = self.bank is not None and self.bank.measure(measurement)
        return taken or self.filter is not None

    def _stands_still(self, measurement: Measurement) -> bool:
        """Tell whether a fix is the last one again, to the last digit, while the filter moves."""
        if not isinstance(measurement, PositionFix):
            return False
        last, self._last_lla = self._last_lla, measurement.lla
        return (
            last is not None
            and np.array_equal(last, measurement.lla)
            and self.filter is not None
            and float(np.linalg.norm(self.filter.nav[VELOCITY])) > MOVING
        )

    def look(self) -> None:
        """Look now and then how the IMU does, and whether the vehicle stands."""
        running, t_ns = self.best, self.last_ns
        if t_ns < self._look_ns or running is None:
            return
        self._look_ns = t_ns + STANDSTILL_NS
        samples = self.ring.after(t_ns - 1_000_000_000)
        span = t_ns - samples["t_ns"][0]
        before, self.fault = self.fault, find_fault(samples)
        falling = self._is_falling(t_ns)
        if falling:
            self.fault = None
        for fault in (before, self.fault):
            if fault is not None and fault[0] in MISLEADING:
                self._submit(CovarianceInflation(t_ns, self._doubted(fault[0])))
        if self.fault is not None and self.fault[0] in UNUSABLE:
            fault = self.fault
            self.give_up(f"the IMU is unusable: {fault[1]}")
            self.fault = fault
            return
        if self.filter is not None and self.fault is None and not falling:
            self._biases.append(Biases.of(self.filter.state, t_ns))
        self.standing = span > 0.8e9 and is_standing(samples) and _may_stand(running)
        if self.standing and self._zero_updates:
            self._give(Standstill.of(samples))

    def _is_falling(self, t_ns: int) -> bool:
        """
        Tell a free fall from an IMU without gravity, in the moment that the IMU shows neither.

        To the filter both are a fall. Where the vehicle does not, the next fix is beyond the gate.
        """
        if self.fault is None or self.fault[0] != NO_GRAVITY:
            self._weighed_ns = t_ns
            return False
        return (
            self.filter is not None
            and t_ns - self._weighed_ns < LONGEST_FALL_NS
            and t_ns - self._agreed_ns < LAST_FIX_NS
        )

    def _doubted(self, fault: str) -> Array:
        """Standard deviations, (15,), of the errors that misleading readings leave behind."""
        std, block = np.zeros(N_ERROR), MISLEADING[fault]
        if block == B_A:
            std[B_A], std[DV] = UNKNOWN_BIAS_STD_A, MISLED_SPEED
        else:
            std[B_G], std[EPS] = UNKNOWN_BIAS_STD_G, MISLED_TURN
        return std

    def heed(self, verdict: Verdict) -> None:
        """Start over when the state had to be opened again and again: its heading is wrong."""
        if verdict.measurement.kind == "position":
            plain = verdict.accepted and not verdict.inflated
            self._agreed_ns = verdict.measurement.t_ns if plain else 0
        if not verdict.inflated or self.filter is None:
            return
        t_ns = verdict.measurement.t_ns
        self._opened.append(t_ns)
        speed = float(np.linalg.norm(self.filter.nav[VELOCITY]))
        if (
            len(self._opened) == REOPENINGS
            and t_ns - self._opened[0] < REOPENING_NS
            and speed > 1.0
        ):
            self._biases.clear()
            self.give_up("the state did not fit the fixes: it was opened time and again")

    def change_noise(self, event: NoiseEstimate | NoiseChange) -> None:
        """Take a regressor's estimate or another noise model."""
        self._submit(event)

    def _submit(self, event: Change) -> None:
        for target in (self.bank, self.filter):
            if target is not None:
                target.submit(event)


def _may_stand(running: InsFilter) -> bool:
    """Tell whether the filter's speed may be zero: a smooth cruise looks like standing."""
    velocity = running.nav[VELOCITY]
    P = covariance(running.nav)[DV, DV] + 0.05**2 * np.eye(3)
    return bool(velocity @ np.linalg.solve(P, velocity) < SPEED_NIS_STANDING)
