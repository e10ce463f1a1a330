"""
ins_evaluate: how far the estimate is from the truth, and whether it knows.

`evaluate` is pure: tracks in, a frozen `Result` out. Calibration, field experiments and Monte
Carlo runs call it with arrays; the program around it reads bags and prints.

References
----------
.. [1] B. Or, I. Klein, *A Hybrid Model and Learning-Based Adaptive Navigation Filter*, IEEE TIM
       71, 2022: eq. 25 (PRMSE), eq. 26 (PMAE).
.. [2] Y. Bar-Shalom, X. R. Li, T. Kirubarajan, *Estimation with Applications to Tracking and
       Navigation*, 2001, section 5.4 (NEES and NIS).
"""

from __future__ import annotations

import argparse
import json
import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.cli import batch, options, program
from hybrid_ins.core import rotations
from hybrid_ins.errors import InputError
from hybrid_ins.evaluation import report
from hybrid_ins.evaluation.result import (
    Epochs,
    Errors,
    FixCount,
    Outage,
    Result,
    Scoring,
    TimeOffset,
)
from hybrid_ins.evaluation.run_reader import Recording, Topics, Verdicts, read_recording
from hybrid_ins.evaluation.statistics import Consistency, nees
from hybrid_ins.plotting import run
from hybrid_ins.ros.trajectory import Array, Stamps, Trajectory

_SAME_EPOCH_NS = 100_000  # stamps of one epoch may differ by the rounding of float seconds
_LOW_COVERAGE = 0.95
_FEW_EPOCHS = 10


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
        Stamps in the reference clock. In the estimate's map; where both datums are known and
        differ it is moved there. None: only the verdicts are judged.
    fix_stamp_ns : ndarray, shape (K,), optional
        Stamps of the position fixes (reference clock). Truth epochs at these stamps are not
        scored; without verdicts they all count as accepted.
    verdicts : Verdicts, optional
        What the filter did with the fixes.
    scoring : Scoring, optional
        What counts.

    Returns
    -------
    Result

    Raises
    ------
    InputError
        Nothing can be scored: no common time, everything skipped, fed or not finite.

    """
    scoring = scoring or Scoring()
    verdicts = Verdicts.of(()) if verdicts is None else verdicts
    positions = verdicts.rows(verdicts.kind == "position")
    fix_ns = np.union1d(
        np.empty(0, np.int64) if fix_stamp_ns is None else fix_stamp_ns, positions.stamp_ns
    )
    estimate, _ = estimate.in_order()
    if len(estimate) < 2:
        raise InputError("the estimate has fewer than two messages: nothing to interpolate")
    clock = _Clock(scoring.time_offset, verdicts)
    notes: list[str] = []

    if truth is None:
        origin_ns = int(estimate.stamp_ns[0])
        window = (
            _after(origin_ns, max(scoring.start or 0.0, scoring.skip)),
            int(estimate.stamp_ns[-1]) if scoring.end is None else _after(origin_ns, scoring.end),
        )
        errors, epochs, coverage = None, None, None
        gap_between = estimate.stamp_ns
        offset = clock.summary(fix_ns)
    else:
        truth, _ = truth.in_order()
        if not len(truth):
            raise InputError("the truth is empty")
        if estimate.datum_lla is not None and truth.datum_lla is not None:
            truth = truth.in_map_of(estimate.datum_lla)
        truth_imu_ns = clock.to_imu(truth.stamp_ns)
        origin_ns = int(truth_imu_ns[0])
        errors, epochs, coverage, notes = _errors(estimate, truth, truth_imu_ns, fix_ns, scoring)
        scored_ns = errors.stamp_ns[errors.scored]
        window = int(scored_ns[0]), int(scored_ns[-1])
        covered = (estimate.stamp_ns >= truth_imu_ns[0]) & (estimate.stamp_ns <= truth_imu_ns[-1])
        gap_between = estimate.stamp_ns[covered]
        offset = clock.summary(truth.stamp_ns)
        if not len(fix_ns):
            notes.append("no fixes in the bag: epochs that were fed to the filter count, too")

    judged_ns = clock.to_imu(verdicts.stamp_ns)
    judged = verdicts.rows((judged_ns >= window[0]) & (judged_ns <= window[1]))
    fused_ns = positions.stamp_ns[positions.accepted] if len(positions) else fix_ns
    return Result(
        origin_ns,
        scoring,
        epochs,
        coverage,
        float(np.max(np.diff(gap_between), initial=0)) * 1e-9,
        offset,
        **_accuracy(errors),
        **_nees(errors, notes),
        **_nis(judged, notes),
        outages=_outages(errors, estimate, clock.to_imu(fused_ns), origin_ns, scoring.outage_gap),
        notes=tuple(notes),
        errors=errors,
    )


def evaluate_recording(recording: Recording, scoring: Scoring | None = None) -> Result:
    """Evaluate a run as read from its bags; what the reading left out goes to the notes."""
    estimate, truth = recording.estimate, recording.truth
    notes = list(recording.notes)
    if truth is not None and (estimate.datum_lla is None) != (truth.datum_lla is None):
        missing = "estimate's" if estimate.datum_lla is None else "truth's"
        notes.append(f"the {missing} datum is not in the bag: both maps are taken as the same")
    result = evaluate(
        estimate,
        truth,
        fix_stamp_ns=recording.fixes.stamp_ns,
        verdicts=recording.verdicts,
        scoring=scoring,
    )
    return replace(result, notes=(*result.notes, *notes))


class _Clock:
    """Brings stamps of the reference clock (truth, fixes) to the IMU clock."""

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


def _errors(
    estimate: Trajectory, truth: Trajectory, truth_imu_ns: Stamps, fix_ns: Stamps, scoring: Scoring
) -> tuple[Errors, Epochs, float, list[str]]:
    """Match truth epochs with the estimate and decide which are scored."""
    inside = np.ones(len(truth), bool)
    if scoring.start is not None:
        inside &= truth_imu_ns >= _after(truth_imu_ns[0], scoring.start)
    if scoring.end is not None:
        inside &= truth_imu_ns <= _after(truth_imu_ns[0], scoring.end)
    if not np.any(inside):
        lasts = (truth_imu_ns[-1] - truth_imu_ns[0]) * 1e-9
        raise InputError(f"no truth between --start and --end: it lasts {lasts:.1f} s")
    gap_ns = estimate.bracket_ns(truth_imu_ns)
    reached = inside & (gap_ns >= 0)
    if not np.any(reached):
        raise InputError(_no_overlap(estimate.stamp_ns, truth_imu_ns[inside]))
    covered = reached & (gap_ns <= 1e9 * scoring.max_gap)
    if not np.any(covered):
        raise InputError(
            f"the estimates are {np.min(gap_ns[reached]) * 1e-9:.3g} s apart or more, too far to "
            f"interpolate over {scoring.max_gap:g} s: raise --max-gap"
        )
    there = truth.rows(covered)
    stamp_ns = truth_imu_ns[covered]
    here = estimate.at(stamp_ns)
    position = there.position_enu - here.position_enu
    valid = np.asarray(np.isfinite(position).all(axis=1))
    late = stamp_ns >= _after(stamp_ns[0], scoring.skip)
    fed = np.zeros(len(there), bool) if scoring.include_fed else _near(there.stamp_ns, fix_ns)
    scored = valid & late & ~fed
    if not np.any(scored):
        raise InputError(_nothing_scored(valid, late, fed, scoring))

    errors = Errors(
        stamp_ns,
        scored,
        position,
        _difference(there.velocity_enu, here.velocity_enu),
        _difference(there.velocity_base, here.velocity_base),
        _rotation(there.quat_xyzw, here.quat_xyzw),
        here,
        there,
    )
    epochs = Epochs(
        truth=int(np.sum(inside)),
        scored=int(np.sum(scored)),
        fed=int(np.sum(valid & late & fed)),
        skipped=int(np.sum(valid & ~late)),
        uncovered=int(np.sum(inside & ~covered)),
        invalid=int(np.sum(~valid)),
    )
    coverage = float(np.sum(covered) / np.sum(inside))
    notes = _coverage_notes(estimate, truth_imu_ns[inside], coverage, epochs)
    return errors, epochs, coverage, notes


def _coverage_notes(
    estimate: Trajectory, truth_ns: Stamps, coverage: float, epochs: Epochs
) -> list[str]:
    notes = []
    if coverage < _LOW_COVERAGE:
        late = (estimate.stamp_ns[0] - truth_ns[0]) * 1e-9
        early = (truth_ns[-1] - estimate.stamp_ns[-1]) * 1e-9
        where = [f"it begins {late:.1f} s late"] if late > 0 else []
        where += [f"it ends {early:.1f} s early"] if early > 0 else []
        notes.append(
            f"the estimate covers only {100 * coverage:.1f} % of the truth: "
            + (" and ".join(where) if where else "it has gaps")
        )
    if epochs.scored < _FEW_EPOCHS:
        notes.append(f"only {epochs.scored} epochs scored: the figures mean little")
    return notes


def _no_overlap(estimate_ns: Stamps, truth_ns: Stamps) -> str:
    def span(stamp_ns: Stamps) -> str:
        return f"{stamp_ns[0] * 1e-9:.3f} to {stamp_ns[-1] * 1e-9:.3f} s"

    return (
        f"estimate ({span(estimate_ns)}) and truth ({span(truth_ns)}) have no time in common: "
        "other flights, or other clocks (--time-offset)"
    )


def _nothing_scored(
    valid: NDArray[np.bool_], late: NDArray[np.bool_], fed: NDArray[np.bool_], scoring: Scoring
) -> str:
    if not np.any(valid):
        return "no epoch has a finite position in both truth and estimate"
    if not np.any(valid & late):
        return f"nothing is left to score after skipping {scoring.skip:g} s (--skip)"
    return (
        f"all {np.sum(valid & late & fed)} truth epochs lie at fix stamps, so the filter was fed "
        "with them: score them all the same with --include-fed"
    )


def _near(stamp_ns: Stamps, marks_ns: Stamps) -> NDArray[np.bool_]:
    """Tell which stamps coincide with one of the marks (sorted)."""
    first = np.searchsorted(marks_ns, stamp_ns - _SAME_EPOCH_NS, side="left")
    last = np.searchsorted(marks_ns, stamp_ns + _SAME_EPOCH_NS, side="right")
    return last > first


def _difference(true: Array | None, estimated: Array | None) -> Array | None:
    return None if true is None or estimated is None else true - estimated


def _rotation(true_xyzw: Array | None, estimated_xyzw: Array | None) -> Array | None:
    """Misalignment about the map axes: C_true = (I - [eps x]) C_estimated."""
    if true_xyzw is None or estimated_xyzw is None:
        return None
    return rotations.rotvec_from_quat(
        rotations.quat_multiply(estimated_xyzw, rotations.quat_conjugate(true_xyzw))
    )


def _accuracy(errors: Errors | None) -> dict[str, Any]:
    position = None if errors is None else errors.position_enu[errors.scored]
    velocity = None if errors is None else _scored(errors, errors.velocity_enu)
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
        "attitude_rmse": _rms(rotation),
        "heading_rmse": _rms(rotation, slice(2, 3)),
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
    """Root of the mean over epochs of the squared length; [1]_ eq. 25."""
    if values is None:
        return None
    return float(np.sqrt(np.mean(np.sum(values[:, axes] ** 2, axis=1))))


def _nees(errors: Errors | None, notes: list[str]) -> dict[str, Any]:
    parts: dict[str, Any] = dict.fromkeys(("nees_position", "nees_velocity", "nees_attitude"))
    if errors is None:
        return parts
    for name, error, covariance in (
        ("position", errors.position_enu, errors.estimate.position_cov),
        ("velocity", errors.velocity_base, errors.estimate.velocity_cov),
        ("attitude", errors.rotation_enu, errors.estimate.attitude_cov),
    ):
        if error is None or covariance is None:
            continue
        there = errors.scored & np.isfinite(error).all(axis=1)
        values = nees(error[there], covariance[there])
        if np.any(np.isnan(values)):
            notes.append(
                f"the {name} covariance is not positive definite at {np.sum(np.isnan(values))} "
                f"of {len(values)} epochs: no NEES there"
            )
        parts[f"nees_{name}"] = Consistency.of(values, error.shape[1])
    return parts


def _nis(judged: Verdicts, notes: list[str]) -> dict[str, Any]:
    def of(rows: Verdicts) -> Consistency | None:
        return Consistency.of(rows.nis, rows.dof)

    positions = judged.rows(judged.kind == "position")
    refused = Counter(positions.reason[~positions.accepted].tolist())
    tested = positions.rows(np.isfinite(positions.nis))
    if len(tested) and np.mean(~tested.accepted) > 0.01:
        notes.append(
            f"{100 * np.mean(~tested.accepted):.1f} % of the tested fixes were refused: the NIS of "
            "the accepted ones alone looks better than the filter is"
        )
    return {
        "nis_position": of(tested.rows(tested.accepted)),
        "nis_velocity": of(judged.rows((judged.kind == "velocity") & judged.accepted)),
        "nis_tested": of(tested),
        "fixes": FixCount(
            len(positions), int(np.sum(positions.accepted)), dict(refused.most_common())
        )
        if len(positions)
        else None,
    }


def _outages(
    errors: Errors | None, estimate: Trajectory, fused_ns: Stamps, origin_ns: int, at_least: float
) -> tuple[Outage, ...]:
    """Find stretches without accepted fixes, and the error just before the next fix is fused."""
    outages = []
    for start_ns, end_ns in outage_spans(fused_ns, int(estimate.stamp_ns[-1]) + 1, at_least):
        outage = Outage((start_ns - origin_ns) * 1e-9, (end_ns - start_ns) * 1e-9)
        if errors is not None:
            # The estimate at the returning fix's stamp already contains it.
            last = estimate.stamp_ns[max(int(np.searchsorted(estimate.stamp_ns, end_ns)) - 1, 0)]
            usable = (errors.stamp_ns > start_ns) & (errors.stamp_ns <= last)
            usable &= np.isfinite(errors.position_enu).all(axis=1)
            usable &= errors.stamp_ns >= errors.stamp_ns[errors.scored][0]
            for error in errors.position_enu[usable][-1:]:
                outage = replace(
                    outage,
                    end_error=float(np.linalg.norm(error)),
                    end_horizontal_error=float(np.linalg.norm(error[:2])),
                )
        outages.append(outage)
    return tuple(outages)


def outage_spans(fused_ns: Stamps, end_ns: int, at_least: float) -> list[tuple[int, int]]:
    """
    Stretches of time without a fused fix.

    Parameters
    ----------
    fused_ns : ndarray, shape (N,)
        Sorted stamps of the fused fixes.
    end_ns
        End of the run: a last outage may last until here.
    at_least
        Shortest outage [s]; it must also exceed three times the usual fix interval.

    """
    if not len(fused_ns):
        return []
    interval_ns = float(np.median(np.diff(fused_ns))) if len(fused_ns) > 1 else 0.0
    marks_ns = np.append(fused_ns, max(end_ns, int(fused_ns[-1])))
    long = np.flatnonzero(np.diff(marks_ns) > max(1e9 * at_least, 3.0 * interval_ns))
    return [(int(marks_ns[i]), int(marks_ns[i + 1])) for i in long]


def _after(origin_ns: int, seconds: float) -> int:
    return int(origin_ns) + round(1e9 * seconds)


DESCRIPTION = """\
Compare an estimate with the truth: PRMSE and PMAE, velocity and attitude RMSE, whether the filter's
covariances are right (NEES, NIS with their 95 % bands), and the error at the end of outages.

The estimate is interpolated to the truth's epochs. Truth epochs at the stamp of a fix are not
scored: the filter was fed with them. Truth and GNSS share a clock; the offset to the IMU's clock is
taken from gnss/verdict. The bags' datums may differ. Without --skip, scoring begins with the first
estimate: the filter publishes none before it is aligned."""

EXAMPLE = "ins_evaluate flight_estimate --truth flight.mcap --plot flight.png"


def main(argv: Sequence[str] | None = None) -> int:
    """Run the program ``ins_evaluate``."""
    parser = program.parser("ins_evaluate", DESCRIPTION, EXAMPLE)
    parser.add_argument(
        "estimate", metavar="EST", type=Path, nargs="+",
        help="bag with the filter's output; several, or a folder of bags",
    )  # fmt: skip
    parser.add_argument("--truth", metavar="BAG", type=Path, help="bag with truth (default EST)")
    parser.add_argument(
        "--no-truth", action="store_true", help="only NIS, fixes and the picture: a flight as it is"
    )
    parser.add_argument("--json", action="store_true", help="print JSON instead of the table")
    parser.add_argument("--plot", metavar="FILE", type=Path, help="write a picture, .png or .svg")
    parser.add_argument(
        "--report", metavar="FILE", type=Path,
        help="write an HTML file: the usual questions answered, picture and table",
    )  # fmt: skip

    defaults = Scoring()
    scoring = parser.add_argument_group("what is scored")
    scoring.add_argument(
        "--skip", metavar="S", type=options.not_negative, default=defaults.skip,
        help="do not score the first S seconds with an estimate (default %(default)s)",
    )  # fmt: skip
    scoring.add_argument(
        "--start", metavar="S", type=options.not_negative,
        help="begin S seconds after the first truth epoch",
    )  # fmt: skip
    scoring.add_argument(
        "--end", metavar="S", type=options.not_negative,
        help="end S seconds after the first truth epoch",
    )  # fmt: skip
    scoring.add_argument(
        "--include-fed", action="store_true", help="score truth epochs at fix stamps, too"
    )
    scoring.add_argument(
        "--time-offset", metavar="S", type=options.number,
        help="seconds to add to truth and fix stamps (default: as in gnss/verdict, else 0)",
    )  # fmt: skip
    scoring.add_argument(
        "--max-gap", metavar="S", type=options.not_negative, default=defaults.max_gap,
        help="longest gap between estimates to interpolate over (default %(default)s)",
    )  # fmt: skip
    scoring.add_argument(
        "--outage-gap", metavar="S", type=options.not_negative, default=defaults.outage_gap,
        help="time without an accepted fix that counts as outage (default %(default)s)",
    )  # fmt: skip

    batch.add_options(parser).add_argument(
        "--results", metavar="DIR", type=Path,
        help="keep what is found of each bag there: the same command again does only what is new",
    )  # fmt: skip

    names = parser.add_argument_group("topics")
    topics = Topics()
    for option, default in (
        ("--odometry", topics.odometry),
        ("--truth-topic", topics.truth),
        ("--fix", topics.fix),
        ("--verdict", topics.verdict),
    ):
        names.add_argument(option, metavar="TOPIC", default=default, help="default %(default)s")
    return program.run(_run, parser.parse_args(argv))


def _run(args: argparse.Namespace) -> int:
    if args.plot is not None:
        run.check(args.plot)
    if args.report is not None:
        report.check(args.report)
    if args.no_truth and args.truth is not None:
        raise InputError("--truth and --no-truth exclude each other")
    topics = Topics(
        odometry=args.odometry, truth=args.truth_topic, fix=args.fix, verdict=args.verdict
    )
    scoring = Scoring(
        args.skip,
        args.start,
        args.end,
        args.time_offset,
        args.include_fed,
        args.max_gap,
        args.outage_gap,
    )
    if len(args.estimate) > 1 or not batch.is_bag(args.estimate[0]):
        if args.truth or args.json or args.plot or args.report:
            raise InputError("--truth, --json, --plot and --report are for one bag at a time")
        settings = {"topics": vars(topics), "scoring": vars(scoring), "no_truth": args.no_truth}
        work = partial(_evaluate_one, topics, scoring, args.no_truth)
        return batch.run(args, batch.find_jobs(args.estimate, args.results), work, settings)
    [path] = args.estimate
    recording = _read(path, args.truth, topics, args.no_truth)
    result = evaluate_recording(recording, scoring)
    if args.json:
        bags = {"estimate": str(path), "truth": str(args.truth or path)}
        print(json.dumps({**bags, **_finite_only(result.as_dict())}, indent=2, allow_nan=False))
    else:
        print(result.table())
    if args.plot is not None:
        run.save(run.overview(recording, result), args.plot)
        if not args.json:
            print(f"picture: {args.plot}")
    if args.report is not None:
        args.report.write_text(report.page(recording, result), encoding="utf-8")
        if not args.json:
            print(f"report: {args.report}")
    return 0


def draw(path: Path, picture: Path) -> None:
    """
    Draw the run in a bag, against its truth where that can be scored.

    Raises
    ------
    InputError
        The bag holds no estimate, or no picture can be written.

    """
    recording = read_recording(path)
    try:
        result = evaluate_recording(recording)
    except InputError:  # too short a common time, all epochs fed: a picture all the same
        recording = replace(recording, truth=None)
        result = evaluate_recording(recording)
    run.save(run.overview(recording, result), picture)


def _read(path: Path, truth: Path | None, topics: Topics, no_truth: bool) -> Recording:
    recording = read_recording(path, truth, topics)
    if no_truth:
        return replace(recording, truth=None)
    if recording.truth is None:
        raise InputError(
            f"{path}: no truth on {topics.truth}: give its bag with --truth, or look at the filter "
            "alone with --no-truth"
        )
    return recording


def _evaluate_one(
    topics: Topics, scoring: Scoring, no_truth: bool, job: batch.Job
) -> dict[str, Any]:
    """Evaluate one bag of many."""
    result = evaluate_recording(_read(job.source, None, topics, no_truth), scoring)
    degrees = None if result.heading_rmse is None else math.degrees(result.heading_rmse)
    means = {
        f"{name} {part}": None if consistency is None else consistency.mean
        for name, part, consistency in (
            ("NEES", "position", result.nees_position),
            ("NIS", "position", result.nis_position),
        )
    }
    return {
        "PRMSE [m]": result.prmse,
        "PMAE [m]": result.pmae,
        "velocity [m/s]": result.velocity_rmse,
        "heading [deg]": degrees,
        **means,
        "coverage": result.coverage,
        "outages": len(result.outages),
    }


def _finite_only(value: Any) -> Any:
    """Replace NaN and infinity, which JSON does not know, by null."""
    if isinstance(value, dict):
        return {key: _finite_only(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite_only(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
