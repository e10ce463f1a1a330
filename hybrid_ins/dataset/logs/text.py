"""Words, numbers and times in the lines of text tables."""

from __future__ import annotations

import csv
import logging
import re
from collections.abc import Sequence
from datetime import datetime, timezone
from functools import cache

import numpy as np

from hybrid_ins.ros.messages.trajectory import Array

DATES = ("%Y-%m-%d", "%Y/%m/%d", "%d.%m.%Y", "%Y%m%d", "%d%m%y", "%d/%m/%Y", "%m/%d/%Y")
YEARS = 1980, 2100  # of a date; others are misread
STAMP = re.compile(r"(\d{4}-\d\d?-\d\d?)[T ](\d\d?:\d\d:\d\d\.?\d*) ?(Z|UTC|[+-]\d\d:?\d\d)?")
CLOCK = re.compile(r"\d\d?:\d\d:\d\d\.?\d*Z?")
COMMA = re.compile(r"^([^.,]*),(\d+(?:[eE][-+]?\d+)?Z?)$")  # a decimal comma
SEPARATORS = ";\t,"
UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9}  # s, of a clock
UNIT_IN_NAME = re.compile(r"[\[(_ ](s|ms|us|µs|ns)[\])]?$")
LEAST_STEP = 1e-4  # s, of a clock whose unit is named
SINCE_1970 = 9e8, 2.2e9  # s, of a clock that shows the date

_log = logging.getLogger(__name__)


def separator_of(line: str) -> str | None:
    """Return what separates the words of a line; None for blanks."""
    return next((mark for mark in SEPARATORS if mark in line), None)


def split(line: str, separator: str | None) -> list[str]:
    """Return the words of a line, without quotes; a decimal comma becomes a point."""
    if separator is None:
        return line.split()
    try:
        words = [word.strip() for word in next(csv.reader([line], delimiter=separator), [])]
        return words if separator == "," else [COMMA.sub(r"\1.\2", word) for word in words]
    except csv.Error:  # control characters: no text
        return []


def number(word: str) -> float:
    """Return a word's number; NaN where it is none."""
    try:
        return float(word)
    except ValueError:
        return np.nan


def unit_of(t: Array, shortest: float, longest: float, name: str = "") -> float:
    """
    Return the unit of a clock [s]: as its name says, as makes it a date, or by its steps alone.

    Parameters
    ----------
    t : ndarray, shape (N,)
        Readings; NaN is left out.
    shortest, longest : float
        What the median of the steps can be [s].
    name : str
        Of the column, in lower case; a unit may end it, in brackets or after an underscore.

    Raises
    ------
    ValueError
        In no unit it is that, or no step is above zero; says what the steps are.
    """
    steps = np.diff(t[np.isfinite(t)])
    step = float(np.median(steps[steps > 0.0])) if (steps > 0.0).any() else np.nan
    named = UNIT_IN_NAME.search(name)
    if named and LEAST_STEP <= step * UNITS[named[1]] <= longest:
        return UNITS[named[1]]
    possible = [unit for unit in UNITS.values() if shortest <= step * unit <= longest]
    for unit in possible:
        if SINCE_1970[0] < np.nanmax(t) * unit < SINCE_1970[1]:
            return unit
    if possible:
        return possible[0]
    raise ValueError(f"steps of {step:g}")


def dates(words: Sequence[str]) -> Array:
    """Return the days of a column [s since 1970], all in one format; NaN where a word is no day."""
    distinct = set(words)
    found = [{word: _day(word, form) for word in distinct} for form in DATES]
    understood = [sum(np.isfinite(t) for t in days.values()) for days in found]
    best = int(np.argmax(understood))
    month_first = DATES.index("%m/%d/%Y")
    if understood[best] and DATES[best] == "%d/%m/%Y" and understood[month_first] == len(distinct):
        _log.warning("dates as %s are read as day/month/year", next(iter(distinct)))
    return np.array([found[best][word] for word in words])


def clocks(words: Sequence[str]) -> Array:
    """Return the times of day of a column [s]: ``hh:mm:ss`` or ``hhmmss``; NaN for other words."""
    return np.array([_clock(word) for word in words])


def stamps(words: Sequence[str]) -> Array:
    """Return a column of ISO 8601 [s since 1970]; UTC where it has no zone, NaN for other words."""
    return np.array([stamp(word) for word in words])


def stamp(word: str) -> float:
    """Return an ISO 8601 time [s since 1970]; NaN where it is none."""
    match = STAMP.fullmatch(word.strip())
    if match is None:
        return np.nan
    day, clock, zone = match.groups()
    return _day(day, "%Y-%m-%d") + _clock(clock) - _zone(zone or "Z")


@cache
def _day(word: str, form: str) -> float:
    try:
        day = datetime.strptime(word.strip(), form).replace(tzinfo=timezone.utc)
    except ValueError:
        return np.nan
    return day.timestamp() if YEARS[0] <= day.year < YEARS[1] else np.nan


def _clock(word: str) -> float:
    parts = [number(part) for part in word.strip().rstrip("Z").split(":")]
    if len(parts) == 3:
        return 3600.0 * parts[0] + 60.0 * parts[1] + parts[2]
    [value] = parts if len(parts) == 1 else [np.nan]  # hhmmss.ss
    return 3600.0 * (value // 1e4) + 60.0 * (value // 100 % 100) + value % 100.0


@cache
def _zone(word: str) -> float:
    """Return a time zone's seconds ahead of UTC."""
    if word in ("Z", "UTC"):
        return 0.0
    digits = word[1:].replace(":", "")
    seconds = 3600.0 * int(digits[:2]) + 60.0 * int(digits[2:])
    return seconds if word[0] == "+" else -seconds
