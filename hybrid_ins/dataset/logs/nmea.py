"""
NMEA 0183 streams: GGA, RMC or ZDA for the date, GST for standard deviations. Needs `pynmeagps`.

References
----------
NMEA 0183 standard 4.11, sentences GGA, GST, RMC, ZDA.
"""

from __future__ import annotations

import io
import re
from datetime import date, time
from pathlib import Path
from typing import Any

import numpy as np

from hybrid_ins.dataset.logs.series import (
    DAY,
    FIX,
    GBAS_FIX,
    SBAS_FIX,
    GnssLog,
    diagonal,
    head_of,
    rising,
    undamaged,
)
from hybrid_ins.errors import InputError
from hybrid_ins.ros.messages.trajectory import Array

STATUS_OF_QUALITY = {1: FIX, 2: SBAS_FIX, 3: FIX, 4: GBAS_FIX, 5: GBAS_FIX}
RANGE_STD, VERTICAL = 2.5, 1.5  # m, for a dilution of precision of 1; of the horizontal deviation
KNOT = 1852.0 / 3600.0  # m/s


def recognise(head: bytes) -> bool:
    """Return whether a file holds NMEA sentences near its beginning, among others perhaps."""
    return (
        re.search(rb"\$[A-Z]{2}(GGA|RMC|GST|GLL|VTG|GSA|GSV),[^\r\n]*\*[0-9A-F]{2}", head)
        is not None
    )


class _Epoch:
    """The sentences of one time of day, by their kind."""

    def __init__(self, at: time) -> None:
        self.at = at
        self.sentences: dict[str, Any] = {}

    @property
    def day(self) -> date | None:
        """The date that RMC gives, else ZDA; None without."""
        rmc, zda = self.sentences.get("RMC"), self.sentences.get("ZDA")
        if rmc is not None and isinstance(rmc.date, date):
            return rmc.date
        try:
            return None if zda is None else date(zda.year, zda.month, zda.day)
        except (TypeError, ValueError):  # fields that are empty
            return None

    @property
    def of_day(self) -> float:
        """Seconds since midnight."""
        at = self.at
        return 3600.0 * at.hour + 60.0 * at.minute + at.second + 1e-6 * at.microsecond


def read_gnss(path: Path) -> GnssLog:
    """
    Read the fixes; the day is that of RMC or ZDA.

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
    epochs: list[_Epoch] = []
    with io.BytesIO(head_of(path, -1)) as stream:
        for message in undamaged(NMEAReader(stream, quitonerror=ERR_IGNORE)):
            if message.msgID in ("GGA", "RMC", "GST", "ZDA") and isinstance(message.time, time):
                if not epochs or epochs[-1].at != message.time:
                    epochs.append(_Epoch(message.time))
                epochs[-1].sentences[message.msgID] = message
    gga = [epoch.sentences.get("GGA") for epoch in epochs]
    found = [k for k, m in enumerate(gga) if m is not None and m.quality in STATUS_OF_QUALITY]
    if not found:
        raise InputError(f"{path}: no GGA sentence with a fix; enable GGA in the receiver")
    t = _times(path, epochs)[found]
    rows = [_row(epochs[k].sentences) for k in found]
    lla, std, status, velocity = map(np.array, zip(*rows, strict=True))
    kept = rising(path, t, "fixes")
    return GnssLog(
        path,
        t[kept],
        lla[kept],
        diagonal(std[kept]),
        status[kept].astype(np.int8),
        velocity[kept],
    )


def _times(path: Path, epochs: list[_Epoch]) -> Array:
    """
    Return the times of epochs, shape (N,) [s since 1970].

    One without a date has that of the dated epoch before it or after it whose time of day is
    nearer, or the day before or after that.
    """
    of_day = np.array([epoch.of_day for epoch in epochs])
    dated = np.array([k for k, epoch in enumerate(epochs) if epoch.day is not None], int)
    if not len(dated):
        raise InputError(f"{path}: no RMC or ZDA sentence has the date; enable RMC in the receiver")
    days = np.array([epochs[k].day for k in dated], "datetime64[s]").astype(float)
    rows = np.arange(len(epochs))
    after = np.searchsorted(dated, rows)  # of a dated epoch itself: the nearest in any case
    near = np.stack((np.minimum(after, len(dated) - 1), np.maximum(after - 1, 0)))
    away = of_day - of_day[dated[near]]
    turns = np.rint(away / DAY)
    best = np.argmin(np.abs(away - turns * DAY), axis=0)
    return np.asarray(days[near[best, rows]] - turns[best, rows] * DAY + of_day)


def _field(value: Any, missing: float = np.nan) -> float:
    """Return a number of a sentence; its field may be empty."""
    return value if isinstance(value, float) else missing


def _row(epoch: dict[str, Any]) -> tuple[Any, ...]:
    """Return position, standard deviations [m], status and velocity [m/s] of an epoch."""
    gga, gst, rmc = epoch["GGA"], epoch.get("GST"), epoch.get("RMC")
    lla = (np.radians(gga.lat), np.radians(gga.lon), _field(gga.alt) + _field(gga.sep, 0.0))
    if gst is not None and isinstance(gst.stdLat, float):
        std = (gst.stdLat, _field(gst.stdLong), _field(gst.stdAlt))
    else:
        horizontal = RANGE_STD * _field(gga.HDOP, 1.0) / 2**0.5
        std = (horizontal, horizontal, VERTICAL * horizontal)
    velocity = (np.nan, np.nan, np.nan)
    if rmc is not None and isinstance(rmc.spd, float):
        course, speed = np.radians(_field(rmc.cog, 0.0)), rmc.spd * KNOT
        velocity = (speed * np.cos(course), speed * np.sin(course), np.nan)
    return lla, std, STATUS_OF_QUALITY[gga.quality], velocity
