"""Trajectories as text tables: TUM for trajectory tools, CSV for everything else."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from hybrid_ins.core.inertial.rotations import rpy_from_quat
from hybrid_ins.errors import InputError
from hybrid_ins.evaluation.evaluate import HEADING_UNKNOWN
from hybrid_ins.export.track import lat_lon_height
from hybrid_ins.ros.messages.trajectory import Array, Trajectory

# Columns of the CSV file with their number of decimals. Time: UNIX time of the IMU's clock. Height
# above the WGS-84 ellipsoid. Position in the map (ENU at the datum), its standard deviations along
# the same axes. Velocity over ground along the map's axes; its standard deviations along those of
# base_link. Roll, pitch, yaw of base_link (FLU) in the map (REP-103: yaw from east, anticlockwise);
# heading of the nose from north, clockwise. Attitude uncertainty: rotations about the map's axes,
# that about "up" being the standard deviation of heading and yaw. What is not known is empty.
COLUMNS = {
    "time_s": 9,
    "latitude_deg": 10,
    "longitude_deg": 10,
    "height_m": 4,
    "east_m": 4,
    "north_m": 4,
    "up_m": 4,
    "sigma_east_m": 4,
    "sigma_north_m": 4,
    "sigma_up_m": 4,
    "velocity_east_mps": 4,
    "velocity_north_mps": 4,
    "velocity_up_mps": 4,
    "sigma_velocity_forward_mps": 4,
    "sigma_velocity_left_mps": 4,
    "sigma_velocity_up_mps": 4,
    "roll_deg": 4,
    "pitch_deg": 4,
    "yaw_deg": 4,
    "heading_deg": 4,
    "sigma_rotation_east_deg": 4,
    "sigma_rotation_north_deg": 4,
    "sigma_rotation_up_deg": 4,
}
_BLOCK = 5000  # rows formatted at a time


def tum(trajectory: Trajectory, name: str) -> Iterator[str]:
    """
    Yield lines ``time x y z qx qy qz qw`` of base_link in the map, where the heading is known.

    Raises
    ------
    InputError
        No epoch has an attitude, or none a known heading.
    """
    quat = trajectory.quat_xyzw
    known = np.zeros(len(trajectory), bool) if quat is None else np.isfinite(quat).all(axis=1)
    if trajectory.attitude_cov is not None:
        known &= ~(trajectory.attitude_cov[:, 2, 2] >= HEADING_UNKNOWN**2)
    if quat is None or not np.any(known):
        raise InputError(
            f"{name}: has no attitude with a known heading, which TUM files need: export to .csv "
            "instead"
        )
    rows = np.column_stack((trajectory.position_enu, quat))[known]
    for stamp_ns, row in zip(trajectory.stamp_ns[known].tolist(), rows.tolist(), strict=True):
        yield f"{_seconds(stamp_ns)} " + " ".join(f"{value:.9f}" for value in row) + "\n"


def csv(trajectory: Trajectory, name: str) -> Iterator[str]:
    """Yield the header and a line for each epoch, see `COLUMNS`."""
    del name  # any trajectory has a table
    yield ",".join(COLUMNS) + "\n"
    decimals = list(COLUMNS.values())[1:]
    for start in range(0, len(trajectory), _BLOCK):
        block = trajectory.rows(slice(start, start + _BLOCK))
        for stamp_ns, row in zip(block.stamp_ns.tolist(), _columns(block).tolist(), strict=True):
            cells = (
                "" if value != value else f"{value:.{places}f}"
                for value, places in zip(row, decimals, strict=True)
            )
            yield f"{_seconds(stamp_ns)},{','.join(cells)}\n"


def _columns(trajectory: Trajectory) -> Array:
    """Return the values of all columns but the time, shape (N, 22)."""
    unknown = np.full((len(trajectory), 3), np.nan)
    rpy = unknown if trajectory.quat_xyzw is None else rpy_from_quat(trajectory.quat_xyzw)
    rpy = np.degrees(rpy)
    velocity = trajectory.velocity_enu
    return np.column_stack(
        (
            lat_lon_height(trajectory),
            trajectory.position_enu,
            _std(trajectory.position_cov, unknown),
            unknown if velocity is None else velocity,
            _std(trajectory.velocity_cov, unknown),
            rpy,
            np.mod(np.round(90.0 - rpy[:, 2], COLUMNS["heading_deg"]), 360.0),
            np.degrees(_std(trajectory.attitude_cov, unknown)),
        )
    )


def _std(covariance: Array | None, unknown: Array) -> Array:
    if covariance is None:
        return unknown
    variance = np.diagonal(covariance, axis1=1, axis2=2)
    known = np.isfinite(variance) & (variance >= 0.0)
    return np.sqrt(np.where(known, variance, np.nan))


def _seconds(stamp_ns: int) -> str:
    """Return a stamp in seconds with all its digits, which a float would not hold."""
    seconds, nanoseconds = divmod(stamp_ns, 1_000_000_000)
    return f"{seconds}.{nanoseconds:09d}"
