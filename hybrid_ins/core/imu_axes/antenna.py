"""
An antenna far from where it is said to be, by a motion that does not fit the IMU's readings.

Twenty metres above the IMU of a ship an antenna swings by more than its fixes scatter: with its
place missing or of the wrong sign no readings fit, and the filter finds the heading of a vehicle
that rolls the other way. `sensor_errors.lever_arm` starts from a known heading, this does not: its
lever arm comes with a fit of the attitude. Two motions that are half different have to agree on it,
of the last few.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Generator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.imu_axes.faults import NEW_MOTION
from hybrid_ins.core.imu_axes.fit import Fit, Motion, fit
from hybrid_ins.core.imu_axes.nuisance import FAR

Array = NDArray[np.float64]

FAR_AWAY = 4.0  # m: nearer ones are left to `sensor_errors.lever_arm`
AGREE = 0.3  # of the error: between two motions, at most
CERTAIN = 3.0  # standard deviations
OVERLAP, LEAST_STD = 2.0, 0.2  # of successive changes of velocity, that share fixes; m
MOTIONS_KEPT = 4  # motions: a minute of them
STARTS = 10.0  # m, along all axes: where the search for the lever arm begins


def far_fit(motion: Motion, as_given: Fit) -> Generator[None, None, Fit]:
    """Return the best fit of the axes as given, with the antenna anywhere; yields between parts."""
    best = as_given
    away = STARTS * np.vstack((np.eye(3), -np.eye(3)))
    for lever_arm in (as_given.lever_arm, *away):
        start = Fit(1.0, np.eye(3), lever_arm=lever_arm, given_arm=as_given.given_arm)
        found = fit(motion, start, FAR)
        if found.left < best.left:
            best = found
        yield
    return best


def is_far_away(found: Fit) -> bool:
    """Return whether a fit has its antenna far from the given place, for certain."""
    error, std = found.lever_arm - found.given_arm, found.arm_std * OVERLAP + LEAST_STD
    distance = float(np.linalg.norm(error))
    along = float(np.linalg.norm(error * std)) / max(distance, 1e-9)
    return distance > max(FAR_AWAY, CERTAIN * along)


class FarAntenna:
    """
    What the motions so far show of an antenna that is far from its given place.

    Attributes
    ----------
    error : ndarray, shape (3,), or None
        True minus given lever arm [m], in the IMU's own axes, once two motions agree on it.
    std : ndarray, shape (3,)
        Its standard deviation [m].
    is_doubtful : bool
        The last motion has shown another place.
    """

    def __init__(self) -> None:
        self.error: Array | None = None
        self.std: Array = np.zeros(3)
        self.reset()

    def reset(self) -> None:
        """Forget the motions so far."""
        self._shown: deque[_Shown] = deque(maxlen=MOTIONS_KEPT)
        self.is_doubtful = False

    def add(self, motion: Motion, found: Fit) -> None:
        """Use the fit of a motion that only another place of the antenna explains."""
        begin, end = float(motion.fix_t[0]), float(motion.fix_t[-1])
        std = found.arm_std * OVERLAP + LEAST_STD
        now = _Shown(found.lever_arm - found.given_arm, std, begin, end)
        for before in self._shown:
            new = (end - before.end) / min(end - begin, before.end - before.begin)
            if new >= NEW_MOTION and now.agrees_with(before):
                self.error, self.std = now.mean_with(before)
        self._shown.append(now)
        self.is_doubtful = True


@dataclass(frozen=True, slots=True, eq=False)
class _Shown:
    """What a motion shows: the error (3,) [m], its σ (3,) [m]; begin and end [s]."""

    error: Array
    std: Array
    begin: float
    end: float

    def agrees_with(self, other: _Shown) -> bool:
        """Return whether another motion shows the same, by its σ and a share of it."""
        size = float(np.linalg.norm(self.error))
        apart = np.abs(self.error - other.error)
        std = np.hypot(self.std, other.std)
        return bool(np.all(apart < 3.0 * std)) and float(np.linalg.norm(apart)) < AGREE * size

    def mean_with(self, other: _Shown) -> tuple[Array, Array]:
        """Return the weighted mean of both, and its σ."""
        own, others = self.std**-2.0, other.std**-2.0
        mean = (own * self.error + others * other.error) / (own + others)
        return mean, np.maximum(1.0 / np.sqrt(own + others), 0.5 * np.abs(self.error - other.error))
