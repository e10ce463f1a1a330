"""What every log becomes: IMU samples and GNSS fixes in arrays, SI units."""

from __future__ import annotations

import codecs
import gzip
import logging
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.inertial.earth import C_en, ecef_to_lla
from hybrid_ins.ros.messages.trajectory import Array

NO_FIX, FIX, SBAS_FIX, GBAS_FIX = -1, 0, 1, 2  # sensor_msgs/NavSatStatus
STATUS_OF_FIX_TYPE = {3: FIX, 4: SBAS_FIX, 5: GBAS_FIX, 6: GBAS_FIX}  # MAVLink GPS_FIX_TYPE
GPS_EPOCH = 315_964_800  # 1980-01-06T00:00:00Z [s since 1970]
DAY, WEEK = 86_400, 604_800  # s
LEAPS = (  # from when on GPS time is ahead of UTC by one second more
    *("1981-07", "1982-07", "1983-07", "1985-07", "1988-01", "1990-01", "1991-01", "1992-07"),
    *("1993-07", "1994-07", "1996-01", "1997-07", "1999-01", "2006-01", "2009-01", "2012-07"),
    *("2015-07", "2017-01"),
)
GZIP = b"\x1f\x8b"

_log = logging.getLogger(__name__)


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
    covariance_n: Array  # (M, 3, 3) m², NED; NaN of axes where the receiver gave none
    status: NDArray[np.int8]  # (M,) NavSatStatus
    velocity_n: Array | None = None  # (M, 3) m/s, NED; NaN of axes where there is none
    velocity_covariance_n: Array | None = None  # (M, 3, 3) (m/s)², NED; NaN where unknown
    is_dated: bool = True  # else: the clock is that of the IMU in the same log


@dataclass(frozen=True, eq=False)
class EstimateLog:
    """An autopilot's own estimate, by the clock of its IMU; for comparison, not truth."""

    t: Array  # (K,) s
    lla: Array  # (K, 3) rad, rad, m above sea level
    velocity_n: Array  # (K, 3) m/s, NED
    quat_xyzw: Array  # (K, 4) of C_nb, FRD to NED


def undamaged(messages: Iterator[tuple[Any, Any]]) -> Iterator[Any]:
    """Yield what a library parses; where that fails on damaged bytes it goes on behind them."""
    while True:
        try:
            _, message = next(messages)
        except StopIteration:
            return
        except Exception:  # the library raises what the damage leads to
            continue
        if message is not None:
            yield message


def head_of(path: Path, size: int) -> bytes:
    """Return the first bytes of a file, decompressed (gzip), and UTF-16 text as UTF-8."""
    with path.open("rb") as stream:
        head = stream.read(2)
        stream.seek(0)
        if head != GZIP:
            return _utf8(stream.read(size))
    with gzip.open(path) as compressed:
        return _utf8(compressed.read(size))


def _utf8(head: bytes) -> bytes:
    is_utf16 = head.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    return head.decode("utf-16", "replace").encode() if is_utf16 else head


def text_of(path: Path) -> str:
    """Return a text file's content, see `head_of`."""
    return head_of(path, -1).decode("utf-8-sig", errors="replace")


def rising(path: Path, t: Array, what: str) -> NDArray[np.bool_]:
    """
    Return which rows of a log are later than all before them (N,), and warn of the others.

    Parameters
    ----------
    path : Path
        Of the log.
    t : ndarray, shape (N,)
        Times of its rows [s].
    what : str
        What a row is, in the plural.
    """
    before = np.fmax.accumulate(np.append(-np.inf, t[:-1]))
    later = np.asarray(t > before)
    if not later.all():
        first = int(np.argmin(later))
        _log.warning(
            "%s: %d of %d %s are left out, whose time does not rise; the first is number %d, at "
            "%.3f s after %.3f s: check the clock of the log",
            path,
            np.count_nonzero(~later),
            len(t),
            what,
            first + 1,
            t[first],
            before[first],
        )
    return later


def diagonal(std: Array) -> Array:
    """Return covariances (M, 3, 3) of standard deviations (M, 3), each of which may be NaN."""
    return np.where(np.eye(3), np.asarray(std)[..., None] ** 2, 0.0)  # NaN stays in its axis


def utc_from_gps(seconds: Array | float) -> Array:
    """Return UTC [s since 1970] of GPS time [s since 1980-01-06]."""
    continuous = np.asarray(seconds) + GPS_EPOCH
    starts = np.array(LEAPS, "datetime64[s]").astype(np.int64) + np.arange(1, len(LEAPS) + 1)
    return continuous - np.searchsorted(starts, continuous, side="right")


def from_ecef(ecef: Array, covariance: Array, *vectors: Array) -> tuple[Array, Array, list[Array]]:
    """
    Convert Earth-fixed positions, and what is given along the Earth's axes with them.

    Parameters
    ----------
    ecef : ndarray, shape (M, 3)
        Positions [m].
    covariance : ndarray, shape (M, 3, 3)
        Theirs [m²].
    *vectors : ndarray, shape (M, 3) or (M, 3, 3)
        Further vectors and covariances.

    Returns
    -------
    lla, covariance_n, list of ndarray
        The same, in NED.
    """
    lla = ecef_to_lla(ecef)
    C_ne = np.array([C_en(row).T for row in lla])

    def turned(rows: Array) -> Array:
        if rows.ndim == 2:
            return np.asarray(np.einsum("kij,kj->ki", C_ne, rows))
        return np.asarray(C_ne @ rows @ np.swapaxes(C_ne, 1, 2))

    return lla, turned(covariance), [turned(rows) for rows in vectors]
