"""
Readings on a straight line: somebody has filled a gap between two samples; nothing was measured.

Converters and recorders resample so. Measured readings have noise: six axes that change along a
line for a fifth of a second are none. Those who believe them find an IMU without noise in a turn
that it has not seen.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.compilation import kernel

LASTING_NS, FEWEST = 200_000_000, 12  # time and readings: shorter lines are of a slower IMU
STRAIGHT = 1e-3  # of the change along a line, by which a reading on it may be off
ROUNDING = 3e-6  # m/s², rad/s: of readings with six decimals, or in single precision
CHANGING = 4  # axes, at least: an IMU without noise is steady on the others
FIRST, MIDDLE, LAST = 0, 1, 2
COUNT = 3


class Line(NamedTuple):
    """The line on which the last readings lie; `follows_line` overwrites it."""

    stamps: NDArray[np.int64]  # (4,) ns: of the first, a middle one, the last; their number
    readings: NDArray[np.float64]  # (3, 6) m/s², rad/s


def no_line() -> Line:
    """Return the line before the first reading."""
    return Line(np.zeros(4, np.int64), np.zeros((3, 6)))


@kernel(allocates=False)
def follows_line(stamps, readings, t_ns, reading):  # type: ignore[no-untyped-def]
    """
    Return whether a reading is one of many on a straight line in time: it was not measured.

    The same reading again leaves the answer as it is.

    Parameters
    ----------
    stamps, readings : ndarray, shape (4,), (3, 6)
        Of a `Line`.
    t_ns : int
        Stamp of the reading [ns].
    reading : tuple of float, length 6
        Specific force [m/s²] and angular rate [rad/s].
    """
    count = stamps[COUNT]
    if count == 0 or t_ns != stamps[LAST]:
        follows = count > 0 and t_ns > stamps[LAST]
        is_straight = follows and count > 1 and _is_straight(stamps, readings, t_ns, reading)
        if not is_straight:
            count = int(follows)  # a new line leads here from the reading before, if any
            stamps[FIRST] = stamps[LAST] if follows else t_ns
            for c in range(6):
                readings[FIRST, c] = readings[LAST, c] if follows else reading[c]
        if count & (count - 1) == 0:
            stamps[MIDDLE] = t_ns
            for c in range(6):
                readings[MIDDLE, c] = reading[c]
        stamps[LAST], stamps[COUNT] = t_ns, count + 1
        for c in range(6):
            readings[LAST, c] = reading[c]
    if stamps[COUNT] < FEWEST or t_ns - stamps[FIRST] < LASTING_NS:
        return False
    changing = 0
    for c in range(6):
        changing += abs(reading[c] - readings[FIRST, c]) > 10.0 * ROUNDING
    return changing >= CHANGING


@kernel(allocates=False)
def _is_straight(stamps, readings, t_ns, reading):  # type: ignore[no-untyped-def]
    """Return whether a later reading lies on the line of at least two, and they on the longer."""
    first_ns = stamps[FIRST]
    by_last = (t_ns - first_ns) / (stamps[LAST] - first_ns)
    to_middle = (stamps[MIDDLE] - first_ns) / (t_ns - first_ns)
    for c in range(6):
        first = readings[FIRST, c]
        change = reading[c] - first
        limit = STRAIGHT * abs(change) + ROUNDING
        if not (
            abs(change - by_last * (readings[LAST, c] - first)) <= limit
            and abs(readings[MIDDLE, c] - first - to_middle * change) <= limit
        ):
            return False
    return True
