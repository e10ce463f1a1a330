"""
Position and velocity at the start, from the first fixes and a GNSS velocity.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.inertial.earth import curvature_scale, displacement
from hybrid_ins.core.update.measurements import PositionFix, VelocityFix

Array = NDArray[np.float64]

SHORTEST_SPAN = 0.3  # s
ACCELERATION_STD = 2.0  # m/s², of a vehicle that may manoeuvre
SPEED_STD = 100.0  # m/s, of a velocity of which nothing is known
CLIMB_STD = 5.0  # m/s, of the vertical velocity of which nothing is known
HEIGHT_STD = 100.0  # m, likewise; an unknown height is considered besides, see `missing_height`
LEAST_VARIANCE = 0.01  # m²/s², of a receiver's velocity at the start


class FirstMotion(NamedTuple):
    """Position and velocity at an instant."""

    lla: Array  # (3,) rad, rad, m
    p_cov: Array  # (3, 3) m², NED
    velocity_n: Array  # (3,) m/s
    v_cov: Array  # (3, 3) m²/s²
    has_velocity: bool  # otherwise the velocity is zero, with the variance of any

    @property
    def speed(self) -> float:
        """Speed over ground [m/s]."""
        return math.hypot(self.velocity_n[0], self.velocity_n[1])


def first_motion(
    fixes: Sequence[PositionFix], velocity: VelocityFix | None, now: int
) -> FirstMotion:
    """
    Return position and velocity at a stamp.

    Parameters
    ----------
    fixes : sequence of PositionFix
        By stamp, at least one.
    velocity : VelocityFix, optional
        The last.
    now : int
        The stamp [ns].
    """
    last = fixes[-1]
    lla = last.lla.copy()
    heights = [f.lla[2] for f in fixes if math.isfinite(f.lla[2])]
    if not math.isfinite(lla[2]):
        lla[2] = heights[-1] if heights else 0.0
    scale = curvature_scale(lla)
    p_cov = last.covariance_n.copy()
    if not np.isfinite(p_cov[2, 2]) or not math.isfinite(last.lla[2]):
        p_cov[2, :] = p_cov[:, 2] = 0.0
        p_cov[2, 2] = HEIGHT_STD**2
    known = _slope(fixes, lla, p_cov, bool(heights))
    if velocity is not None and abs(now - velocity.t_ns) < 1e9:
        known = _measured(velocity, known)
    velocity_n, v_cov = known or (np.zeros(3), SPEED_STD**2 * np.eye(3))
    age = (now - last.t_ns) * 1e-9
    p_cov = p_cov + v_cov * age**2 + np.eye(3) * (0.5 * ACCELERATION_STD * age**2) ** 2
    return FirstMotion(lla + velocity_n * age / scale, p_cov, velocity_n, v_cov, known is not None)


def _measured(velocity: VelocityFix, slope: tuple[Array, Array] | None) -> tuple[Array, Array]:
    """Velocity [m/s, NED] and its covariance by the receiver; what it lacks is that of a slope."""
    velocity_n, variance = velocity.velocity_n.copy(), np.diag(velocity.covariance_n).copy()
    if not math.isfinite(velocity_n[2]):
        velocity_n[2] = 0.0 if slope is None else slope[0][2]
        variance[2] = CLIMB_STD**2 if slope is None else slope[1][2, 2]
    return velocity_n, np.diag(np.maximum(np.nan_to_num(variance), LEAST_VARIANCE))


def _slope(
    fixes: Sequence[PositionFix], lla: Array, p_cov: Array, has_heights: bool
) -> tuple[Array, Array] | None:
    """
    Velocity now [m/s, NED] and its covariance from the fixes over the best of all spans.

    The slope is the velocity at the span's middle: a short span is noisy, a long one outdated.
    ``lla`` (3,) is the last position, with a height where that has none: then nothing is known of
    the vertical velocity but that vehicles climb and descend slowly.
    """
    last = fixes[-1]
    t = np.array([(f.t_ns - last.t_ns) * 1e-9 for f in fixes])
    offsets = np.nan_to_num(displacement(lla, np.array([f.lla for f in fixes])))
    best: tuple[Array, Array] | None = None
    for start in range(len(fixes) - 1):
        centred = t[start:] - t[start:].mean()
        if t[start] > -SHORTEST_SPAN:
            break
        noise = np.diag(np.diag(p_cov)) / (centred @ centred)
        if not has_heights:
            noise[2, 2] = CLIMB_STD**2
        covariance = noise + np.eye(3) * (0.5 * ACCELERATION_STD * t[start]) ** 2
        if best is None or np.trace(covariance) < np.trace(best[1]):
            best = centred @ offsets[start:] / (centred @ centred), covariance
    return best
