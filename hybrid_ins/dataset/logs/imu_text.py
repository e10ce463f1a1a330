"""
Tables of IMU readings in text: time, three accelerations, three angular rates in any order.

Columns and units are found by name where there is a header, else by what the numbers can be: the
time increases, gravity shows the accelerations and their unit, and rates of a moving IMU are in
rad/s below ``LARGEST_RAD`` and in deg/s above. The time may also be ISO 8601, a date and a time of
day, or a GPS week and its seconds, which the header names.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from hybrid_ins.core.inertial.earth import STANDARD_GRAVITY
from hybrid_ins.dataset.logs import text
from hybrid_ins.dataset.logs.series import DAY, WEEK, ImuLog, rising, text_of, utc_from_gps
from hybrid_ins.errors import InputError
from hybrid_ins.ros.messages.trajectory import Array

UNITS_OF_GRAVITY = {"m/s²": 1.0, "g": STANDARD_GRAVITY, "mg": 1e-3 * STANDARD_GRAVITY}
TOLERANCE = 0.3  # of gravity, for the median of the specific force
STEADINESS = 0.02  # share of gravity, within which the first of several candidates is taken
LARGEST_RAD = 4.0  # rad/s, of the median of the faster half of the readings
DATED = 1e9  # s: a clock beyond it counts from 1970
NAMES = {
    "t": r"^(t|time|timestamp|stamp|sec|seconds|uptime|t_?(s|ms|us|ns))\b",
    "week": r"^(gps_?)?(week|wn|wk)\b",
    "tow": r"^(i?tow|sow|gps_?(tow|sow|seconds))",
    "a": r"^(a|acc|accel|acceleration|f|linear_acceleration)[ _.]?({0})\b",
    "w": r"^(g|gyr|gyro|w|omega|rate|angular_velocity)[ _.]?({0})\b",
}


def recognise(head: bytes) -> bool:
    """Return whether a file is a table of seven or more numbers a line."""
    lines = [line for line in head.split(b"\n")[:-1] if line.strip() and line[:1] not in b"#%"]
    rows = [_values(_words(line.decode("utf-8", "replace"))) for line in lines]
    return sum(np.isfinite(row).sum() >= 7 for row in rows) > 0.5 * len(lines)


def read_imu(path: Path) -> ImuLog:
    """
    Read a table; lines that are no row of it (preamble, comments, cut lines) are left out.

    Raises
    ------
    InputError
        It has no seven columns that can be time, accelerations and angular rates.
    """
    lines = [_words(line) for line in text_of(path).splitlines()]
    rows = [_values(words) for words in lines]
    shapes = [tuple(np.isfinite(row).tolist()) for row in rows]
    full = [shape for shape in shapes if sum(shape) >= 7]
    if len(full) < 10:
        raise InputError(f"{path}: fewer than ten rows of seven or more numbers")
    shape = max(set(full), key=full.count)
    chosen = [k for k, one in enumerate(shapes) if one == shape]
    names = _header(lines[: chosen[0]], len(shape))
    table = np.array([rows[k] for k in chosen])
    calendar, used = _calendar(path, names, lines[chosen[0]], [lines[k] for k in chosen], table)
    free = [k for k, is_number in enumerate(shape) if is_number and k not in used]
    time, force, rate = _columns(path, table, names, free, calendar is not None)
    t = calendar if calendar is not None else table[:, time] * _unit_of(path, table[:, time])
    factor = _unit_of_gravity(path, table[:, force])
    rates = table[:, rate]
    if _is_in_degrees(rates, " ".join(names[k] for k in rate) if names else ""):
        rates = np.radians(rates)
    held = np.append(False, (np.diff(table[:, [*force, *rate]], axis=0) == 0.0).all(axis=1))
    # A logger that asks faster than the sensor samples repeats rows.
    kept = rising(path, t, "IMU samples") & ~held
    return ImuLog(path, t[kept], table[kept][:, force] * factor, rates[kept], t[0] > DATED)


def _calendar(
    path: Path, names: list[str], first: list[str], lines: list[list[str]], table: Array
) -> tuple[Array | None, list[int]]:
    """Return times [s] of a calendar or a clock of the day, and their columns, if it has such."""
    found = {what: _named(names, NAMES[what]) for what in ("week", "tow")}
    if min(found.values()) >= 0:
        tow = table[:, found["tow"]] * _unit_of(path, table[:, found["tow"]])
        return utc_from_gps(table[:, found["week"]] * WEEK + tow), list(found.values())
    of_day = [k for k, word in enumerate(first) if text.CLOCK.fullmatch(word)]
    if of_day:
        clock = of_day[0]
        days = [k for k, word in enumerate(first[:clock]) if np.isfinite(text.dates([word])[0])]
        if days:
            t = text.dates([row[days[0]] for row in lines]) + table[:, clock]
            return t, [days[0], clock]
        midnights = np.cumsum(np.diff(table[:, clock], prepend=0.0) < -0.5 * DAY)
        return table[:, clock] + midnights * DAY, [clock]
    iso = [k for k, word in enumerate(first) if np.isfinite(text.stamp(word))]
    return (table[:, iso[0]], iso) if iso else (None, [])


def _is_in_degrees(rates: Array, names: str) -> bool:
    """Return whether rates are in deg/s: by the names of their columns, else by their size."""
    if re.search(r"deg|dps|°", names):
        return True
    faster = np.median(np.sort(np.linalg.norm(rates, axis=1))[len(rates) // 2 :])
    return "rad" not in names and bool(faster > LARGEST_RAD or np.max(np.abs(rates)) > 40.0)


def _words(line: str) -> list[str]:
    """Return the words of a line; a space separates them, too, where nothing else does."""
    words = text.split(line, text.separator_of(line))
    return words if len(words) != 1 else line.split()


def _values(words: list[str]) -> list[float]:
    """Return the numbers of a line; times of day and ISO 8601 count, other words are NaN."""
    try:
        return [float(word) for word in words]
    except ValueError:
        return [_value(word) for word in words]


def _value(word: str) -> float:
    if text.CLOCK.fullmatch(word):
        return float(text.clocks([word])[0])
    value = text.number(word)
    return value if np.isfinite(value) else text.stamp(word)


def _header(lines: list[list[str]], width: int) -> list[str]:
    """Return the names of the columns, if one of the lines before the first row has them."""
    for line in reversed(lines):
        words = [word.strip('"#% ').lower() for word in line]
        if len(words) == width and all(words) and not np.isfinite(_values(words)).any():
            return words
    return []


def _named(names: list[str], pattern: str) -> int:
    """Return the first column with such a name; -1 where there is none."""
    return next((k for k, name in enumerate(names) if re.match(pattern, name)), -1)


def _columns(
    path: Path, table: Array, names: list[str], free: list[int], is_timed: bool
) -> tuple[int, list[int], list[int]]:
    """Return the columns of the time (-1 where that is known), the accelerations and the rates."""
    force, rate = ([_named(names, NAMES[what].format(axis)) for axis in "xyz"] for what in "aw")
    time = -1 if is_timed else _named(names, NAMES["t"])
    if min(*force, *rate, 0 if is_timed else time) >= 0:
        return time, force, rate
    rising = [k for k in free if np.mean(np.diff(table[:, k]) >= 0.0) > 0.99]
    rising = [k for k in rising if table[-1, k] > table[0, k]]
    if not is_timed and time < 0:
        if not rising:
            raise InputError(f"{path}: no column increases as a time does; add a line of names")
        clocks = [k for k in rising if not (np.diff(table[:, k]) == 1.0).all()]
        time = [*clocks, *rising][0]  # rather than a count of the rows
    others = [k for k in free if k != time and k not in rising]
    step = 1 if len(others) % 3 else 3  # of whole vectors no two are mixed
    triples = [others[k : k + 3] for k in range(0, max(len(others) - 2, 0), step)]
    triples = [three for three in triples if _gravity(table[:, three]) is not None]
    if not triples or len(others) < 6:
        raise InputError(
            f"{path}: no three columns hold gravity in m/s², g or mg; name the columns in a header"
        )
    unsteady = [_unsteadiness(table[:, three]) for three in triples]
    triple = triples[int(np.argmax(np.array(unsteady) < min(unsteady) + STEADINESS))]
    return time, triple, [k for k in others if k not in triple][:3]


def _unsteadiness(force: Array) -> float:
    """Return by how much the size of readings varies and is not that of gravity, as a share."""
    sizes = np.linalg.norm(force, axis=1)
    middle = float(np.median(sizes))
    factor = _gravity(force)
    assert factor is not None
    spread = float(np.median(np.abs(sizes - middle))) / middle
    return spread + abs(middle * factor / STANDARD_GRAVITY - 1.0)


def _gravity(force: Array) -> float | None:
    middle = float(np.median(np.linalg.norm(force, axis=1)))
    for factor in UNITS_OF_GRAVITY.values():
        if abs(middle * factor / STANDARD_GRAVITY - 1.0) < TOLERANCE:
            return factor
    return None


def _unit_of_gravity(path: Path, force: Array) -> float:
    factor = _gravity(force)
    if factor is None:
        middle = float(np.median(np.linalg.norm(force, axis=1)))
        raise InputError(
            f"{path}: the accelerations have a median of {middle:.3g}, which is gravity in none of "
            f"{', '.join(UNITS_OF_GRAVITY)}"
        )
    return factor


def _unit_of(path: Path, t: Array) -> float:
    """Return the unit [s] of a clock: IMUs sample 5 to 10 000 times a second."""
    if not (np.diff(t) > 0.0).any():
        raise InputError(f"{path}: its times do not advance: is the first column the time?")
    try:
        return text.unit_of(t, 1e-4, 0.2)
    except ValueError as error:
        raise InputError(f"{path}: {error} are those of an IMU in no unit from s to ns") from None
