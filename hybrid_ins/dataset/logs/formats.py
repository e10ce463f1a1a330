"""The formats of logs, and which one a file has, by its content, not by its name."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

from hybrid_ins.dataset.logs import ardupilot, gnss_text, imu_text, nmea, rtklib, ubx, ulog
from hybrid_ins.dataset.logs.series import EstimateLog, GnssLog, ImuLog, head_of
from hybrid_ins.errors import InputError
from hybrid_ins.ros.messages.trajectory import Array

FORMATS: tuple[ModuleType, ...] = (ulog, ardupilot, rtklib, ubx, nmea, gnss_text, imu_text)
"""Each has ``recognise(head)``, and ``read_imu(path)`` or ``read_gnss(path)`` or both."""
BAGS = b"\x89MCAP", b"SQLite format 3", b"#ROSBAG"
IS_A_BAG = "is a bag already: ins_replay and ins_calibrate read it as it is"
HEAD = 1 << 16  # bytes


def read_logs(paths: list[Path], origin: Array | None = None) -> tuple[ImuLog, GnssLog]:
    """
    Read an IMU's samples and a receiver's fixes from one or two logs.

    Parameters
    ----------
    paths : list of Path
        One or two files.
    origin : ndarray, shape (3,), optional
        Of local coordinates, see `gnss_text.read_gnss`.

    Raises
    ------
    InputError
        A file has no known format, or they do not hold one of each.
    """
    modules = [format_of(path) for path in paths]
    holds = [(hasattr(module, "read_imu"), hasattr(module, "read_gnss")) for module in modules]
    if len(paths) == 2:  # what one of them is for, an autopilot's log is not asked
        holds = [
            (not other[0], not other[1]) if own == (True, True) and other != own else own
            for own, other in zip(holds, holds[::-1], strict=True)
        ]
    imu: list[ImuLog] = []
    gnss: list[GnssLog] = []
    for path, module, (has_imu, has_gnss) in zip(paths, modules, holds, strict=True):
        try:
            if has_imu:
                imu.append(_read_imu(module, path))
            if has_gnss:
                given = (path, origin) if module is gnss_text else (path,)
                gnss.append(module.read_gnss(*given))
        except (AttributeError, KeyError) as error:  # another version of a binary format
            raise InputError(f"{path}: a message lacks a field: {error}") from None
    if len(imu) != 1 or len(gnss) != 1:
        raise InputError(
            f"{', '.join(map(str, paths))}: {len(imu)} IMU logs and {len(gnss)} GNSS logs; give "
            "one of each"
        )
    return imu[0], gnss[0]


def _read_imu(module: ModuleType, path: Path) -> ImuLog:
    """Read the IMU's samples; a table of fixes that is taken for a table of them is named."""
    try:
        samples: ImuLog = module.read_imu(path)
    except InputError:
        lacks = gnss_text.lacking(head_of(path, HEAD)) if module is imu_text else ""
        if not lacks:
            raise
        raise InputError(
            f"{path}: is no table of an IMU, and to be one of fixes it lacks a column for {lacks}: "
            "docs/logs.md shows the names"
        ) from None
    return samples


def read_estimate(path: Path) -> EstimateLog | None:
    """Read the autopilot's own estimate from a log that holds one; see `format_of`."""
    read = getattr(format_of(path), "read_estimate", None)
    return None if read is None else read(path)


def format_of(path: Path) -> ModuleType:
    """
    Return the module that reads a file.

    Raises
    ------
    InputError
        There is no such file, or none recognises it.
    """
    if path.is_dir():
        raise InputError(f"{path}: is a folder; give the files, or a folder of CSV files alone")
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    try:
        head = head_of(path, HEAD)
    except (OSError, EOFError) as error:
        raise InputError(f"{path}: cannot be read: {error}") from None
    if head.startswith(BAGS):
        raise InputError(f"{path}: {IS_A_BAG}")
    for module in FORMATS:
        if module.recognise(head):
            return module
    names = ", ".join(module.__name__.rpartition(".")[2] for module in FORMATS)
    raise InputError(
        f"{path}: none of the known formats ({names}); a table of fixes needs a line of names with "
        "time, latitude and longitude: docs/logs.md"
    )
