"""
Tables of fixes in text, with a line of names: latitude and longitude, Earth-fixed, or local.

Columns are found by their names, in any order and in the usual spellings (``NAMES``); a unit may
follow in brackets or after an underscore (``SCALES``). Time is one column (seconds, milliseconds,
microseconds or nanoseconds, or ISO 8601), a date and a time, or a GPS week and its seconds; it is
UTC unless the name says GPS. Standard deviations, covariances, status and velocity are used where
they are.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Callable, Iterator
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.inertial.earth import LocalFrame
from hybrid_ins.dataset.logs import text
from hybrid_ins.dataset.logs.series import (
    FIX,
    GBAS_FIX,
    GPS_EPOCH,
    NO_FIX,
    SBAS_FIX,
    WEEK,
    GnssLog,
    diagonal,
    from_ecef,
    rising,
    text_of,
    utc_from_gps,
)
from hybrid_ins.errors import InputError
from hybrid_ins.ros.messages.trajectory import Array

VERTICAL = 1.5  # times the horizontal standard deviation, where a table has that alone
NAMES = {  # quantity: what its column may be called, unit and punctuation taken off
    "week": "week|gpsweek|gwk|wn",
    "tow": "tow|itow|sow|gpstow|secondsofweek|gpsseconds|timeofweek|gms",
    "date": "date|gpsdate|utcdate|day",
    "clock": "time|utc|utctime|gpstime|gpst|timeofday|clock",
    "t": "t|time|timestamp|stamp|utc|utctime|gpst|gpstime|unixtime|datetime|epoch|sec|seconds",
    "lat": "lat|latitude",
    "lon": "lon|lng|long|longitude",
    "height": "h|height|hgt|alt|altitude|hell|ellipsoidalheight|heightellipsoid|altellipsoid",
    "msl": "hmsl|mslh|altmsl|mslalt|heightmsl|altitudemsl|msl|ele|elevation|orthometricheight",
    "geoid": "geoid|geoidsep|geoidseparation|geoidheight|undulation|sep",
    "x": "x|ecefx|xecef|posx",
    "y": "y|ecefy|yecef|posy",
    "z": "z|ecefz|zecef|posz",
    "east": "e|east|easting|localx",
    "north": "n|north|northing|localy",
    "up": "u|up|localz",
    "sdn": "(sd|sigma|std|stdev)_?(n|north|lat|latitude)",
    "sde": "(sd|sigma|std|stdev)_?(e|east|lon|longitude)",
    "sdu": "(sd|sigma|std|stdev)_?(u|up|h|height|alt|altitude|d)",
    "sdx": "(sd|sigma|std|stdev)_?x",
    "sdy": "(sd|sigma|std|stdev)_?y",
    "sdz": "(sd|sigma|std|stdev)_?z",
    "hacc": "hacc|eph|horizontalaccuracy|accuracy|accuracyh|sigmah|horizontalstd",
    "vacc": "vacc|epv|verticalaccuracy|accuracyv|sigmav|verticalstd",
    "covnn": "(cov|var)_?(nn|n)",
    "covee": "(cov|var)_?(ee|e)",
    "covuu": "(cov|var)_?(uu|u|dd|d)",
    "covne": "cov_?(ne|en)",
    "coveu": "cov_?(eu|ue)",
    "covnu": "cov_?(nu|un)",
    "vn": "vn|veln|vnorth|velnorth|velocitynorth|northvelocity",
    "ve": "ve|vele|veast|veleast|velocityeast|eastvelocity",
    "vu": "vu|velu|vup|velup|velocityup|upvelocity",
    "vd": "vd|veld|vdown|veldown|velocitydown|downvelocity",
    "speed": "speed|groundspeed|gspeed|sog|spd",
    "course": "course|cog|headmot|headingofmotion|track|gcrs",
    "sdvn": "(sd|sigma|std)_?(vn|veln|velnorth)",
    "sdve": "(sd|sigma|std)_?(ve|vele|veleast)",
    "sdvu": "(sd|sigma|std)_?(vu|vd|velu|veld|velup|veldown)",
    "sacc": "sacc|speedaccuracy|accuracyspeed",
    "Q": "q|rtklibq|solutionquality",
    "gga": "quality|gga|ggaquality|fixquality|gpsquality|qual",
    "fixtype": "fixtype|gpsfixtype",
    "status": "status|navsatstatus|fix|fixstatus|solution|solutionstatus|mode|carrsoln|type",
}
WORDS = {  # that a status may contain, whole: without one it is FIX
    GBAS_FIX: r"\w*rtk\w*|ppp\w*|(narrow|wide)?(fixed|float|int|integer)|narrow|wide|carrier",
    SBAS_FIX: r"sbas|dgps|dgnss|diff|psrdiff|differential|waas|egnos",
    NO_FIX: r"no|nofix|not|none|invalid|lost|unknown",
}
CODES = {  # numbers of a status, by whose they are
    "Q": {1: GBAS_FIX, 2: GBAS_FIX, 3: SBAS_FIX, 4: SBAS_FIX, 5: FIX, 6: FIX},
    "gga": {0: NO_FIX, 1: FIX, 2: SBAS_FIX, 3: FIX, 4: GBAS_FIX, 5: GBAS_FIX, 9: SBAS_FIX},
    "fixtype": {0: NO_FIX, 1: NO_FIX, 2: FIX, 3: FIX, 4: SBAS_FIX, 5: GBAS_FIX, 6: GBAS_FIX},
}
UNIT = (
    r"[\[(].*?[\])]|_(deg|rad|m|cm|mm|s|ms|us|ns|mps|m_s|cm_s|mm_s|kmh|km_h|kph|kn|knots|utc|degrees|"
    r"meters|metres|seconds|ft|feet|ft_s|fps|mph)$"
)
SCALES = {  # of a unit in a column's name, to metres or m/s
    r"[\[(_ ]mm(_s|/s|ps)?[\])]?$": 1e-3,
    r"[\[(_ ]cm(_s|/s|ps)?[\])]?$": 1e-2,
    r"[\[(_ ](km_?/?h|kph)[\])]?$": 1.0 / 3.6,
    r"[\[(_ ](kn|kt|kts|knots)[\])]?$": 1852.0 / 3600.0,
    r"[\[(_ ](ft|feet)(_s|/s)?[\])]?$|[\[(_ ]fps[\])]?$": 0.3048,
    r"[\[(_ ]mph[\])]?$": 0.44704,
}
LETTER = r"([-+]?[\d.]+) ?°? ?([NSEW])"  # of a latitude or longitude
EARTH = (6.3e6, 6.4e6)  # m, distances of Earth-fixed positions from the centre
DEGREES_1E7 = 1e4  # a latitude beyond it counts in 1e-7 degrees


_log = logging.getLogger(__name__)


def recognise(head: bytes) -> bool:
    """Return whether a file has a line of names with a position and a time, and rows below."""
    return _table(head.decode("utf-8", "replace").splitlines()[:-1]) is not None


def read_gnss(path: Path, origin: Array | None = None) -> GnssLog:
    """
    Read a table of fixes.

    Parameters
    ----------
    path : Path
        Of the file.
    origin : ndarray, shape (3,), optional
        Of local coordinates: latitude, longitude [rad], height [m].

    Raises
    ------
    InputError
        A column is missing or cannot be understood, or local coordinates have no origin.
    """
    found = _table(text_of(path).splitlines())
    assert found is not None
    table = _Columns(path, *found)
    t, is_dated = table.time()
    status = table.status()
    velocity, velocity_covariance = table.velocity()
    if "lat" in table.at:
        lla = np.column_stack((table.angle("lat"), table.angle("lon"), table.height()))
        covariance = table.covariance()
    elif "x" in table.at:
        ecef = np.column_stack([table["x"], table["y"], table["z"]])
        lla, covariance, _ = from_ecef(ecef, table.covariance_of(("sdx", "sdy", "sdz")))
        if not np.isfinite(covariance).any():
            covariance = table.covariance()
    else:
        if origin is None:
            raise InputError(f"{path}: holds local coordinates: give their origin, --origin")
        enu = np.column_stack([table["east"], table["north"], table["up"]])
        lla = LocalFrame(origin).lla(enu[:, [1, 0, 2]] * [1.0, 1.0, -1.0])
        covariance = table.covariance()
    good = np.isfinite(t) & np.isfinite(lla[:, :2]).all(axis=1) & (status >= 0)
    good[good] &= rising(path, t[good], "fixes")
    if not good.any():
        raise InputError(f"{path}: no row holds a fix")
    return GnssLog(
        path,
        t[good],
        lla[good],
        covariance[good],
        status[good],
        None if velocity is None else velocity[good],
        None if velocity_covariance is None else velocity_covariance[good],
        is_dated,
    )


def _quantities(names: list[str]) -> dict[str, int]:
    """Return the column of each quantity."""
    plain = [re.sub(r"[^a-z_]", "", re.sub(UNIT, "", name.lower())) for name in names]
    at: dict[str, int] = {}
    for column, name in enumerate(plain):
        for what in _quantities_of(name):
            at.setdefault(what, column)
    if at.get("date", at.get("clock")) == at.get("clock"):  # one column alone is no date and time
        at.pop("clock", None)
    return at


@lru_cache(1024)  # lines of numbers are asked for, too: all of their words are ""
def _quantities_of(name: str) -> tuple[str, ...]:
    """Return what a column's name can mean, in lower case and without its unit."""
    bare = name.replace("_", "")
    return tuple(
        what
        for what, pattern in NAMES.items()
        if re.fullmatch(pattern, name) or re.fullmatch(pattern, bare)
    )


def lacking(head: bytes) -> str:
    """Return what a file with names of positions lacks to be a table of fixes; else nothing."""
    for _, _, _, at in _titles(head.decode("utf-8", "replace").splitlines()):
        missing = [] if _is_timed(at) else ["time"]
        if {"lat", "lon"} & at.keys():
            missing += [long for what, long in (("lat", "latitude"), ("lon", "longitude"))
                        if what not in at]  # fmt: skip
        elif {"east", "north"} & at.keys():
            missing += [what for what in ("east", "north", "up") if what not in at]
            missing[-1:] = [f"{last} (or latitude and longitude)" for last in missing[-1:]]
        else:
            continue
        return " and ".join(missing)
    return ""


def _titles(
    lines: list[str],
) -> Iterator[tuple[int, str | None, list[str], dict[str, int]]]:
    """Generate number, separator, words and columns of what may be a table's first line."""
    for number, line in enumerate(lines[:200]):
        line = line.lstrip("#% ")
        separator = text.separator_of(line)
        names = text.split(line, separator)
        yield number, separator, names, _quantities(names)


def _is_timed(at: dict[str, int]) -> bool:
    return "t" in at or {"week", "tow"} <= at.keys() or {"date", "clock"} <= at.keys()


def _table(lines: list[str]) -> tuple[list[str], list[list[str]]] | None:
    """Return the names and the rows of a table, or None: preamble and cut lines are left out."""
    for number, separator, names, at in _titles(lines):
        places = ({"lat", "lon"}, {"x", "y", "z"}, {"east", "north", "up"})
        if _is_timed(at) and any(place <= at.keys() for place in places):
            rows = [
                text.split(row, separator) for row in lines[number + 1 :] if row[:1] not in "#%"
            ]
            rows = [row for row in rows if len(row) == len(names)]
            if not rows or ("lat" not in at and "x" in at and not _is_on_earth(rows[0], at)):
                return None
            return names, rows
    return None


def _is_on_earth(row: list[str], at: dict[str, int]) -> bool:
    distance = np.linalg.norm([text.number(row[at[axis]]) for axis in "xyz"])
    return bool(EARTH[0] < distance < EARTH[1])


class _Columns:
    """The columns of a table by the quantities that they hold."""

    def __init__(self, path: Path, names: list[str], rows: list[list[str]]) -> None:
        self.path, self.names = path, names
        self.at = _quantities(names)
        self._text = list(zip(*rows, strict=True))

    def __getitem__(self, what: str) -> Array:
        """Return a column as numbers; NaN where there is none, and everywhere without it."""
        if what not in self.at:
            return np.full(len(self._text[0]), np.nan)
        return np.array([text.number(word) for word in self.words(what)])

    def words(self, what: str) -> tuple[str, ...]:
        """Return a column's words."""
        return self._text[self.at[what]]

    def name(self, what: str) -> str:
        """Return a column's name in lower case, with its unit."""
        return self.names[self.at[what]].lower()

    def angle(self, what: str) -> Array:
        """Return latitude or longitude [rad]: degrees, 1e-7 degrees, or as the name says."""
        values = self[what]
        if np.isnan(values).all():  # 32.1 N
            found = [re.fullmatch(LETTER, word.upper()) for word in self.words(what)]
            values = np.array(
                [
                    text.number(m[1]) * (-1.0 if m[2] in "SW" else 1.0) if m else np.nan
                    for m in found
                ]
            )
        if "rad" in self.name(what):
            return values
        large = np.nanmax(np.abs(self["lat"]), initial=0.0) > DEGREES_1E7
        return np.radians(values * (1e-7 if large else 1.0))

    def metric(self, what: str) -> Array:
        """Return a column in metres or m/s, converted from the unit that its name ends in."""
        if what not in self.at:
            return self[what]
        unit = next((u for end, u in SCALES.items() if re.search(end, self.name(what))), 1.0)
        return self[what] * unit

    def height(self) -> Array:
        """Return the height above the ellipsoid [m]; NaN where there is none."""
        if "height" in self.at or "msl" not in self.at:
            return self.metric("height")
        if "geoid" in self.at:
            return self.metric("msl") + self.metric("geoid")
        _log.warning(
            "%s: heights above sea level are taken for those above the ellipsoid", self.path
        )
        return self.metric("msl")

    def time(self) -> tuple[Array, bool]:
        """Return the times [s], and whether they are UTC; else the clock is one of its own."""
        if {"week", "tow"} <= self.at.keys():
            tow = self["tow"] * self._unit_of(self["tow"], self.name("tow"))
            return utc_from_gps(self["week"] * WEEK + tow), True
        if "clock" in self.at:
            t = text.dates(self.words("date")) + text.clocks(self.words("clock"))
            return self._utc(t, self.name("date") + self.name("clock")), True
        t = self["t"]
        if np.isnan(t).mean() > 0.5:
            t = text.stamps(self.words("t"))
            return self._utc(t, self.name("t")), True
        t = t * self._unit_of(t, self.name("t"))
        if np.nanmax(t) < 3e8:
            return t, False
        if "gps" in self.name("t") and np.nanmax(t) < 1.6e9:
            return utc_from_gps(t), True
        return self._utc(t, self.name("t")), True

    def _unit_of(self, t: Array, name: str) -> float:
        """Return a clock's unit [s]; receivers give up to 100 fixes a second, or one a minute."""
        try:
            return text.unit_of(t, 0.009, 60.0, name)
        except ValueError as error:
            raise InputError(
                f"{self.path}: {error} are those of a receiver in no unit from s to ns"
            ) from None

    def _utc(self, t: Array, name: str) -> Array:
        """Return UTC of a calendar's seconds since 1970 in the time scale of a column's name."""
        return utc_from_gps(t - GPS_EPOCH) if "gps" in name else t

    def status(self) -> NDArray[np.int8]:
        """Return the NavSatStatus of each row; FIX where nothing says it."""
        for what, codes in CODES.items():
            if what in self.at:
                return self._coded(what, lambda code, codes=codes: codes.get(code, FIX))  # type: ignore[misc]
        if "status" in self.at:
            # Of other numbers only those below zero have one meaning: no fix.
            is_ros = set(np.unique(self["status"]).tolist()) <= {-2.0, -1.0, 0.0, 1.0, 2.0}
            is_ros &= "status" in self.name("status")
            return self._coded("status", lambda code: code if is_ros or code < 0 else FIX)
        return np.full(len(self._text[0]), FIX, np.int8)

    def _coded(self, what: str, meaning: Callable[[int], int]) -> NDArray[np.int8]:
        codes = []
        for word in self.words(what):
            number = text.number(word)
            if np.isfinite(number):
                codes.append(meaning(int(number)))
            else:
                plain = re.sub(r"[\W_]+", " ", word.lower())
                found = (s for s, may in WORDS.items() if re.search(rf"\b({may})\b", plain))
                codes.append(next(found, FIX))
        return np.array(codes, np.int8)

    def covariance_of(self, names: tuple[str, str, str]) -> Array:
        """Return covariances (M, 3, 3) of three columns of standard deviations."""
        return diagonal(np.column_stack([self.metric(name) for name in names]))

    def covariance(self) -> Array:
        """Return (M, 3, 3), NED, by covariances, deviations, or a horizontal and a vertical one."""
        if "covnn" in self.at:
            P = np.zeros((len(self._text[0]), 3, 3))
            for i, j, what, sign in (
                *((0, 0, "covnn", 1.0), (1, 1, "covee", 1.0), (2, 2, "covuu", 1.0)),
                *((0, 1, "covne", 1.0), (1, 2, "coveu", -1.0), (0, 2, "covnu", -1.0)),
            ):
                if i == j or what in self.at:
                    P[:, i, j] = P[:, j, i] = sign * self[what]
        elif "sdn" in self.at:
            P = self.covariance_of(("sdn", "sde", "sdu"))
        else:
            horizontal = self.metric("hacc") / 2**0.5
            P = diagonal(np.column_stack((horizontal, horizontal, self.metric("vacc"))))
        unknown = np.isnan(P[:, 2, 2])
        P[unknown, 2, 2] = VERTICAL**2 * P[unknown, :2, :2].trace(axis1=1, axis2=2) / 2.0
        return P

    def velocity(self) -> tuple[Array | None, Array | None]:
        """Return velocities (M, 3), NED, and their covariances, where there are any."""
        down = -self.metric("vu") if "vu" in self.at else self.metric("vd")
        if {"vn", "ve"} <= self.at.keys():
            velocity = np.column_stack((self.metric("vn"), self.metric("ve"), down))
        elif {"speed", "course"} <= self.at.keys():
            course = self["course"] if "rad" in self.name("course") else np.radians(self["course"])
            speed = self.metric("speed")
            velocity = np.column_stack((speed * np.cos(course), speed * np.sin(course), down))
        else:
            return None, None
        if "sdvn" in self.at:
            return velocity, self.covariance_of(("sdvn", "sdve", "sdvu"))
        return velocity, diagonal(np.column_stack([self.metric("sacc") / 3**0.5] * 3))
