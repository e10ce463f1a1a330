"""
A flight's CSV files in SI units and the filter's axes, by a column map, and checked by physics.

Gravity shows whether the accelerometer's unit and axes are right, and the reference's attitude
whether the gyroscope's are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.inertial.earth import LocalFrame, displacement
from hybrid_ins.core.inertial.rotations import (
    matrix_from_quat,
    quat_conjugate,
    quat_from_rpy,
    quat_multiply,
    rotvec_from_quat,
    slerp,
)
from hybrid_ins.dataset.column_map import (
    AttitudeMap,
    Columns,
    ImuMap,
    Orientation,
    PositionMap,
    Source,
)
from hybrid_ins.dataset.csv_table import Faults, Table, read_table
from hybrid_ins.errors import InputError
from hybrid_ins.ros.messages.conversions import FLIP, SWAP, quat_nb_from_enu
from hybrid_ins.ros.messages.trajectory import Array

MOST_SPECIFIC_FORCE = 1000.0  # m/s2, a hundred g: no vehicle's accelerometer reads that
MOST_ANGULAR_RATE = 100.0  # rad/s
MOST_TILT = 20.0  # degrees, of the mean specific force; the mount's and the attitude's errors


@dataclass(frozen=True, eq=False)
class ImuSeries:
    """An IMU's readings in SI units and FRD axes."""

    path: Path
    t: Array  # (N,) s
    specific_force_b: Array  # (N, 3) m/s2
    angular_rate_b: Array  # (N, 3) rad/s
    quat_xyzw: Array | None = None  # (N, 4) of C_nb


@dataclass(frozen=True, eq=False)
class PositionSeries:
    """Reference positions."""

    path: Path
    t: Array  # (K,) s
    lla: Array  # (K, 3) rad, rad, m


@dataclass(frozen=True, eq=False)
class AttitudeSeries:
    """Reference attitudes."""

    path: Path
    t: Array  # (K,) s
    quat_xyzw: Array  # (K, 4) of C_nb

    @property
    def angular_rate_b(self) -> Array:
        """Mean angular rate [rad/s] from each epoch to the next, shape (K - 1, 3)."""
        turn = quat_multiply(quat_conjugate(self.quat_xyzw[:-1]), self.quat_xyzw[1:])
        return rotvec_from_quat(turn) / np.diff(self.t)[:, None]

    def at(self, times: Array) -> tuple[Array, NDArray[np.bool_]]:
        """
        Interpolate, along the shortest turn.

        Returns
        -------
        ndarray, shape (N, 4)
        ndarray of bool, shape (N,)
            Where that is sound: not in a gap, and at most a step beyond the ends.

        """
        step = np.median(np.diff(self.t))
        left = np.clip(np.searchsorted(self.t, times) - 1, 0, self.t.size - 2)
        spans = self.t[left + 1] - self.t[left]
        quat = slerp(self.quat_xyzw[left], self.quat_xyzw[left + 1], (times - self.t[left]) / spans)
        near = (times > self.t[0] - 1.01 * step) & (times < self.t[-1] + 1.01 * step)
        return quat, near & (spans < 2.5 * step)


def read_imu(directory: Path, layout: ImuMap, number: int, faults: Faults) -> ImuSeries:
    """
    Read one IMU of a flight.

    Parameters
    ----------
    directory : Path
        Of the flight.
    layout : ImuMap
    number : int
        Which IMU, where the map has several.
    faults : Faults
        Receives the defects of single rows.

    Returns
    -------
    ImuSeries

    Raises
    ------
    InputError
        No such file or column, too few usable rows, or readings that cannot be in the units that
        the map states.

    """
    groups = [layout.specific_force, layout.angular_rate]
    if layout.orientation is not None:
        groups.append(layout.orientation.columns)
    table = _read(directory, layout.source, groups, faults, number)
    force, rate = np.abs(table.values[:, :3]), np.abs(table.values[:, 3:6])
    absurd = (force > MOST_SPECIFIC_FORCE).any(axis=1) | (rate > MOST_ANGULAR_RATE).any(axis=1)
    if absurd.mean() > 0.5:
        raise InputError(
            f"{table.path}: most readings are beyond {MOST_SPECIFIC_FORCE:g} m/s2 or"
            f" {MOST_ANGULAR_RATE:g} rad/s: check the units of specific_force and angular_rate"
        )
    table = table.drop(absurd, faults, "reading beyond 1000 m/s2 or 100 rad/s")
    force, rate = table.values[:, :3], table.values[:, 3:6]
    step, weight = np.median(np.diff(table.t)), np.median(np.linalg.norm(force, axis=1))
    if not 1e-4 <= step <= 0.2:
        raise InputError(f"{table.path}: {1 / step:.3g} samples a second: check the unit of time")
    if not 3.0 <= weight <= 40.0:
        raise InputError(
            f"{table.path}: the median specific force is {weight:.3g} m/s2, gravity is 9.8:"
            " check its unit, and that gravity was not removed"
        )
    quat = None
    if layout.orientation is not None:
        quat = _quaternions(table.values[:, 6:], layout.orientation)
    return ImuSeries(
        table.path,
        table.t,
        force @ layout.C_flu.T @ FLIP,
        rate @ layout.C_flu.T @ FLIP,
        quat,
    )


def read_position(directory: Path, layout: PositionMap, faults: Faults) -> PositionSeries:
    """Read the reference's positions; see `read_imu`."""
    table = _read(directory, layout.source, [layout.columns], faults)
    if layout.frame == "lla":
        limits = [np.pi / 2, 2 * np.pi, 1e5]
        absurd = (np.abs(table.values) > limits).any(axis=1)
        no_fix = ~table.values[:, :2].any(axis=1)
        table = table.drop(absurd | no_fix, faults, "no place on Earth, or none yet")
        lla = table.values
    else:
        assert layout.origin_lla is not None
        local = table.values if layout.frame == "ned" else table.values @ SWAP
        lla = LocalFrame(layout.origin_lla).lla(local)
    if table.t.size < 5:
        raise InputError(f"{table.path}: {table.t.size} usable positions: too few")
    steps = np.diff(displacement(lla[0], lla), axis=0)
    speed = np.median(np.linalg.norm(steps, axis=1) / np.diff(table.t))
    if speed > 300.0:
        raise InputError(
            f"{table.path}: a median speed of {speed:.3g} m/s: check the units of position and time"
        )
    return PositionSeries(table.path, table.t, lla)


def read_attitude(directory: Path, layout: AttitudeMap, faults: Faults) -> AttitudeSeries:
    """Read the reference's attitudes, stamped like the positions; see `read_imu`."""
    table = _read(directory, layout.source, [layout.orientation.columns], faults)
    quat = _quaternions(table.values, layout.orientation)
    return AttitudeSeries(table.path, table.t - layout.delay, quat)


def check_against_attitude(imu: ImuSeries, attitude: AttitudeSeries, faults: Faults) -> None:
    """
    Compare the IMU's units and axes with the attitude; their clocks need not agree closely.

    Raises
    ------
    InputError
        The gyroscope turns much faster or slower than the attitude, or the IMU's time is too short
        for both.

    """
    step = np.median(np.diff(attitude.t))
    times = np.arange(imu.t[0], imu.t[-1], step)
    if times.size < 2:
        raise InputError(
            f"{imu.path}: its {imu.t.size} usable rows span {imu.t[-1] - imu.t[0]:.3g} s, no two"
            f" epochs of {attitude.path.name}: too few"
        )
    angle = np.zeros_like(imu.angular_rate_b)
    middle = 0.5 * (imu.angular_rate_b[1:] + imu.angular_rate_b[:-1])
    angle[1:] = np.cumsum(middle * np.diff(imu.t)[:, None], axis=0)
    turned = np.stack([np.diff(np.interp(times, imu.t, axis)) for axis in angle.T], axis=-1) / step
    rate, reference = _rms(turned), _rms(attitude.angular_rate_b)
    if reference > 0.05 and not 0.2 < rate / reference < 5.0:
        raise InputError(
            f"{imu.path}: the gyroscope turns {rate / reference:.3g} times as fast as the attitude"
            f" in {attitude.path.name}: check the units of angular_rate and attitude"
        )
    quat, sound = attitude.at(imu.t)
    if not sound.any():
        return
    force_n = (matrix_from_quat(quat) @ imu.specific_force_b[..., None])[sound, :, 0].mean(axis=0)
    tilt = np.degrees(np.arccos(np.clip(-force_n[2] / np.linalg.norm(force_n), -1.0, 1.0)))
    if tilt > MOST_TILT:
        faults.file(
            imu.path,
            f"the specific force is {tilt:.0f} degrees off the vertical of {attitude.path.name}:"
            " check axes in the map's imu and frames in its attitude; converted as it is",
        )


def _read(
    directory: Path, source: Source, groups: Sequence[Columns], faults: Faults, number: int = 1
) -> Table:
    """Read the columns of the groups, side by side, in SI units."""
    table = read_table(
        _find(directory, source.file, number),
        source.layout,
        source.time_column,
        source.seconds_per_unit,
        [name for group in groups for name in group.names],
        faults,
    )
    t = table.t - table.t[0] if source.from_zero else table.t
    return replace(table, t=t, values=table.values * np.hstack([g.factors for g in groups]))


def _find(directory: Path, pattern: str, number: int) -> Path:
    """Find the one file of a flight that fits."""
    name = pattern.replace("{imu}", str(number))
    if not any(character in name for character in "*?["):
        if not (directory / name).is_file() and name != pattern:
            others = sorted(path.name for path in directory.glob(pattern.replace("{imu}", "*")))
            there = f"there are {', '.join(others)}" if others else "none fits the column map"
            raise InputError(f"{directory / name}: no such file; {there}")
        return directory / name
    found = sorted(directory.glob(name))
    if len(found) != 1:
        raise InputError(f"{directory / name}: {len(found)} files fit, not one")
    return found[0]


def _quaternions(values: Array, orientation: Orientation) -> Array:
    """Turn a table's angles [rad] or quaternions into unit quaternions of C_nb, shape (N, 4)."""
    quat = values if values.shape[1] == 4 else quat_from_rpy(*values.T)
    quat = quat / np.maximum(np.linalg.norm(quat, axis=1, keepdims=True), 1e-9)
    return quat if orientation.ned else quat_nb_from_enu(quat)


def _rms(vectors: Array) -> float:
    return float(np.sqrt(np.mean(np.sum(vectors**2, axis=1))))
