"""
Health of the IMU and standing of the vehicle, checked twice a second while filters run.

What a check finds is applied to the filters: inflated covariances, zero-velocity updates.
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.alignment.alignment import Biases
from hybrid_ins.core.alignment.clock_search import ClockSearch
from hybrid_ins.core.alignment.given_heading import HEADING_KEPT_STD
from hybrid_ins.core.filter.events import CovarianceInflation
from hybrid_ins.core.filter.ins_filter import InsFilter
from hybrid_ins.core.imu.fix_motion import FixMotion
from hybrid_ins.core.imu.health import FaultKind, ImuFault, find_fault
from hybrid_ins.core.imu.lift_watch import LiftWatch
from hybrid_ins.core.imu.samples import ImuRing
from hybrid_ins.core.imu.standstill import (
    LONGEST_BRAKING_NS,
    Glides,
    StandingForce,
    is_standing,
    may_be_zero,
)
from hybrid_ins.core.inertial.rotations import matrix_from_quat
from hybrid_ins.core.inertial.state import (
    B_A,
    B_G,
    BIAS_G,
    DV,
    EPS,
    N_ERROR,
    QUAT,
    VELOCITY,
    covariance,
)
from hybrid_ins.core.navigator.notices import RestartCause
from hybrid_ins.core.navigator.phase_machine import PhaseMachine
from hybrid_ins.core.navigator.phases import FilterParts
from hybrid_ins.core.navigator.slow_turn import SlowTurn
from hybrid_ins.core.navigator.stand_turn import StandTurn
from hybrid_ins.core.update.gate import Verdict
from hybrid_ins.core.update.measurements import Standstill

Array = NDArray[np.float64]

PERIOD_NS = 500_000_000  # between two checks
WINDOW_NS = 1_000_000_000  # of samples that are checked
SHORTEST_STAND = 0.8e9  # ns, of samples that may show standing
BIASES_KEPT = 6  # checks: the estimate that is kept is older than a fault's discovery
SPEED_STD_FLOOR = 0.05  # m/s, of the filter's speed: a standing vehicle rocks
LARGEST_SPEED = 4.0  # standard deviations, of a vehicle whose speed may be zero
STILL_KNOWN = 2.0  # factor on the σ of a speed that was not zero: beyond it, zero is no news
SOFTEST_BRAKING = 0.2  # m/s²: steady braking resembles standing until it ends
STEADY_NS = 5_000_000_000  # after a change of the specific force that ended a stand
LONGEST_MANOEUVRE_NS = 5_000_000_000  # of a fall, or of a turn at several times gravity
LARGEST_RATE = 35.0  # rad/s, of a vehicle that rolls: gyroscopes measure no more
CONVINCING = 4  # fixes since its begin that agree: it may be longer
GRAVITY_FAULTS = (FaultKind.NO_GRAVITY, FaultKind.TOO_MUCH_GRAVITY)
UNKNOWN_BIAS_STD_A, UNKNOWN_BIAS_STD_G = 0.3, 0.01  # m/s², rad/s: after misleading readings
MISLED_SPEED, MISLED_TURN = 1.5, 0.1  # m/s, rad: between two checks of such readings
MISLEADING_FORCE = (FaultKind.SATURATED_FORCE, FaultKind.SPIKES_FORCE)
MISLEADING_RATE = (FaultKind.SATURATED_RATE, FaultKind.SPIKES_RATE)


class ImuMonitor:
    """
    Checks the last second of samples for faults and for standing.

    Parameters
    ----------
    parts : FilterParts
        What the filters are made of: it knows how the IMU lies, and where the antenna is.
    zero_updates : bool
        Use standing as a measurement.
    bias_g : ndarray, shape (3,)
        The gyroscopes' bias that was given [rad/s], b.

    Attributes
    ----------
    fault : ImuFault or None
        What the last check found.
    standing : bool
        The vehicle stood at the last check.
    calm : tuple of int
        Stamps [ns] between which it may have stood, the last time that it did.
    """

    def __init__(self, parts: FilterParts, zero_updates: bool, bias_g: Array) -> None:
        self._parts = parts
        self._turn = StandTurn(bias_g)
        self._slow_turn = SlowTurn()
        self._glides = Glides()
        self._zero_updates = zero_updates
        self._biases: deque[Biases] = deque(maxlen=BIASES_KEPT)
        self._still_ns: int | None = None  # since when the IMU shows no change of the velocity
        self.reset()

    @property
    def may_stand(self) -> bool:
        """The vehicle stands, or brakes so steadily that the IMU shows no difference."""
        return self._calm_ns is not None

    @property
    def restart_cause(self) -> RestartCause | None:
        """Why the state has to be given up, by the last check; None: it goes on."""
        if self.fault is not None and self.fault.unusable:
            return RestartCause.IMU_UNUSABLE
        if self._was_misled:
            return RestartCause.FIXES_WANDERED
        if self.fault is not None and self.fault.lost_turn > HEADING_KEPT_STD:
            return RestartCause.TURN_UNMEASURED
        return None

    def reset(self) -> None:
        """Restart, as the filter did; the biases stay."""
        self.fault: ImuFault | None = None
        self.standing = False
        self.calm = 0, 0
        self._force_changed = False  # since the stand began
        self._was_misled = False  # a search took the wander of fixes at a stand for motion
        self._calm_ns: int | None = None  # since when the vehicle may stand
        self._calm_std = math.inf  # m/s, of its speed when that began, or later if it was less
        self._standing_force = StandingForce()
        self._slow_turn.reset()
        self._glides.reset()
        self._gliding_std = math.inf  # m/s, of a speed that was not zero while all was calm
        self._lift = LiftWatch()
        self._next_ns = 0
        self._fix_agreed_ns = 0  # stamp of the last fix, if it was fused without a reset
        self._weighed_ns = 0  # last check that found gravity, and not several times as much
        self._agreed: int | None = 0  # fixes since; None: one did not agree

    @property
    def biases(self) -> Biases | None:
        """What a filter estimated before any fault of the last checks can have misled it."""
        return self._biases[0] if self._biases else None

    def remember(self, biases: Biases) -> None:
        """Note what an earlier run has found: while the vehicle stands, other rates are turns."""
        self._turn.bias_g = biases.gyroscope

    def discard_biases(self) -> None:
        """Discard them: the filter that estimated them was wrong, or is of another time."""
        self._biases.clear()
        self._turn.forget()

    def on_verdict(self, verdict: Verdict) -> None:
        """Note whether the last fix agreed with the filter."""
        if verdict.measurement.kind == "position":
            agreed = verdict.accepted and not verdict.inflated
            self._fix_agreed_ns = verdict.measurement.t_ns if agreed else 0
            if self._agreed is not None:
                plainly = agreed and verdict.nis <= verdict.threshold
                self._agreed = self._agreed + 1 if plainly else None
            self._lift.reset()

    def check(self, phases: PhaseMachine, ring: ImuRing, t_ns: int, motion: FixMotion) -> bool:
        """
        Check where that is due, and apply the result to the filters.

        Parameters
        ----------
        phases : PhaseMachine
            The filters; without any there is no check.
        ring : ImuRing
            Recent IMU samples.
        t_ns : int
            Stamp of the last of them [ns].
        motion : FixMotion
            By the position fixes: what moves does not stand.

        Returns
        -------
        bool
            A check was due.
        """
        best = phases.phase.best
        if best is None or t_ns < self._next_ns:
            return False
        self._next_ns = t_ns + PERIOD_NS
        samples = ring.after(t_ns - WINDOW_NS)
        before, self.fault = self.fault, find_fault(samples, self._parts.mount)
        manoeuvres = self._is_manoeuvre(t_ns, phases.filter is not None)
        if manoeuvres:
            self.fault = None
        for fault in (before, self.fault):  # what happened between the checks misled the filters
            std = (
                None if fault is None else _error_std_after(fault, matrix_from_quat(best.nav[QUAT]))
            )
            if std is not None:
                phases.submit(CovarianceInflation(t_ns, std, self._parts.settings.lever_b))
        if self.fault is not None and self.fault.unusable:
            return True
        if phases.filter is not None and self.fault is None and not manoeuvres:
            self._biases.append(Biases.of(phases.filter.state, t_ns))
        calm = t_ns - samples["t_ns"][0] > SHORTEST_STAND and is_standing(samples)
        self._lift.observe(samples[samples["t_ns"] > t_ns - PERIOD_NS], PERIOD_NS * 1e-9, calm)
        calm = calm and not self._lift.moves
        self._follow_still(samples, calm)
        wander = self._still_ns is not None and motion.wanders(self._still_ns, t_ns)
        fixes_move = motion.moves(t_ns) and not wander
        self._follow_calm(best, samples, fixes_move, calm, wander)
        self._follow_turns(phases, best, samples, fixes_move)
        if self._calm_ns is not None:
            self.calm = self._calm_ns, t_ns
        self.standing = (
            self._calm_ns is not None
            and t_ns - self._calm_ns >= _longest_braking_ns(best)
            and not self._glides.explain(self._calm_std)
        )
        if self.standing:
            self._lift.note_stand(samples)
            bank = phases.phase.bank
            if phases.filter is None and isinstance(bank, ClockSearch):
                self._was_misled = self._still_ns is not None and self._still_ns < bank.begun_ns
        if self.standing and self._zero_updates:
            if wander and not _zero_speed_is_plausible(best):
                std = _error_std_after_wander(best)
                phases.submit(CovarianceInflation(t_ns, std, self._parts.settings.lever_b))
            phases.measure(Standstill.of(samples, self._slow_turn.turns))
        return True

    def _follow_turns(
        self,
        phases: PhaseMachine,
        best: InsFilter,
        samples: NDArray[np.void],
        fixes_move: bool,
    ) -> None:
        """Correct what stands have taught of the gyroscopes' bias while the vehicle turned."""
        t_ns, lever_b = int(samples["t_ns"][-1]), self._parts.settings.lever_b
        bias_std = np.sqrt(np.diag(covariance(best.nav))[B_G])
        noticed = self._slow_turn.follow(samples, self.may_stand, best.nav[BIAS_G], bias_std)
        if noticed is not None and self._zero_updates:
            phases.submit(CovarianceInflation(t_ns, noticed.std, lever_b))
            if noticed.stand is not None:
                phases.measure(noticed.stand)
        if not (self.may_stand and self._slow_turn.turns):
            taught = self._turn.follow(samples, self.may_stand, fixes_move, PERIOD_NS)
            if taught is not None:
                phases.submit(CovarianceInflation(t_ns, taught, lever_b))

    def _follow_still(self, samples: NDArray[np.void], calm: bool) -> None:
        """Note since when the IMU shows no change of the velocity, by ``samples`` until now."""
        begin_ns = int(samples["t_ns"][0])
        self._force_changed = calm and self._standing_force.changes(samples)
        if not calm or self._force_changed:
            self._still_ns = None
        elif self._still_ns is None or self._still_ns > begin_ns:
            self._still_ns = begin_ns

    def _follow_calm(
        self,
        best: InsFilter,
        samples: NDArray[np.void],
        fixes_move: bool,
        calm: bool,
        fixes_wander: bool,
    ) -> None:
        """
        Note since when the vehicle may stand, by ``samples`` until now.

        The speed of a filter that follows fixes which wander is no evidence, and braking is steady.
        """
        if not calm:
            self._calm_ns, self._gliding_std = None, math.inf
            self._standing_force.reset()
            self._glides.reset()
            return
        begin_ns, t_ns = int(samples["t_ns"][0]), int(samples["t_ns"][-1])
        speed_std, changed = _speed_std(best), self._force_changed
        if fixes_move:
            speed = float(np.linalg.norm(best.nav[VELOCITY]))
            self._glides.observe(begin_ns, t_ns, speed, speed_std)
        else:
            self._glides.reset()
        if changed:
            self._gliding_std = math.inf
        if fixes_move or not (fixes_wander or _zero_speed_is_plausible(best)):
            self._calm_ns, self._gliding_std = None, min(speed_std, self._gliding_std)
        elif speed_std > STILL_KNOWN * self._gliding_std:
            self._calm_ns = None
        elif changed:
            self._calm_ns, self._calm_std = t_ns + STEADY_NS, speed_std
        elif self._calm_ns is None:
            self._calm_std = speed_std
            self._calm_ns = self._still_ns if fixes_wander else begin_ns
        self._calm_std = min(self._calm_std, speed_std)

    def _is_manoeuvre(self, t_ns: int, running: bool) -> bool:
        """
        Distinguish a fall, a hard turn or a roll from an IMU without gravity or with a wrong unit.

        To the filter both are a motion. Where the vehicle does not move so, the next fix is beyond
        the gate, once one filter runs (``running``); before, a short motion is believed. A rolling
        aircraft feels gravity where it always does, as if it hardly turned.

        A longer one is believed as long as every fix since its begin agrees: without gravity an IMU
        is metres off after a second.
        """
        if self.fault is not None and self.fault.kind is FaultKind.DEGREES:
            possible = self.fault.value < LARGEST_RATE
            return possible and running and self._fix_agreed_ns > 0
        if self.fault is None or self.fault.kind not in GRAVITY_FAULTS:
            self._weighed_ns, self._agreed = t_ns, 0
            return False
        if running and (self._agreed or 0) >= CONVINCING:
            return True
        is_short = t_ns - self._weighed_ns < LONGEST_MANOEUVRE_NS
        return is_short and (self._fix_agreed_ns > 0 or not running)


def _error_std_after(fault: ImuFault, C_nb: Array) -> Array | None:
    """
    Return what readings with a fault may have done to the state between two checks.

    Standard deviations, shape (15,), in the order of the error state; None where the fault does
    not mislead.
    """
    std = np.zeros(N_ERROR)
    if fault.kind is FaultKind.SATURATED_FORCE:  # of a second: the mean force lacks as much
        std[B_A] = fault.lost_speed
        north, east, down = np.sqrt(C_nb**2 @ np.square(fault.lost_speed))
        std[DV] = math.hypot(north, east), math.hypot(north, east), down  # whatever the heading
    elif fault.kind in MISLEADING_FORCE:
        std[B_A], std[DV] = UNKNOWN_BIAS_STD_A, MISLED_SPEED
    elif fault.kind in MISLEADING_RATE:
        std[B_G], std[EPS] = UNKNOWN_BIAS_STD_G, max(MISLED_TURN, fault.lost_turn)
    else:
        return None
    return std


def _error_std_after_wander(best: InsFilter) -> Array:
    """Return what fixes that wandered at a stand have done to the state, as `_error_std_after`."""
    std = np.zeros(N_ERROR)
    std[DV] = np.linalg.norm(best.nav[VELOCITY])
    std[EPS.start : EPS.stop - 1] = MISLED_TURN
    return std


def _zero_speed_is_plausible(running: InsFilter) -> bool:
    """Return whether the filter's speed may be zero: a smooth cruise resembles standing."""
    return may_be_zero(running.nav[VELOCITY], _speed_covariance(running))


def _longest_braking_ns(running: InsFilter) -> int:
    """
    Return how long [ns] a vehicle may go on braking since its speed may be zero.

    A filter that knows its speed poorly finds zero plausible long before the vehicle stands.
    """
    speed = LARGEST_SPEED * _speed_std(running)
    return min(int(speed / SOFTEST_BRAKING * 1e9), LONGEST_BRAKING_NS)


def _speed_std(running: InsFilter) -> float:
    return float(np.sqrt(_speed_covariance(running).diagonal().max()))


def _speed_covariance(running: InsFilter) -> Array:
    return covariance(running.nav)[DV, DV] + SPEED_STD_FLOOR**2 * np.eye(3)
