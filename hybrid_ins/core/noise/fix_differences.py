"""
How much fixes scatter from one to the next, before any filter has judged them.

A receiver that claims centimetres and scatters by metres makes all filters fail that begin with its
claims, one after the other, and by when each has learned the scatter would decide which heading
and which clock offset is right. The third differences of fixes at even distances contain hardly any
motion: the change of the acceleration, whereas white errors of σ have (1 + 9 + 9 + 1) σ² there.
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.imu.samples import ImuRing
from hybrid_ins.core.inertial.earth import displacement
from hybrid_ins.core.noise.hypotheses import COUNT, ON_R, R_LEVELS
from hybrid_ins.core.update.measurements import PositionFix

Array = NDArray[np.float64]

KEPT = 24  # fixes
LEAST = 4  # third differences that show anything
OF_WHITE = 20.0  # variance of third differences of white errors, over theirs
INDEPENDENT = 0.3  # share of third differences, which overlap, that are
UNEVEN = 0.25  # of the interval
LEVER = 1.0  # m, of an antenna whose place nobody knows
TAIL_DOF = 6.0  # of a t distribution: single fixes may jump


def third_differences(
    t_ns: NDArray[np.int64], lla: Array
) -> tuple[Array, NDArray[np.bool_], float]:
    """
    Return the third differences of fixes, which of them are of even distances, and the distance.

    Parameters
    ----------
    t_ns : ndarray, shape (N,)
        Stamps [ns].
    lla : ndarray, shape (N, 3)
        Latitude, longitude [rad] and height [m].

    Returns
    -------
    third : ndarray, shape (N - 3, 3)
        Of the positions [m], NED.
    even : ndarray of bool, shape (N - 3,)
    step : float
        The median distance [s].
    """
    steps = np.diff(t_ns) * 1e-9
    step = float(np.median(steps))
    even = np.abs(steps - step) < UNEVEN * step
    third = np.diff(displacement(lla[0], lla), 3, axis=0)
    return third, even[:-2] & even[1:-1] & even[2:], step


class FixDifferences:
    """The last position fixes, and what they say of the factor on their covariance."""

    def __init__(self) -> None:
        self._fixes: deque[PositionFix] = deque(maxlen=KEPT)

    def observe(self, fix: PositionFix) -> None:
        """Use a fix with a height; one that is older than the last begins anew."""
        if self._fixes and fix.t_ns <= self._fixes[-1].t_ns:
            self._fixes.clear()
        if not math.isnan(fix.lla.item(2)):
            self._fixes.append(fix)

    @property
    def begins_to_show(self) -> bool:
        """Whether the last fix is the first with which they may show anything."""
        return len(self._fixes) == LEAST + 3

    def shown(self, ring: ImuRing) -> tuple[Array, Array] | None:
        """
        Return the evidence on R; None where nothing is shown.

        Parameters
        ----------
        ring : ImuRing
            The IMU's samples meanwhile: how the vehicle moves.

        Returns
        -------
        log_likelihood : ndarray, shape (COUNT,)
            Of the hypotheses' factors on R.
        claimed_std : ndarray, shape (3,)
            What the fixes claim [m], NED.
        """
        if len(self._fixes) < LEAST + 3:
            return None
        t_ns = np.array([fix.t_ns for fix in self._fixes])
        third, even, step = third_differences(t_ns, np.array([fix.lla for fix in self._fixes]))
        samples = ring.after(int(t_ns[0]))
        if even.sum() < LEAST or len(samples) < 2:
            return None
        third = third[even]
        claimed = np.array([fix.covariance_n.diagonal() for fix in self._fixes])[3:][even]
        force, rate = (float(np.sqrt(samples[name].var(axis=0).sum())) for name in ("f", "w"))
        motion = 2.0 * (force * step**2 + LEVER * rate * step)
        found = np.empty(COUNT)
        for level in R_LEVELS:
            common, on_height = ON_R[:, level[0]]
            variance = OF_WHITE * common * claimed * [1.0, 1.0, on_height] + motion**2
            tail = np.log1p(third**2 / (variance * (TAIL_DOF - 2.0)))
            found[level] = -0.5 * np.sum(np.log(variance) + (TAIL_DOF + 1.0) * tail)
        found = INDEPENDENT * (found - found.max())
        return found, np.sqrt(np.median(claimed, axis=0))
