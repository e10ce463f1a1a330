"""
Comparison of a filter's own clock offset with the one that a search beside it finds.
"""

from __future__ import annotations

import math
from enum import Enum, auto

from hybrid_ins.core.alignment.clock_search import OFFSET_KNOWN, ClockSearch
from hybrid_ins.core.filter.ins_filter import InsFilter
from hybrid_ins.core.navigator.heading_check import check

CONFIRMATION, CONTRADICTION = 1.0, 2.0
"""Standard deviations, between a search and a filter's own clock offset."""

CERTAIN_NS = 10_000_000_000  # for how long [ns] another offset is certain before it is used
PRECISE = 0.02  # s, of a search beside a filter that runs: it is not urgent
SIGNIFICANT_OFFSET = 3.0  # standard deviations, from the offset in force


class Comparison(Enum):
    """What a search shows of the offset that a filter has found."""

    NOTHING = auto()
    CONFIRMED = auto()
    CONTRADICTED = auto()
    EXCLUDED = auto()


def compare(running: InsFilter, search: ClockSearch) -> Comparison:
    """
    Return what a search shows of the clock offset of the filter beside it.

    The search goes on until it is precise, or until both have found the offset in force to be wrong
    and agree on the right one: the filter's clock is corrected only once the search has ended. A
    contradicted filter has to inflate its clock variance: certain to milliseconds of a clock that
    has jumped since, it would take minutes to find another one. An offset that is too large for
    this has to be certain for a while before the filter's own is excluded: where the motion hardly
    shows the clock, chance favours now one offset, now another.
    """
    certain = search.shift_is_certain
    if search.has_lasted("certain", certain, CERTAIN_NS):
        return Comparison.EXCLUDED
    (found, sigma), own = search.clock(), running.clock
    difference, std = abs(found - own.residual), math.hypot(sigma, own.sigma)
    if sigma <= OFFSET_KNOWN[0] and difference > CONTRADICTION * std:
        return Comparison.CONTRADICTED
    precise = sigma <= min(OFFSET_KNOWN[0], max(PRECISE, 2.0 * own.sigma))
    significant = min(abs(found) / sigma, abs(own.residual) / own.sigma) > SIGNIFICANT_OFFSET
    if certain or not (precise or significant) or difference > CONFIRMATION * std:
        return Comparison.NOTHING
    return Comparison.CONFIRMED


def is_excluded(provisional: InsFilter, search: ClockSearch) -> bool:
    """Return whether a search excludes the offset or the heading of a provisional filter."""
    return search.shift_is_certain or check(provisional, search).corrected is not None


def lacking_std(provisional: InsFilter, search: ClockSearch) -> float:
    """Return by how much [s] a provisional filter is surer of its clock offset than the search."""
    (found, sigma), own = search.clock(), provisional.clock
    return math.sqrt(max(0.0, sigma**2 + (found - own.residual) ** 2 - own.sigma**2))
