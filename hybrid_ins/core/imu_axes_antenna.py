"""
An antenna far from where it is said to be, by a motion that does not fit the IMU's readings.

Twenty metres above the IMU of a ship an antenna swings by more than its fixes scatter: with its
place missing or of the wrong sign no readings fit, and the filter finds the heading of a vehicle
that rolls the other way. `lever_arm_observer` starts from a known heading, this does not: its
lever arm comes with a fit of the attitude. Two motions that are half different have to agree on it.
"""

from __future__ import annotations

from collections.abc import Generator

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.imu_axes_faults import NEW_MOTION
from hybrid_ins.core.imu_axes_fit import Fit, Motion, fit
from hybrid_ins.core.imu_axes_nuisance import FAR

Array = NDArray[np.float64]

FAR_AWAY = 4.0  # m: nearer ones are left to `lever_arm_observer`
AGREE, AGREE_SHARE = 1.0, 0.15  # m, and of the error: between two motions
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


class FarAntenna:
    """
    What the motions so far show of an antenna that is far from its given place.

    Attributes
    ----------
    error : ndarray, shape (3,), or None
        True minus given lever arm [m], in the IMU's own axes, once two motions agree on it.
    """

    def __init__(self) -> None:
        self.error: Array | None = None
        self.reset()

    def reset(self) -> None:
        """Forget the last motion."""
        self._last: Array | None = None
        self._last_end = 0.0

    @property
    def is_doubtful(self) -> bool:
        """A motion has shown another place."""
        return self._last is not None

    def add(self, motion: Motion, found: Fit) -> None:
        """Use the fit of a motion that only another place of the antenna explains."""
        error = found.lever_arm - found.given_arm
        begin, end = float(motion.fix_t[0]), float(motion.fix_t[-1])
        last, is_new = self._last, end - self._last_end >= NEW_MOTION * (end - begin)
        if last is not None and not is_new:
            return
        self._last, self._last_end = error, end
        allowed = AGREE + AGREE_SHARE * float(np.linalg.norm(error))
        if last is not None and np.linalg.norm(error - last) < allowed:
            self.error = 0.5 * (error + last)
