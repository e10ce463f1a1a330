"""
Tables of IMU readings in text: time, three accelerations, three angular rates in any order.

Columns and units are found by name where there is a header, else by what the numbers can be: the
time increases, gravity shows the accelerations and their unit, and rates of a moving IMU are in
rad/s below ``LARGEST_RAD`` and in deg/s above.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from hybrid_ins.dataset.logs.series import ImuLog, text_of
from hybrid_ins.errors import InputError
from hybrid_ins.ros.trajectory import Array

GRAVITY = 9.80665  # m/s²
UNITS_OF_GRAVITY = {"m/s²": 1.0, "g": GRAVITY, "mg": 1e-3 * GRAVITY}
TOLERANCE = 0.3  # of gravity, for the median of the specific force
LARGEST_RAD = 4.0  # rad/s, of the median of the faster half of the readings
DATED = 1e9  # s: a clock beyond it counts from 1970
NAMES = {
    "t": r"^(t|time|timestamp|stamp|sec|seconds|uptime|t_?(s|ms|us|ns))\b",
    "a": r"^(a|acc|accel|acceleration|f|linear_acceleration)[ _.]?({0})\b",
    "w": r"^(g|gyr|gyro|w|omega|rate|angular_velocity)[ _.]?({0})\b",
}


def recognise(head: bytes) -> bool:
    """Return whether a file is a table of seven or more numbers a line."""
    lines = [line for line in head.split(b"\n")[:-1] if line.strip() and line[:1] not in b"#%"]
    return sum(len(_numbers(line.decode("utf-8", "replace"))) >= 7 for line in lines) > 0.5 * len(
        lines
    )


def read_imu(path: Path) -> ImuLog:
    """
    Read a table; lines that are no row of it (preamble, comments, cut lines) are left out.

    Raises
    ------
    InputError
        It has no seven columns that can be time, accelerations and angular rates.
    """
    lines = text_of(path).splitlines()
    rows = [_numbers(line) for line in lines]
    widths = [len(row) for row in rows if len(row) >= 7]
    if len(widths) < 10:
        raise InputError(f"{path}: fewer than ten rows of seven or more numbers")
    width = max(set(widths), key=widths.count)
    table = np.array([row for row in rows if len(row) == width])
    names = _header(lines, rows, width)
    time, force, rate = _columns(path, table, names)
    t, seconds = _seconds(path, table[:, time])
    later = np.append(True, np.diff(np.maximum.accumulate(t)) > 0.0)
    factor = _unit_of_gravity(path, table[:, force])
    rates = table[:, rate]
    if _is_in_degrees(rates, " ".join(names[k] for k in rate) if names else ""):
        rates = np.radians(rates)
    held = np.append(False, (np.diff(table[:, [*force, *rate]], axis=0) == 0.0).all(axis=1))
    kept = later & ~held  # a logger that asks faster than the sensor samples repeats rows
    return ImuLog(
        path, t[kept] * seconds, table[kept][:, force] * factor, rates[kept], t[0] * seconds > DATED
    )


def _is_in_degrees(rates: Array, names: str) -> bool:
    """Return whether rates are in deg/s: by the names of their columns, else by their size."""
    if re.search(r"deg|dps|°", names):
        return True
    faster = np.median(np.sort(np.linalg.norm(rates, axis=1))[len(rates) // 2 :])
    return "rad" not in names and bool(faster > LARGEST_RAD or np.max(np.abs(rates)) > 40.0)


def _numbers(line: str) -> list[float]:
    words = re.split(r"[,;\s]+", line.strip())
    try:
        return [float(word) for word in words if word]
    except ValueError:
        return []


def _header(lines: list[str], rows: list[list[float]], width: int) -> list[str]:
    """Return the names of the columns, if a line before the first row has them."""
    first = next(k for k, row in enumerate(rows) if len(row) == width)
    for line in reversed(lines[:first]):
        words = [w.strip('" ').lower() for w in re.split(r"[,;\t]|\s+", line.strip("#% "))]
        words = [word for word in words if word]
        if len(words) == width and not any(re.fullmatch(r"[-+.\de]+", word) for word in words):
            return words
    return []


def _columns(path: Path, table: Array, names: list[str]) -> tuple[int, list[int], list[int]]:
    """Return the columns of the time, of the accelerations and of the rates."""
    if names:
        found = {}
        for what, pattern in NAMES.items():
            for axis in ("x", "y", "z") if what != "t" else ("",):
                at = [k for k, name in enumerate(names) if re.match(pattern.format(axis), name)]
                found[what + axis] = at[0] if at else -1
        if min(found.values()) >= 0:
            return (
                found["t"],
                [found["ax"], found["ay"], found["az"]],
                [found["wx"], found["wy"], found["wz"]],
            )
    rising = [k for k in range(table.shape[1]) if np.mean(np.diff(table[:, k]) >= 0.0) > 0.99]
    rising = [k for k in rising if table[-1, k] > table[0, k]]
    if not rising:
        raise InputError(f"{path}: no column increases as a time does; add a line of names")
    time = rising[0]
    others = [k for k in range(table.shape[1]) if k != time]
    triples = [others[k : k + 3] for k in range(len(others) - 2)]
    for triple in triples:
        if _gravity(table[:, triple]) is not None:
            rest = [k for k in others if k not in triple][:3]
            if len(rest) == 3:
                return time, triple, rest
    raise InputError(
        f"{path}: no three columns hold gravity in m/s², g or mg; name the columns in a header"
    )


def _gravity(force: Array) -> float | None:
    middle = float(np.median(np.linalg.norm(force, axis=1)))
    for factor in UNITS_OF_GRAVITY.values():
        if abs(middle * factor / GRAVITY - 1.0) < TOLERANCE:
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


def _seconds(path: Path, t: Array) -> tuple[Array, float]:
    """Return the times and their unit [s]: IMUs sample 5 to 10 000 times a second."""
    steps = np.diff(t)
    if not (steps > 0.0).any():
        raise InputError(f"{path}: its times do not advance: is the first column the time?")
    step = float(np.median(steps[steps > 0.0]))
    for unit in (1.0, 1e-3, 1e-6, 1e-9):
        if 1e-4 <= step * unit <= 0.2:
            return t, unit
    raise InputError(f"{path}: steps of {step:g} are those of an IMU in no unit from s to ns")
