"""
Logs of ArduPilot: dataflash (``*.bin``, as text ``*.log``) and telemetry (``*.tlog``).

They need `pymavlink`.

References
----------
ArduPilot documentation, "Onboard message log messages": IMU, GPS, GPA, ORGN, XKF1, NKF1. MAVLink
common message set: RAW_IMU, SCALED_IMU, HIGHRES_IMU, GPS_RAW_INT.
"""

from __future__ import annotations

import logging
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from hybrid_ins.core.inertial.earth import STANDARD_GRAVITY, LocalFrame
from hybrid_ins.core.inertial.rotations import quat_from_rpy
from hybrid_ins.dataset.logs.epochs import times_of_epochs
from hybrid_ins.dataset.logs.series import (
    STATUS_OF_FIX_TYPE,
    WEEK,
    EstimateLog,
    GnssLog,
    ImuLog,
    diagonal,
    head_of,
    rising,
)
from hybrid_ins.errors import InputError
from hybrid_ins.ros.messages.conversions import FLIP
from hybrid_ins.ros.messages.trajectory import Array

DATAFLASH = b"\xa3\x95\x80"  # the first message describes itself
DATAFLASH_TEXT = b"FMT,"  # likewise, in logs that a ground station has converted
MAVLINK = b"\xfe\xfd"  # packets of version 1 and 2
YEARS_US = 978_307_200_000_000, 4_102_444_800_000_000  # 2001 to 2100, of telemetry stamps
IMU_MESSAGES = {  # name: unit of its accelerations [m/s²] and rates [rad/s]
    "HIGHRES_IMU": (1.0, 1.0),
    "RAW_IMU": (1e-3 * STANDARD_GRAVITY, 1e-3),
    "SCALED_IMU": (1e-3 * STANDARD_GRAVITY, 1e-3),
}
ESTIMATES = ("XKF1", "NKF1")  # of EKF3 and EKF2
UNKNOWN = 65_535  # of speed and course in GPS_RAW_INT

_log = logging.getLogger(__name__)


def recognise(head: bytes) -> bool:
    """Return whether a file begins as a dataflash or telemetry log."""
    return head.startswith((DATAFLASH, DATAFLASH_TEXT)) or _is_telemetry(head)


def _is_telemetry(head: bytes) -> bool:
    if len(head) < 9 or head[8] not in MAVLINK:
        return False
    [stamp_us] = struct.unpack(">Q", head[:8])
    return bool(YEARS_US[0] < stamp_us < YEARS_US[1])


def read_imu(path: Path) -> ImuLog:
    """
    Read the first IMU, by the autopilot's clock.

    Raises
    ------
    InputError
        `pymavlink` is not installed, or the log cannot be read or holds no IMU.
    """
    if _is_dataflash(path):
        rows: list[tuple[float, ...]] = [
            (m.TimeUS * 1e-6, m.AccX, m.AccY, m.AccZ, m.GyrX, m.GyrY, m.GyrZ)
            for m in _messages(path, "IMU")
            if getattr(m, "I", 0) == 0
        ]
        hint = "set LOG_BITMASK to log the IMU"
    else:
        found: dict[str, list[tuple[float, ...]]] = {name: [] for name in IMU_MESSAGES}
        for m in _of_one_vehicle(path, *IMU_MESSAGES):
            name = m.get_type()
            unit_f, unit_w = IMU_MESSAGES[name]
            t = m.time_boot_ms * 1e-3 if name == "SCALED_IMU" else m.time_usec * 1e-6
            force = (m.xacc * unit_f, m.yacc * unit_f, m.zacc * unit_f)
            found[name].append((t, *force, m.xgyro * unit_w, m.ygyro * unit_w, m.zgyro * unit_w))
        rows = next((part for part in found.values() if part), [])
        hint = "raise the stream rate of the raw sensors, or use the dataflash log"
    if not rows:
        raise InputError(f"{path}: holds no IMU message; {hint}")
    table = np.array(rows, float)
    table = table[rising(path, table[:, 0], "IMU samples")]
    return ImuLog(path, table[:, 0], table[:, 1:4] @ FLIP, table[:, 4:7] @ FLIP, False)


def read_gnss(path: Path) -> GnssLog:
    """
    Read the first receiver's fixes, by the autopilot's clock.

    Heights are above the ellipsoid where the log has the geoid's, else above sea level.

    Raises
    ------
    InputError
        `pymavlink` is not installed, or the log cannot be read or holds no fix.
    """
    rows = _dataflash_fixes(path) if _is_dataflash(path) else _telemetry_fixes(path)
    if not rows:
        raise InputError(f"{path}: holds no three-dimensional fix")
    table = np.array(rows, float)
    table = table[rising(path, table[:, 0], "fixes")]
    t, status, lla, velocity, accuracy, epochs = np.split(table, [1, 2, 5, 8, 11], axis=1)
    accuracy[accuracy <= 0.0] = np.nan
    horizontal, vertical, speed = accuracy.T
    return GnssLog(
        path,
        times_of_epochs(t[:, 0], epochs[:, 0]),
        np.column_stack((np.radians(lla[:, :2]), lla[:, 2])),
        diagonal(np.column_stack((horizontal / 2**0.5, horizontal / 2**0.5, vertical))),
        np.array([STATUS_OF_FIX_TYPE[int(kind)] for kind in status[:, 0]], np.int8),
        velocity,
        diagonal(np.column_stack([speed / 3**0.5] * 3)),
        is_dated=False,
    )


def read_estimate(path: Path) -> EstimateLog | None:
    """Read the first core of EKF3, else of EKF2, from a dataflash log; None without either."""
    origin: Array | None = None
    geoid: list[float] = []  # m, below the ellipsoid: an origin is above sea level
    found: dict[str, list[tuple[float, ...]]] = {name: [] for name in ESTIMATES}
    for m in _messages(path, "ORGN", "GPA", *ESTIMATES) if _is_dataflash(path) else ():
        if m.get_type() == "ORGN":
            origin = np.array([*np.radians((m.Lat, m.Lng)), m.Alt])
        elif m.get_type() == "GPA":
            geoid.append(getattr(m, "Und", 0.0))
        elif getattr(m, "C", 0) == 0:  # logs before ArduPilot 4.1 name further cores otherwise
            found[m.get_type()].append(
                (m.TimeUS * 1e-6, m.PN, m.PE, m.PD, m.VN, m.VE, m.VD, m.Roll, m.Pitch, m.Yaw)
            )
    rows = next((part for part in found.values() if len(part) > 1), [])
    if origin is None or not rows:
        return None
    table = np.array(rows, float)
    table = table[rising(path, table[:, 0], "estimates")]
    quats = np.array([quat_from_rpy(*rpy) for rpy in np.radians(table[:, 7:10])])
    origin[2] -= np.median(geoid) if geoid else 0.0
    lla = LocalFrame(origin).lla(table[:, 1:4])
    return EstimateLog(table[:, 0], lla, table[:, 4:7], quats)


def _dataflash_fixes(path: Path) -> list[tuple[float, ...]]:
    """
    Return rows of fixes.

    Time of arrival, kind, latitude, longitude, height, velocity NED, three accuracies, receiver's
    time.
    """
    rows: list[tuple[float, ...]] = []
    fixes: list[tuple[Any, Any]] = []
    for m in _messages(path, "GPS", "GPA"):
        if getattr(m, "I", 0) == 0:
            if m.get_type() == "GPS":
                fixes.append((m, None))
            elif fixes:  # follows the message that it belongs to
                fixes[-1] = (fixes[-1][0], m)
    for m, own in fixes:
        if m.Status not in STATUS_OF_FIX_TYPE:
            continue
        course = np.radians(m.GCrs)
        height = m.Alt - (getattr(own, "Und", 0.0) if own is not None else 0.0)
        place = (m.Lat, m.Lng, height)
        velocity = (m.Spd * np.cos(course), m.Spd * np.sin(course), m.VZ)
        claimed = (own.HAcc, own.VAcc, own.SAcc) if own is not None else (np.nan,) * 3
        epoch = m.GWk * WEEK + m.GMS * 1e-3
        rows.append((m.TimeUS * 1e-6, m.Status, *place, *velocity, *claimed, epoch))
    return rows


def _telemetry_fixes(path: Path) -> list[tuple[float, ...]]:
    """Return rows as `_dataflash_fixes`."""
    rows: list[tuple[float, ...]] = []
    for m in _of_one_vehicle(path, "GPS_RAW_INT"):
        if m.fix_type not in STATUS_OF_FIX_TYPE:
            continue
        is_moving_known = UNKNOWN not in (m.vel, m.cog)
        speed = m.vel * 1e-2 if is_moving_known else np.nan
        course = np.radians(m.cog * 1e-2)
        height = (getattr(m, "alt_ellipsoid", 0) or m.alt) * 1e-3
        place = (m.lat * 1e-7, m.lon * 1e-7, height)
        velocity = (speed * np.cos(course), speed * np.sin(course), np.nan)
        accuracy = (getattr(m, name, 0) * 1e-3 for name in ("h_acc", "v_acc", "vel_acc"))
        t = m.time_usec * 1e-6
        rows.append((t, m.fix_type, *place, *velocity, *accuracy, t))
    return rows


def _is_dataflash(path: Path) -> bool:
    return head_of(path, 4).startswith((DATAFLASH, DATAFLASH_TEXT))


def _of_one_vehicle(path: Path, *types: str) -> Iterator[Any]:
    """Yield telemetry of the first vehicle that sends an IMU's, where several are heard."""
    first = next(_messages(path, *IMU_MESSAGES), None)
    for message in _messages(path, *types):
        if first is None or message.get_srcSystem() == first.get_srcSystem():
            yield message


def _messages(path: Path, *types: str) -> Iterator[Any]:
    try:
        from pymavlink import mavutil
        from pymavlink.DFReader import DFReader_binary, DFReader_text
    except ImportError:
        raise InputError(f"{path}: ArduPilot logs need pymavlink: pip install pymavlink") from None
    log, count = None, 0
    try:
        head = head_of(path, 4)
        if head.startswith(DATAFLASH_TEXT):
            log = DFReader_text(str(path))
        elif head.startswith(DATAFLASH):
            log = DFReader_binary(str(path))
        else:
            log = mavutil.mavlogfile(str(path))
        while (message := log.recv_match(type=list(types))) is not None:
            count += 1
            yield message
    except Exception as error:  # the library raises what the damage leads to
        if not count:
            raise InputError(f"{path}: no readable log of ArduPilot: {error}") from None
        _log.warning("%s: damaged: what follows the first %d messages is left out", path, count)
    finally:
        if log is not None:
            log.close()
