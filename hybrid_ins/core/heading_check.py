"""
Check of a given heading by motion: filters under other headings beside the one that uses it.

A heading that was given (by hand, by a magnetometer, by the course) may be wrong by far more than
its standard deviation, and a filter that starts with it does not find out: it explains the
innovations by biases and tilt. So it is one hypothesis among others, [1]_, until the motion has
shown which is right.

References
----------
.. [1] Y. Bar-Shalom, X. Li, T. Kirubarajan, *Estimation with Applications to Tracking and
       Navigation*, 2001, section 11.6.2 (static multiple-model estimator).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from hybrid_ins.core.alignment import yaw_of
from hybrid_ins.core.ins_filter import FilterSettings
from hybrid_ins.core.multiple_model import FilterFactory, MultipleModelBank
from hybrid_ins.core.state import NavState

WRONG = 0.1  # prior probability that a given heading is wrong
SIGNIFICANT = 3.0  # standard deviations
GROSS = 0.5  # rad; the filter corrects a smaller error by itself


class HeadingCheck(MultipleModelBank):
    """
    The same filter under a given heading and under all others.

    Parameters
    ----------
    states : sequence of NavState
        Initial states, all at one time; the first has the given heading.
    make_filter, settings
        See `MultipleModelBank`.
    """

    def __init__(
        self, states: Sequence[NavState], make_filter: FilterFactory, settings: FilterSettings
    ) -> None:
        super().__init__(states, make_filter, settings)
        others = len(states) - 1
        self.log_weights = np.log([1.0 - WRONG, *[WRONG / others] * others])


def is_contradicted(state: NavState, found: NavState) -> bool:
    """Return whether the heading of a state is far from the one that motion has shown."""
    turn = math.remainder(yaw_of(found.quat_xyzw) - yaw_of(state.quat_xyzw), 2.0 * math.pi)
    std = math.sqrt(state.P[8, 8] + found.P[8, 8])
    return abs(turn) > max(GROSS, SIGNIFICANT * std)
