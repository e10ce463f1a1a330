"""Wrong units, axes and clocks of two logs, as gravity and the receiver's motion show them."""

from __future__ import annotations

import logging
import math
from dataclasses import replace

import numpy as np

from hybrid_ins.core.inertial.earth import STANDARD_GRAVITY
from hybrid_ins.dataset.logs.clock_match import (
    GRID,
    LEAST_OVERLAP,
    LEAST_SPEED,
    clock_offset,
    imu_turn_rate,
    mean_over,
    positions,
    speed_and_turn,
)
from hybrid_ins.dataset.logs.series import GnssLog, ImuLog
from hybrid_ins.errors import InputError
from hybrid_ins.ros.messages.trajectory import Array

UPRIGHT = 0.7  # cosine of the mean specific force with an axis that is vertical
STEADY = 5.0  # m/s², of the mean specific force: gravity in a vehicle that mostly stays upright
SHORT = 5.0  # s, over which a vehicle keeps its attitude, or moves by more than fixes scatter
LEAST_TURNS = math.radians(5.0)  # rad/s, RMS of the course rate that shows a factor
LEAST_CORRELATION = 0.5
STEADY_RATE = 1e-6  # rad/s, of the range of a rate that does not vary: of no correlation
USUAL = 0.7, 1.4  # of the gyroscope's turn rate by that of the course
DEGREES = 0.7 * math.degrees(1.0), 1.4 * math.degrees(1.0)  # the same, if units were mixed up

TURNED = math.radians(40.0)  # of the IMU's x axis from the direction of travel
LEAST_FORCE = 0.3  # m/s², RMS of the horizontal acceleration that shows it
LEAST_LIKENESS = 0.7  # correlation of the accelerations
LARGEST_OFFSET = 1.5  # s, that `ins_calibrate` searches

_log = logging.getLogger(__name__)


def check_imu(imu: ImuLog, gnss: GnssLog) -> ImuLog:
    """
    Return the IMU's log with the unit of its rates that fits the course; warn of wrong axes.

    Parameters
    ----------
    imu, gnss : ImuLog, GnssLog
        Of one clock.
    """
    means = _short_means(imu)
    size, mean = float(np.median(np.linalg.norm(means, axis=1))), np.median(means, axis=0)
    if size < STEADY:
        _log.warning(
            "%s: the specific force is %.1f m/s² on average: gravity is missing; accelerations "
            "that were freed of it cannot be used",
            imu.path,
            size,
        )
        return imu
    is_upright_mostly = np.linalg.norm(mean) > 0.5 * size  # else it flies loops and rolls
    up = float(mean[2] / np.linalg.norm(mean)) if is_upright_mostly else 1.0
    if up < -UPRIGHT:
        _log.warning(
            "%s: gravity points along +z: the axes are not forward, left, up; of forward, right, "
            "down give the node imu.mount_rpy: [3.14159, 0.0, 0.0]",
            imu.path,
        )
    elif up < UPRIGHT:
        _log.warning(
            "%s: the specific force is along [%.1f, %.1f, %.1f] m/s² on average, not up: give the "
            "node imu.mount_rpy",
            imu.path,
            *mean,
        )
    factor = turn_factor(imu, gnss)
    if factor is None:
        return imu
    if DEGREES[0] < abs(factor) < DEGREES[1]:
        _log.warning("%s: by the course the rates are in deg/s: converted", imu.path)
        return replace(imu, angular_rate=np.radians(imu.angular_rate))
    if DEGREES[0] < abs(1.0 / factor) < DEGREES[1]:
        _log.warning("%s: by the course the rates are in rad/s: not converted", imu.path)
        return replace(imu, angular_rate=np.degrees(imu.angular_rate))
    if factor < 0.0:
        _log.warning(
            "%s: the gyroscope turns against the course: the axes are left-handed, the signs of "
            "the accelerations or of the rates are inverted, or latitude and longitude are "
            "exchanged",
            imu.path,
        )
    elif not USUAL[0] < factor < USUAL[1]:
        _log.warning(
            "%s: the gyroscope turns %.2f times as fast as the course: check unit and axes of the "
            "rates",
            imu.path,
            factor,
        )
    yaw = mount_yaw(imu, gnss)
    if yaw is not None and abs(yaw) > TURNED:
        _log.warning(
            "%s: by the accelerations x points %.0f° to the %s of the direction of travel: if the "
            "vehicle moves along its nose give the node imu.mount_rpy: [0.0, 0.0, %.2f]",
            imu.path,
            abs(math.degrees(yaw)),
            "left" if yaw > 0.0 else "right",
            yaw,
        )
    return imu


def _short_means(imu: ImuLog) -> Array:
    """Return the means (K, 3) of the specific force over stretches of ``SHORT``."""
    width = max(1, round(SHORT / float(np.median(np.diff(imu.t)))))
    whole = max(1, len(imu.t) // width)
    return np.array([part.mean(axis=0) for part in np.array_split(imu.specific_force, whole)])


def mount_yaw(imu: ImuLog, gnss: GnssLog) -> float | None:
    """
    Return the angle of the IMU's x axis left of the direction of travel [rad], axes z up.

    None where the horizontal accelerations are not those of the receiver's motion: too small, or of
    a vehicle that leans into its turns.
    """
    if min(imu.t[-1] - imu.t[0], gnss.t[-1] - gnss.t[0]) < LEAST_OVERLAP:
        return None
    t, speed, turn = speed_and_turn(gnss)
    inside = (t > imu.t[0]) & (t < imu.t[-1])
    if inside.sum() * GRID < LEAST_OVERLAP:
        return None
    ahead = mean_over(t, np.gradient(speed, GRID)) + 1j * mean_over(t, speed * turn)
    force = [mean_over(imu.t, f) for f in imu.specific_force[:, :2].T]
    x, y = (np.interp(t, imu.t, f)[inside] for f in force)
    a = ahead[inside] - ahead[inside].mean()
    f = x - x.mean() + 1j * (y - y.mean())
    match = complex(np.mean(f * np.conj(a)))
    size = math.sqrt(float(np.mean(np.abs(a) ** 2)))
    scatter = math.sqrt(float(np.mean(np.abs(f) ** 2)))
    if size < LEAST_FORCE or abs(match) < LEAST_LIKENESS * size * scatter:
        return None
    return -math.atan2(match.imag, match.real)


def check_positions(gnss: GnssLog) -> None:
    """Warn where all positions are such that their degrees may be radians."""
    latitude, longitude = np.abs(np.degrees(gnss.lla[:, :2])).max(axis=0)
    if latitude < math.pi / 2.0 and longitude < math.pi:
        _log.warning(
            "%s: the positions are within %.3g° of latitude 0 and %.3g° of longitude 0: if they "
            "are radians, name the columns lat_rad and lon_rad",
            gnss.path,
            latitude,
            longitude,
        )


def check_velocity(gnss: GnssLog) -> None:
    """Warn where the receiver's speed is not that of its positions: another unit."""
    if gnss.velocity_n is None or len(gnss.t) < 3:
        return
    position = positions(gnss)[:, :2]
    width = max(1, round(SHORT / float(np.median(np.diff(gnss.t)))))
    if len(position) <= width:
        return
    step = (position[width:] - position[:-width]) / (gnss.t[width:] - gnss.t[:-width])[:, None]
    middle = 0.5 * (gnss.velocity_n[1:, :2] + gnss.velocity_n[:-1, :2])
    velocity = np.lib.stride_tricks.sliding_window_view(middle, width, axis=0).mean(axis=-1)
    speed, by_positions = np.hypot(*velocity.T), np.hypot(*step.T)
    claimed = np.sqrt(np.trace(gnss.covariance_n[width:, :2, :2], axis1=1, axis2=2))
    shown = np.fmax(LEAST_SPEED, 3.0 * claimed / SHORT)  # beyond the positions' own wander
    known = np.isfinite(speed) & (by_positions > shown)
    if known.sum() < 10 or np.hypot(*np.diff(position, axis=0).T).sum() < 20.0:
        return
    factor = float(np.median(speed[known] / by_positions[known]))
    if not USUAL[0] < factor < USUAL[1]:
        _log.warning(
            "%s: the velocity is %.3g times that of the positions: check its unit",
            gnss.path,
            factor,
        )


def check_clocks(imu: ImuLog, gnss: GnssLog) -> None:
    """Warn where the motion in two logs that are dated fits at another time than that stated."""
    try:
        found = clock_offset(imu, gnss)
    except InputError:  # the motion says nothing
        return
    if abs(found.offset) > LARGEST_OFFSET and found.correlation > LEAST_LIKENESS:
        _log.warning(
            "%s: %s in both fit with --time-offset %.1f: is one of the clocks GPS time, which is "
            "18 s ahead of UTC?",
            imu.path,
            found.by,
            found.offset,
        )


def turn_factor(imu: ImuLog, gnss: GnssLog) -> float | None:
    """Return the gyroscope's turn rate by that of the course; None where too little turns."""
    if min(imu.t[-1] - imu.t[0], gnss.t[-1] - gnss.t[0]) < LEAST_OVERLAP:
        return None
    t_imu, turn_imu = imu_turn_rate(imu)
    t, speed, course_rate = speed_and_turn(gnss)
    # The gyroscope's turn is that about the specific force, which leans into a turn with the
    # vehicle, or without it: of a turn on the level it sees the cosine.
    lean = np.arctan2(mean_over(t, speed * course_rate), STANDARD_GRAVITY)
    moving = (speed > LEAST_SPEED) & (t > t_imu[0]) & (t < t_imu[-1])
    a, b = np.interp(t, t_imu, turn_imu)[moving], (course_rate * np.cos(lean))[moving]
    if len(b) * GRID < LEAST_OVERLAP or np.sqrt(np.mean(b**2)) < LEAST_TURNS:
        return None
    # The course is the noisier one, and a body may turn later: both at half a hertz.
    width = np.ones(round(2.0 / GRID)) * GRID / 2.0
    a, b = np.convolve(a, width, "valid"), np.convolve(b, width, "valid")
    if np.ptp(a) < STEADY_RATE or abs(np.corrcoef(a, b)[0, 1]) < LEAST_CORRELATION:
        return None
    sign = math.copysign(1.0, float(np.dot(a, b)))
    return sign * float(np.sqrt(np.mean(a**2) / np.mean(b**2)))
