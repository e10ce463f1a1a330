"""
A flight in CSV files as a bag on the node's topics.

Made for the dataset "Quadrotor Dead Reckoning with Multiple Inertial Sensors"; a column map
(`hybrid_ins.dataset.column_map`) adapts it to others. The reference is the truth, and thinned out
and with noise added it makes the GNSS fixes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.bags import flight_bag
from hybrid_ins.bags.flight_bag import GnssRecord, ImuRecord, TruthRecord, stamps
from hybrid_ins.bags.formats import METADATA
from hybrid_ins.core.inertial.earth import curvature_scale
from hybrid_ins.core.inertial.rotations import matrix_from_quat, skew
from hybrid_ins.dataset.column_map import ColumnMap
from hybrid_ins.dataset.csv_flight import (
    AttitudeSeries,
    PositionSeries,
    check_against_attitude,
    read_attitude,
    read_imu,
    read_position,
)
from hybrid_ins.dataset.csv_table import Faults
from hybrid_ins.dataset.logs.formats import IS_A_BAG
from hybrid_ins.errors import InputError
from hybrid_ins.ros.messages.trajectory import Array, Trajectory
from hybrid_ins.simulation.sensors import RTK_STD, in_outage, report_empty_outages

DEFAULT_MAP = "config/datasets/quadrotor.yaml"
HALF_WINDOW = 0.4  # s, of the cubic whose slope is the velocity


@dataclass(frozen=True)
class Conversion:
    """What is converted, and the fixes that are made of the reference."""

    imu: int = 1  # which of the flight's
    time_offset: float = 0.0  # s, added to the reference's times
    gnss_rate: float = 5.0  # Hz
    gnss_noise: Sequence[float] = RTK_STD  # m: north, east, down
    outages: Sequence[tuple[float, float]] = ()  # start after the first IMU sample, duration [s]
    seed: int = 0  # of the noise


def convert(
    flight: Path, out: Path, layout: ColumnMap, conversion: Conversion, *, overwrite: bool = False
) -> str:
    """
    Convert the CSV files in the directory `flight` to the bag `out`.

    Parameters
    ----------
    flight, out : Path
    layout : ColumnMap
        What the files hold.
    conversion : Conversion
    overwrite : bool
        See `hybrid_ins.bags.writer.BagWriter`.

    Returns
    -------
    str
        A line on what was written.

    Raises
    ------
    InputError
        A file is missing or does not match the map, or IMU and reference have no time in
        common.

    """
    if not flight.is_dir():
        raise InputError(f"{flight}: no such directory")
    if (flight / METADATA).is_file():
        raise InputError(f"{flight}: {IS_A_BAG}")
    faults = Faults()
    try:
        imu = read_imu(flight, layout.imu, conversion.imu, faults)
        position = read_position(flight, layout.position, faults)
        attitude = None
        if layout.attitude is not None:
            attitude = read_attitude(flight, layout.attitude, faults)
            check_against_attitude(imu, attitude, faults)
    finally:
        faults.close()

    position = replace(position, t=position.t + conversion.time_offset)
    if attitude is not None:
        attitude = replace(attitude, t=attitude.t + conversion.time_offset)
    if position.t[-1] < imu.t[0] or position.t[0] > imu.t[-1]:
        raise InputError(
            f"{position.path} from {position.t[0]:g} to {position.t[-1]:g} s and {imu.path} from"
            f" {imu.t[0]:g} to {imu.t[-1]:g} s have no time in common: check --time-offset"
        )
    report_empty_outages(position.t - imu.t[0], conversion.outages)
    t, lla, std = make_fixes(
        position,
        layout.position.std,
        conversion.gnss_rate,
        np.asarray(conversion.gnss_noise),
        np.random.default_rng(conversion.seed),
        [(imu.t[0] + start, duration) for start, duration in conversion.outages],
    )
    # Made from the reference's positions, which are base_link's.
    gnss = GnssRecord(stamps(t, layout.epoch), lla, std, frame_id="base_link")
    truth = make_truth(
        position,
        layout.position.std,
        attitude,
        None if layout.attitude is None else layout.attitude.orientation.std,
        gnss,
        layout.epoch,
    )
    orientation = layout.imu.orientation
    flight_bag.write_flight(
        out,
        ImuRecord(
            stamps(imu.t, layout.epoch),
            imu.specific_force_b,
            imu.angular_rate_b,
            imu.quat_xyzw,
            None if orientation is None else orientation.std,
        ),
        gnss,
        truth,
        overwrite=overwrite,
    )
    return (
        f"{out}: {imu.t[-1] - imu.t[0]:.1f} s; {imu.t.size} samples of {imu.path.name} at"
        f" {1.0 / np.median(np.diff(imu.t)):.4g} Hz, {t.size} fixes at"
        f" {conversion.gnss_rate:g} Hz, {len(truth.track)} of {position.t.size} epochs of truth"
        + ("" if truth.track.quat_xyzw is not None else " (no attitude: positions only)")
    )


def pick_epochs(t: Array, rate: float) -> tuple[Array, NDArray[np.int64]]:
    """
    Choose where fixes are made.

    Where `rate` divides that of the reference, it is every n-th epoch, so that the ones between
    are never used; else multiples of ``1 / rate`` from the first epoch on, between two epochs.
    There is no fix where an epoch is missing.

    Returns
    -------
    ndarray, shape (M,)
        Row of the reference, with a fraction where the fix lies between two.
    ndarray of int, shape (M,)
        How many fixes would lie before it in a flight without gaps.

    Raises
    ------
    InputError
        The reference is slower than `rate`.

    """
    steps = np.diff(t)
    whole = steps < 1.5 * np.median(steps)
    step = steps[whole].mean()
    every = round(1.0 / (rate * step))
    if every >= 1 and abs(every * rate * step - 1.0) < 0.02:
        epoch = np.rint((t - t[0]) / step).astype(np.int64)
        rows = np.flatnonzero(epoch % every == 0)
        return rows.astype(float), epoch[rows] // every
    if rate * step > 1.0:
        raise InputError(f"--gnss-rate {rate:g}: the reference has {1 / step:.4g} epochs a second")
    slots = np.arange(int((t[-1] - t[0]) * rate) + 1)
    rows = np.interp(t[0] + slots / rate, t, np.arange(t.size))
    sound = np.append(whole, True)[rows.astype(int)]
    return rows[sound], slots[sound]


def make_fixes(
    position: PositionSeries,
    reference_std: Array,
    rate: float,
    noise: Array,
    rng: np.random.Generator,
    outages: Sequence[tuple[float, float]],
) -> tuple[Array, Array, Array]:
    """
    Make GNSS fixes of the reference.

    Noise is drawn for every fix of the whole flight: a gap or an outage does not change the
    noise of the others.

    Parameters
    ----------
    position : PositionSeries
    reference_std, noise : ndarray, shape (3,)
        Of the reference and of what is added to it: north, east, down [m].
    rate : float
        [Hz]
    rng : Generator
    outages : sequence of (float, float)
        Start and duration [s], in the clock of the positions.

    Returns
    -------
    t : ndarray, shape (M,)
        [s]
    lla : ndarray, shape (M, 3)
    std : ndarray, shape (3,)
        Standard deviation of a fix: the noise added, or the reference's own where that is larger.

    """
    rows, slots = pick_epochs(position.t, rate)
    error = noise * rng.standard_normal((slots[-1] + 1, 3)) / curvature_scale(position.lla[0])
    index = np.arange(position.t.size)
    t = np.interp(rows, index, position.t)
    lla = np.stack([np.interp(rows, index, axis) for axis in position.lla.T], axis=-1)
    lla += error[slots]
    kept = ~in_outage(t, outages)
    return t[kept], lla[kept], np.maximum(noise, reference_std)


def differentiate(t: Array, position: Array) -> tuple[Array, Array]:
    """
    Velocity from positions: the slope of a cubic fitted to the epochs within `HALF_WINDOW`.

    Parameters
    ----------
    t : ndarray, shape (K,)
        [s]
    position : ndarray, shape (K, 3)
        [m]

    Returns
    -------
    ndarray, shape (K, 3)
        [m/s]
    ndarray, shape (K,)
        Its standard deviation per metre of the position's [1/s]: twice what white noise makes of
        it, for what no cubic follows.

    """
    velocity, gain = np.zeros_like(position), np.zeros(t.size)
    first = np.searchsorted(t, t - 1.01 * HALF_WINDOW)
    last = np.searchsorted(t, t + 1.01 * HALF_WINDOW)
    for row in range(t.size):
        near = slice(max(min(first[row], row - 2), 0), max(last[row], row + 3))
        powers = np.vander(t[near] - t[row], 4 if last[row] - first[row] >= 5 else 3, True)
        slope = np.linalg.pinv(powers)[1]
        velocity[row] = slope @ position[near]
        gain[row] = 2.0 * np.linalg.norm(slope)
    return velocity, gain


def make_truth(
    position: PositionSeries,
    position_std: Array,
    attitude: AttitudeSeries | None,
    attitude_std: Array | None,
    gnss: GnssRecord,
    epoch: float,
) -> TruthRecord:
    """
    Make the truth of the reference, at its positions' epochs.

    Parameters
    ----------
    position, attitude : PositionSeries, AttitudeSeries
        In one clock. Without attitude the truth is position only.
    position_std, attitude_std : ndarray, shape (3,)
        North, east, down [m]; roll, pitch, yaw [rad].
    gnss : GnssRecord
        The first fix is the map's origin.
    epoch : float
        Added to the times [s].

    Returns
    -------
    TruthRecord

    """
    datum_lla = flight_bag.first_datum(gnss)
    stamp_ns = stamps(position.t, epoch)
    variance_enu = position_std[[1, 0, 2]] ** 2
    position_cov = np.broadcast_to(np.diag(variance_enu), (position.t.size, 3, 3))
    if attitude is None or attitude_std is None:
        track = Trajectory.from_navigation(stamp_ns, position.lla, datum_lla=datum_lla)
        return TruthRecord(replace(track, position_cov=position_cov))

    quat, sound = attitude.at(position.t)
    track = Trajectory.from_navigation(stamp_ns, position.lla, None, quat, datum_lla=datum_lla)
    velocity, gain = differentiate(position.t, track.position_enu)
    roll_std, pitch_std, yaw_std = attitude_std
    horizontal = max(roll_std, pitch_std) ** 2
    attitude_cov = np.broadcast_to(
        np.diag([horizontal, horizontal, yaw_std**2]), position_cov.shape
    )
    assert track.quat_xyzw is not None
    # Along the vehicle's axes, which the attitude's error turns.
    C_base_map = np.swapaxes(matrix_from_quat(track.quat_xyzw), -1, -2)
    turn = C_base_map @ skew(velocity)
    velocity_cov = gain[:, None, None] ** 2 * (
        C_base_map @ position_cov @ np.swapaxes(C_base_map, -1, -2)
    ) + turn @ attitude_cov @ np.swapaxes(turn, -1, -2)
    track = replace(
        track,
        velocity_enu=velocity,
        position_cov=position_cov,
        velocity_cov=velocity_cov,
        attitude_cov=attitude_cov,
    )
    between = AttitudeSeries(attitude.path, position.t, quat).angular_rate_b
    angular_rate = 0.5 * (between[[0, *range(len(between))]] + between[[*range(len(between)), -1]])
    # Two independent attitudes, two epochs apart.
    angular_rate_std = attitude_std.max() / (2**0.5 * float(np.median(np.diff(position.t))))
    return TruthRecord(track.rows(sound), angular_rate[sound], angular_rate_std)
