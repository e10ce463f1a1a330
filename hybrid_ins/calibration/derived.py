"""What follows from the states of the fitted filter: IMU mount, biases."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.calibration.filter_pass import FilterPass
from hybrid_ins.calibration.recording import Recording
from hybrid_ins.core.inertial import state
from hybrid_ins.core.inertial.rotations import (
    matrix_from_quat,
    quat_conjugate,
    quat_from_matrix,
    quat_multiply,
    rotvec_from_quat,
    slerp,
)

Array = NDArray[np.float64]

REPEATABILITY = 0.03, 1e-3  # m/s², rad/s: prior of the biases' change from start to start
PRIOR_STARTS = 2.0  # number of recordings to which this prior is equivalent


def mean_rotation(quats_xyzw: Array) -> tuple[Array, float]:
    """Return the mean of rotations (K, 4) as a matrix, and their RMS distance from it [rad]."""
    M = np.mean(matrix_from_quat(quats_xyzw), axis=0)
    u, _, vt = np.linalg.svd(M)
    C = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    away = rotvec_from_quat(quat_from_matrix(matrix_from_quat(quats_xyzw) @ C.T))
    return C, float(np.sqrt(np.mean(np.sum(away**2, axis=-1))))


def rotations_to_truth(recording: Recording, after: FilterPass) -> Array | None:
    """Return rotations (K, 4) from b of the samples to b of the truth, where both are known."""
    if recording.attitude is None:
        return None
    t, quats = recording.attitude
    known = np.isfinite(after.nis) & (_heading_std(after) < math.radians(3.0))
    known &= (recording.aid_t > t[0]) & (recording.aid_t < t[-1])
    if not np.any(known):
        return None
    at = recording.aid_t[known]
    right = np.clip(np.searchsorted(t, at), 1, len(t) - 1)
    fraction = (at - t[right - 1]) / (t[right] - t[right - 1])
    truth = slerp(quats[right - 1], quats[right], fraction)
    return quat_multiply(quat_conjugate(truth), after.states[known][:, state.QUAT])


def courses(after: FilterPass) -> Array:
    """Return the directions of travel about the down axis of b [rad], where they are known."""
    known = np.isfinite(after.nis) & (_heading_std(after) < math.radians(5.0))
    rows = after.states[known]
    C_nb = matrix_from_quat(rows[:, state.QUAT])
    velocity_b = np.einsum("kji,kj->ki", C_nb, rows[:, state.VELOCITY])
    velocity_b = velocity_b[np.hypot(velocity_b[:, 0], velocity_b[:, 1]) > 1.0]
    angles: Array = np.arctan2(velocity_b[:, 1], velocity_b[:, 0])
    return angles


class Travel(NamedTuple):
    """The direction in which a vehicle travels, forward or backward, about the down axis of b."""

    angle: float  # rad, of what it does most of the time
    spread: float  # rad, root of the mean square
    backward: float  # share of the time


def travel(angles: Array) -> Travel:
    """Return the axis of directions of travel (K,) [rad], K > 0: those of a reverse are turned."""
    angle = 0.5 * float(np.angle(np.mean(np.exp(2j * angles))))
    away = np.angle(np.exp(1j * (angles - angle)))
    backward = float(np.mean(np.abs(away) > 0.5 * np.pi))
    spread = math.sqrt(float(np.mean(np.minimum(np.abs(away), np.pi - np.abs(away)) ** 2)))
    if backward > 0.5:
        return Travel(math.remainder(angle + math.pi, 2.0 * math.pi), spread, 1.0 - backward)
    return Travel(angle, spread, backward)


def next_biases(after: Sequence[FilterPass]) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """
    Predict the biases at the next start of the same IMU.

    Every recording gives the biases at its end with the filter's uncertainty. Their variance from
    start to start is estimated from the recordings by the method of moments, together with its
    prior ``REPEATABILITY``.

    Returns
    -------
    (bias_a, std_a), (bias_g, std_g)
        Means and standard deviations, shape (3,) each, b [m/s², rad/s].
    """
    last = [one.states[np.isfinite(one.nis)][-1] for one in after]
    variances = np.array([row[state.COVARIANCE][state.DIAGONAL[9:15]] for row in last])
    found = []
    for part, axes, repeatability in (
        (state.BIAS_A, slice(0, 3), REPEATABILITY[0]),
        (state.BIAS_G, slice(3, 6), REPEATABILITY[1]),
    ):
        bias = np.array([row[part] for row in last])
        weight = 1.0 / variances[:, axes]
        mean = np.sum(weight * bias, axis=0) / np.sum(weight, axis=0)
        excess = np.sum(np.maximum((bias - mean) ** 2 - variances[:, axes], 0.0), axis=0)
        between = (PRIOR_STARTS * repeatability**2 + excess) / (PRIOR_STARTS + len(last) - 1)
        weight = 1.0 / (variances[:, axes] + between)
        mean = np.sum(weight * bias, axis=0) / np.sum(weight, axis=0)
        found.append((mean, np.sqrt(between + 1.0 / np.sum(weight, axis=0))))
    return found[0], found[1]


def _heading_std(after: FilterPass) -> Array:
    std: Array = np.sqrt(after.states[:, state.COVARIANCE][:, state.DIAGONAL[8]])
    return std
