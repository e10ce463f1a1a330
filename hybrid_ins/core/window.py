"""
Whether a noise estimate may be made from a window of IMU samples.

Pure checks on what the estimator's ring buffer holds; a named fault, or none.
"""

from __future__ import annotations

from enum import Enum

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

LONGEST_GAP = 3.5
"""Largest step between stamps, in median steps: jitter of host stamps passes, a lost stretch no."""
LONGEST_REPEAT = 10
LARGEST_REPEATED_SHARE = 0.4
LONGEST_AT_LIMIT = 5
LARGEST_SHARE_AT_LIMIT = 0.1
FEWEST_VALUES_TO_SATURATE = 20
SMALLEST_DROP = 3.0


class WindowFault(Enum):
    """Why a window is refused; the value is the text shown to the user."""

    NOT_FINITE = "a reading is not finite"
    OUT_OF_ORDER = "stamps do not increase"
    GAP = "samples are missing"
    RATE = "sampling rate outside the model's range"
    REPEATED = "samples repeat"
    SATURATED = "a channel is saturated"


def sampling_rate(t_ns: NDArray[np.int64]) -> float:
    """Return the rate [Hz] of stamps (N,) [ns] by their median step; 0 where they stand still."""
    step = float(np.median(np.diff(t_ns)))
    return 1e9 / step if step > 0.0 else 0.0


def find_fault(
    t_ns: NDArray[np.int64], readings: Array, rate_range_hz: tuple[float, float]
) -> WindowFault | None:
    """
    Return the first fault of a window, or None if a noise level may be read from it.

    Parameters
    ----------
    t_ns : (N,) int array
        Stamps [ns], oldest first.
    readings : (N, C) array
        Specific force [m/s^2] and angular rate [rad/s], one sample a row.
    rate_range_hz : (float, float)
        Rates that the regressor knows [Hz]; 1 % beyond is let through.
    """
    if not np.isfinite(readings).all():
        return WindowFault.NOT_FINITE
    steps = np.diff(t_ns)
    if steps.min() <= 0:
        return WindowFault.OUT_OF_ORDER
    rate = sampling_rate(t_ns)
    if steps.max() * rate > LONGEST_GAP * 1e9:
        return WindowFault.GAP
    if not 0.99 * rate_range_hz[0] <= rate <= 1.01 * rate_range_hz[1]:
        return WindowFault.RATE
    # A whole sample that repeats is stale; one channel that repeats is merely quantised.
    repeated = (readings[1:] == readings[:-1]).all(axis=1)
    count = np.count_nonzero(repeated)
    if count > LARGEST_REPEATED_SHARE * len(repeated) or (
            count > LONGEST_REPEAT and _longest_run(repeated) > LONGEST_REPEAT):
        return WindowFault.REPEATED
    for limit in (readings.max(axis=0), readings.min(axis=0)):
        dwelling = (readings == limit).sum(axis=0) >= LONGEST_AT_LIMIT
        for channel in np.flatnonzero(dwelling):
            if _is_cut_off(np.abs(limit[channel] - readings[:, channel])):
                return WindowFault.SATURATED
    return None


def _is_cut_off(below: Array) -> bool:
    """
    Return whether a channel is cut off at its extreme value, given its distance (N,) below it.

    A quantised channel dwells at its extremes too, but steps down from there by one resolution; a
    channel that was cut off drops from full swing.
    """
    at_limit = below == 0.0
    if np.unique(below).size < FEWEST_VALUES_TO_SATURATE:
        return False
    if at_limit.mean() <= LARGEST_SHARE_AT_LIMIT and _longest_run(at_limit) < LONGEST_AT_LIMIT:
        return False
    leaving = at_limit[:-1] != at_limit[1:]
    drop = np.maximum(below[:-1], below[1:])[leaving]
    return bool(drop.mean() > SMALLEST_DROP * quantisation_step(below[:, None])[0])


def _longest_run(flags: NDArray[np.bool_]) -> int:
    """Return the length of the longest stretch of true flags (N,)."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], flags, [False])).astype(np.int8)))
    return int((edges[1::2] - edges[::2]).max(initial=0))


def quantisation_step(readings: Array) -> Array:
    """
    Return the resolution (C,) that shows in readings (N, C), 0 where none does.

    A channel is quantised where at least a quarter of its values recur and all lie on one grid.
    Quantisation noise then has the variance ``step**2 / 12``, below which no estimate is honest.
    """
    ordered = np.sort(readings, axis=0)
    gaps = np.diff(ordered, axis=0)
    size = readings.shape[0]
    # Decimal values in binary differ from their grid by rounding.
    rounding = 8.0 * np.finfo(float).eps * np.maximum(-ordered[0], ordered[-1]) + 1e-300
    distinct = gaps > rounding
    recurring = distinct.sum(axis=0) + 1 <= 0.75 * size
    if not recurring.any():
        return np.zeros(readings.shape[1])
    step = np.where(distinct, gaps, np.inf).min(axis=0)
    with np.errstate(invalid="ignore"):
        multiples = np.where(distinct, gaps, 0.0) / step
    on_grid = np.abs(multiples - np.round(multiples)).max(axis=0) < 0.05
    return np.where(recurring & on_grid & np.isfinite(step), step, 0.0)
