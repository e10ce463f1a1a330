"""
NMEA 0183 streams: GGA and RMC, GST for standard deviations. Needs `pynmeagps`.

References
----------
NMEA 0183 standard 4.11, sentences GGA, GST, RMC.
"""

from __future__ import annotations

import re
from datetime import date, datetime, time, timedelta, timezone
from pathlib import Path
from typing import Any

import numpy as np

from hybrid_ins.dataset.logs.series import FIX, GBAS_FIX, SBAS_FIX, GnssLog, diagonal, undamaged
from hybrid_ins.errors import InputError

STATUS = {1: FIX, 2: SBAS_FIX, 3: FIX, 4: GBAS_FIX, 5: GBAS_FIX}
RANGE_STD, VERTICAL = 2.5, 1.5  # m, for a dilution of precision of 1; of the horizontal deviation
KNOT = 1852.0 / 3600.0  # m/s


def recognise(head: bytes) -> bool:
    """Return whether a file holds NMEA sentences near its beginning, among others perhaps."""
    return (
        re.search(rb"\$[A-Z]{2}(GGA|RMC|GST|GLL|VTG|GSA|GSV),[^\r\n]*\*[0-9A-F]{2}", head)
        is not None
    )


def read_gnss(path: Path) -> GnssLog:
    """
    Read the fixes; the day is that of RMC.

    Heights are above the ellipsoid where GGA has the geoid's.

    Raises
    ------
    InputError
        `pynmeagps` is not installed, or there are no GGA sentences with a fix, or no date.
    """
    try:
        from pynmeagps import ERR_IGNORE, NMEAReader
    except ImportError:
        raise InputError(f"{path}: NMEA files need pynmeagps: pip install pynmeagps") from None
    epochs: dict[tuple[int, time], dict[str, Any]] = {}
    key = (0, time())  # days since the first sentence, time of day
    with path.open("rb") as stream:
        for message in undamaged(NMEAReader(stream, quitonerror=ERR_IGNORE)):
            if message.msgID not in ("GGA", "RMC", "GST"):
                continue
            if isinstance(message.time, time):
                past_midnight = message.time < key[1] and key[1].hour == 23
                key = key[0] + past_midnight, message.time
                epochs.setdefault(key, {})[message.msgID] = message
    found = [(key, m) for key, m in epochs.items() if "GGA" in m and m["GGA"].quality in STATUS]
    dates = [(key[0], m["RMC"].date) for key, m in epochs.items() if "RMC" in m]
    dates = [(days, day) for days, day in dates if isinstance(day, date)]
    if not found:
        raise InputError(f"{path}: no GGA sentence with a fix; enable GGA in the receiver")
    if not dates:
        raise InputError(f"{path}: no RMC sentence has the date; enable RMC in the receiver")
    midnight = datetime.combine(dates[0][1], time(), timezone.utc) - timedelta(days=dates[0][0])
    rows = [_row(midnight + timedelta(days=days), at, m) for (days, at), m in found]
    t, lla, std, status, velocity = map(np.array, zip(*rows, strict=True))
    return GnssLog(path, t, lla, diagonal(std), status.astype(np.int8), velocity, None)


def _row(day: datetime, at: time, epoch: dict[str, Any]) -> tuple[Any, ...]:
    t = datetime.combine(day.date(), at, timezone.utc).timestamp()
    gga, gst, rmc = epoch["GGA"], epoch.get("GST"), epoch.get("RMC")
    geoid = gga.sep if isinstance(gga.sep, float) else 0.0
    lla = (np.radians(gga.lat), np.radians(gga.lon), float(gga.alt) + geoid)
    if gst is not None and isinstance(gst.stdLat, float):
        std = (gst.stdLat, gst.stdLong, gst.stdAlt)
    else:
        horizontal = RANGE_STD * (gga.HDOP if isinstance(gga.HDOP, float) else 1.0) / 2**0.5
        std = (horizontal, horizontal, VERTICAL * horizontal)
    velocity = (np.nan, np.nan, np.nan)
    if rmc is not None and isinstance(rmc.spd, float):
        course = np.radians(rmc.cog) if isinstance(rmc.cog, float) else 0.0
        speed = rmc.spd * KNOT
        velocity = (speed * np.cos(course), speed * np.sin(course), np.nan)
    return t, lla, std, STATUS[gga.quality], velocity
