"""
The rough offset between the clocks of an IMU log and a GNSS log, by correlation.

What both see is the turn about the vertical: the gyroscope's about the mean direction of the
specific force, the receiver's as the change of its course. Where there is too little of that, the
receiver's change of speed is compared with the horizontal specific force along the axis in which
that varies most. The offset with the highest correlation over the common moving time is taken;
`ins_calibrate` refines it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.inertial.earth import displacement
from hybrid_ins.dataset.logs.series import GnssLog, ImuLog
from hybrid_ins.errors import InputError
from hybrid_ins.ros.messages.trajectory import Array

GRID = 0.1  # s
LEVEL_TIME = 2.0  # s, over which the direction of the specific force is averaged
FORCE_TIME = 1.0  # s, over which forces and speeds are averaged to compare them
LEAST_SPEED = 0.7  # m/s, below which a course means nothing
LEAST_OVERLAP = 20.0  # s of moving time
LEAST_CORRELATION = 0.5
NEAR = 3.0  # s around the best offset, in which no other one counts
DISTINCT = 1.15  # times the next best correlation


class ClockMatch(NamedTuple):
    """The offset between two clocks, and how it was found."""

    offset: float  # s, to be added to the IMU's times
    correlation: float
    by: str  # what both see


def clock_offset(imu: ImuLog, gnss: GnssLog) -> ClockMatch:
    """
    Return what has to be added to the IMU's times to be the receiver's.

    Raises
    ------
    InputError
        No offset stands out: too little motion, or neither turns nor changes of speed.
    """
    if min(imu.t[-1] - imu.t[0], gnss.t[-1] - gnss.t[0]) < LEAST_OVERLAP:
        raise _failure(imu, gnss, f"shorter than {LEAST_OVERLAP:g} s")
    _, turn_imu = imu_turn_rate(imu)
    _, turn_gnss, moving = gnss_turn_rate(gnss)
    if moving.sum() * GRID < LEAST_OVERLAP:
        raise _failure(imu, gnss, f"the receiver moved for {moving.sum() * GRID:.0f} s only")
    turns = _best(turn_imu, turn_gnss, moving, moving, signed=True)
    speed_changes = gnss_speed_change(gnss)
    everywhere = np.ones(len(speed_changes), bool)
    forces = _best(imu_forward_force(imu), speed_changes, everywhere, moving, signed=False)
    for by, (lag, r, others) in (("the turns", turns), ("the changes of speed", forces)):
        if r >= max(LEAST_CORRELATION, DISTINCT * others):
            at = lag - (len(turn_imu) - 1)  # grid steps that the IMU's first sample lies behind
            return ClockMatch(float(gnss.t[0] + at * GRID - imu.t[0]), r, by)
    raise _failure(
        imu,
        gnss,
        f"best correlation of turns {turns[1]:.2f}, next {turns[2]:.2f}; of changes of speed "
        f"{forces[1]:.2f}, next {forces[2]:.2f}",
    )


def _best(
    a: Array, b: Array, mask: NDArray[np.bool_], moving: NDArray[np.bool_], *, signed: bool
) -> tuple[int, float, float]:
    """Return the lag with the highest correlation, that, and the highest one far from it."""
    r, counts = _correlations(a, b, mask)
    moving_counts = _correlations(a, b, moving)[1]
    r = r if signed else np.abs(r)
    least = max(LEAST_OVERLAP, 0.3 * moving.sum() * GRID)
    r[(counts * GRID < least) | (moving_counts * GRID < least)] = -1.0
    best = int(np.argmax(r))
    far = np.abs(np.arange(len(r)) - best) * GRID > NEAR
    return best, float(r[best]), float(r[far].max(initial=-1.0))


def _failure(imu: ImuLog, gnss: GnssLog, why: str) -> InputError:
    return InputError(
        f"{imu.path} and {gnss.path}: no clock offset by the motion in both ({why}); give it with "
        "--time-offset"
    )


def imu_forward_force(imu: ImuLog) -> Array:
    """Return the horizontal specific force on the axis of its largest variation, on the grid."""
    smooth = np.column_stack([mean_over(imu.t, f) for f in imu.specific_force.T])
    up = smooth.mean(axis=0) / np.linalg.norm(smooth.mean(axis=0))
    level = smooth - smooth.mean(axis=0)
    level -= np.outer(level @ up, up)
    axis = np.linalg.svd(level, full_matrices=False)[2][0]
    t = np.arange(imu.t[0], imu.t[-1], GRID)
    return np.asarray(np.interp(t, imu.t, level @ axis))


def gnss_speed_change(gnss: GnssLog) -> Array:
    """Return the rate of change of the speed over ground [m/s²], on the grid."""
    at, velocity = _horizontal_velocity(gnss)
    t = np.arange(gnss.t[0], gnss.t[-1], GRID)
    speed = np.interp(t, at, np.hypot(velocity[:, 0], velocity[:, 1]))
    return np.asarray(np.gradient(mean_over(t, speed), GRID))


def mean_over(t: Array, values: Array) -> Array:
    """Return the mean of values (N,) over `FORCE_TIME` around each time."""
    width = max(1, round(FORCE_TIME / float(np.median(np.diff(t)))))
    weights = np.convolve(np.ones(len(values)), np.ones(width), "same")
    return np.asarray(np.convolve(values, np.ones(width), "same") / weights)


def _horizontal_velocity(gnss: GnssLog) -> tuple[Array, Array]:
    """Return times and velocities NED [m/s], of the positions where the receiver gave none."""
    velocity = gnss.velocity_n
    if velocity is None or not np.isfinite(velocity[:, :2]).any():
        return gnss.t, np.gradient(positions(gnss), gnss.t, axis=0)
    known = np.isfinite(velocity[:, :2]).all(axis=1)
    return gnss.t[known], velocity[known]


def positions(gnss: GnssLog) -> Array:
    """Return positions relative to the first one [m], NED; a height may be missing."""
    lla = np.nan_to_num(gnss.lla)
    return displacement(lla[0], lla)


def imu_turn_rate(imu: ImuLog) -> tuple[Array, Array]:
    """Return times [s] and the turn rate about the vertical [rad/s], up positive, on the grid."""
    t = np.arange(imu.t[0], imu.t[-1], GRID)
    width = max(1, round(LEVEL_TIME / float(np.median(np.diff(imu.t)))))
    kernel = np.ones(width) / width
    up = np.column_stack([np.convolve(f, kernel, "same") for f in imu.specific_force.T])
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    rate = np.einsum("ij,ij->i", imu.angular_rate, up)
    total = np.concatenate(([0.0], np.cumsum(0.5 * (rate[1:] + rate[:-1]) * np.diff(imu.t))))
    return t, np.asarray(np.gradient(np.interp(t, imu.t, total), GRID))


def gnss_turn_rate(gnss: GnssLog) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Return times [s], turn rate of the course [rad/s], up positive, and where it moves."""
    t, speed, turn = speed_and_turn(gnss)
    return t, turn, speed > LEAST_SPEED


def speed_and_turn(gnss: GnssLog) -> tuple[Array, Array, Array]:
    """Return times [s], speed over ground [m/s] and turn rate of the course [rad/s], up positive.

    The turn rate is zero where the receiver hardly moves.
    """
    at, velocity = _horizontal_velocity(gnss)
    t = np.arange(gnss.t[0], gnss.t[-1], GRID)
    speed = np.interp(t, at, np.hypot(velocity[:, 0], velocity[:, 1]))
    course = np.unwrap(np.arctan2(velocity[:, 1], velocity[:, 0]))
    rate = -np.gradient(np.interp(t, at, course), GRID)
    return t, speed, np.where(speed > LEAST_SPEED, rate, 0.0)


def _correlations(a: Array, b: Array, mask: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Return the correlation of a with the masked b for every lag, and how many values it is of."""
    size = len(a) + len(b) - 1
    one, m = np.ones(len(a)), mask.astype(float)

    def sums(x: Array, y: Array) -> Array:
        product = np.conj(np.fft.rfft(x, size)) * np.fft.rfft(y, size)
        return np.roll(np.fft.irfft(product, size), len(a) - 1)

    n = np.maximum(np.rint(sums(one, m)), 1.0)
    mean_a, mean_b = sums(a, m) / n, sums(one, m * b) / n
    var_a = np.maximum(sums(a * a, m) / n - mean_a**2, 1e-12)
    var_b = np.maximum(sums(one, m * b * b) / n - mean_b**2, 1e-12)
    return (sums(a, m * b) / n - mean_a * mean_b) / np.sqrt(var_a * var_b), n
