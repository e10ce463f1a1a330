"""
Accuracy and consistency of an estimate: arrays in, a frozen `Result` out.

References
----------
.. [1] B. Or, I. Klein, *A Hybrid Model and Learning-Based Adaptive Navigation Filter*, IEEE TIM
       71, 2022: eq. 25 (PRMSE), eq. 26 (PMAE).
.. [2] Y. Bar-Shalom, X. R. Li, T. Kirubarajan, *Estimation with Applications to Tracking and
       Navigation*, 2001, section 5.4 (NEES and NIS).
"""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from typing import Any

import numpy as np

from hybrid_ins.errors import InputError
from hybrid_ins.evaluation.matching import after, match
from hybrid_ins.evaluation.result import (
    GNSS_CLOCK,
    IMU_CLOCK,
    Errors,
    FixCount,
    Outage,
    Result,
    Scoring,
    TimeOffset,
)
from hybrid_ins.evaluation.run import Run, Topics, Verdicts
from hybrid_ins.evaluation.statistics import Consistency, nees
from hybrid_ins.ros.messages.trajectory import Array, Stamps, Trajectory

HEADING_UNKNOWN = 1.0  # rad, σ: any heading would have 1.8
_ELSEWHERE = 10_000.0  # m, between a run and the truth of another
_WHITE = 0.5  # share of independent NIS values below which they are reported as correlated


def evaluate(
    estimate: Trajectory,
    truth: Trajectory | None,
    *,
    fix_stamp_ns: Stamps | None = None,
    verdicts: Verdicts | None = None,
    scoring: Scoring | None = None,
) -> Result:
    """
    Compare an estimate with the truth at the truth's epochs.

    Parameters
    ----------
    estimate : Trajectory
        Stamps in the IMU clock; interpolated, never extrapolated.
    truth : Trajectory or None
        Stamps in the reference clock, or in the IMU's as ``scoring.truth_clock`` says. In the
        estimate's map; where both datums are known and differ it is transformed to it. None: only
        the verdicts are evaluated.
    fix_stamp_ns : ndarray, shape (K,), optional
        Stamps of the position fixes (reference clock). Truth epochs at these stamps are not
        scored; without verdicts all of them count as accepted.
    verdicts : Verdicts, optional
        The filter's decisions on the fixes.
    scoring : Scoring, optional
        Which epochs are scored.

    Returns
    -------
    Result

    Raises
    ------
    InputError
        There is nothing to score: no common time, or every epoch is skipped, at the stamp of a
        fix, or not finite.

    """
    scoring = scoring or Scoring()
    verdicts = Verdicts.of(()) if verdicts is None else verdicts
    positions = verdicts.rows(verdicts.kind == "position")
    fix_ns = np.union1d(
        np.empty(0, np.int64) if fix_stamp_ns is None else fix_stamp_ns, positions.stamp_ns
    )
    estimate, _ = estimate.in_order()
    if len(estimate) < 2:
        raise InputError("the estimate has fewer than two messages: it cannot be interpolated")
    clock = _ClockOffset(scoring.time_offset, verdicts)
    notes: list[str] = []

    if truth is None:
        origin_ns = int(estimate.stamp_ns[0])
        window = (
            after(origin_ns, max(scoring.start or 0.0, scoring.skip)),
            int(estimate.stamp_ns[-1]) if scoring.end is None else after(origin_ns, scoring.end),
        )
        if window[0] > min(window[1], int(estimate.stamp_ns[-1])):
            duration = (int(estimate.stamp_ns[-1]) - origin_ns) * 1e-9
            raise InputError(
                f"no estimate between --start or --skip and --end: it lasts {duration:.1f} s"
            )
        errors, epochs, coverage = None, None, None
        gaps_within = estimate.stamp_ns
        offset = clock.summary(fix_ns)
    else:
        truth, _ = truth.in_order()
        if not len(truth):
            raise InputError("the truth is empty")
        if estimate.datum_lla is not None and truth.datum_lla is not None:
            truth = truth.in_map_of(estimate.datum_lla)
        truth_imu_ns, fed_ns = clock.to_imu(truth.stamp_ns), fix_ns
        if scoring.truth_clock == IMU_CLOCK:
            truth_imu_ns, fed_ns = truth.stamp_ns, np.sort(clock.to_imu(fix_ns))
        origin_ns = int(truth_imu_ns[0])
        errors, epochs, coverage, notes = match(estimate, truth, truth_imu_ns, fed_ns, scoring)
        scored_ns = errors.stamp_ns[errors.scored]
        window = int(scored_ns[0]), int(scored_ns[-1])
        covered = (estimate.stamp_ns >= truth_imu_ns[0]) & (estimate.stamp_ns <= truth_imu_ns[-1])
        gaps_within = estimate.stamp_ns[covered]
        offset = clock.summary(truth.stamp_ns)
        if not len(fix_ns):
            notes.append("no fixes in the bag: epochs at fix stamps could not be left out")

    least = _least_heading_std(estimate)
    heading_known = least < HEADING_UNKNOWN
    if not heading_known:
        notes.append(
            f"the heading was never known (its σ is {np.degrees(least):.0f}° at least): it is not "
            "scored; it needs motion, or an initial heading"
        )
    elif errors is not None:
        errors = _where_heading_is_known(errors, notes)
    verdict_ns = clock.to_imu(verdicts.stamp_ns)
    in_window = verdicts.rows((verdict_ns >= window[0]) & (verdict_ns <= window[1]))
    fused_ns = positions.stamp_ns[positions.accepted] if len(positions) else fix_ns
    return Result(
        origin_ns,
        scoring,
        epochs,
        coverage,
        float(np.max(np.diff(gaps_within), initial=0)) * 1e-9,
        offset,
        **_accuracy(errors, heading_known),
        **_nees(errors, notes, heading_known),
        **_nis(in_window, notes),
        outages=_outages(errors, estimate, clock.to_imu(fused_ns), origin_ns, scoring.outage_gap),
        notes=tuple(notes),
        errors=errors,
        heading_known=heading_known,
    )


def evaluate_run(run: Run, scoring: Scoring | None = None) -> Result:
    """Evaluate a run as read from its bags; its notes are added to those of the result."""
    estimate, truth, scoring = run.estimate, run.truth, scoring or Scoring()
    notes = list(run.notes)
    if truth is not None and (estimate.datum_lla is None) != (truth.datum_lla is None):
        missing = "estimate's" if estimate.datum_lla is None else "truth's"
        notes.append(f"the {missing} datum is not in the bag: both maps are assumed to be the same")
    notes += _another_place(estimate, truth)
    result = evaluate(
        estimate,
        truth,
        fix_stamp_ns=run.fixes.stamp_ns,
        verdicts=run.verdicts,
        scoring=scoring,
    )
    is_shifted = result.time_offset.source == "verdicts" and result.time_offset.mean != 0.0
    if is_shifted and run.truth_topic != Topics.truth and scoring.truth_clock == GNSS_CLOCK:
        notes.append(
            f"{run.truth_topic} is taken to have the clock of the fixes: where it has the IMU's, "
            "as the estimate of another program, give --truth-clock imu"
        )
    return replace(result, notes=(*result.notes, *notes))


def _another_place(estimate: Trajectory, truth: Trajectory | None) -> list[str]:
    """Return a note where the truth is that of another run, elsewhere."""
    if truth is None or estimate.datum_lla is None or truth.datum_lla is None:
        return []
    true = truth.in_map_of(estimate.datum_lla).position_enu[:, :2]
    beside = estimate.position_enu[:, :2] - np.clip(
        estimate.position_enu[:, :2], np.nanmin(true, axis=0), np.nanmax(true, axis=0)
    )
    distance = float(np.nanmin(np.linalg.norm(beside, axis=1)))
    if distance < _ELSEWHERE:
        return []
    return [f"the truth is {distance / 1000.0:.0f} km off, in another place: is it of this run?"]


class _ClockOffset:
    """Converts stamps of the reference clock (truth, fixes) to the IMU clock."""

    def __init__(self, given: float | None, verdicts: Verdicts) -> None:
        known = np.isfinite(verdicts.time_offset)
        if given is not None:
            self.source = "option"
            self._since_ns, self._offset = np.zeros(1, np.int64), np.array([given])
        elif np.any(known):
            self.source = "verdicts"
            self._since_ns, self._offset = verdicts.stamp_ns[known], verdicts.time_offset[known]
        else:
            self.source = "none"
            self._since_ns, self._offset = np.zeros(1, np.int64), np.zeros(1)

    def _in_force(self, stamp_ns: Stamps) -> Array:
        latest = np.searchsorted(self._since_ns, stamp_ns, side="right") - 1
        return self._offset[np.maximum(latest, 0)]

    def to_imu(self, stamp_ns: Stamps) -> Stamps:
        return stamp_ns + np.rint(1e9 * self._in_force(stamp_ns)).astype(np.int64)

    def summary(self, stamp_ns: Stamps) -> TimeOffset:
        used = self._in_force(stamp_ns) if len(stamp_ns) else self._offset
        return TimeOffset(
            float(np.mean(used)), float(np.min(used)), float(np.max(used)), self.source
        )


def _least_heading_std(estimate: Trajectory) -> float:
    """Return the smallest standard deviation of the heading [rad]; 0 where none is stated."""
    if estimate.attitude_cov is None:
        return 0.0
    variance = estimate.attitude_cov[:, 2, 2]
    stated = variance[np.isfinite(variance) & (variance > 0.0)]
    return float(np.sqrt(np.min(stated))) if len(stated) else 0.0


def _where_heading_is_known(errors: Errors, notes: list[str]) -> Errors:
    """Return errors without attitudes and body velocities of a heading that is searched for."""
    covariance = errors.estimate.attitude_cov
    if covariance is None:
        return errors
    unknown = covariance[:, 2, 2] >= HEADING_UNKNOWN**2
    left_out = np.count_nonzero(unknown & errors.scored)
    if left_out:
        notes.append(
            f"the heading was not known at {left_out} of {np.count_nonzero(errors.scored)} scored "
            f"epochs (its σ is {np.degrees(HEADING_UNKNOWN):.0f}° or more): attitude and velocity "
            "along the body's axes are not scored there"
        )

    def of_known(values: Array | None) -> Array | None:
        return None if values is None else np.where(unknown[:, None], np.nan, values)

    return replace(
        errors,
        velocity_base=of_known(errors.velocity_base),
        rotation_enu=of_known(errors.rotation_enu),
    )


def _accuracy(errors: Errors | None, heading_known: bool) -> dict[str, Any]:
    position = None if errors is None else errors.position_enu[errors.scored]
    velocity = None if errors is None else _scored(errors, errors.velocity_enu)
    of_body = None if errors is None else _scored(errors, errors.velocity_base)
    rotation = None if errors is None else _scored(errors, errors.rotation_enu)
    return {
        "prmse": _rms(position),
        "pmae": None if position is None else float(np.mean(np.sum(np.abs(position), axis=1))),
        "horizontal_rmse": _rms(position, slice(0, 2)),
        "vertical_rmse": _rms(position, slice(2, 3)),
        "largest_error": None
        if position is None
        else float(np.max(np.linalg.norm(position, axis=1))),
        "velocity_rmse": _rms(velocity),
        "body_velocity_rmse": _rms(of_body),
        "attitude_rmse": _rms(rotation) if heading_known else None,
        "heading_rmse": _rms(rotation, slice(2, 3)) if heading_known else None,
        "tilt_rmse": _rms(rotation, slice(0, 2)),
    }


def _scored(errors: Errors, values: Array | None) -> Array | None:
    """Return the finite rows of the scored epochs, None if there are none."""
    if values is None:
        return None
    values = values[errors.scored]
    values = values[np.isfinite(values).all(axis=1)]
    return values if len(values) else None


def _rms(values: Array | None, axes: slice = slice(None)) -> float | None:
    """Root mean square, over the epochs, of the length of each row; [1]_ eq. 25."""
    if values is None:
        return None
    return float(np.sqrt(np.mean(np.sum(values[:, axes] ** 2, axis=1))))


def _nees(errors: Errors | None, notes: list[str], heading_known: bool) -> dict[str, Any]:
    parts: dict[str, Any] = dict.fromkeys(("nees_position", "nees_velocity", "nees_attitude"))
    if errors is None:
        return parts
    for name, error, covariance in (
        ("position", errors.position_enu, errors.estimate.position_cov),
        ("velocity", errors.velocity_base, errors.estimate.velocity_cov),
        ("attitude", errors.rotation_enu, errors.estimate.attitude_cov),
    ):
        if error is None or covariance is None or (name == "attitude" and not heading_known):
            continue
        scored = errors.scored & np.isfinite(error).all(axis=1)
        values = nees(error[scored], covariance[scored])
        if np.any(np.isnan(values)):
            notes.append(
                f"the {name} covariance is not positive definite at {np.sum(np.isnan(values))} "
                f"of {len(values)} epochs: they have no NEES"
            )
        parts[f"nees_{name}"] = Consistency.of(values, error.shape[1])
    return parts


def _nis(verdicts: Verdicts, notes: list[str]) -> dict[str, Any]:
    def of(rows: Verdicts) -> Consistency | None:
        return Consistency.of(rows.nis, rows.dof, independent=True)

    positions = verdicts.rows(verdicts.kind == "position")
    rejected = Counter(positions.reason[~positions.accepted].tolist())
    tested = positions.rows(np.isfinite(positions.nis))
    if len(tested) and np.mean(~tested.accepted) > 0.01:
        notes.append(
            f"{100 * np.mean(~tested.accepted):.1f} % of the tested fixes were rejected: the NIS "
            "of the accepted ones alone is too favourable"
        )
    accepted = of(tested.rows(tested.accepted))
    if accepted is not None and accepted.effective_count < _WHITE * accepted.count:
        notes.append(
            f"successive NIS values are correlated ({accepted.count} are equivalent to "
            f"{accepted.effective_count:.0f}), those of a consistent filter are not: check clock "
            "offset, lever arm and slow errors of the receiver"
        )
    return {
        "nis_position": accepted,
        "nis_velocity": of(verdicts.rows((verdicts.kind == "velocity") & verdicts.accepted)),
        "nis_tested": of(tested),
        "fixes": FixCount(
            len(positions), int(np.sum(positions.accepted)), dict(rejected.most_common())
        )
        if len(positions)
        else None,
    }


def _outages(
    errors: Errors | None, estimate: Trajectory, fused_ns: Stamps, origin_ns: int, at_least: float
) -> tuple[Outage, ...]:
    """Find the outages, the errors within them, and the last one before the next fix is fused."""
    outages = []
    for start_ns, end_ns in outage_spans(fused_ns, int(estimate.stamp_ns[-1]) + 1, at_least):
        outage = Outage((start_ns - origin_ns) * 1e-9, (end_ns - start_ns) * 1e-9)
        if errors is not None:
            # The estimate at the stamp of the next fix already includes that fix.
            last = estimate.stamp_ns[max(int(np.searchsorted(estimate.stamp_ns, end_ns)) - 1, 0)]
            usable = (errors.stamp_ns > start_ns) & (errors.stamp_ns <= last)
            usable &= np.isfinite(errors.position_enu).all(axis=1)
            usable &= errors.stamp_ns >= errors.stamp_ns[errors.scored][0]
            inside = errors.position_enu[usable]
            if len(inside):
                outage = replace(
                    outage,
                    end_error=float(np.linalg.norm(inside[-1])),
                    end_horizontal_error=float(np.linalg.norm(inside[-1, :2])),
                    largest_error=float(np.max(np.linalg.norm(inside, axis=1))),
                )
        outages.append(outage)
    return tuple(outages)


def outage_spans(fused_ns: Stamps, end_ns: int, at_least: float) -> list[tuple[int, int]]:
    """
    Return the intervals without a fused fix, first and last stamp of each [ns].

    Parameters
    ----------
    fused_ns : ndarray, shape (N,)
        Sorted stamps of the fused fixes.
    end_ns
        End of the run, at which the last outage may end.
    at_least
        Shortest outage [s]; it must also exceed three times the usual fix interval.

    """
    if not len(fused_ns):
        return []
    interval_ns = float(np.median(np.diff(fused_ns))) if len(fused_ns) > 1 else 0.0
    marks_ns = np.append(fused_ns, max(end_ns, int(fused_ns[-1])))
    long = np.flatnonzero(np.diff(marks_ns) > max(1e9 * at_least, 3.0 * interval_ns))
    return [(int(marks_ns[i]), int(marks_ns[i + 1])) for i in long]
