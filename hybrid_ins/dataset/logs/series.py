"""What every log becomes: IMU samples and GNSS fixes in arrays, SI units."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.ros.trajectory import Array

NO_FIX, FIX, SBAS_FIX, GBAS_FIX = -1, 0, 1, 2  # sensor_msgs/NavSatStatus
GPS_EPOCH = 315_964_800  # 1980-01-06T00:00:00Z [s since 1970]
LEAP_SECONDS = 18  # GPS time minus UTC, since 2017


@dataclass(frozen=True, eq=False)
class ImuLog:
    """Samples of an IMU."""

    path: Path
    t: Array  # (N,) s since 1970, UTC, or of a clock of its own
    specific_force: Array  # (N, 3) m/s², FLU
    angular_rate: Array  # (N, 3) rad/s, FLU
    is_dated: bool  # the clock counts from 1970


@dataclass(frozen=True, eq=False)
class GnssLog:
    """Fixes of a receiver."""

    path: Path
    t: Array  # (M,) s since 1970, UTC
    lla: Array  # (M, 3) rad, rad, m
    covariance_n: Array  # (M, 3, 3) m², NED; NaN where the receiver gave none
    status: NDArray[np.int8]  # (M,) NavSatStatus
    velocity_n: Array | None = None  # (M, 3) m/s, NED; NaN where there is none
    velocity_covariance_n: Array | None = None  # (M, 3, 3) (m/s)², NED; NaN where unknown
    is_dated: bool = True  # else: the clock is that of the IMU in the same log


def diagonal(std: Array) -> Array:
    """Return covariances (M, 3, 3) of standard deviations (M, 3)."""
    return np.asarray(std)[..., None] ** 2 * np.eye(3)


def utc_from_gps(seconds: Array | float) -> Array:
    """Return UTC [s since 1970] of GPS time [s since 1980-01-06]."""
    return np.asarray(seconds) + GPS_EPOCH - LEAP_SECONDS
