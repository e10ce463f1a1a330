"""Matches the truth with the estimate, epoch by epoch, and selects the epochs to score."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.inertial import rotations
from hybrid_ins.errors import InputError
from hybrid_ins.evaluation.result import Epochs, Errors, Scoring
from hybrid_ins.ros.messages.trajectory import Array, Stamps, Trajectory

_SAME_EPOCH_NS = 100_000  # stamps of one epoch may differ by the rounding of float seconds
_LOW_COVERAGE = 0.95
_FEW_EPOCHS = 10


def after(origin_ns: int, seconds: float) -> int:
    """Return the stamp `seconds` after another one [ns]."""
    return int(origin_ns) + round(1e9 * seconds)


def match(
    estimate: Trajectory, truth: Trajectory, truth_imu_ns: Stamps, fix_ns: Stamps, scoring: Scoring
) -> tuple[Errors, Epochs, float, list[str]]:
    """
    Compute the errors at the epochs of the truth and select those to score.

    Parameters
    ----------
    estimate, truth : Trajectory
        In one map, in the order of their stamps.
    truth_imu_ns : ndarray, shape (N,)
        Stamps of the truth, IMU clock.
    fix_ns : ndarray, shape (K,)
        Sorted stamps of the position fixes, in the clock of the truth's stamps.
    scoring : Scoring

    Returns
    -------
    errors : Errors
        At all epochs that the estimate covers.
    epochs : Epochs
        Their counts.
    coverage : float
        Share of the truth epochs that the estimate covers.
    notes : list of str
        What the user should know about the coverage.

    Raises
    ------
    InputError
        There is no epoch to score.

    """
    inside = np.ones(len(truth), bool)
    if scoring.start is not None:
        inside &= truth_imu_ns >= after(truth_imu_ns[0], scoring.start)
    if scoring.end is not None:
        inside &= truth_imu_ns <= after(truth_imu_ns[0], scoring.end)
    if not np.any(inside):
        duration = (truth_imu_ns[-1] - truth_imu_ns[0]) * 1e-9
        raise InputError(f"no truth between --start and --end: it lasts {duration:.1f} s")
    gap_ns = estimate.bracket_ns(truth_imu_ns)
    reached = inside & (gap_ns >= 0)
    if not np.any(reached):
        raise InputError(_no_overlap(estimate.stamp_ns, truth_imu_ns[inside]))
    covered = reached & (gap_ns <= 1e9 * scoring.max_gap)
    if not np.any(covered):
        raise InputError(
            f"the estimates are at least {np.min(gap_ns[reached]) * 1e-9:.3g} s apart, more than "
            f"the {scoring.max_gap:g} s to interpolate over: raise --max-gap"
        )
    true = truth.rows(covered)
    stamp_ns = truth_imu_ns[covered]
    estimated = estimate.at(stamp_ns)
    position = true.position_enu - estimated.position_enu
    valid = np.asarray(np.isfinite(position).all(axis=1))
    late = stamp_ns >= after(stamp_ns[0], scoring.skip)
    fed = np.zeros(len(true), bool) if scoring.include_fed else _near(true.stamp_ns, fix_ns)
    scored = valid & late & ~fed
    if not np.any(scored):
        raise InputError(_nothing_scored(valid, late, fed, scoring))

    errors = Errors(
        stamp_ns,
        scored,
        position,
        _difference(true.velocity_enu, estimated.velocity_enu),
        _difference(true.velocity_base, estimated.velocity_base),
        _misalignment(true.quat_xyzw, estimated.quat_xyzw),
        estimated,
        true,
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
    in_gaps = float(np.sum(reached & ~covered) / np.sum(inside))
    notes = _coverage_notes(estimate, truth_imu_ns[inside], coverage, in_gaps, scoring.max_gap)
    if epochs.scored < _FEW_EPOCHS:
        notes.append(f"only {epochs.scored} epochs scored: too few for reliable figures")
    return errors, epochs, coverage, notes


def _coverage_notes(
    estimate: Trajectory, truth_ns: Stamps, coverage: float, in_gaps: float, max_gap: float
) -> list[str]:
    """Return why the estimate covers few epochs of the truth, with the shares of them."""
    if coverage >= _LOW_COVERAGE:
        return []
    late = (estimate.stamp_ns[0] - truth_ns[0]) * 1e-9
    early = (truth_ns[-1] - estimate.stamp_ns[-1]) * 1e-9
    where = [f"it begins {late:.1f} s late"] if late > 0 else []
    where += [f"it ends {early:.1f} s early"] if early > 0 else []
    if in_gaps:
        where.append(f"{100 * in_gaps:.1f} % lie in gaps of more than {max_gap:g} s (--max-gap)")
    return [f"the estimate covers only {100 * coverage:.1f} % of the truth: {' and '.join(where)}"]


def _no_overlap(estimate_ns: Stamps, truth_ns: Stamps) -> str:
    def span(stamp_ns: Stamps) -> str:
        return f"{stamp_ns[0] * 1e-9:.3f} to {stamp_ns[-1] * 1e-9:.3f} s"

    return (
        f"estimate ({span(estimate_ns)}) and truth ({span(truth_ns)}) have no time in common: "
        "are they of one flight, and of one clock (--time-offset)?"
    )


def _nothing_scored(
    valid: NDArray[np.bool_], late: NDArray[np.bool_], fed: NDArray[np.bool_], scoring: Scoring
) -> str:
    if not np.any(valid):
        return "no epoch has a finite position in both truth and estimate"
    if not np.any(valid & late):
        return f"no epoch is left to score after the first {scoring.skip:g} s (--skip)"
    return (
        f"all {np.sum(valid & late & fed)} truth epochs are at fix stamps, where the filter was "
        "given the position: score them nevertheless with --include-fed"
    )


def _near(stamp_ns: Stamps, marks_ns: Stamps) -> NDArray[np.bool_]:
    """Return which stamps coincide with one of the sorted marks."""
    first = np.searchsorted(marks_ns, stamp_ns - _SAME_EPOCH_NS, side="left")
    last = np.searchsorted(marks_ns, stamp_ns + _SAME_EPOCH_NS, side="right")
    return last > first


def _difference(true: Array | None, estimated: Array | None) -> Array | None:
    return None if true is None or estimated is None else true - estimated


def _misalignment(true_xyzw: Array | None, estimated_xyzw: Array | None) -> Array | None:
    """Return eps (N, 3) about the map axes: C_true = (I - [eps x]) C_estimated."""
    if true_xyzw is None or estimated_xyzw is None:
        return None
    return rotations.rotvec_from_quat(
        rotations.quat_multiply(estimated_xyzw, rotations.quat_conjugate(true_xyzw))
    )
