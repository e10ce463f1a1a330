"""
Whether the motion of an antenna that nobody has placed may be no more than the vehicle's turns.

The antenna of a vehicle that turns on the spot, an excavator or a robot, moves on a circle about
it. That is no evidence on the heading: with another heading the lever arm has another direction,
and the fixes are the same. A filter that takes the antenna for where the IMU is finds the heading
in which the IMU's small accelerations have the direction of the antenna's large ones, and is sure
of it.

With a horizontal lever arm l, fixes p_k at the yaw angles a_k of a vehicle in uniform motion, which
an IMU does not see, are p + v t_k + R(a_k) l. So the fixes of the last seconds are compared with
the p, v and l that fit best, for any offset of their clock. What these leave over, or more of l
than an antenna is away, is a motion of the vehicle.
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.filter.ins_filter import InsFilter
from hybrid_ins.core.inertial.earth import displacement
from hybrid_ins.core.inertial.rotations import matrix_from_quat
from hybrid_ins.core.inertial.state import BIAS_G, QUAT
from hybrid_ins.core.noise.position_scatter import horizontal_variance
from hybrid_ins.core.update.measurements import Measurement, PositionFix

Array = NDArray[np.float64]

LONGEST_LEVER = 2.0  # m, of an antenna that nobody has placed
SEEN = 2.0  # standard deviations of fixes: a smaller motion of the antenna is not
LARGEST_SWING = LONGEST_LEVER / math.sqrt(2.0)  # m, root mean square over a turn
LEFT = 0.3  # of the motion: less is left where the lever arm may be all there is to it
LEAST_STD = 0.03  # m: so little is left by the errors of fixes that resolve small swings
HARDLY_LEFT = 0.12  # likewise, where it certainly is: a pedestrian's first steps leave more
LEAST_MOTION = 0.15  # m, of the antenna: filters that were misled by less can go on
LAGS_NS = np.arange(-700_000_000, 700_000_001, 100_000_000)  # of the fixes behind the IMU
WINDOW_NS = 10_000_000_000
SPACING_NS = 150_000_000  # between two fixes: more of them show hardly more
LEAST_FIXES, MANY_FIXES = 3, 8  # fewer of them a lever arm, a velocity and a clock always explain


class TurningOnTheSpot:
    """
    Compares how the antenna has moved with how turns may have moved it.

    Parameters
    ----------
    antenna_is_placed : bool
        Somebody has said where the antenna is: its motion about the vehicle is known.

    Attributes
    ----------
    hides_heading : bool
        The last fixes show no more than the antenna's motion about the vehicle.
    misleads : bool
        That has moved filters by more than they recover from.
    """

    def __init__(self, antenna_is_placed: bool) -> None:
        self._is_needed = not antenna_is_placed
        self.hides_heading = self.misleads = False
        self._fixes: deque[PositionFix] = deque()
        self._yaws: deque[tuple[int, float]] = deque()  # stamps, and yaw [rad] from the first one

    def observe(self, measurement: Measurement, follower: InsFilter) -> bool:
        """
        Use a measurement, and a filter that has followed the IMU beyond it.

        Returns whether it is no evidence on the heading.
        """
        if self._is_needed and isinstance(measurement, PositionFix):
            last_ns = self._fixes[-1].t_ns if self._fixes else 0
            if measurement.t_ns - last_ns >= SPACING_NS:
                self._compare(measurement, follower)
        return self.hides_heading

    def _compare(self, fix: PositionFix, follower: InsFilter) -> None:
        """Compare the last fixes, and this one, with the turns."""
        self._fixes.append(fix)
        self._follow(follower, fix.t_ns - LAGS_NS[-1])
        while fix.t_ns - self._fixes[0].t_ns > WINDOW_NS:
            self._fixes.popleft()
        while self._yaws and self._yaws[0][0] < self._fixes[0].t_ns - 2 * LAGS_NS[-1]:
            self._yaws.popleft()
        if min(len(self._fixes), len(self._yaws)) < LEAST_FIXES:
            return
        first = self._fixes[0].lla
        ways = np.stack([displacement(first, f.lla)[:2] for f in self._fixes])
        t_ns = np.array([f.t_ns for f in self._fixes])
        stamps, yaws = zip(*self._yaws, strict=True)
        moved, left = _explained(t_ns, ways, np.array(stamps), np.array(yaws))
        std = math.sqrt(horizontal_variance(fix.claimed))
        seen = SEEN * std
        least = math.hypot(LEFT * moved, min(std, LEAST_STD))
        self.hides_heading = left < least and seen < LARGEST_SWING
        is_all = left < HARDLY_LEFT * moved and len(t_ns) >= MANY_FIXES
        self.misleads = self.hides_heading and is_all and moved > max(LEAST_MOTION, seen)

    def _follow(self, follower: InsFilter, begin_ns: int) -> None:
        """Integrate the yaw rate up to the last IMU sample, at first from ``begin_ns`` on."""
        begin_ns, yaw = self._yaws[-1] if self._yaws else (begin_ns, 0.0)
        samples = follower.ring.after(begin_ns - 1)
        if len(samples) < 2:
            return
        down_b = matrix_from_quat(follower.nav[QUAT])[2]
        rate = (samples["w"] - follower.nav[BIAS_G]) @ down_b
        t_ns = samples["t_ns"]
        steps = 0.5e-9 * (rate[1:] + rate[:-1]) * np.diff(t_ns)
        yaws = yaw + np.concatenate(([0.0], np.cumsum(steps)))
        spacing = max(1, int(SPACING_NS * (len(t_ns) - 1) // (t_ns[-1] - t_ns[0])))
        for k in range(spacing, len(t_ns), spacing):
            self._yaws.append((int(t_ns[k]), float(yaws[k])))


def _explained(
    t_ns: NDArray[np.int64], ways: Array, stamps: NDArray[np.int64], yaws: Array
) -> tuple[float, float]:
    """
    Return what uniform motion leaves of the ways of fixes, and what a lever arm does of that.

    Both are root mean squares [m].

    Parameters
    ----------
    t_ns, ways : ndarray, shape (N,), (N, 2)
        Stamps [ns], and ways from the first fix [m], NE.
    stamps, yaws : ndarray, shape (M,)
        Stamps [ns] and yaw angles [rad].
    """
    t = (t_ns - t_ns[0]) * 1e-9
    lines = np.linalg.qr(np.stack((np.ones_like(t), t), axis=1))[0]
    way = ways @ np.array([1.0, 1j])  # a turn by a is a factor exp(i a)
    way = way - lines @ (lines.T @ way)
    at = (t_ns - LAGS_NS[:, None] - stamps[0]) * 1e-9
    turn = np.exp(1j * np.interp(at, (stamps - stamps[0]) * 1e-9, yaws))
    turn = turn - (turn @ lines) @ lines.T
    power = np.maximum(np.sum(np.abs(turn) ** 2, axis=1), 1e-12)
    lever = turn.conj() @ way / power
    lever *= np.minimum(1.0, LONGEST_LEVER / np.maximum(np.abs(lever), 1e-9))
    left = np.min(np.mean(np.abs(way - lever[:, None] * turn) ** 2, axis=1))
    return math.sqrt(float(np.mean(np.abs(way) ** 2))), math.sqrt(float(left))
