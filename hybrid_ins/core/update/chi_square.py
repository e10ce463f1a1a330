"""The chi-square distribution, as far as gates need it, without a library slow to load."""

from __future__ import annotations

import math


def survival(x: float, dof: int) -> float:
    """
    Return the probability that a chi-square variable exceeds ``x`` >= 0.

    Exact sums for whole ``dof`` >= 1, built up from one or two degrees of freedom by steps of two.
    """
    half = 0.5 * x
    if dof % 2:
        total, m = math.erfc(math.sqrt(half)), 1
    else:
        total, m = math.exp(-half), 2
    while m < dof:
        total += half ** (0.5 * m) * math.exp(-half) / math.gamma(0.5 * m + 1.0)
        m += 2
    return total


def quantile(probability: float, dof: int) -> float:
    """Return what a chi-square variable stays below with ``probability`` < 1."""
    low, high = 0.0, 1.0
    while survival(high, dof) > 1.0 - probability:
        low, high = high, 2.0 * high
    while True:
        middle = 0.5 * (low + high)
        if not low < middle < high:
            return middle
        if survival(middle, dof) > 1.0 - probability:
            low = middle
        else:
            high = middle
