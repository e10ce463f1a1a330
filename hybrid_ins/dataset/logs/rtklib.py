"""
Solutions of RTKLIB, ``*.pos``.

References
----------
RTKLIB manual 2.4.2, appendix B.1 (positioning solution file).
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from datetime import datetime, timezone
from pathlib import Path

import numpy as np

from hybrid_ins.dataset.logs.series import (
    FIX,
    GBAS_FIX,
    GPS_EPOCH,
    SBAS_FIX,
    WEEK,
    GnssLog,
    from_ecef,
    text_of,
    utc_from_gps,
)
from hybrid_ins.errors import InputError

STATUS_OF_QUALITY = {1: GBAS_FIX, 2: GBAS_FIX, 3: SBAS_FIX, 4: SBAS_FIX, 5: FIX, 6: FIX}
NED_AXES, ECEF_AXES = (("n", "e", "u"), (1.0, 1.0, -1.0)), (("x", "y", "z"), (1.0, 1.0, 1.0))

SCALES = b"GPST", b"UTC", b"JST"
PLACES = b"latitude", b"x-ecef", b"e-baseline"
JST = 9 * 3600  # s ahead of UTC


def recognise(head: bytes) -> bool:
    """Return whether a file begins as a solution does."""
    lines = [line for line in head.split(b"\n") if line.startswith(b"%")]
    return any(scale in line for line in lines[-3:] for scale in SCALES) and any(
        place in line for line in lines for place in PLACES
    )


def read_gnss(path: Path) -> GnssLog:
    """
    Read a solution in degrees and metres or in ECEF, with calendar time or week and seconds.

    Raises
    ------
    InputError
        The header names no columns, or no row can be read.
    """
    names: list[str] = []
    is_sexagesimal = False
    rows: list[tuple[float, list[float]]] = []
    for line in text_of(path).splitlines():
        if line.startswith("%"):
            if any(place.decode() in line for place in PLACES):
                names = [word.split("(")[0] for word in _words(line.strip("% "))]
                is_sexagesimal = "(d'" in line
            continue
        words = _words(line)
        try:
            rows.append((_time(words[0], words[1]), [float(word) for word in words[2:]]))
        except (ValueError, IndexError):
            continue  # a cut line
    if is_sexagesimal or "e-baseline" in names:
        raise InputError(
            f"{path}: holds baselines, or degrees with minutes: let RTKLIB write latitude and "
            "longitude in degrees (out-solformat=llh, out-outdegform=deg)"
        )
    width = len(names) - 1
    rows = sorted(dict(rows).items())  # a backward solution is written from its end
    table = [(t, values) for t, values in rows if len(values) == width and width >= 10]
    if not table:
        raise InputError(f"{path}: no row has the columns that its header names")
    columns = dict(zip(names[1:], np.array([values for _, values in table]).T, strict=True))
    t = np.array([t for t, _ in table])
    status = np.array([STATUS_OF_QUALITY.get(int(q), FIX) for q in columns["Q"]], np.int8)
    t = utc_from_gps(t) if names[0] == "GPST" else t + GPS_EPOCH
    t = t - JST if names[0] == "JST" else t
    if "x-ecef" in columns:
        vectors = []
        if "vx" in columns:
            vectors.append(np.column_stack([columns[f"v{axis}"] for axis in "xyz"]))
        if "vx" in columns and "sdvx" in columns:
            vectors.append(_covariance(columns, "sdv{}", *ECEF_AXES))
        lla, covariance, turned = from_ecef(
            np.column_stack([columns[f"{axis}-ecef"] for axis in "xyz"]),
            _covariance(columns, "sd{}", *ECEF_AXES),
            *vectors,
        )
        velocity, velocity_covariance = [*turned, None, None][:2]
        return GnssLog(path, t, lla, covariance, status, velocity, velocity_covariance)
    velocity_n = None
    if "vn" in columns:
        velocity_n = np.column_stack((columns["vn"], columns["ve"], -columns["vu"]))
    return GnssLog(
        path,
        t,
        np.column_stack(
            (*np.radians((columns["latitude"], columns["longitude"])), columns["height"])
        ),
        _covariance(columns, "sd{}", *NED_AXES),
        status,
        velocity_n,
        _covariance(columns, "sdv{}", *NED_AXES) if "sdvn" in columns else None,
    )


def _covariance(
    columns: dict[str, np.ndarray], name: str, axes: Sequence[str], signs: Sequence[float]
) -> np.ndarray:
    """Return (M, 3, 3): off the diagonal the file has square roots with the sign kept."""
    P = np.zeros((len(columns["Q"]), 3, 3))
    for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (2, 0)):
        value = columns.get(name.format(axes[i] if i == j else axes[i] + axes[j]))
        if value is not None:
            P[:, i, j] = P[:, j, i] = signs[i] * signs[j] * value * np.abs(value)
    return P


def _words(line: str) -> list[str]:
    """Return the words of a line, whatever separates the fields."""
    return re.sub(r"[,;]", " ", line).split()


def _time(first: str, second: str) -> float:
    """Return GPS time [s since 1980-01-06] of a date and a time, or of a week and seconds."""
    if "/" not in first:
        return int(first) * WEEK + float(second)
    day = datetime.strptime(first, "%Y/%m/%d").replace(tzinfo=timezone.utc)
    hours, minutes, seconds = second.split(":")
    start = datetime(1980, 1, 6, tzinfo=timezone.utc)
    return (day - start).total_seconds() + 3600 * int(hours) + 60 * int(minutes) + float(seconds)
