"""An IMU log and a GNSS log as a bag on the node's topics, with the receiver's own deviations."""

from __future__ import annotations

import heapq
from collections.abc import Iterator
from dataclasses import replace
from operator import itemgetter
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hybrid_ins import progress
from hybrid_ins.bags.flight_bag import (
    EPOCH_NS,
    UNKNOWN_VARIANCE,
    Entry,
    TruthRecord,
    odometry_entries,
    set_vector,
    stamp,
    stamps,
)
from hybrid_ins.bags.messages import new_message
from hybrid_ins.bags.writer import BagWriter
from hybrid_ins.dataset.logs.clock_match import clock_offset
from hybrid_ins.dataset.logs.formats import read_estimate, read_logs
from hybrid_ins.dataset.logs.plausibility import (
    check_clocks,
    check_imu,
    check_positions,
    check_velocity,
)
from hybrid_ins.dataset.logs.series import EstimateLog, GnssLog, ImuLog
from hybrid_ins.errors import InputError
from hybrid_ins.ros.messages.conversions import SWAP, datum_fix, set_place
from hybrid_ins.ros.messages.trajectory import Array, Trajectory
from hybrid_ins.ros.messages.type_names import FIX, IMU, TWIST

Mask = NDArray[np.bool_]  # (M,)

KNOWN, UNKNOWN = 3, 0  # NavSatFix.position_covariance_type
AUTOPILOT = "/autopilot"  # topics of its own estimate
LATEST = 2.0**31  # s, of a stamp
EPOCH = 1e-9 * EPOCH_NS  # s, 2023-01-01: where neither clock is dated


def convert_logs(
    paths: list[Path],
    out: Path,
    time_offset: float | None = None,
    origin: Array | None = None,
    *,
    overwrite: bool = False,
) -> str:
    """
    Write a bag of one or two logs, which are told apart by their content.

    Parameters
    ----------
    paths : list of Path
        An IMU's and a receiver's, or an autopilot's log with both.
    out : Path
        See `BagWriter`.
    time_offset : float, optional
        Added to the IMU's times to bring them to the receiver's clock [s]. Without it that is
        found by correlation, unless both have one clock or overlap already.
    origin : ndarray, shape (3,), optional
        Of local coordinates in a table of fixes: latitude, longitude [rad], height [m].
    overwrite : bool
        See `BagWriter`.

    Returns
    -------
    str
        A line on what was written.

    Raises
    ------
    InputError
        A file cannot be read, or the two have no time in common.
    """
    imu, gnss = read_logs(paths, origin)
    _check_times(imu, 2)
    _check_times(gnss, 1)
    remarks = ""
    common = min(imu.t[-1], gnss.t[-1]) - max(imu.t[0], gnss.t[0])
    if time_offset is not None:
        imu = replace(imu, t=imu.t + time_offset)
    elif len(paths) > 1 and (imu.is_dated != gnss.is_dated or common <= 0.0):
        found = clock_offset(imu, gnss)
        imu = replace(imu, t=imu.t + found.offset)
        remarks = (
            f"; clock offset by {found.by} in both, correlation {found.correlation:.2f} "
            "(refine: ins_calibrate)"
        )
    if min(imu.t[-1], gnss.t[-1]) < max(imu.t[0], gnss.t[0]):
        raise InputError(f"{imu.path} and {gnss.path} have no time in common: check --time-offset")
    if time_offset is None and not remarks and imu.is_dated and gnss.is_dated:
        check_clocks(imu, gnss)
    check_positions(gnss)
    check_velocity(gnss)
    imu = check_imu(imu, gnss)
    if not gnss.is_dated:
        imu, gnss = replace(imu, t=imu.t + EPOCH), replace(gnss, t=gnss.t + EPOCH)
    streams = [_imu_entries(imu), _fix_entries(gnss), _velocity_entries(gnss)]
    estimate = read_estimate(paths[0]) if len(paths) == 1 else None
    if estimate is not None:
        t = estimate.t + EPOCH + (time_offset or 0.0)  # one clock with the IMU
        streams.append(_estimate_entries(replace(estimate, t=t)))
        remarks += f"; the autopilot's own estimate on {AUTOPILOT}/odometry"
    remarks += _left_out(gnss)
    count = len(imu.t) + (1 + (gnss.velocity_n is not None)) * len(gnss.t)
    entries = heapq.merge(*streams, key=itemgetter(0, 1))
    with BagWriter(out, overwrite=overwrite) as bag:
        for log_ns, _, topic, message in progress.track(entries, "writing", total=count):
            bag.write(topic, message, log_ns)
    rate = 1.0 / float(np.median(np.diff(imu.t)))
    return (
        f"{out}: {imu.t[-1] - imu.t[0]:.1f} s; {len(imu.t)} samples of {imu.path.name} at "
        f"{rate:.4g} Hz, {len(gnss.t)} fixes of {gnss.path.name}{remarks}"
    )


def _check_times(log: ImuLog | GnssLog, fewest: int) -> None:
    """Raise `InputError` for a log that is too short, or whose times fit no message's stamp."""
    if len(log.t) < fewest:
        kind = "samples of the IMU" if isinstance(log, ImuLog) else "fixes"
        raise InputError(f"{log.path}: holds {len(log.t)} {kind}")
    if np.abs(log.t).max() >= LATEST:
        raise InputError(
            f"{log.path}: its times reach {np.abs(log.t).max():.6g} s, but stamps end in 2038: "
            "check unit and format of the time"
        )


def _imu_entries(imu: ImuLog) -> Iterator[Entry]:
    message = new_message(IMU)
    message.orientation_covariance[0] = -1.0  # sensor_msgs/Imu: no orientation
    for row, stamp_ns in enumerate(stamps(imu.t, 0.0).tolist()):
        stamp(message, stamp_ns, "imu_link")
        set_vector(message.linear_acceleration, imu.specific_force[row])
        set_vector(message.angular_velocity, imu.angular_rate[row])
        yield stamp_ns, 0, "/imu/data", message


def _fix_entries(gnss: GnssLog) -> Iterator[Entry]:
    message = new_message(FIX)
    message.status.service = 1  # SERVICE_GPS
    covariance_enu, is_known = _covariance_enu(gnss.covariance_n), _is_known(gnss.covariance_n)
    for row, stamp_ns in enumerate(stamps(gnss.t, 0.0).tolist()):
        stamp(message, stamp_ns, "gnss_link")
        message.status.status = int(gnss.status[row])
        set_place(message, gnss.lla[row])
        message.position_covariance_type = KNOWN if is_known[row] else UNKNOWN
        message.position_covariance = covariance_enu[row].ravel()
        yield stamp_ns, 1, "/gnss/fix", message


def _estimate_entries(estimate: EstimateLog) -> Iterator[Entry]:
    """Yield the autopilot's estimate in a map of its own."""
    stamp_ns = stamps(estimate.t, 0.0)
    datum = estimate.lla[0]
    yield (
        int(stamp_ns[0]),
        -1,
        f"{AUTOPILOT}/datum",
        datum_fix(new_message, int(stamp_ns[0]), "map", datum),
    )
    track = Trajectory.from_navigation(
        stamp_ns, estimate.lla, estimate.velocity_n, estimate.quat_xyzw, datum_lla=datum
    )
    yield from odometry_entries(TruthRecord(track), f"{AUTOPILOT}/odometry")


def _velocity_entries(gnss: GnssLog) -> Iterator[Entry]:
    """Yield velocities whose horizontal part is known; an unknown vertical one is NaN."""
    if gnss.velocity_n is None or gnss.velocity_covariance_n is None:
        return
    message = new_message(TWIST)
    velocity_enu = gnss.velocity_n[:, [1, 0, 2]] * [1.0, 1.0, -1.0]
    covariance_enu = _covariance_enu(gnss.velocity_covariance_n)
    stamp_ns = stamps(gnss.t, 0.0).tolist()
    for row in np.flatnonzero(_is_used(gnss.velocity_n, gnss.velocity_covariance_n)):
        stamp(message, stamp_ns[row], "gnss_link")
        covariance = np.diag(np.full(6, UNKNOWN_VARIANCE))  # a receiver knows nothing of rotation
        covariance[:3, :3] = covariance_enu[row]
        message.twist.covariance = covariance.ravel()
        set_vector(message.twist.twist.linear, velocity_enu[row])
        yield stamp_ns[row], 2, "/gnss/velocity", message


def _covariance_enu(covariance_n: Array) -> Array:
    """
    Return covariances for messages.

    Parameters
    ----------
    covariance_n : ndarray, shape (M, 3, 3)
        NED; NaN where unknown.

    Returns
    -------
    ndarray, shape (M, 3, 3)
        ENU, the vertical with ``UNKNOWN_VARIANCE`` where only that is unknown; zero where a
        horizontal axis is.
    """
    P = covariance_n.copy()
    unknown = ~np.isfinite(P[:, 2]).all(axis=1)
    P[unknown, 2, :] = P[unknown, :, 2] = 0.0
    P[unknown, 2, 2] = UNKNOWN_VARIANCE
    P[~_is_known(covariance_n)] = 0.0
    return np.asarray(SWAP @ P @ SWAP)


def _is_known(covariance_n: Array) -> Mask:
    """Return which covariances (M, 3, 3) say what is needed: their horizontal part."""
    return np.asarray(np.isfinite(covariance_n[:, :2, :2]).all(axis=(1, 2)))


def _is_used(velocity_n: Array, covariance_n: Array) -> Mask:
    """Return which velocities (M, 3) are known horizontally, with their covariance (M, 3, 3)."""
    return np.isfinite(velocity_n[:, :2]).all(axis=1) & _is_known(covariance_n)


def _left_out(gnss: GnssLog) -> str:
    """Return a remark on what the receiver gave and no message holds; empty for nothing."""
    text = ""
    some = np.isfinite(np.diagonal(gnss.covariance_n, axis1=1, axis2=2)).any(axis=1)
    count = np.count_nonzero(some & ~_is_known(gnss.covariance_n))
    if count:
        text += f"; {count} of {len(gnss.t)} fixes lack the standard deviation of a horizontal axis"
    if gnss.velocity_n is None:
        return text
    if gnss.velocity_covariance_n is None:
        used = np.zeros(len(gnss.t), bool)
    else:
        used = _is_used(gnss.velocity_n, gnss.velocity_covariance_n)
    some = np.isfinite(gnss.velocity_n).any(axis=1)
    count = np.count_nonzero(some & ~used)
    if count:
        text += (
            f"; {count} of {np.count_nonzero(some)} velocities are left out: they lack a "
            "horizontal component or its standard deviation"
        )
    return text
