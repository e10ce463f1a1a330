"""
A heading that was given for a stamp, carried on to the present by the gyroscopes.

Fixes may come a minute after the heading was true. While the IMU shows a stand, the rates are bias
and the heading stays; otherwise the vehicle turns by what the gyroscopes say, and what is not known
of their bias adds to the uncertainty. Where the bias is known, a slow turn is no stand.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.alignment.levelling import relative_attitudes, roll_pitch
from hybrid_ins.core.imu.samples import ImuRing
from hybrid_ins.core.imu.standstill import is_standing
from hybrid_ins.core.inertial.rotations import (
    heading_from_quat,
    matrix_from_quat,
    quat_from_matrix,
    quat_from_rpy,
)

Array = NDArray[np.float64]

HEADING_KEPT_STD = 0.35  # rad; an attitude less certain than that is not kept
PLAUSIBLE = 2.0  # standard deviations of a gyroscope's bias


class GivenHeading:
    """
    Carries a heading on.

    Parameters
    ----------
    t_ns : int
        Stamp at which it was true [ns].
    yaw, std : float
        The heading of b from north and its standard deviation [rad].
    """

    def __init__(self, t_ns: int, yaw: float, std: float) -> None:
        self._yaw, self._std = yaw, std
        self._t_ns = t_ns  # up to which it was carried
        self._C_then_now = np.eye(3)
        self._turning = 0.0  # s, for which the vehicle did not stand
        self._bias_std = 0.0  # rad/s, the largest of an axis

    def follow(self, ring: ImuRing, window: NDArray[np.void], bias_g: Array, std: Array) -> None:
        """
        Carry the heading on to the last sample of ``ring``.

        Parameters
        ----------
        ring : ImuRing
            With all samples since the last call.
        window : ndarray of ``SAMPLE_DTYPE``
            The last second.
        bias_g, std : ndarray, shape (3,)
            Bias of the gyroscopes and its standard deviation [rad/s].
        """
        samples = ring.after(self._t_ns - 1)
        if len(samples) < 2:
            return
        seconds = (samples["t_ns"][-1] - samples["t_ns"][0]) * 1e-9
        self._t_ns = int(samples["t_ns"][-1])
        away = np.abs(window["w"].mean(axis=0) - bias_g)
        if is_standing(window) and np.all(away < PLAUSIBLE * std):
            return
        samples["w"] -= bias_g
        self._C_then_now = self._C_then_now @ relative_attitudes(samples)[0].T
        self._turning, self._bias_std = self._turning + seconds, float(std.max())

    @property
    def std(self) -> float:
        """Standard deviation of the heading now [rad]."""
        return math.hypot(self._std, self._drift_std)

    @property
    def is_outdated(self) -> bool:
        """The gyroscopes' bias may have turned it so far that it is of no use."""
        return self._drift_std > HEADING_KEPT_STD

    @property
    def _drift_std(self) -> float:
        return self._turning * self._bias_std

    def now(self, down_b: Array) -> float:
        """Return the heading now [rad from north]; ``down_b`` (3,) is the direction of gravity."""
        return carried_heading(self._yaw, self._C_then_now, down_b)


def carried_heading(yaw: float, C_then_now: Array, down_b: Array) -> float:
    """
    Return the heading [rad from north] that one of an earlier attitude has become.

    Parameters
    ----------
    yaw : float
        The earlier one [rad from north].
    C_then_now : ndarray, shape (3, 3)
        From b now to b then.
    down_b : ndarray, shape (3,)
        Direction of gravity now, b.
    """
    roll, pitch = roll_pitch(C_then_now @ down_b)
    C_nb = matrix_from_quat(quat_from_rpy(roll, pitch, yaw)) @ C_then_now
    return heading_from_quat(quat_from_matrix(C_nb))
