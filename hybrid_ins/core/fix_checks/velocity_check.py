"""
Comparison of GNSS velocities with the displacements of the positions.

A driver may publish velocities in other axes than east, north, up: north first, or those of the
vehicle; in km/h or knots; or zeros. No filter survives velocities that contradict the positions,
and its innovations do not show which of both is wrong. The sum of velocities over some seconds
does: it has to be the way between two positions. Velocities are older than positions by up to a
second, which matters at the ends of the way only; multipath shifts positions, but not by a large
share of each of several ways. Velocities that have agreed for long are not the wrong ones: a
receiver may repeat its last position in a tunnel.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.inertial.earth import displacement
from hybrid_ins.core.update.measurements import PositionFix, VelocityFix

Array = NDArray[np.float64]

SHORTEST_TIME, LONGEST_TIME = 5.0, 60.0  # s, of a way
LEAST_WAY = 20.0  # m
SIGMAS = 10.0  # of the positions, that a way has at least
MAX_INTERVAL_NS = 2_000_000_000  # between velocities that are summed
AGE = 1.0  # s, that velocities may be older than positions
CONTRADICTS, AGREES = 0.4, 0.2  # of the longer of both ways, by which they differ
IN_A_ROW = 3  # ways that show either
MOST_AGREED = 20  # ways that agreed before and must be outnumbered: it may be the positions


@dataclass(frozen=True, slots=True)
class Contradiction:
    """The last way by which velocities were found to contradict the positions."""

    moved_n: Array  # (3,) m, NED, by the positions
    summed_n: Array  # (3,) m, NED, by the velocities
    seconds: float


class VelocityCheck:
    """Compares the velocities of a receiver with its positions, horizontally and vertically."""

    def __init__(self) -> None:
        self._comparisons = [_Comparison(axes) for axes in (slice(0, 2), slice(2, 3))]

    @property
    def contradiction(self) -> Contradiction | None:
        """Why velocities are of no use now; None where they are."""
        horizontal, vertical = self._comparisons
        return horizontal.contradiction or vertical.contradiction

    def reset(self) -> None:
        """Forget the way so far, but not what earlier ones have shown."""
        for one in self._comparisons:
            one.reset()

    def observe(self, fix: PositionFix | VelocityFix) -> None:
        """Use a position or a velocity, in the order of their arrival."""
        for one in self._comparisons:
            one.observe(fix)


class _Comparison:
    """Compares velocities with positions along some axes; attributes see `VelocityCheck`."""

    def __init__(self, axes: slice) -> None:
        self.contradiction: Contradiction | None = None
        self._axes = axes
        self._count = 0  # of ways in a row that contradict; negative: that agree
        self._agreed = 0  # ways, of all
        self.reset()

    def reset(self) -> None:
        self._start: PositionFix | None = None
        self._first: VelocityFix | None = None  # when the way began
        self._last: VelocityFix | None = None
        self._summed_n = np.zeros(3)  # m, between both

    def observe(self, fix: PositionFix | VelocityFix) -> None:
        if isinstance(fix, VelocityFix):
            self._add(fix)
        elif self._last is not None and self._start is None and fix.t_ns >= self._last.t_ns:
            self._start, self._first, self._summed_n = fix, self._last, np.zeros(3)
        elif self._start is not None:
            self._end_way(self._start, fix)

    def _add(self, fix: VelocityFix) -> None:
        """Sum velocities by the trapezoidal rule."""
        interval_ns = 0 if self._last is None else fix.t_ns - self._last.t_ns
        if not 0 <= interval_ns <= MAX_INTERVAL_NS:
            self.reset()
        if self._last is not None:
            mean_n = 0.5 * (self._last.velocity_n + fix.velocity_n)
            self._summed_n = self._summed_n + interval_ns * 1e-9 * mean_n
        self._last = fix

    def _end_way(self, start: PositionFix, end: PositionFix) -> None:
        """Compare both if the way to this position is long enough."""
        first, last, axes = self._first, self._last, self._axes
        seconds = (end.t_ns - start.t_ns) * 1e-9
        if seconds < SHORTEST_TIME:
            return
        assert first is not None and last is not None
        if seconds > LONGEST_TIME or end.t_ns - last.t_ns > MAX_INTERVAL_NS:
            self.reset()
            return
        moved_n = displacement(start.lla, end.lla)
        before, after = (start.t_ns - first.t_ns) * 1e-9, (end.t_ns - last.t_ns) * 1e-9
        summed_n = self._summed_n - before * first.velocity_n + after * last.velocity_n
        claimed = np.maximum(start.covariance_n.diagonal(), end.covariance_n.diagonal())[axes]
        way = float(max(np.linalg.norm(moved_n[axes]), np.linalg.norm(summed_n[axes])))
        if not way > max(LEAST_WAY, SIGMAS * math.sqrt(claimed.max())):
            return
        differ = float(np.linalg.norm(moved_n[axes] - summed_n[axes]))
        of_age = AGE * float(np.linalg.norm(last.velocity_n[axes] - first.velocity_n[axes]))
        if differ > CONTRADICTS * way + of_age:
            self._count = max(self._count, 0) + 1
        elif differ < AGREES * way:
            self._count = min(self._count, 0) - 1
            self._agreed = min(self._agreed + 1, MOST_AGREED)
        if self._count >= max(IN_A_ROW, self._agreed):
            self.contradiction = Contradiction(moved_n, summed_n, seconds)
        elif self._count <= -IN_A_ROW:
            self.contradiction = None
        self.reset()
