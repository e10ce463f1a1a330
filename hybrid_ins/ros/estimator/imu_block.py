"""
Many Imu readings at once into an estimator: recordings are read in blocks.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.imu.samples import as_samples
from hybrid_ins.core.inertial.state import N_NAV
from hybrid_ins.core.navigator.notices import RestartCause
from hybrid_ins.ros.estimator.estimator import Estimator
from hybrid_ins.ros.messages.cdr import ImuFields
from hybrid_ins.ros.reporting.reports import OdometryBlock

Array = NDArray[np.float64]


def handle_imu_block(
    estimator: Estimator,
    t_ns: NDArray[np.int64],
    force: Array,
    rate: Array,
    orientation_xyzw: Array | None = None,
    frame_id: str | None = None,
) -> list[OdometryBlock]:
    """
    Use readings in the IMU's own axes; the result is that of `Estimator.handle_imu` one by one.

    Parameters
    ----------
    estimator : Estimator
    t_ns : ndarray, shape (N,)
        Stamps [ns].
    force, rate : ndarray, shape (N, 3)
        Specific force [m/s²] and angular rate [rad/s].
    orientation_xyzw : ndarray, shape (N, 4), optional
        Orientations in ENU; they matter to heading_source imu only.
    frame_id : str, optional
        Of the readings; by default it is the one in force.

    Returns
    -------
    list of OdometryBlock
        Of each stretch in which the filter ran.
    """
    force, rate = np.ascontiguousarray(force), np.ascontiguousarray(rate)
    frame = estimator.placement.frame_of("imu/data") if frame_id is None else frame_id
    done: list[OdometryBlock] = []
    k = 0
    while k < len(t_ns):
        end = _end_of_stretch(estimator, t_ns, force, rate, k, frame)
        if end > k:
            block = _handle_stretch(estimator, t_ns[k:end], force[k:end], rate[k:end])
            if block is not None:
                done.append(block)
        else:
            end = k + 1
            one = estimator.handle_imu(_fields(k, t_ns, force, rate, orientation_xyzw, frame))
            if one is not None:
                done.append(OdometryBlock(t_ns[k:end], one.in_map[None], one.in_odom[None]))
        estimator.run_periodic()
        k = end
    return done


def _fields(
    k: int,
    t_ns: NDArray[np.int64],
    force: Array,
    rate: Array,
    orientation_xyzw: Array | None,
    frame: str,
) -> ImuFields:
    """Return one reading as a message."""
    imu = ImuFields(int(t_ns[k]), tuple(force[k].tolist()), tuple(rate[k].tolist()), frame)
    if orientation_xyzw is None:
        return imu
    orientation = tuple(orientation_xyzw[k].tolist())
    return imu._replace(orientation_xyzw=orientation, orientation_cov0=0.0)


def _end_of_stretch(
    estimator: Estimator,
    t_ns: NDArray[np.int64],
    force: Array,
    rate: Array,
    start: int,
    frame: str,
) -> int:
    """Return the end of the rows that need nothing between them."""
    running = estimator.navigator.filter
    if running is None or estimator.odometry.map is None:
        return start
    if not estimator.placement.is_settled("imu/data", frame):
        return start
    until_ns = min(estimator.due_ns, running.next_event_ns)
    return estimator.admission.end_of_stretch(t_ns, force, rate, start, until_ns)


def _handle_stretch(
    estimator: Estimator, t_ns: NDArray[np.int64], force: Array, rate: Array
) -> OdometryBlock | None:
    """Use the readings of a stretch."""
    navigator, placement = estimator.navigator, estimator.placement
    running = navigator.filter
    assert running is not None
    samples = as_samples(t_ns, force @ placement.mount.T, rate @ placement.mount.T)
    rows = np.empty((len(t_ns), N_NAV))
    navigator.imu_block(samples, rows)
    rate_variance = running.noise.levels()[3:]
    block = estimator.odometry.make_block(t_ns, rows, placement.arm_b, rate_variance)
    if block is None:
        navigator.give_up(RestartCause.NOT_FINITE)
    return block
