"""
Times of fixes by the autopilot's clock, without the scatter of their arrival.

An autopilot notes a fix when its main loop has read it, some hundredths of a second late by an
amount that varies; a fixed wing moves a metre in that time. The receiver's own time is exact, so
its times are laid on a line through those of the arrivals: what remains is one delay, which is the
clock offset, and the drift of the autopilot's clock.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import least_squares

from hybrid_ins.ros.messages.trajectory import Array

LEAST_FIXES = 10
SCATTER = 0.005  # s, of arrivals; those that are much later count less
LARGEST_SCATTER = 0.1  # s, in the median: beyond, the receiver's times are not those of the fixes
LARGEST_DRIFT = 1e-3


def times_of_epochs(arrivals: Array, epochs: Array) -> Array:
    """
    Return the times of fixes by the clock of their arrivals.

    Parameters
    ----------
    arrivals : ndarray, shape (M,)
        When the fixes arrived [s], ascending.
    epochs : ndarray, shape (M,)
        The receiver's times of the fixes [s].

    Returns
    -------
    ndarray, shape (M,)
        The arrivals themselves where they and the receiver's times do not belong together.
    """
    if len(arrivals) < LEAST_FIXES or np.any(np.diff(epochs) <= 0.0):
        return arrivals
    elapsed = epochs - epochs[0]
    late = arrivals - elapsed
    start = [float(np.median(late)), 0.0]
    line = least_squares(
        lambda x: x[0] + x[1] * elapsed - late, start, loss="soft_l1", f_scale=SCATTER
    ).x
    times = elapsed + line[0] + line[1] * elapsed
    fits = np.median(np.abs(arrivals - times)) < LARGEST_SCATTER and abs(line[1]) < LARGEST_DRIFT
    return np.asarray(times) if fits else arrivals
