"""
What an ideal IMU would have read on a track: smoothed runs of one's own robot as baselines.

The paper's data set adds noise of known variance to the readings of trajectories that are known
exactly (section III-B). A smoothed run is such a trajectory: its velocity and attitude,
differentiated over ``SPAN``, give readings without noise and vibration. Earth rate and Coriolis
force, constant within a window, are left out.
"""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.signal import savgol_filter

from hybrid_ins.core.inertial.earth import normal_gravity
from hybrid_ins.core.inertial.rotations import (
    matrix_from_quat,
    quat_conjugate,
    quat_multiply,
    rotvec_from_quat,
)
from hybrid_ins.errors import InputError
from hybrid_ins.evaluation.run_reader import read_run
from hybrid_ins.ros.messages.trajectory import Trajectory

Array = NDArray[np.float64]

SPAN = 0.5  # s, over which velocity and attitude are differentiated (by a cubic)
LONGEST_GAP_NS = 100_000_000
SHORTEST = 10.0  # s of a track without a gap


def track_readings(bag: Path, rate_hz: float) -> list[Array]:
    """
    Return the noise-free IMU of the track in a bag, a table for each stretch without a gap.

    Parameters
    ----------
    bag : Path
        Written by ``ins_replay --smooth``.
    rate_hz : float
        Of the readings [Hz].

    Returns
    -------
    list of ndarray, shape (N, 6)
        Specific force [m/s²], then angular rate [rad/s], FLU.

    Raises
    ------
    InputError
        There is no track of ``SHORTEST``.
    """
    track = read_run(bag).estimate
    if track.quat_xyzw is None or track.velocity_enu is None:
        raise InputError(f"{bag}: the track has no attitude or velocity: use ins_replay --smooth")
    cuts = np.flatnonzero(np.diff(track.stamp_ns) > LONGEST_GAP_NS) + 1
    bounds = [0, *cuts.tolist(), len(track)]
    parts = [track.rows(slice(a, b)) for a, b in pairwise(bounds)]
    long = [p for p in parts if len(p) and p.stamp_ns[-1] - p.stamp_ns[0] > SHORTEST * 1e9]
    if not long:
        raise InputError(f"{bag}: no {SHORTEST:g} s of a track without a gap")
    return [_readings(part, rate_hz) for part in long]


def _readings(track: Trajectory, rate_hz: float) -> Array:
    step_ns = round(1e9 / rate_hz)
    at = track.at(np.arange(track.stamp_ns[0], track.stamp_ns[-1], step_ns))
    assert at.quat_xyzw is not None and at.velocity_enu is not None
    width = 2 * round(0.5 * SPAN * rate_hz) + 1
    acceleration = savgol_filter(at.velocity_enu, width, 3, deriv=1, delta=1.0 / rate_hz, axis=0)
    acceleration[:, 2] += normal_gravity(0.0 if at.datum_lla is None else at.datum_lla[0], 0.0)[1]
    C_map_b = matrix_from_quat(at.quat_xyzw)
    force = np.einsum("kji,kj->ki", C_map_b, acceleration)
    turns = rotvec_from_quat(quat_multiply(quat_conjugate(at.quat_xyzw[:-1]), at.quat_xyzw[1:]))
    rate = savgol_filter(turns * rate_hz, width, 3, axis=0)
    return np.hstack((force[:-1], rate))
