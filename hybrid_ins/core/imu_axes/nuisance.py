"""
What may explain, besides an IMU's axes, that its readings do not fit a motion: how much of it.

Each is a pair of standard deviations and limits of the parameters that `fit.fit` finds by
least squares.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

CLOCK_OFFSETS = np.linspace(-1.0, 1.0, 21)  # s, that may explain a misfit
CLOCK_STEP = float(CLOCK_OFFSETS[1] - CLOCK_OFFSETS[0])
BIAS_STD, LARGEST_BIAS = 0.02, 0.05  # rad/s, of a gyroscope
DRIFT_STD, LARGEST_DRIFT, DRIFT_TIME = 0.0015, 0.005, 30.0  # rad/s, of that bias in so many s
LEVER_ARM_STD, LONGEST_LEVER_ARM = 0.5, 3.0  # m, from the IMU to the antenna along each axis

# Bias, lever arm from where it is said to be, clock offset between those of the grid.
STRICT = (
    np.repeat((BIAS_STD, LEVER_ARM_STD, 0.5 * CLOCK_STEP), (3, 3, 1)),
    np.repeat((LARGEST_BIAS, LONGEST_LEVER_ARM, 0.5 * CLOCK_STEP), (3, 3, 1)),
)


def _tolerant(lever_arm_std: float, longest: float) -> tuple[Array, Array]:
    """
    Return the same; an accelerometer's bias [m/s²], a gyroscope's scales, misaligned axes, drift.
    """
    count = (3, 3, 1, 3, 9, 3)
    std = np.repeat((BIAS_STD, lever_arm_std, 0.5 * CLOCK_STEP, 0.1, 0.01, DRIFT_STD), count)
    largest = LARGEST_BIAS, longest, 0.5 * CLOCK_STEP, 0.5, 0.03, LARGEST_DRIFT
    return std, np.repeat(largest, count)


TOLERANT = _tolerant(2.0, 5.0)
FAR = _tolerant(20.0, 60.0)  # with an antenna anywhere
