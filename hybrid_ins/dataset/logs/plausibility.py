"""Wrong units and axes of an IMU log, as gravity and the receiver's course show them."""

from __future__ import annotations

import logging
import math
from dataclasses import replace

import numpy as np

from hybrid_ins.dataset.logs.clock_match import GRID, LEAST_OVERLAP, gnss_turn_rate, imu_turn_rate
from hybrid_ins.dataset.logs.series import GnssLog, ImuLog

UPRIGHT = 0.7  # cosine of the mean specific force with an axis that is vertical
LEAST_TURNS = math.radians(5.0)  # rad/s, RMS of the course rate that shows a factor
LEAST_CORRELATION = 0.5
USUAL = 0.7, 1.4  # of the gyroscope's turn rate by that of the course
DEGREES = 0.7 * math.degrees(1.0), 1.4 * math.degrees(1.0)  # the same, if units were mixed up

_log = logging.getLogger(__name__)


def check_imu(imu: ImuLog, gnss: GnssLog) -> ImuLog:
    """
    Return the IMU's log with the unit of its rates that fits the course; warn of wrong axes.

    Parameters
    ----------
    imu, gnss : ImuLog, GnssLog
        Of one clock.
    """
    mean = np.mean(imu.specific_force, axis=0)
    up = float(mean[2] / np.linalg.norm(mean))
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
            "%s: the gyroscope turns against the course: the axes are left-handed, or the signs of "
            "the accelerations or of the rates are inverted",
            imu.path,
        )
    elif not USUAL[0] < factor < USUAL[1]:
        _log.warning(
            "%s: the gyroscope turns %.2f times as fast as the course: check unit and axes of the "
            "rates",
            imu.path,
            factor,
        )
    return imu


def turn_factor(imu: ImuLog, gnss: GnssLog) -> float | None:
    """Return the gyroscope's turn rate by that of the course; None where too little turns."""
    if min(imu.t[-1] - imu.t[0], gnss.t[-1] - gnss.t[0]) < LEAST_OVERLAP:
        return None
    t_imu, turn_imu = imu_turn_rate(imu)
    t, course_rate, moving = gnss_turn_rate(gnss)
    moving &= (t > t_imu[0]) & (t < t_imu[-1])
    a, b = np.interp(t, t_imu, turn_imu)[moving], course_rate[moving]
    if len(b) * GRID < LEAST_OVERLAP or np.sqrt(np.mean(b**2)) < LEAST_TURNS:
        return None
    # The course is the noisier one, and a body may turn later: both at half a hertz.
    width = np.ones(round(2.0 / GRID)) * GRID / 2.0
    a, b = np.convolve(a, width, "valid"), np.convolve(b, width, "valid")
    if abs(np.corrcoef(a, b)[0, 1]) < LEAST_CORRELATION:
        return None
    sign = math.copysign(1.0, float(np.dot(a, b)))
    return sign * float(np.sqrt(np.mean(a**2) / np.mean(b**2)))
