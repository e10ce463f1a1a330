"""Errors of fixes below roofs and between houses, which wander smoothly."""

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

Array = NDArray[np.float64]

SMOOTH_TIME = 1.5  # s


def smooth_wander(
    rng: np.random.Generator, shape: tuple[int, int], interval: float, std: float, time: float
) -> Array:
    """
    Return a smoothed first-order Gauss-Markov process of each axis, (fixes, axes) m.

    ``interval`` [s] is that of the fixes; ``std`` [m] and correlation ``time`` [s] are those of the
    process before it is smoothed.
    """
    decay, smooth = np.exp(-interval / time), np.exp(-interval / SMOOTH_TIME)
    steps = std * np.sqrt(1.0 - decay**2) * rng.standard_normal(shape)
    steps = lfilter([1.0], [1.0, -decay], steps, axis=0)
    return np.asarray(lfilter([1.0 - smooth], [1.0, -smooth], steps, axis=0))
