"""
Admission of IMU samples and of aiding measurements by their stamps.

A stamp that does not follow the last one is refused by name; several in a row that follow each
other are a new time base, such as a bag that is played again or a clock that was set.
"""

from __future__ import annotations

import math
from collections import deque
from enum import Enum

from hybrid_ins.core.filter.gap import LONG_GAP
from hybrid_ins.core.fix_checks.fix_speed import SpeedCheck
from hybrid_ins.core.fix_checks.repeated_fixes import RepetitionCheck, left_behind, with_course
from hybrid_ins.core.fix_checks.velocity_check import Contradiction, VelocityCheck
from hybrid_ins.core.imu.fix_motion import FixMotion
from hybrid_ins.core.noise.position_scatter import horizontal_variance
from hybrid_ins.core.update.gate import Verdict
from hybrid_ins.core.update.measurements import Measurement, PositionFix, VelocityFix

BEGINNING_NS = 1_000_000_000  # after the first stamp: a bag that is played again is there at first
AHEAD_NS = 1_000_000_000  # a measurement may be that far ahead of the IMU, beyond a gap
JUMP_CONFIRMED = 5  # samples in a row that make a jump of the stamps a long gap, or a new time base
STAMPS_KEPT = 64  # of measurements, to find repeated ones
MOVING = 1.0  # m/s, at which a receiver cannot report the same position twice
STANDING = 0.2  # m/s: below, a velocity that stays the same is that of a stand
WITHOUT_POSITION_NS = 2_000_000_000  # that a receiver may be, and report one velocity meanwhile
STAMPED_AHEAD = "stamped ahead of the IMU"  # the reason of one that is further ahead
PUBLISHED_AGAIN = "published again with a new stamp"  # the reason of a repeated measurement


class StampFault(Enum):
    """Why an IMU sample is refused; the value is the name under which it is counted."""

    REPEATED = "repeated stamp"
    OUT_OF_ORDER = "stamp out of order"
    JUMP = "stamp jumps"


class ImuStampCheck:
    """
    Decides whether an IMU sample may be used, by its stamp.

    The caller sets ``last_ns`` to the stamp of each sample that it uses. A step of up to
    ``steady_ns`` needs no further check: the caller compares it itself, at the IMU's rate.

    Parameters
    ----------
    max_gap : float
        Longest step between samples that dead reckoning bridges [s].

    Attributes
    ----------
    last_ns : int
        Stamp of the last sample that was used [ns]; 0 before the first.
    steady_ns, short_ns, max_gap_ns : int
        Steps of up to ``steady_ns`` [ns] lack no sample; steps of up to ``max_gap_ns`` are bridged,
        of more than ``short_ns`` once several samples have confirmed them.
    """

    def __init__(self, max_gap: float) -> None:
        self.max_gap_ns = int(max_gap * 1e9)
        self.steady_ns = self.short_ns = int(min(max_gap, LONG_GAP) * 1e9)
        self._first_ns = 0  # where the stamps begin [ns]
        self.reset()

    def reset(self) -> None:
        """Forget the last stamps."""
        self.last_ns = 0
        self._jumped_ns = self._jumps = 0
        self._jumped_from_ns = 0  # `last_ns` then

    def is_ahead(self, t_ns: int) -> bool:
        """Return whether a measurement's stamp [ns] lies further ahead than samples may lack."""
        return self.last_ns > 0 and t_ns - self.last_ns > self.max_gap_ns + AHEAD_NS

    def check(self, t_ns: int) -> StampFault | None:
        """
        Check a stamp [ns] that does not follow the last one within ``steady_ns``.

        None: the sample is to be used. Its step from ``last_ns`` is then a gap, or leads to a new
        time base.
        """
        if self.last_ns == 0:
            self._first_ns = self._first_ns or t_ns
            return None
        step = t_ns - self.last_ns
        if 0 < step <= self.short_ns:
            self._jumps = 0
            return None
        if -self.short_ns < step <= 0:
            return StampFault.REPEATED if step == 0 else StampFault.OUT_OF_ORDER
        # One stray stamp is the driver's fault; several in a row are a gap, a loop, a new clock.
        follows = 0 < t_ns - self._jumped_ns <= self.short_ns
        in_a_row = self._jumps > 0 and self.last_ns == self._jumped_from_ns
        self._jumps = self._jumps + 1 if follows and in_a_row else 1
        self._jumped_ns, self._jumped_from_ns = t_ns, self.last_ns
        if self._jumps < JUMP_CONFIRMED:
            return StampFault.JUMP
        self._jumps = 0
        return None

    def begin_anew(self, t_ns: int) -> bool:
        """
        Return whether stamps that went back to ``t_ns`` [ns] begin where they began, or before.

        So do those of a bag that is played again. Behind the beginning the clock was set: the
        vehicle is not where it was at first.
        """
        if t_ns - self._first_ns > BEGINNING_NS:
            return False
        self._first_ns = min(self._first_ns, t_ns)
        return True


class MeasurementCheck:
    """
    Refuses measurements that come twice, from the future, too fast, or from a stuck receiver.

    Velocities are refused while they contradict the positions, too.

    Parameters
    ----------
    speed_check : SpeedCheck
        How fast the vehicle may be.

    Attributes
    ----------
    motion : FixMotion
        Of the position fixes that were admitted.
    was_misled : bool
        The last measurement has shown that earlier ones, in motion, were no new ones.
    contradiction : Contradiction or None
        The last measurement has shown that the velocities so far contradict the positions.
    """

    def __init__(self, speed_check: SpeedCheck) -> None:
        self._speed_check = speed_check
        self._repetitions = {
            PositionFix.kind: RepetitionCheck(),
            VelocityFix.kind: RepetitionCheck(),
        }
        self._velocities = VelocityCheck()
        self.reset()

    def reset(self) -> None:
        """Forget all measurements, but not that their driver repeats them."""
        self._speed_check.reset()
        self._velocities.reset()
        self.motion = FixMotion()
        self.was_misled = False
        self.contradiction: Contradiction | None = None
        self._seen: deque[tuple[str, int]] = deque(maxlen=STAMPS_KEPT)
        self._position_ns = 0  # stamp of the last position
        self._moved = 0.0  # m, while the receiver repeated that
        self._new_ns = self._spacing_ns = 0  # of the last position that was none of these
        self._same_since_ns = 0  # stamp of the first of velocities that are the same
        self._is_velocity_held = False

    def forget_stamps(self) -> None:
        """Forget the stamps of earlier measurements: the next come by another clock."""
        self._seen.clear()

    def check(
        self, measurement: Measurement, stamps: ImuStampCheck, speed: float
    ) -> Verdict | None:
        """
        Return the verdict on a measurement that is refused; None: it is to be used.

        Parameters
        ----------
        measurement : Measurement
        stamps : ImuStampCheck
            Where the IMU is.
        speed : float
            Of the vehicle over ground [m/s]; 0 where it is not known.
        """
        self.was_misled, self.contradiction = False, None
        key = (measurement.kind, measurement.t_ns)
        if key in self._seen:
            return Verdict.rejected(measurement, "repeated stamp")
        if stamps.is_ahead(measurement.t_ns):
            age = (stamps.last_ns - measurement.t_ns) * 1e-9
            return Verdict.rejected(measurement, STAMPED_AHEAD, age)
        self._seen.append(key)
        if not self._speed_check.is_reachable(measurement):
            return Verdict.rejected(measurement, "faster than gnss.max_speed")
        if isinstance(measurement, PositionFix | VelocityFix):
            refused = self._check_repetition(measurement, speed)
            return refused or self._check_velocities(measurement)
        return None

    def _check_repetition(self, fix: PositionFix | VelocityFix, speed: float) -> Verdict | None:
        """Refuse a fix that is no new one: the first of identical ones has the right stamp."""
        repetition = self._repetitions[fix.kind]
        believed = not repetition.repeats
        measured = with_course(fix.velocity_n) if isinstance(fix, VelocityFix) else fix.lla
        again = repetition.is_again(measured)
        self.was_misled = believed and repetition.repeats and self.motion.speed > 0.0
        if again and repetition.repeats:
            return Verdict.rejected(fix, PUBLISHED_AGAIN)
        if isinstance(fix, PositionFix):
            if self._is_held(fix, again, speed):
                return Verdict.rejected(fix, "same position while moving")
            self._spacing_ns, self._new_ns = fix.t_ns - (self._new_ns or fix.t_ns), fix.t_ns
            claimed_std = math.sqrt(horizontal_variance(fix.claimed))
            self.motion.observe(fix.t_ns, fix.lla, claimed_std)
        elif self._holds_velocity(fix.t_ns, again, speed):
            return Verdict.rejected(fix, "same velocity while no position comes")
        return None

    def _is_held(self, fix: PositionFix, again: bool, speed: float) -> bool:
        """
        Return whether a receiver repeats a position that the vehicle leaves, or has left.

        A vehicle that stops in a tunnel is not where its receiver has held its position since.
        """
        moves = again and speed > MOVING
        if not again:
            self._moved = 0.0
        elif moves:
            self._moved += speed * (fix.t_ns - self._position_ns) * 1e-9
        self._position_ns = fix.t_ns
        return moves or self._moved > left_behind(fix)

    def _holds_velocity(self, t_ns: int, again: bool, speed: float) -> bool:
        """
        Return whether a receiver without a position repeats a velocity, until that changes.

        It holds the last one, or sends zeros: without satellites it measures none.
        """
        if not again:
            self._same_since_ns, self._is_velocity_held = t_ns, False
        elif self._new_ns and speed > STANDING:
            since_ns = max(self._same_since_ns, self._new_ns)
            patience_ns = max(WITHOUT_POSITION_NS, 2 * self._spacing_ns)
            self._is_velocity_held |= t_ns - since_ns >= patience_ns
        return self._is_velocity_held

    def _check_velocities(self, fix: PositionFix | VelocityFix) -> Verdict | None:
        """Refuse a velocity while those of its driver contradict the positions."""
        before = self._velocities.contradiction
        self._velocities.observe(fix)
        now = self._velocities.contradiction
        self.contradiction = now if before is None else None
        if now is not None and isinstance(fix, VelocityFix):
            return Verdict.rejected(fix, "velocity contradicts the positions")
        return None
