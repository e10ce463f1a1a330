"""
Motion by position fixes alone, and their wander while a calm IMU shows that there is none.

Near walls and under roofs the fixes of a vehicle that stands wander by metres, as fast as it could
go. A motion that no accelerometer shows has a constant velocity: fixes follow a straight line, or a
parabola. Wander does not.
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray

from hybrid_ins.core.compilation import kernel
from hybrid_ins.core.inertial.earth import curvature_scale, displacement, wrapped

FIX_SPAN_NS = 5_000_000_000  # of fixes that may show motion
MIN_FIXES, MAX_FIXES = 4, 64  # of those
MIN_SPEED = 0.25  # m/s: the slow errors of receivers are as fast
SIGNIFICANT_SPEED = 4.0  # standard deviations of the speed
SHORTEST_WANDER_NS, WANDER_SPAN_NS = 8_000_000_000, 20_000_000_000  # of fixes that show wander
SPACING_NS = 240_000_000  # between two of those, at the least
STRAIGHT = 13.0  # times what a parabola leaves of them: a random walk moves 5 times as far
ALIKE = 0.4  # correlation of what is left of neighbours: noise has none
BEYOND_CLAIM = 0.3  # of what is left to what is claimed: the slow errors of an open sky leave 0.2


class FixMotion:
    """
    Speed over ground by the last position fixes, from their own scatter, whatever they claim.

    Attributes
    ----------
    speed : float
        Horizontal [m/s]; 0 where it is not significant.
    """

    def __init__(self) -> None:
        self.speed = 0.0
        self._t_ns = np.empty(0, np.int64)
        self._lla = np.empty((0, 3))
        self._spaced: deque[tuple[int, NDArray[np.float64], float]] = deque()

    def observe(self, t_ns: int, lla: NDArray[np.float64], claimed_std: float) -> None:
        """
        Use a position fix.

        Stamp [ns], latitude and longitude [rad] and height [m], (3,), NaN where it has none; and
        what it claims horizontally [m].
        """
        if len(self._t_ns) and t_ns <= self._t_ns[-1]:
            return
        lla = np.nan_to_num(lla)  # the length of a degree hardly depends on the height
        first = max(self._t_ns.searchsorted(t_ns - FIX_SPAN_NS), len(self._t_ns) + 1 - MAX_FIXES)
        self._t_ns = np.concatenate((self._t_ns[first:], (t_ns,)))
        self._lla = np.concatenate((self._lla[first:], (lla,)))
        self.speed = significant_speed(self._t_ns, self._lla)
        spaced = self._spaced
        if not spaced or t_ns - spaced[-1][0] >= SPACING_NS:
            spaced.append((t_ns, lla, claimed_std))
        while t_ns - spaced[0][0] > WANDER_SPAN_NS:
            spaced.popleft()

    def moves(self, t_ns: int) -> bool:
        """Return whether fixes have shown motion until a stamp [ns], and not long before."""
        return self.speed > 0.0 and t_ns - int(self._t_ns[-1]) < FIX_SPAN_NS

    def wanders(self, since_ns: int, t_ns: int) -> bool:
        """
        Return whether what they have shown until a stamp [ns] is their wander.

        Parameters
        ----------
        since_ns, t_ns : int
            Stamps [ns] between which the IMU has shown no change of the velocity.
        """
        spaced = [one for one in self._spaced if one[0] >= since_ns]
        if not spaced or spaced[-1][0] - spaced[0][0] < SHORTEST_WANDER_NS:
            return False
        if t_ns - spaced[-1][0] > FIX_SPAN_NS:
            return False
        stamps, places_lla, claims = zip(*spaced, strict=True)
        if len(stamps) < 2 * MIN_FIXES:
            return False
        t = (np.array(stamps) - stamps[0]) * 1e-9
        places = displacement(places_lla[0], np.stack(places_lla))[:, :2]
        parabola = np.vander(t / t[-1], 3)
        fit = parabola @ np.linalg.lstsq(parabola, places, rcond=None)[0]
        left, moved = places - fit, float(np.linalg.norm(fit[-1] - fit[0]))
        square = float(np.mean(left**2))
        alike = 1.0 - 0.5 * float(np.mean(np.diff(left, axis=0) ** 2)) / max(square, 1e-12)
        least = max(moved / STRAIGHT, BEYOND_CLAIM * float(np.mean(claims)))
        return alike > ALIKE and math.sqrt(2.0 * square) > least


@kernel()
def significant_speed(t_ns, lla):  # type: ignore[no-untyped-def]
    """
    Return the horizontal speed [m/s] of positions by a straight line; 0 where it is none.

    Stamps (N,) [ns]; latitude, longitude [rad] and height [m], (N, 3). It has to be significant
    without the largest step between two positions, too: receivers step at rest.
    """
    count = len(t_ns)
    if count < MIN_FIXES:
        return 0.0
    t, places, last = np.empty(count), np.empty((count, 2)), lla[count - 1]
    north, east, _ = curvature_scale(last)
    for k in range(count):
        t[k] = (t_ns[k] - t_ns[count - 1]) * 1e-9
        places[k, 0] = (lla[k, 0] - last[0]) * north
        places[k, 1] = wrapped(lla[k, 1] - last[1]) * east
    t -= t.mean()
    speed = _slope(t, places)
    if speed == 0.0:
        return 0.0
    at, largest = 1, 0.0
    for k in range(1, count):
        step = np.hypot(places[k, 0] - places[k - 1, 0], places[k, 1] - places[k - 1, 1])
        if step > largest:
            at, largest = k, step
    for axis in range(2):
        step = places[at, axis] - places[at - 1, axis]
        others = (places[count - 1, axis] - places[0, axis] - step) / (count - 2)
        for k in range(at, count):
            places[k, axis] += others - step
    return speed if _slope(t, places) > 0.0 else 0.0


@register_jitable
def _slope(t, places):  # type: ignore[no-untyped-def]
    """Return the speed of places (N, 2) [m] by a straight line, t (N,) about 0; 0: it is none."""
    count, square, residual, speed = len(t), np.sum(t * t), 0.0, 0.0
    for axis in range(2):
        place = places[:, axis] - places[:, axis].mean()
        slope = np.sum(t * place) / square
        residual += np.sum((place - t * slope) ** 2)
        speed = np.hypot(speed, slope)
    variance = residual / (2 * count - 4) / square
    return speed if speed > max(MIN_SPEED, SIGNIFICANT_SPEED * np.sqrt(variance)) else 0.0
