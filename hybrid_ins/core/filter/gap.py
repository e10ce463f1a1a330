"""Propagation over a gap in the IMU samples, with the uncertainty of what went unmeasured."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.imu.samples import as_numbers
from hybrid_ins.core.inertial import propagation
from hybrid_ins.core.inertial.earth import STANDARD_GRAVITY
from hybrid_ins.core.inertial.rotations import matrix_from_quat, skew
from hybrid_ins.core.inertial.state import (
    COVARIANCE,
    DP,
    DV,
    EPS,
    LAST_F,
    LAST_W,
    N_ERROR,
    N_NAV,
    QUAT,
    VELOCITY,
    covariance,
    pack,
)

Array = NDArray[np.float64]

LONG_GAP = 0.5  # s; a longer one is told, and no measurement within it is used
GAP_FORCE, GAP_RATE = 0.1, 0.01  # m/s², rad/s: unmeasured motion of a calm vehicle
SWING_TIME = 1.0  # s, after which a swaying vehicle may read the same, and not have moved so
MAX_STEP_ROTATION = 0.2  # rad, for which the series of the mechanisation hold


def run(
    nav: Array,
    t_ns: int,
    samples: NDArray[np.void],
    long_step_ns: int,
    interval: float,
    rows: Array,
) -> bool:
    """
    Propagate over samples and the gaps between them; return whether there were any.

    Parameters
    ----------
    nav : ndarray, shape (N_FLAT,)
        Flat state at ``t_ns`` [ns]; overwritten.
    samples : ndarray of SAMPLE_DTYPE
        At least one, younger than that.
    long_step_ns : int
        A longer step [ns] is a gap.
    interval, rows
        See `propagation.run`.
    """
    numbers = as_numbers(samples)
    integers, start = numbers.view(np.int64), 0
    while True:
        rest = slice(start, None)
        k = start + propagation.run_samples(
            nav, t_ns, numbers[rest], integers[rest], long_step_ns, interval, rows[rest]
        )
        if k > start:
            t_ns = integers.item(k - 1, 0)
        if k == len(samples):
            return start > 0
        bridge(nav, numbers[k, 1:], (integers.item(k, 0) - t_ns) * 1e-9, interval)
        if len(rows):
            rows[k] = nav[:N_NAV]
        t_ns, start = integers.item(k, 0), k + 1


def bridge(nav: Array, reading: Array, dt: float, interval: float) -> None:
    """
    Propagate to the sample behind a gap, along a line between the samples at its ends.

    Parameters
    ----------
    nav : ndarray, shape (N_FLAT,)
        Flat state before the gap; overwritten, with nothing pending.
    reading : ndarray, shape (6,)
        Sample behind the gap: specific force [m/s²] and angular rate [rad/s], b.
    dt : float
        Length of the gap [s].
    interval : float
        See `propagation.step`.
    """
    last = np.concatenate((nav[LAST_F], nav[LAST_W]))
    readings = line(last, reading, dt)
    steps = np.full(len(readings), dt / len(readings))
    propagation.run(nav, steps, readings, interval, propagation.NO_ROWS)
    propagation.propagate_covariance(nav)
    inflate(nav, last, reading, dt)


def line(last: Array, reading: Array, dt: float) -> Array:
    """
    Return readings, shape (n, 6), at the ends of n equal steps over a gap.

    Parameters
    ----------
    last, reading : ndarray, shape (6,)
        Samples before the gap and behind it, see `bridge`.
    dt : float
        Length of the gap [s].
    """
    fastest = max(float(np.linalg.norm(reading[3:])), float(np.linalg.norm(last[3:])))
    parts = 1 + int(dt * fastest / MAX_STEP_ROTATION)
    return np.asarray(last + np.linspace(0.0, 1.0, parts + 1)[1:, None] * (reading - last))


def inflate(nav: Array, last: Array, reading: Array, dt: float) -> None:
    """
    Add unmeasured motion in a gap to the covariance of ``nav``; parameters as in `bridge`.

    It is a force and a rate that are constant over the gap: tilt by a rate moves the velocity, too.
    The velocity may have turned as far as the vehicle, though not with it: a drone's does not.
    """
    force_std, rate_std = _unmeasured(last, reading, dt)
    C = matrix_from_quat(nav[QUAT])
    f_n, rate_n = C @ (0.5 * (last + reading)[:3]), C * rate_std
    by_force, by_rate, by_turn = np.zeros((3, N_ERROR, 3))
    by_force[DP], by_force[DV] = 0.5 * dt**2 * np.eye(3), dt * np.eye(3)
    by_rate[DP], by_rate[DV] = dt**3 / 6.0 * skew(f_n), 0.5 * dt**2 * skew(f_n)
    by_rate[EPS] = dt * np.eye(3)
    turn = skew(nav[VELOCITY])
    by_turn[DP], by_turn[DV] = 0.5 * dt**2 * turn, dt * turn
    P = covariance(nav)
    P += force_std**2 * by_force @ by_force.T
    for by_rate_b in (by_rate @ rate_n, by_turn @ rate_n):
        P += by_rate_b @ by_rate_b.T
    pack(P, nav[COVARIANCE])


def turn_std(last: Array, reading: Array, dt: float) -> float:
    """Return the standard deviation [rad] of a turn in a gap; parameters as in `bridge`."""
    return float(_unmeasured(last, reading, dt)[1].max()) * dt


def _unmeasured(last: Array, reading: Array, dt: float) -> tuple[float, Array]:
    """
    Return standard deviations about a line over a gap: force [m/s²], rates (3,) [rad/s], b.

    It is most uncertain about the axis that the vehicle turns about.
    """
    jump, rate = np.abs(reading - last), float(np.linalg.norm(reading[3:]))
    swing = min(dt / SWING_TIME, 1.0) ** 2
    force = abs(float(np.linalg.norm(reading[:3])) - STANDARD_GRAVITY)
    return (
        GAP_FORCE + 0.25 * jump[:3].max() + 0.5 * (rate + swing * force),
        GAP_RATE
        + 0.15 * (jump[3:] + jump[3:].max())
        + 0.1 * rate
        + 0.4 * swing * np.abs(reading[3:]),
    )
