"""The chi-square distribution, as far as gates need it, without a library slow to load."""

from __future__ import annotations

import math
from collections.abc import Mapping


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
    return quantile_of_mixture(probability, {dof: 1.0})


def quantile_of_mixture(probability: float, shares: Mapping[int, float]) -> float:
    """Return the same of one whose ``dof`` is drawn: shares of each, in all 1."""

    def above(x: float) -> float:
        return sum(share * survival(x, dof) for dof, share in shares.items())

    low, high = 0.0, 1.0
    while above(high) > 1.0 - probability:
        low, high = high, 2.0 * high
    while True:
        middle = 0.5 * (low + high)
        if not low < middle < high:
            return middle
        if above(middle) > 1.0 - probability:
            low = middle
        else:
            high = middle
