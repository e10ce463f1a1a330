"""
The hypotheses of `multiple_model`: factors on the noise, and slow errors of fixes.

Most are a grid of factors on the noise of accelerometer, gyroscope and fixes. Beside it are those
of a receiver that claims centimetres whatever solution it has: an R that is far too small, a slow
error of positions, and both; and of a driver that stamps fixes when they arrive, which is late by a
time that varies.
"""

from __future__ import annotations

import numpy as np
from numba.extending import register_jitable

from hybrid_ins.core.noise.position_scatter import (
    CORRECTED_STD,
    SLOW_AXES,
    SLOW_TIME,
    UNCORRECTED_STD,
    uncorrected,
)

DECADES = np.array([-1.5, 0.0, 1.0, 2.0, 3.0, 4.0])  # of the factor on the accelerometer's noise
RATE_DECADES = np.array([-1.5, 0.0, 3.0])  # on the gyroscope's
GNSS_DECADES = np.array([0.0, 0.7, 1.5, 3.0])  # on R
POOREST_DECADE = 4.4  # on R: centimetres claimed by a driver's constant, and metres received
BESIDE_POOREST = np.array([0.0, 1.0, 2.0])  # decades of the accelerometer's factor beside that
FACTOR_COST = 2.0  # nats of evidence that a factor above 1 needs
DECADE_COST = (1.0, 1.0, 2.0)  # and for each of its decades
REDUCTION_COST, REDUCTION_DECADE_COST = 1.5, 0.3  # the same of factors below 1
SLOW_STDS = np.array([0.3, 1.0, 3.0])  # m, of a slow error of the fixes
SLOW_DECADES = np.array([-1.5, 0.0, 1.0, 2.0])  # of the accelerometer's factor beside that
SLOW_WHITE_STDS = np.array([1.0, 3.0])  # m, of one beside R that is too small as well
SLOW_WHITE_DECADES = np.array([1.5, 3.0, POOREST_DECADE])  # on R: fixed and single solutions
SLOW_RATIO = 2.0  # smallest, to the σ that a receiver with corrections claims
UNCORRECTED_RATIO = 20.0  # to that of one without: it contains the slow error already
CLEAR_UNCORRECTED_RATIO = 3.5  # to that, from which it is to blame: none of ``SLOW_STDS`` is
SLOW_COST = 3.5  # nats of evidence that a slow error needs

STAMP_STDS = np.array([0.01, 0.03, 0.1])  # s, of the stamps of fixes
STAMP_DECADES = np.array([-1.5, 0.0, 1.0, 2.0])  # of the accelerometer's factor beside that
STAMP_COST = 7.0  # nats of evidence that stamps scatter: clock and heading look like it at first

_GRID = np.stack(
    [grid.ravel() for grid in np.meshgrid(DECADES, RATE_DECADES, GNSS_DECADES, indexing="ij")]
)
_POOREST = np.zeros((3, BESIDE_POOREST.size))
_POOREST[0], _POOREST[2] = BESIDE_POOREST, POOREST_DECADE
_BESIDE_SLOW = np.zeros((3, SLOW_STDS.size * SLOW_DECADES.size))
_BESIDE_SLOW[0] = np.tile(SLOW_DECADES, SLOW_STDS.size)
_SLOW_AND_WHITE = np.zeros((3, SLOW_WHITE_STDS.size * SLOW_WHITE_DECADES.size))
_SLOW_AND_WHITE[2] = np.tile(SLOW_WHITE_DECADES, SLOW_WHITE_STDS.size)
_BESIDE_STAMPS = np.zeros((3, STAMP_STDS.size * STAMP_DECADES.size))
_BESIDE_STAMPS[0] = np.tile(STAMP_DECADES, STAMP_STDS.size)
_DECADES = np.hstack((_GRID, _POOREST, _BESIDE_STAMPS, _BESIDE_SLOW, _SLOW_AND_WHITE))
_STAMP_STD = np.concatenate(
    (
        np.zeros(_GRID.shape[1] + _POOREST.shape[1]),
        np.repeat(STAMP_STDS, STAMP_DECADES.size),
        np.zeros(_BESIDE_SLOW.shape[1] + _SLOW_AND_WHITE.shape[1]),
    )
)
_SLOW_STD = np.concatenate(
    (
        np.zeros(_GRID.shape[1] + _POOREST.shape[1] + _BESIDE_STAMPS.shape[1]),
        np.repeat(SLOW_STDS, SLOW_DECADES.size),
        np.repeat(SLOW_WHITE_STDS, SLOW_WHITE_DECADES.size),
    )
)
_LOG_PRIOR = -sum(
    (
        np.where(
            grid < 0.0,
            REDUCTION_COST - REDUCTION_DECADE_COST * grid,
            FACTOR_COST * (grid > 0.0) + cost * grid,
        )
        for grid, cost in zip(_DECADES, DECADE_COST, strict=True)
    ),
    SLOW_COST * (_SLOW_STD > 0.0) + STAMP_COST * (_STAMP_STD > 0.0),
)
COUNT = len(_LOG_PRIOR)

# What a hypothesis assumes, one per column.
ON_NOISE, SLOW_WALK = slice(0, 3), slice(3, 6)  # factors on accelerometer, gyroscope, R; m²/s, NED
LOG_FACTORS = slice(6, 9)  # decades
SLOW_STD, LOG_PRIOR, STAMP_STD = 9, 10, 11  # m; s
HYPOTHESES = np.vstack(
    (
        10.0**_DECADES,
        np.outer(SLOW_AXES, 2.0 * _SLOW_STD**2 / SLOW_TIME),
        _DECADES,
        _SLOW_STD,
        _LOG_PRIOR,
        _STAMP_STD,
    )
)


@register_jitable
def smallest_slow_std(claimed_std):  # type: ignore[no-untyped-def]
    """Return the smallest slow error [m] to be found besides the claimed σ [m], horizontally."""
    share = np.log(claimed_std / CORRECTED_STD) / np.log(UNCORRECTED_STD / CORRECTED_STD)
    share = min(max(share, 0.0), 1.0)
    return claimed_std * SLOW_RATIO * (UNCORRECTED_RATIO / SLOW_RATIO) ** share


def clear_slow_std(claimed_std: float) -> float:
    """Return the slow error [m] beyond the claimed σ [m] for which a receiver is to blame."""
    rise = CLEAR_UNCORRECTED_RATIO - SLOW_RATIO
    return claimed_std * (SLOW_RATIO + rise * uncorrected(claimed_std))
