"""
Logs of PX4, ``*.ulg``: sensor_combined or vehicle_imu, and the receiver's. Needs `pyulog`.

References
----------
PX4 user guide, "ULog file format"; message definitions SensorCombined, VehicleImu and SensorGps.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from hybrid_ins.core.inertial.earth import LocalFrame
from hybrid_ins.core.inertial.rotations import slerp
from hybrid_ins.dataset.logs.epochs import times_of_epochs
from hybrid_ins.dataset.logs.series import (
    STATUS_OF_FIX_TYPE,
    EstimateLog,
    GnssLog,
    ImuLog,
    diagonal,
)
from hybrid_ins.errors import InputError
from hybrid_ins.ros.messages.conversions import FLIP

GNSS_TOPICS = ("vehicle_gps_position", "sensor_gps")


def recognise(head: bytes) -> bool:
    """Return whether a file begins as a ULog."""
    return head.startswith(b"ULog\x01\x12\x35")


def read_imu(path: Path) -> ImuLog:
    """
    Read ``sensor_combined``, or ``vehicle_imu`` where that is logged, by the autopilot's clock.

    Raises
    ------
    InputError
        `pyulog` is not installed, or the log lacks the topic.
    """
    data = _topic(path, ("sensor_combined", "vehicle_imu"))
    names, lengths = ("accelerometer_m_s2", "gyro_rad"), (1.0, 1.0)
    if "delta_angle[0]" in data:  # integrals, and how long [µs]
        names = ("delta_velocity", "delta_angle")
        lengths = tuple(data[f"{name}_dt"] * 1e-6 for name in names)
        data = {name: values[lengths[0] * lengths[1] > 0.0] for name, values in data.items()}
        lengths = tuple(data[f"{name}_dt"] * 1e-6 for name in names)
    force, rate = (
        np.column_stack([data[f"{name}[{axis}]"] / dt for axis in range(3)]).astype(float) @ FLIP
        for name, dt in zip(names, lengths, strict=True)
    )
    sampled = np.any(data.get("timestamp_sample", 0))
    return ImuLog(
        path, data["timestamp_sample" if sampled else "timestamp"] * 1e-6, force, rate, False
    )


def read_gnss(path: Path) -> GnssLog:
    """
    Read the receiver's fixes, by the autopilot's clock.

    Raises
    ------
    InputError
        `pyulog` is not installed, or the log lacks the topic.
    """
    data = _topic(path, GNSS_TOPICS)
    good = np.isin(data["fix_type"], list(STATUS_OF_FIX_TYPE))
    if not good.any():
        raise InputError(f"{path}: holds no three-dimensional fix")
    data = {name: values[good] for name, values in data.items()}
    if "latitude_deg" in data:
        degrees, height = ("latitude_deg", "longitude_deg"), data["altitude_ellipsoid_m"]
        angles = [np.radians(data[name]) for name in degrees]
    else:  # before PX4 1.15
        angles = [np.radians(data[name] * 1e-7) for name in ("lat", "lon")]
        height = data["alt_ellipsoid"] * 1e-3
    lla = np.column_stack((*angles, height))
    horizontal = data["eph"] / 2**0.5
    speed = data["s_variance_m_s"].astype(float)  # a deviation, despite its name
    speed[np.asarray(data.get("vel_ned_valid", np.ones(len(speed)))) == 0] = np.nan
    sampled = np.any(data.get("timestamp_sample", 0))
    stamps = data["timestamp_sample" if sampled else "timestamp"]
    arrivals, epochs = stamps * 1e-6, data.get("time_utc_usec", stamps) * 1e-6
    return GnssLog(
        path,
        times_of_epochs(arrivals, epochs),
        lla,
        diagonal(np.column_stack((horizontal, horizontal, data["epv"]))),
        np.array([STATUS_OF_FIX_TYPE[int(kind)] for kind in data["fix_type"]], np.int8),
        np.column_stack([data[f"vel_{axis}_m_s"] for axis in "ned"]).astype(float),
        diagonal(np.column_stack([speed] * 3)),
        is_dated=False,
    )


def read_estimate(path: Path) -> EstimateLog | None:
    """Read the autopilot's estimate; None where the log does not hold it."""
    try:
        place, attitude = (
            _topic(path, ("vehicle_local_position",)),
            _topic(path, ("vehicle_attitude",)),
        )
    except InputError:
        return None
    t, t_attitude = place["timestamp"] * 1e-6, attitude["timestamp"] * 1e-6
    good = place["xy_valid"].astype(bool) & place["xy_global"].astype(bool)
    good &= np.isfinite(place["ref_alt"])
    good &= (t >= t_attitude[0]) & (t <= t_attitude[-1])
    if good.sum() < 2 or len(t_attitude) < 2:
        return None
    t = t[good]
    quats = np.column_stack([attitude[f"q[{k}]"] for k in (1, 2, 3, 0)]).astype(float)
    right = np.clip(np.searchsorted(t_attitude, t), 1, len(t_attitude) - 1)
    part = (t - t_attitude[right - 1]) / (t_attitude[right] - t_attitude[right - 1])
    origin = (place["ref_lat"][good][-1], place["ref_lon"][good][-1])
    height = place["ref_alt"][good][-1] + _geoid(path)
    frame = LocalFrame(np.array([*np.radians(origin), height]))
    return EstimateLog(
        t,
        frame.lla(np.column_stack([place[axis][good] for axis in "xyz"]).astype(float)),
        np.column_stack([place[f"v{axis}"][good] for axis in "xyz"]).astype(float),
        slerp(quats[right - 1], quats[right], part),
    )


def _geoid(path: Path) -> float:
    """Return the geoid's height above the ellipsoid [m], as the receiver's fixes have it."""
    try:
        data = _topic(path, GNSS_TOPICS)
    except InputError:
        return 0.0
    good = np.isin(data["fix_type"], list(STATUS_OF_FIX_TYPE))
    if "altitude_msl_m" in data:
        above = data["altitude_ellipsoid_m"] - data["altitude_msl_m"]
    elif "alt" in data and "alt_ellipsoid" in data:
        above = (data["alt_ellipsoid"] - data["alt"]) * 1e-3
    else:
        return 0.0
    return float(np.median(above[good])) if good.any() else 0.0


def _topic(path: Path, names: tuple[str, ...]) -> dict[str, Any]:
    try:
        from pyulog import ULog
    except ImportError:
        raise InputError(f"{path}: ULog files need pyulog: pip install pyulog") from None
    try:
        log = ULog(str(path), list(names))
    except Exception as error:  # the library raises what the damage leads to
        raise InputError(f"{path}: no readable ULog: {error}") from None
    for name in names:
        for dataset in log.data_list:
            if dataset.name == name and dataset.multi_id == 0 and len(dataset.data["timestamp"]):
                return dict(dataset.data)
    raise InputError(f"{path}: holds no {' or '.join(names)}; enable its logging in PX4")
