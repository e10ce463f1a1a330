"""
Check of a given heading by motion: filters under other headings beside the one that uses it.

A heading that was given (by hand, by a magnetometer, by the course) may be wrong by far more than
its standard deviation, and a filter that starts with it does not find out: it explains the
innovations by biases and tilt. So it is one hypothesis among others, [1]_, until the motion has
shown which is right. Long before one of the others is known to be right the given one may be known
to be wrong: the state is then that of all others together. From when the others are the more
probable ones until then, what they are off it is part of its reported variance.

References
----------
.. [1] Y. Bar-Shalom, X. Li, T. Kirubarajan, *Estimation with Applications to Tracking and
       Navigation*, 2001, section 11.6.2 (static multiple-model estimator).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.alignment.multiple_model import MultipleModelBank, headings
from hybrid_ins.core.filter.ins_filter import InsFilter, state_at_imu
from hybrid_ins.core.inertial.rotations import heading_from_quat
from hybrid_ins.core.inertial.state import HEADING_VARIANCE, QUAT, NavState
from hybrid_ins.core.navigator.notices import HeadingCorrected

Array = NDArray[np.float64]

WRONG = 0.1  # prior probability that a given heading is wrong
SIGNIFICANT_TURN = 3.0  # standard deviations
DOUBTFUL = 0.5  # probability of a heading below which others are the more probable ones
EXCLUDED = 0.01  # that of one that is given up
GROSS = 0.5  # rad; the filter corrects a smaller error by itself


def prior(headings: int) -> Array:
    """Return the probabilities of a given heading and of all others, shape (headings,)."""
    return np.array([1.0 - WRONG, *[WRONG / (headings - 1)] * (headings - 1)])


def is_contradicted(state: NavState, found: NavState) -> bool:
    """Return whether the heading of a state is far from the one that motion has shown."""
    turn = heading_from_quat(found.quat_xyzw) - heading_from_quat(state.quat_xyzw)
    std = math.sqrt(state.P[8, 8] + found.P[8, 8])
    return abs(math.remainder(turn, 2.0 * math.pi)) > max(GROSS, SIGNIFICANT_TURN * std)


class HeadingCheck(NamedTuple):
    """What the motion shows of the heading of a filter."""

    doubt: float  # rad², that its variance lacks while other headings are more probable
    corrected: HeadingCorrected | None = None  # the motion excludes it, and shows this
    probability: float = 0.0  # of it, once a motion has shown anything


def check(running: InsFilter, bank: MultipleModelBank) -> HeadingCheck:
    """
    Compare the heading of a filter with those of others.

    Parameters
    ----------
    running : InsFilter
        At the last IMU sample.
    bank : MultipleModelBank
        The filters beside it, which may be behind.
    """
    if not bank.motion.shows_heading:
        return HeadingCheck(0.0)
    best = heading_from_quat(state_at_imu(bank.best, bank.best.nav)[QUAT])
    own = heading_from_quat(running.nav[QUAT])
    std = math.sqrt(running.flat_state()[HEADING_VARIANCE])
    turns = headings(bank.filters, bank.best) - (own - best)
    off = np.abs((turns + math.pi) % (2.0 * math.pi) - math.pi)
    weights = np.exp(bank.log_weights)
    weights /= weights.sum()
    probability = float(weights[off < max(GROSS, SIGNIFICANT_TURN * std)].sum())
    doubt = float(weights @ off**2) if probability < DOUBTFUL else 0.0
    if probability > EXCLUDED:
        return HeadingCheck(doubt, probability=probability)
    mean, sigma = bank.heading()
    return HeadingCheck(doubt, HeadingCorrected(own, best + mean, sigma), probability)


def is_confirmed(running: InsFilter, bank: MultipleModelBank) -> bool:
    """Return whether the heading of a filter is not in question beside those of others."""
    return not bank.heading_open or check(running, bank).probability > 1.0 - EXCLUDED
