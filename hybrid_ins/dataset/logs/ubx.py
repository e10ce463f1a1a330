"""
Streams of u-blox receivers, ``*.ubx``: NAV-PVT, and NAV-COV where it is there. Needs `pyubx2`.

References
----------
u-blox F9 HPG 1.32 interface description, UBX-NAV-PVT and UBX-NAV-COV.
"""

from __future__ import annotations

import calendar
from pathlib import Path
from typing import Any

import numpy as np

from hybrid_ins.dataset.logs.series import FIX, GBAS_FIX, SBAS_FIX, GnssLog, diagonal, undamaged
from hybrid_ins.errors import InputError


def recognise(head: bytes) -> bool:
    """Return whether a file holds NAV-PVT near its beginning, or UBX messages and no NMEA."""
    return b"\xb5\x62\x01\x07" in head or (head.startswith(b"\xb5\x62") and b"GGA," not in head)


def read_gnss(path: Path) -> GnssLog:
    """
    Read the navigation solutions.

    Raises
    ------
    InputError
        `pyubx2` is not installed, or there is no NAV-PVT with a fix.
    """
    try:
        from pyubx2 import ERR_IGNORE, UBX_PROTOCOL, UBXReader
    except ImportError:
        raise InputError(f"{path}: UBX files need pyubx2: pip install pyubx2") from None
    fixes: dict[int, Any] = {}
    covariances: dict[int, Any] = {}
    with path.open("rb") as stream:
        reader = UBXReader(stream, protfilter=UBX_PROTOCOL, quitonerror=ERR_IGNORE)
        for message in undamaged(reader):
            if message.identity == "NAV-PVT" and message.fixType in (2, 3, 4):
                if message.validDate and message.validTime:
                    fixes[message.iTOW] = message
            elif message.identity == "NAV-COV":
                covariances[message.iTOW] = message
    if not fixes:
        raise InputError(
            f"{path}: no NAV-PVT message with a fix; raw measurements have to be processed first "
            "(RTKLIB), or NAV-PVT enabled in the receiver"
        )
    messages = list(fixes.values())
    covariance = diagonal(np.array([[m.hAcc / 2**0.5] * 2 + [m.vAcc] for m in messages]) * 1e-3)
    velocity_covariance = diagonal(np.array([[m.sAcc / 3**0.5] * 3 for m in messages]) * 1e-3)
    for row, itow in enumerate(fixes):
        known = covariances.get(itow)
        if known is not None and known.posCovValid:
            covariance[row] = _matrix(known, "pos")
        if known is not None and known.velCovValid:
            velocity_covariance[row] = _matrix(known, "vel")
    return GnssLog(
        path,
        np.array([_time(m) for m in messages]),
        np.array([[np.radians(m.lat), np.radians(m.lon), m.height * 1e-3] for m in messages]),
        covariance,
        np.array([_status(m) for m in messages], np.int8),
        np.array([[m.velN, m.velE, m.velD] for m in messages]) * 1e-3,
        velocity_covariance,
    )


def _time(message: Any) -> float:
    date = (message.year, message.month, message.day, message.hour, message.min, message.second)
    return float(calendar.timegm(date) + message.nano * 1e-9)


def _status(message: Any) -> int:
    if message.carrSoln:
        return GBAS_FIX
    is_corrected = any(getattr(message, name, 0) for name in ("diffSoln", "difSoln"))
    return SBAS_FIX if is_corrected else FIX


def _matrix(message: Any, of: str) -> np.ndarray:
    nn, ne, nd, ee, ed, dd = (
        getattr(message, f"{of}Cov{axes}") for axes in ("NN", "NE", "ND", "EE", "ED", "DD")
    )
    return np.array([[nn, ne, nd], [ne, ee, ed], [nd, ed, dd]])
