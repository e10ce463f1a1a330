"""
All that a filter assumes about noise: Qc, and the factor on the covariance of fixes.

References
----------
.. [1] B. Or, I. Klein, "A hybrid model and learning-based adaptive navigation filter", IEEE TIM
       2022, eq. (5)-(7).
"""

from __future__ import annotations

import copy
import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.noise.multiple_model import NoiseMultipleModelBank, StateCorrection
from hybrid_ins.core.noise.position_jumps import PositionJumps
from hybrid_ins.core.noise.position_scatter import PositionScatter, Split
from hybrid_ins.core.noise.process_noise import Correction, NoiseEstimate, NoiseModel, ProcessNoise
from hybrid_ins.core.noise.slow_error import Shares, SlowError
from hybrid_ins.core.noise.weights import NoiseFactors
from hybrid_ins.core.update.gate import Verdict
from hybrid_ins.core.update.measurements import Measurement, PositionFix, VelocityFix

Array = NDArray[np.float64]

PROBABLE = 0.5  # of a slow error of fixes, to be remembered
JUMP_PROBABILITY = 0.9  # of a slow error of fixes: an innovation that began it was a jump
SUSPICION_NS = 3_000_000_000  # in which the innovations show that


class FilterNoise:
    """
    A noise model, its way to Qc, and the factors that the innovations put on it.

    Scale errors of the IMU make the innovations larger, and the factors with them. Where their
    effect is part of the covariance by itself, it would count twice: there the factors are those
    of innovations from which it has been taken out.

    A copy is a checkpoint.

    Parameters
    ----------
    model : NoiseModel
        Per-sample variances of the IMU.
    process : ProcessNoise
        Converts them to densities.
    factors : NoiseMultipleModelBank, optional
        Estimates factors on those variances and on the covariance of fixes; none: all are 1.

    Attributes
    ----------
    split : Split
        Of what the last position claimed.
    jumps : PositionJumps
        Jumps of fixes that are not claimed.
    without_scale : NoiseMultipleModelBank or None
        As ``factors``, by innovations without what scale errors explain of them.
    slow_error : SlowError
        Of positions, that the innovations show.
    considers_scale : bool
        Factors on the IMU's noise are those of ``without_scale``.
    """

    def __init__(
        self,
        model: NoiseModel,
        process: ProcessNoise,
        factors: NoiseMultipleModelBank | None = None,
    ) -> None:
        self.model = model
        self.process = process
        self.factors = factors
        self.without_scale = None if factors is None else NoiseMultipleModelBank()
        self.considers_scale = self._explained = False
        self.split = Split(np.empty(0), np.empty(0), 0.0, claimed_stds=(math.inf, math.inf))
        self.slow_error, self.jumps = SlowError(), PositionJumps()
        self._suspected: tuple[Correction, Array] | None = None
        self._restarted = False
        self._note_levels()

    def __copy__(self) -> FilterNoise:
        twin = object.__new__(FilterNoise)
        twin.__dict__.update(self.__dict__)
        twin.model, twin.factors = copy.copy(self.model), copy.copy(self.factors)
        twin.without_scale = copy.copy(self.without_scale)
        return twin

    def replaced_by(self, other: FilterNoise) -> FilterNoise:
        """Return a copy of ``other`` with what was learned of jumps here."""
        twin = other.__copy__()
        twin.jumps = self.jumps
        return twin

    @property
    def imu_factors(self) -> tuple[float, float]:
        """Factors on the variances of accelerometer and gyroscope."""
        bank = self.without_scale if self.considers_scale and self._explained else self.factors
        found = NoiseFactors() if bank is None else bank.found
        return found.accelerometer, found.gyroscope

    @property
    def found(self) -> NoiseFactors:
        """What the innovations show besides the IMU's factors."""
        return NoiseFactors() if self.factors is None else self.factors.found

    def stamp_std_of(self, measurement: Measurement) -> float:
        """Return the standard deviation of a stamp [s], that of the age if it is a velocity's."""
        found = self.found
        return found.age_std if isinstance(measurement, VelocityFix) else found.stamp_std

    def split_of(self, fix: PositionFix, scatter: PositionScatter) -> Split:
        """Return the split of a position's covariance, and keep it."""
        if len(fix.claimed) == 2:
            for bank in self._banks():
                bank.forget_heights(fix.t_ns)
        found = self.found
        shown = found.slow_std, found.slow_height_std
        is_told = scatter.in_force or (self.factors is not None and self.factors.stands(fix.t_ns))
        lasts = is_told and found.slow_probability > PROBABLE
        self.slow_error = self.slow_error.updated(shown, lasts, fix.t_ns)
        self.split = scatter.split(
            fix.claimed, fix.t_ns, self.slow_error.stds, found.fixes, found.heights
        )
        return self.split

    def factors_by_axis(self, measurement: Measurement) -> tuple[float, float]:
        """Return those that are in the covariance of a measurement, besides that on all fixes."""
        found = self.found
        if isinstance(measurement, VelocityFix):
            return found.horizontal_velocity, found.vertical_velocity
        return (1.0, found.heights) if isinstance(measurement, PositionFix) else (1.0, 1.0)

    def past_variance(self, slow_variance: Array, t_ns: int, *, is_running: bool) -> Array:
        """
        Return the variance of errors that positions have shown up to a stamp [ns], (3,) m², NED.

        Of slow errors what exceeds ``slow_variance``, (3,) [m²], that of the one in force; what a
        claim lacks counts in the filter that runs alone.
        """
        found = self.found if is_running else NoiseFactors()
        possible = _possible_variance(self.slow_error, found, self.split.claimed_stds)
        return np.maximum(self.jumps.variance(t_ns), possible - slow_variance)

    def levels(self) -> Array:
        """Per-sample variances in force: accelerometer x y z, gyroscope x y z, (6,), b frame."""
        return self._levels

    def consider_scale(self, considers: bool) -> None:
        """Note whether scale errors are part of the covariance by themselves."""
        if considers != self.considers_scale:
            self.considers_scale = considers
            self._note_levels()

    def _banks(self) -> list[NoiseMultipleModelBank]:
        """Return the factors' banks."""
        return [bank for bank in (self.factors, self.without_scale) if bank is not None]

    def _note_levels(self) -> None:
        """Set the levels in force: they are asked for with every sample, and change with events."""
        levels, (a, g) = self.model.levels(), self.imu_factors
        self._levels = levels if a == g == 1.0 else levels * np.array((a, a, a, g, g, g))

    def psd(self) -> Array:
        """Return the diagonal of Qc, shape (12,)."""
        return self.process.psd(self.levels())

    def learn_estimate(self, estimate: NoiseEstimate) -> None:
        """
        Learn from a regressor's estimate.

        Factors above 1 and a slow error of fixes that a stand-in needed are dropped.
        """
        replaced = self.model.learn(estimate)
        needed = max(self.imu_factors) > 1.0 or self.found.slow_height_std > 0.0
        if replaced and needed:
            for bank in self._banks():
                bank.restart(keep_weights=False)
        self._note_levels()

    @property
    def uses_corrections(self) -> bool:
        """Whether `learn_correction` does anything."""
        return self.factors is not None or self.model.uses_corrections

    def learn_correction(
        self, correction: Correction, without_scale: Correction | None = None
    ) -> StateCorrection | None:
        """
        Learn from a fix, fused or rejected; may return where the state belongs.

        ``without_scale`` is the same without what scale errors explain of it.
        """
        if self.model.uses_corrections:
            self.model.learn(replace(correction, restarted=self._restarted))
        self._restarted = False
        moved: StateCorrection | None = None
        if self.factors is not None and self.without_scale is not None:
            psd = self.process.psd(self.model.levels())
            moved = self.factors.update(correction, psd)
            if moved is not None:
                self.without_scale.restart(keep_weights=True)
            elif without_scale is not None:
                self.without_scale.update(without_scale, psd)
                self._explained = True
        self._note_levels()
        if self._suspected is not None:
            self._judge_suspected(*self._suspected, correction.t_ns)
        return moved

    def _judge_suspected(self, correction: Correction, claimed: Array, t_ns: int) -> None:
        """Learn a suspected jump if the innovations up to a stamp [ns] show that it is one."""
        shown = self.found.slow_probability > JUMP_PROBABILITY
        if shown:
            self._learn_jump(correction, claimed)
        if shown or t_ns - correction.t_ns > SUSPICION_NS:
            self._suspected = None

    def learn_verdict(self, verdict: Verdict, correction: Correction, R: Array) -> None:
        """
        Learn from the verdict on a fix whether its receiver jumped.

        Where the innovations that follow a surprise show a slow error of fixes, which an INS does
        not make, it was the receiver. Where nothing tells which of them was wrong, it may have
        been.

        Parameters
        ----------
        verdict : Verdict
        correction : Correction
            By that fix.
        R : ndarray, shape (m, m)
            Its covariance in force.
        """
        fix = verdict.measurement
        if isinstance(fix, PositionFix) and verdict.receiver_jumped:
            self._learn_jump(correction, fix.claimed)
            self._suspected = None
        elif verdict.is_ambiguous and not self.jumps.may_be_of_state(correction.t_ns):
            self.slow_error = self.slow_error.doubted(correction.z)
        elif isinstance(fix, PositionFix) and verdict.surprises:
            self._suspected = correction, fix.claimed
        if verdict.disagrees:
            for bank in self._banks():
                bank.weigh_jump(correction, R)
            self._note_levels()

    def _learn_jump(self, correction: Correction, claimed: Array) -> None:
        self.jumps = self.jumps.learned(correction.z, correction.S, claimed, correction.t_ns)

    def on_imu_fault(self, t_ns: int) -> None:
        """Drop what refers to the state before a fault of the IMU at a stamp [ns]."""
        self.restart(keep_weights=True)
        self.jumps = self.jumps.doubted(t_ns)

    @property
    def has_begun(self) -> bool:
        """Whether fixes have been learned from."""
        return self.factors is None or self.factors.t_ns > 0

    def begin_with(self, log_likelihood: Array) -> None:
        """Begin with what is known of the factor on R, see `ScatterShown`."""
        for bank in self._banks():
            bank.add_log_likelihood(log_likelihood)

    def follow(self, correction: Correction) -> None:
        """Learn what a measurement that is no fix did to the state."""
        for bank in self._banks():
            bank.follow(correction, self.process.psd(self.model.levels()))

    def restart(self, *, keep_weights: bool) -> None:
        """
        Drop what refers to the present state: it is changed by other means than measurements.

        Without ``keep_weights`` the factors on the IMU's noise are dropped too: they were learned
        from measurements that proved inconsistent with the state.
        """
        self._restarted, self._suspected = True, None
        for bank in self._banks():
            bank.restart(keep_weights=keep_weights)
        self._note_levels()


def _possible_variance(past: SlowError, found: NoiseFactors, claimed_stds: Shares) -> Array:
    """
    Return the variance of a slow error that there may be [m²], (3,), NED.

    A claim that was too small by a factor, beside velocities that are right, is worth that many
    times more, and bounds a slow error no better.
    """
    excess = max(min(found.fixes, 1.0 / found.horizontal_velocity) - 1.0, 0.0)
    if not excess and not any(past.past):
        return np.zeros(3)
    across, upward = claimed_stds
    stds = np.array([across, across, upward if math.isfinite(upward) else across])
    beyond = excess * np.square(stds, out=np.zeros(3), where=np.isfinite(stds))
    return np.maximum(past.past_variance, beyond)
