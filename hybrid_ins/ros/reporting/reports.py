"""
What the estimator publishes, as records: no messages, no bytes.

`hybrid_ins.ros.output.message_types.encode` turns a `Report` into a serialised message.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Odometry(NamedTuple):
    """Odometry after one IMU sample, in the order of the message: see `ros.output`."""

    t_ns: int
    in_map: Array  # (85,) pose in map, twist in the base frame
    in_odom: Array  # (85,) the same motion in odom, see `ros.output.odom_frame`


class OdometryBlock(NamedTuple):
    """Odometry after each of many IMU samples."""

    t_ns: NDArray[np.int64]  # (N,)
    in_map: Array  # (N, 85)
    in_odom: Array  # (N, 85)


@dataclass(frozen=True, slots=True)
class MapOdometry:
    """A nav_msgs/Odometry in map, of a vehicle whose heading is not known yet."""

    t_ns: int
    frame_id: str
    child_frame_id: str
    values: Array  # (85,) pose in map, twist in the base frame


@dataclass(frozen=True, slots=True)
class Position:
    """A sensor_msgs/NavSatFix; its status is FIX or, without GNSS, NO_FIX."""

    t_ns: int
    frame_id: str
    latitude: float  # deg
    longitude: float  # deg
    height: float  # m above the ellipsoid
    covariance_enu: Array  # (9,) m²
    covariance_type: int
    has_fix: bool = True


@dataclass(frozen=True, slots=True)
class Vector:
    """A geometry_msgs/Vector3Stamped."""

    t_ns: int
    frame_id: str
    xyz: Array  # (3,)


@dataclass(frozen=True, slots=True)
class ImuBiases:
    """A geometry_msgs/AccelWithCovarianceStamped."""

    t_ns: int
    frame_id: str
    accelerometer: Array  # (3,) m/s², FLU
    gyroscope: Array  # (3,) rad/s, FLU
    covariance: Array  # (36,) accelerometer first


class Status(NamedTuple):
    """A diagnostic_msgs/DiagnosticStatus; level 0 OK, 1 WARN, 2 ERROR."""

    level: int
    name: str
    text: str
    values: Sequence[tuple[str, str]]


@dataclass(frozen=True, slots=True)
class Diagnostics:
    """A diagnostic_msgs/DiagnosticArray."""

    t_ns: int
    statuses: Sequence[Status]


Content = MapOdometry | Position | Vector | ImuBiases | Status | Diagnostics


@dataclass(frozen=True, slots=True)
class Report:
    """Something to publish on a topic, a key of `message_types.OUTPUTS`."""

    topic: str
    content: Content
    known_ns: int  # stamp of the last IMU sample when it was made
