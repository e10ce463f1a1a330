"""
What an event does to a filter at its own stamp: the measurement update, and other changes.

A measurement is judged by the gate and fused; its innovation teaches noise, clock and antenna.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.constraints.nonholonomic import NonHolonomic
from hybrid_ins.core.filter.changes import apply_change
from hybrid_ins.core.filter.events import Change, Event
from hybrid_ins.core.filter.filter_noise import FilterNoise
from hybrid_ins.core.filter.fix_update import (
    COUNTS,
    N_RESULT,
    NORMALISED,
    SIGMA,
    TOTALS,
    correction_of,
    fuse_ordinary_fix,
)
from hybrid_ins.core.filter.missing_height import LevelMotion
from hybrid_ins.core.imu.samples import ImuRing
from hybrid_ins.core.inertial.rotations import matrix_from_quat
from hybrid_ins.core.inertial.state import (
    ACCELERATION,
    AGE_SENSITIVITY,
    ANTENNA_VARIANCE,
    ATTITUDE_COVARIANCE,
    CLOCK_VARIANCE,
    COVARIANCE,
    HEADING_ARM,
    HEADING_CONSIDERED,
    HEADING_VARIANCE,
    N_ERROR,
    N_NAV,
    PAST_VARIANCE,
    PSD,
    QUAT,
    SENSITIVITY,
    SLOW_VARIANCE,
    VELOCITY,
    pack,
)
from hybrid_ins.core.noise.heading_information import (
    HEADING,
    IN_FULL,
    HeadingInformation,
    heading_information,
)
from hybrid_ins.core.noise.multiple_model import StateCorrection
from hybrid_ins.core.noise.position_scatter import PositionScatter, Split
from hybrid_ins.core.noise.process_noise import Correction, Linearisation
from hybrid_ins.core.noise.scatter_evidence import Evidence
from hybrid_ins.core.noise.stamp_scatter import stamp_covariance
from hybrid_ins.core.sensor_errors.clock_offset import (
    ClockOffsetObserver,
    age_mean_square,
    share_of_motion,
)
from hybrid_ins.core.sensor_errors.clock_sensitivity import (
    correct_sensitivities,
    initial_sensitivity,
    noise_information,
    sensitivities,
)
from hybrid_ins.core.sensor_errors.considered_scale import Considered
from hybrid_ins.core.sensor_errors.lever_arm import LeverArmObserver
from hybrid_ins.core.sensor_errors.scale_errors import ScaleErrorObserver
from hybrid_ins.core.update import iterated_update
from hybrid_ins.core.update.gate import Gate, Verdict
from hybrid_ins.core.update.inflation import inflate_to_innovation
from hybrid_ins.core.update.kalman import inject, innovation, update_in_body
from hybrid_ins.core.update.measurements import (
    GNSS,
    IMU,
    LinearModel,
    Measurement,
    PositionFix,
    Standstill,
    VelocityFix,
)

Array = NDArray[np.float64]
Fused = tuple[Verdict, bool, Evidence | None]
"""Verdict, whether the noise moved the state, and what a position's scatter teaches."""

UNSPLIT = Split(np.empty(0), np.empty(0), 0.0)  # the covariance of what is no position


class Outcome(NamedTuple):
    """What became of an event."""

    verdict: Verdict | None  # None: no measurement
    r_scale: float  # factor that was on the covariance of fixes
    state_moved: bool  # by a `StateCorrection`
    split: Split | None  # of a position's covariance
    scale: Considered | None = None  # what scale errors did, in an outage


class MeasurementUpdate:
    """
    Applies events to a flat state, and holds what they change besides it.

    A copy is a checkpoint.

    Parameters
    ----------
    noise : FilterNoise
        Qc, and the factor on the covariance of fixes.
    gate : Gate
        Decides which measurements are fused.
    clock : ClockOffsetObserver
        Clock offset of fixes, estimated beside the state.
    scatter : PositionScatter
        Share of the claimed variance of positions that is white.
    corrected_ns : int
        Stamp of the last fix that was fused, or of the start [ns].
    lever_arm : LeverArmObserver
        Error of the antenna's place, estimated beside the state.
    scale_errors : ScaleErrorObserver
        Scale errors of the IMU, likewise.
    """

    def __init__(
        self,
        noise: FilterNoise,
        gate: Gate,
        clock: ClockOffsetObserver,
        scatter: PositionScatter,
        corrected_ns: int,
        lever_arm: LeverArmObserver,
        scale_errors: ScaleErrorObserver,
    ) -> None:
        self.noise, self.gate = noise, gate
        self.clock = clock
        self.scatter = scatter
        self.corrected_ns = corrected_ns
        self.lever_arm, self.scale_errors = lever_arm, scale_errors
        self.heading = HeadingInformation()

    def __copy__(self) -> MeasurementUpdate:
        twin = object.__new__(MeasurementUpdate)
        twin.__dict__.update(self.__dict__)
        twin.noise, twin.gate = self.noise.__copy__(), self.gate.__copy__()
        twin.clock, twin.scatter = self.clock.__copy__(), self.scatter.__copy__()
        twin.lever_arm, twin.scale_errors = self.lever_arm.__copy__(), self.scale_errors.__copy__()
        twin.heading = self.heading.__copy__()
        return twin

    def apply(
        self, nav: Array, event: Event, age: float, consider_clock: bool, ring: ImuRing
    ) -> Outcome:
        """
        Apply an event.

        Parameters
        ----------
        nav : ndarray, shape (N_FLAT,)
            Flat state at the event's stamp with nothing pending; overwritten.
        event : Event
        age : float
            How far the event lies behind the IMU [s].
        consider_clock : bool
            See `FilterSettings`.
        ring : ImuRing
            Recent IMU samples.
        """
        self.scale_errors.follow(nav, ring, event.t_ns)
        r_scale, verdict, moved, psd_changed = self.noise.found.fixes, None, False, True
        split: Split | None = None
        if isinstance(event, Change):
            apply_change(self, nav, event, ring)
        else:
            if isinstance(event, PositionFix):
                split = self.noise.split_of(event, self.scatter)
            elif isinstance(event, VelocityFix):
                event = event.scaled(*self.noise.factors_by_axis(event))
            fused = self._fuse_ordinary(nav, event, split, age)
            psd_changed = fused is None or self.noise.uses_corrections
            verdict, moved, found = fused or self._fuse(nav, event, split, age)
            if verdict.accepted and split is not None:
                self.scatter.learn(split, found, event.t_ns)
            if isinstance(event, LevelMotion):
                nav[SLOW_VARIANCE][2] = event.height_variance
        self.noise.consider_scale(self.scale_errors.in_outage)
        if psd_changed:
            nav[PSD] = self.noise.psd()
        nav[CLOCK_VARIANCE] = self.clock.missing_variance if consider_clock else 0.0
        _consider(nav, self, event.t_ns)
        return Outcome(verdict, r_scale, moved, split, self.scale_errors.done)

    def _fuse_ordinary(
        self, nav: Array, fix: Measurement, split: Split | None, age: float
    ) -> Fused | None:
        """Do what `_fuse` does with a fix that its NIS alone decides on; None for others."""
        if isinstance(fix, PositionFix):
            measured = fix.lla
        elif isinstance(fix, VelocityFix):
            measured = fix.velocity_n
        else:
            return None
        noise, clock, parts = self.noise, self.clock, split or UNSPLIT
        white = fix.claimed if split is None else split.white
        m, uses_corrections = len(white), noise.uses_corrections
        interval = (fix.t_ns - self.corrected_ns) * 1e-9
        before = np.empty(len(nav) if uses_corrections else 0)
        result = np.empty(N_RESULT)
        if not fuse_ordinary_fix(
            nav,
            measured,
            fix.lever_b,
            white,
            split is not None,
            parts.slow_variance,
            parts.interval,
            parts.claimed_growth,
            self.scatter.learning,
            noise.found.fixes,
            noise.stamp_std_of(fix) ** 2,
            clock.values,
            clock.interval(fix.t_ns),
            self.heading.values,
            interval,
            self.gate.ordinary_limit(fix.kind, m, interval),
            before,
            result,
        ):
            return None
        clock.on_corrected(fix.t_ns)
        self.corrected_ns = fix.t_ns
        self.scale_errors.end_outage()
        nis, log_det, weight = result[: TOTALS.start].tolist()
        threshold, sigma = self.gate.threshold(m), result[SIGMA][:m]
        verdict = Verdict(fix, True, "", age, nis, threshold, sigma, log_det, weight=weight)
        moved = uses_corrections and self._learn_noise(
            nav,
            correction_of(
                fix, result, interval, before, weight, noise, self.scatter.in_force, parts
            ),
        )
        found = result[TOTALS], result[COUNTS], result[NORMALISED][:m]
        return verdict, moved, found if self.scatter.learning else None

    def _fuse(self, nav: Array, measurement: Measurement, split: Split | None, age: float) -> Fused:
        """
        Decide on a measurement, fuse it, and let the noise and the clock learn from it.

        ``split`` is that of a position's covariance.
        """
        found: Evidence | None = None
        measurement, by_scale = _decorrelated(nav, measurement, self.scale_errors)
        model = measurement.linearise(nav)
        claimed, parts, unchanged = model[2], split or UNSPLIT, nav.copy()
        of_stamp: Array | None = None
        by_stamp: Array | float = 0.0
        fix_factor = self.noise.found.fixes if measurement.sensor == GNSS else 1.0
        if split is not None:
            share = share_of_motion(self.clock.values)
            of_stamp = stamp_covariance(nav[VELOCITY], share, len(model[0]))
            by_stamp = self.noise.found.stamp_std**2 * of_stamp
            model, found = self.scatter.split_model(nav, model, split, fix_factor, by_stamp)
            nav[HEADING_ARM] = -model[1][:2, HEADING]
        if not np.isfinite(nav[:N_NAV]).all():
            return Verdict.rejected(measurement, "the state is lost"), False, found
        z, H, R = model
        of_age = np.zeros_like(R)
        if measurement.sensor == GNSS:
            R = R * fix_factor + by_stamp
            h, change = sensitivities(nav, H)
            if measurement.kind == VelocityFix.kind:
                of_stamp, variance = np.outer(change, change), self.noise.found.age_std**2
                if nav[CLOCK_VARIANCE] > 0.0:
                    variance = max(variance, age_mean_square(self.clock.values))
                of_age = variance * of_stamp
                R = R + of_age
        else:
            h = H @ np.stack((nav[SENSITIVITY], nav[AGE_SENSITIVITY]), axis=1)
        of_clock = nav[CLOCK_VARIANCE] * np.outer(h[:, 0], h[:, 0])
        S, nis = innovation(nav, z, H, R + of_clock)
        interval = (measurement.t_ns - self.corrected_ns) * 1e-9
        verdict = self.gate.judge(measurement, z, R + of_clock, S, nis, age, interval, claimed)
        before, is_position = nav.copy(), split is not None
        dx, K, linear, turn = np.zeros(N_ERROR), np.zeros((N_ERROR, len(z))), None, 0.0
        if verdict.accepted:
            is_told = self.noise.uses_corrections or self.scale_errors.in_outage
            if is_told and not measurement.in_body:
                linear = iterated_update.linearisation(nav[COVARIANCE], z, H, R / verdict.weight)
            if verdict.inflated:
                inflate_to_innovation(nav, z, H, interval)
            shown, variance = IN_FULL, nav.item(HEADING_VARIANCE)
            if measurement.sensor == GNSS:
                shown = heading_information(nav[COVARIANCE], H, S - of_clock, R)
            dx, K, linear, turn = _correct(nav, measurement, (z, H, R / verdict.weight), linear)
            self.heading.update(interval, shown, variance, nav.item(HEADING_VARIANCE))
        correct_sensitivities(nav, H, K, h, dx, is_position)
        correction = Correction(
            measurement.t_ns,
            z,
            S - of_clock,
            H,
            K,
            dx,
            matrix_from_quat(nav[QUAT]),
            interval,
            before,
            verdict.accepted,
            weight=verdict.weight,
            linear=linear,
            turn=turn,
            of_stamp=of_stamp if self.scatter.in_force else None,
            fix_factor=fix_factor,
            stamp_std=self.noise.stamp_std_of(measurement),
            slow_growth=parts.claimed_growth,
            claimed_stds=parts.claimed_stds,
            kind=measurement.kind,
            factors_by_axis=self.noise.factors_by_axis(measurement),
        )
        if measurement.sensor != GNSS:
            if verdict.accepted and _concerns_noise(measurement):
                self.noise.follow(correction)
            self.lever_arm.update(correction, nav, is_fix=False)
            self.scale_errors.update(correction, is_fix=False, beside=by_scale)
            return verdict, False, found
        if verdict.accepted:
            self.corrected_ns = measurement.t_ns
            self.scale_errors.end_outage()
        self.noise.learn_verdict(verdict, correction, R)
        if verdict.inflated:
            self.noise.restart(keep_weights=False)
            self.lever_arm.restart()
            self.scale_errors.restart()
        if verdict.jump:  # the slow error remains that of the last fix that was fused
            nav[:] = unchanged
        if verdict.inflated or verdict.jump:
            return verdict, False, found
        S = S - of_clock + (1.0 / verdict.weight - 1.0) * R - of_age
        self.clock.update(correction, h, S, noise_information(nav, H, K, S, is_position))
        return verdict, self._learn_noise(nav, correction), found

    def _learn_noise(self, nav: Array, correction: Correction) -> bool:
        """Let noise and sensors' errors learn from it; the former may move the state."""
        without_scale = self.scale_errors.explain(correction)
        if self.noise.uses_corrections:
            self.lever_arm.update(correction, nav, is_fix=True)
            self.scale_errors.update(correction, is_fix=True)
        moved = self.noise.learn_correction(correction, without_scale)
        if moved is not None:
            _move(nav, moved)
        return moved is not None


def _concerns_noise(measurement: Measurement) -> bool:
    """Return whether a measurement that is no fix corrects the hypotheses on the noise, too."""
    return measurement.sensor != IMU or measurement.kind == Standstill.kind


def _consider(nav: Array, known: MeasurementUpdate, t_ns: int) -> None:
    """Write what is reported besides P at a stamp [ns]: of the position and of the attitude."""
    nav[ANTENNA_VARIANCE] = known.lever_arm.considered(nav)
    nav[ATTITUDE_COVARIANCE] = known.scale_errors.considered + known.lever_arm.of_attitude
    nav[HEADING_CONSIDERED] += known.heading.considered(nav)
    nav[PAST_VARIANCE] = known.noise.past_variance(
        nav[SLOW_VARIANCE], t_ns, is_running=known.scatter.in_force
    )


def _move(nav: Array, moved: StateCorrection) -> None:
    """Move a state where it belongs."""
    inject(nav, moved.dx)
    pack(moved.P, nav[COVARIANCE])
    nav[SENSITIVITY] = initial_sensitivity(nav[VELOCITY], nav[ACCELERATION])


def _correct(
    nav: Array, measurement: Measurement, model: LinearModel, linear: Linearisation | None
) -> tuple[Array, Array, Linearisation | None, float]:
    """Fuse a measurement; return correction, gain, what it comes down to, turn: `Correction`."""
    if measurement.in_body:
        dx, K, T = update_in_body(nav, *model)
        return dx, T @ K, (*model[:2], dx, T), 0.0
    dx, K, turn = iterated_update.update(nav, *model)
    return dx, K, linear, turn


def _decorrelated(
    nav: Array, measurement: Measurement, scale_errors: ScaleErrorObserver
) -> tuple[Measurement, Array | float]:
    """Return a measurement as it is fused, and its derivative by scale errors beside the state."""
    if isinstance(measurement, NonHolonomic) and scale_errors.in_outage:
        added, by_scale = scale_errors.decorrelated(nav, measurement.by_scale)
        return replace(measurement, beside=added), by_scale
    return measurement, 0.0
