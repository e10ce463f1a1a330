"""
Checks of a window of IMU samples before noise levels are estimated from it.

The result is a named fault, or none.
"""

from __future__ import annotations

from enum import Enum

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.compilation import kernel
from hybrid_ins.core.imu.samples import sample_period

Array = NDArray[np.float64]

LONGEST_GAP = 10.0
"""
Largest step between stamps, in periods: a window may lack samples here and there, no stretch.

What vibrates between the samples that are left is noise to whatever integrates them, and shows in
their spectrum as such.
"""
LONGEST_REPEAT = 10
LARGEST_REPEATED_SHARE = 0.4
LONGEST_AT_LIMIT = 5
LARGEST_SHARE_AT_LIMIT = 0.1
FEWEST_VALUES_TO_SATURATE = 20
SMALLEST_DROP = 3.0
LARGEST_DISTINCT_SHARE = 0.75
OFF_GRID = 0.05
EPSILON = float(np.finfo(float).eps)
ROUNDING = 2.0**36
"""Per m/s² or rad/s: equal readings are equal again once they are turned into b and back."""


class WindowFault(Enum):
    """Why a window is refused; the value is the text shown to the user."""

    NOT_FINITE = "a reading is not finite"
    OUT_OF_ORDER = "stamps do not increase"
    GAP = "samples are missing"
    RATE = "sampling rate outside the model's range"
    REPEATED = "samples repeat"
    SATURATED = "a channel is saturated"


@kernel()
def own_axes(samples, mount):  # type: ignore[no-untyped-def]
    """
    Return readings (N, 6) in the axes in which the IMU gave them.

    Parameters
    ----------
    samples : (N, 7) array
        Stamps, which are not looked at, specific force [m/s^2] and angular rate [rad/s], b.
    mount : (3, 3) array
        From the IMU's axes to b.
    """
    readings = np.empty((samples.shape[0], 6))
    for row in range(samples.shape[0]):
        for sensor in (0, 3):
            for i in range(3):
                reading = 0.0
                for j in range(3):
                    reading += samples[row, 1 + sensor + j] * mount[j, i]
                readings[row, sensor + i] = np.rint(reading * ROUNDING) / ROUNDING
    return readings


def rounded(readings: Array) -> Array:
    """Return readings as `own_axes` does, of those that never left the IMU's axes."""
    return np.rint(readings * ROUNDING) / ROUNDING


def sampling_rate(t_ns: NDArray[np.int64]) -> float:
    """Return the rate [Hz] of stamps (N,) [ns]; 0 where they stand still."""
    period = sample_period(t_ns)
    return 1.0 / period if period > 0.0 else 0.0


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
    finite, repeats, longest, extremes, dwelling = _tally(readings)
    if not finite:
        return WindowFault.NOT_FINITE
    steps = t_ns[1:] - t_ns[:-1]
    if steps.min() <= 0:
        return WindowFault.OUT_OF_ORDER
    rate = sampling_rate(t_ns)
    if steps.max() * rate > LONGEST_GAP * 1e9:
        return WindowFault.GAP
    if not 0.99 * rate_range_hz[0] <= rate <= 1.01 * rate_range_hz[1]:
        return WindowFault.RATE
    # A whole sample that repeats is stale; one channel that repeats is merely quantised.
    if repeats > LARGEST_REPEATED_SHARE * len(steps) or longest > LONGEST_REPEAT:
        return WindowFault.REPEATED
    for side, channel in zip(*np.nonzero(dwelling >= LONGEST_AT_LIMIT), strict=True):
        if _is_cut_off(np.abs(extremes[side, channel] - readings[:, channel])):
            return WindowFault.SATURATED
    return None


@kernel()
def _tally(readings):  # type: ignore[no-untyped-def]
    """
    Count what is odd in readings (N, C).

    Returns
    -------
    finite : bool
        All are.
    repeats, longest : int
        Samples that repeat the one before, and the longest run of them.
    extremes, dwelling : ndarray, shape (2, C)
        Largest and smallest reading, and how often each occurs.
    """
    size, channels = readings.shape
    extremes, dwelling = np.empty((2, channels)), np.zeros((2, channels), np.int64)
    extremes[:] = readings[0]
    finite, repeats, run, longest = True, 0, 0, 0
    for row in range(size):
        same = row > 0
        for c in range(channels):
            value = readings[row, c]
            finite &= np.isfinite(value)
            same &= value == readings[row - 1, c]
            if value > extremes[0, c]:
                extremes[0, c], dwelling[0, c] = value, 0
            if value < extremes[1, c]:
                extremes[1, c], dwelling[1, c] = value, 0
            for side in range(2):
                dwelling[side, c] += value == extremes[side, c]
        run = run + 1 if same else 0
        repeats += same
        longest = max(longest, run)
    return finite, repeats, longest, extremes, dwelling


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
    Quantisation noise then has the variance ``step**2 / 12``, below which no estimate can be right.
    """
    return _resolution(np.sort(readings, axis=0))  # type: ignore[no-any-return]


@kernel()
def _resolution(ordered):  # type: ignore[no-untyped-def]
    """Return the resolution (C,) of ordered readings (N, C)."""
    size, channels = ordered.shape
    found = np.zeros(channels)
    for c in range(channels):
        # Decimal values in binary differ from their grid by rounding.
        rounding = 8.0 * EPSILON * max(-ordered[0, c], ordered[-1, c]) + 1e-300
        distinct, step = 1, np.inf
        for row in range(1, size):
            gap = ordered[row, c] - ordered[row - 1, c]
            if gap > rounding:
                distinct += 1
                step = min(step, gap)
        if distinct == 1 or distinct > LARGEST_DISTINCT_SHARE * size:
            continue
        found[c] = step
        for row in range(1, size):
            gap = ordered[row, c] - ordered[row - 1, c]
            if gap > rounding and not np.abs(gap / step - np.rint(gap / step)) < OFF_GRID:
                found[c] = 0.0
    return found
