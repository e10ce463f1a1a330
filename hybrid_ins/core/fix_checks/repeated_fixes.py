"""
Detection of a driver that publishes each measurement of its receiver several times.

A driver that is faster than its receiver repeats the last position with a new stamp: to a filter
the vehicle stands, and then jumps. Bit-identical positions alone do not show it. A receiver whose
positions are rounded repeats them at rest, too; but then it goes on by one component and one unit
at a time, and in motion each position is a new one. Of a driver that repeats, every position comes
at least twice, and all components change together. A driver that is a little faster than its
receiver, 5 Hz with one of 4 Hz, repeats a few: never for long, and all components always change.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.inertial.earth import displacement
from hybrid_ins.core.noise.position_scatter import horizontal_variance

Array = NDArray[np.float64]

LEFT_BEHIND = 3.0  # m, and standard deviations: so far from it a repeated position is not believed
RECENT, SOME, SHORT = 30, 5, 3  # runs; repetitions among them that show it, of such a length
RUNS = 4  # in a row that show a driver that repeats; by chance that takes 10^5 rounded positions


class Position(Protocol):
    """What a receiver says of where it is."""

    @property
    def lla(self) -> Array:
        """Latitude, longitude [rad] and height [m], (3,)."""

    @property
    def covariance_n(self) -> Array:
        """Its covariance (3, 3) [m²], NED."""


Fix = TypeVar("Fix", bound=Position)


def left_behind(fix: Position) -> float:
    """Return how far [m] a vehicle may move while its receiver repeats a position."""
    return LEFT_BEHIND * max(1.0, math.sqrt(horizontal_variance(fix.covariance_n)))


def without_held(fixes: Sequence[Fix]) -> list[Fix]:
    """
    Return fixes, in the order of their stamps, without those of a receiver that held its position.

    After them its position has jumped: the vehicle had left it behind. The first one stays.
    """
    kept: list[Fix] = []
    first = 0
    for k, fix in enumerate(fixes):
        if np.array_equal(fix.lla, fixes[first].lla, equal_nan=True):
            continue
        jump = np.linalg.norm(displacement(fixes[first].lla, fix.lla)[:2])
        kept += fixes[first : first + 1 if jump > left_behind(fixes[first]) else k]
        first = k
    return kept + list(fixes[first:])


def with_course(velocity_n: Array) -> Array:
    """
    Return a velocity (3,) with its course [rad] and its speed, (5,).

    A receiver that rounds these two changes north and east with either, one that rounds north and
    east changes these.
    """
    north, east, _ = velocity_n + 0.0  # without the sign of a zero, which would be a course
    course, speed = math.atan2(east, north), math.hypot(north, east)
    return np.array([*velocity_n, round(course, 6), round(speed, 6)])


class RepetitionCheck:
    """
    Compares each measurement of a kind with the one before.

    Attributes
    ----------
    repeats : bool
        Measurements come several times: only the first of each has the right stamp.
    """

    def __init__(self) -> None:
        self.repeats = False
        self._last: Array | None = None
        self._length = 0  # of the run of identical measurements
        self._runs = 0  # that show a repetition, less those that contradict it; 0 to RUNS
        self._recent: deque[int] = deque(maxlen=RECENT)  # lengths of runs; 0: not ended completely
        self._varies = np.array([True, True, False, True, True])  # what is no constant

    def is_again(self, measured: Array) -> bool:
        """
        Return whether a measurement is bit-identical to the last one.

        It is a position (3,), or a velocity `with_course` (5,).
        """
        last, self._last = self._last, measured
        if last is None:
            self._length = 1
            return False
        changed = (measured != last) & ~(np.isnan(measured) & np.isnan(last))
        if not changed.any():
            self._length += 1
            return True
        self._varies[: len(changed)] |= changed
        self._count_run(bool(changed[self._varies[: len(changed)]].all()))
        self._length = 1
        return False

    def _count_run(self, ends_completely: bool) -> None:
        """Count the run of identical measurements that has ended; all components changed or not."""
        self._recent.append(self._length if ends_completely else 0)
        if self._length == 1:
            self._runs = max(self._runs - 1, 0) if self.repeats else 0
        elif ends_completely:
            self._runs = min(self._runs + 1, RUNS)
        elif not self.repeats:
            self._runs = 0
        is_every = self._runs > 0 if self.repeats else self._runs == RUNS
        self.repeats = is_every or self._some_are_repeated()

    def _some_are_repeated(self) -> bool:
        """Return whether the driver is a little faster than its receiver."""
        lengths = self._recent
        if len(lengths) < RECENT or not 0 < min(lengths) <= max(lengths) <= SHORT:
            return False
        return sum(length > 1 for length in lengths) >= SOME
