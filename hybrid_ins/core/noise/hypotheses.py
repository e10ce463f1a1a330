"""
The hypotheses of `multiple_model`: factors on the noise, and slow errors of fixes.

Most are a grid of factors on the noise of accelerometer, gyroscope and fixes. Beside it are those
of a receiver that claims centimetres whatever solution it has: an R that is far too small, a slow
error of positions or of heights, and both; and of a driver that stamps fixes when they arrive,
which is late by a time that varies; and of receivers that filter velocities, which are old, or err
for seconds by more than they claim; and of a claim that is one constant for heights and the rest.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.noise.position_scatter import uncorrected
from hybrid_ins.core.noise.slow_error import SLOW_AXES, SLOW_TIME, Shares, SlowError

Array = NDArray[np.float64]

DECADES = np.array([-1.5, 0.0, 1.0, 2.0, 3.0, 4.0])  # of the factor on the accelerometer's noise
RATE_DECADES = np.array([-1.5, 0.0, 3.0])  # on the gyroscope's
GNSS_DECADES = np.array([0.0, 0.7, 1.5, 3.0])  # on R
POOREST_DECADE = 4.4  # on R: centimetres claimed by a driver's constant, and metres received
BESIDE_POOREST = np.array([0.0, 1.0, 2.0])  # decades of the accelerometer's factor beside that
FACTOR_COST = 2.0  # nats of evidence that a factor above 1 needs
DECADE_COST = (1.0, 1.0, 2.0)  # and for each of its decades
REDUCTION_COST, REDUCTION_DECADE_COST = 1.5, 0.3  # the same of factors below 1
# Standard deviations [m] of a slow error of the fixes, and of one of the heights alone (1.5 times
# that), with decades of the accelerometer's factor beside them: of larger ones it shows less.
SLOW_DECADES = np.array([-1.5, 0.0, 1.0, 2.0])
SLOW_STDS = (
    (np.array([0.3, 1.0]), SLOW_DECADES),
    (np.array([3.0]), SLOW_DECADES[1:3]),
    (np.array([10.0, 30.0]), SLOW_DECADES[1:2]),
)
SLOW_HEIGHT_STDS = (
    (np.array([0.3, 1.0]), SLOW_DECADES),
    (np.array([3.0]), SLOW_DECADES[1:]),
    (np.array([10.0]), SLOW_DECADES[1:2]),
)
SLOW_ALONE = np.stack((SLOW_AXES, SLOW_AXES * [0.0, 0.0, 1.0]))  # of all directions, of the height
SLOW_WHITE_STDS = np.array([1.0, 3.0])  # m, of one beside R that is too small as well
SLOW_WHITE_DECADES = np.array([1.5, 3.0, POOREST_DECADE])  # on R: fixed and single solutions
SLOW_RATIO = 2.0  # smallest, to the σ that is claimed; of heights, 1.5 times that
SEARCHED_RATIO = 10.0  # times that, of a receiver without corrections in a search
CLEAR_UNCORRECTED_RATIO = 3.5  # to that of a receiver without corrections, to blame it
SLOW_COST = 3.5  # nats of evidence that a slow error needs

STAMP_STDS = np.array([0.01, 0.03, 0.1])  # s, of the stamps of fixes
STAMP_DECADES = np.array([-1.5, 0.0, 1.0, 2.0])  # of the accelerometer's factor beside that
STAMP_COST = 7.0  # nats of evidence that stamps scatter: clock and heading look like it at first
AGE_STDS = np.array([0.2, 0.6])  # s, of the age of velocities
VELOCITY_DECADES = np.array([[1.0, 2.0, 0.0, 0.0], [1.0, 2.0, 1.0, 2.0]])  # horizontal, vertical
BESIDE_VELOCITY = np.array([-1.5, 0.0, 1.0, 2.0, 3.0])  # of the accelerometer's factor beside that
POSITION_DECADES = np.array([0.7, 1.5, 2.2, 3.0])  # of the factor on R of positions alone
BESIDE_POSITION = np.array([-1.5, 0.0, 1.0, 2.0])  # of the accelerometer's factor beside that
VELOCITY_COST = 4.0  # nats of evidence that velocities are old, or err by more than they claim
HEIGHT_DECADES = np.array([0.6, 1.2, 1.8, 2.4, 3.0])  # of the factor on R of heights alone
BESIDE_HEIGHT = np.array([-1.5, 0.0, 1.5])  # of the accelerometer's factor beside that
HEIGHT_COST = 2.0  # nats of evidence that it is above 1

# Of one column: decades of the factors on accelerometer, gyroscope and R; standard deviations; and
# decades of those on R of velocities, horizontally and vertically, and on that of heights; and a
# slow error of heights alone, as the horizontal one that it would come with.
_ACCELEROMETER, _FIXES, _SLOW, _STAMP, _AGE, _HORIZONTAL, _VERTICAL = 0, 2, 3, 4, 5, 6, 7
_HEIGHT, _SLOW_HEIGHT, _ROWS = 8, 9, 10


def _beside(decades: Array, values: dict[int, Array]) -> Array:
    """Return columns of ``values``, by row, each beside each of the accelerometer's decades."""
    count = len(next(iter(values.values())))
    columns = np.zeros((_ROWS, count * len(decades)))
    columns[_ACCELEROMETER] = np.tile(decades, count)
    for row, value in values.items():
        columns[row] = np.repeat(value, len(decades))
    return columns


_GRID = np.stack(
    [grid.ravel() for grid in np.meshgrid(DECADES, RATE_DECADES, GNSS_DECADES, indexing="ij")]
)
_slow_and_white = np.meshgrid(SLOW_WHITE_STDS, SLOW_WHITE_DECADES, indexing="ij")
_COLUMNS = np.hstack(  # those with a slow error are the last, see `multiple_model_step`
    (
        np.pad(_GRID, ((0, _ROWS - len(_GRID)), (0, 0))),
        _beside(BESIDE_POOREST, {_FIXES: np.array([POOREST_DECADE])}),
        _beside(STAMP_DECADES, {_STAMP: STAMP_STDS}),
        _beside(STAMP_DECADES, {_AGE: AGE_STDS}),
        _beside(
            BESIDE_VELOCITY,
            {_HORIZONTAL: VELOCITY_DECADES[0], _VERTICAL: VELOCITY_DECADES[1]},
        ),
        _beside(
            BESIDE_POSITION,
            {
                _FIXES: POSITION_DECADES,
                _HORIZONTAL: -POSITION_DECADES,
                _VERTICAL: -POSITION_DECADES,
            },
        ),
        _beside(BESIDE_HEIGHT, {_HEIGHT: HEIGHT_DECADES}),
        *(_beside(decades, {_SLOW_HEIGHT: stds}) for stds, decades in SLOW_HEIGHT_STDS),
        *(_beside(decades, {_SLOW: stds}) for stds, decades in SLOW_STDS),
        _beside(
            np.zeros(1), {_SLOW: _slow_and_white[0].ravel(), _FIXES: _slow_and_white[1].ravel()}
        ),
    )
)
_OF_VELOCITY = np.any(_COLUMNS[[_AGE, _VERTICAL]] > 0.0, axis=0)
_LOG_PRIOR = -sum(
    (
        np.where(
            grid < 0.0,
            REDUCTION_COST - REDUCTION_DECADE_COST * grid,
            FACTOR_COST * (grid > 0.0) + cost * grid,
        )
        for grid, cost in zip(_COLUMNS[:3], DECADE_COST, strict=True)
    ),
    SLOW_COST * (_COLUMNS[_SLOW] + _COLUMNS[_SLOW_HEIGHT] > 0.0)
    + STAMP_COST * (_COLUMNS[_STAMP] > 0.0)
    + VELOCITY_COST * _OF_VELOCITY
    + HEIGHT_COST * (_COLUMNS[_HEIGHT] > 0.0)
    + DECADE_COST[2] * _COLUMNS[_HEIGHT],
)
COUNT = len(_LOG_PRIOR)

# What a hypothesis assumes, one per column.
ON_NOISE, SLOW_WALK = slice(0, 3), slice(3, 6)  # factors on accelerometer, gyroscope, R; m²/s, NED
LOG_FACTORS = slice(6, 9)  # decades
SLOW_STD, STAMP_STD, AGE_STD = 9, 10, 11  # m; s, of a position's stamp and of a velocity's age
ON_VELOCITY = slice(12, 14)  # decades of the factors on R of velocities
ON_HEIGHT, SLOW_HEIGHT_STD = 14, 15  # decades of that on R of heights; m, without 1.5
LOG_PRIOR = 16
HYPOTHESES = np.vstack(
    (
        10.0 ** _COLUMNS[:3],
        2.0 / SLOW_TIME * SLOW_ALONE.T @ np.square(_COLUMNS[[_SLOW, _SLOW_HEIGHT]]),
        _COLUMNS,
        _LOG_PRIOR,
    )
)

# Vector instructions take several hypotheses at once: the last one is repeated to fill them.
WIDTH = COUNT + -COUNT % 16
WIDE_HYPOTHESES = np.pad(HYPOTHESES, ((0, 0), (0, WIDTH - COUNT)), "edge")
# A heading or a clock that is searched for looks like a slow error of heights, as do new heights.
WITHOUT_SLOW_HEIGHTS = WIDE_HYPOTHESES.copy()
WITHOUT_SLOW_HEIGHTS[SLOW_WALK] *= WIDE_HYPOTHESES[SLOW_HEIGHT_STD] == 0.0
# Of positions: the factor on R, and that on the height's besides; those with the same are a level.
ON_R = np.stack((HYPOTHESES[2], 10.0 ** HYPOTHESES[ON_HEIGHT]))
_LEVEL = np.unique(ON_R, axis=1, return_inverse=True)[1].ravel()
R_LEVELS = [np.flatnonzero(level == _LEVEL) for level in range(_LEVEL.max() + 1)]


def claims_in_search(horizontal: float, height: float) -> tuple[float, float]:
    """
    Return what counts as claimed [m] while heading or clock are searched for.

    A wrong one looks like a slow error of metres, which a receiver without corrections has as well:
    only larger ones are evidence.
    """
    ratio = SEARCHED_RATIO ** uncorrected(horizontal)
    return horizontal * ratio, height * ratio


def drifts_beyond_claim(slow_error: SlowError, claimed_stds: Shares) -> Shares:
    """
    Return the slow errors [m] for which a receiver is to blame, of positions and of heights alone.

    They are of clearly more than the σ claimed, ``claimed_stds`` [m]. The published covariance
    contains any. But the slow error of an honest metre may change faster than is assumed, which one
    of the hypotheses may explain for a while.
    """
    rise = CLEAR_UNCORRECTED_RATIO - SLOW_RATIO
    across, upward = (
        std if std > claim * (SLOW_RATIO + rise * uncorrected(claim)) else 0.0
        for std, claim in zip(slow_error.drifts, claimed_stds, strict=True)
    )
    return across, upward
