"""
The phases of a navigator, and the filters that each begins with.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core import heading_check
from hybrid_ins.core.alignment import Alignment, Start
from hybrid_ins.core.clock_search import ClockSearch
from hybrid_ins.core.filter_noise import FilterNoise
from hybrid_ins.core.fix_speed import SpeedCheck
from hybrid_ins.core.gate import Gate
from hybrid_ins.core.ins_filter import FilterSettings, InsFilter, state_at_imu
from hybrid_ins.core.multiple_model import FilterFactory, MultipleModelBank
from hybrid_ins.core.samples import ImuRing, sample_period
from hybrid_ins.core.state import NavState

Array = NDArray[np.float64]

PERIOD_SAMPLES = 256  # that show the IMU's sample period
CHECK_LAG_NS = 500_000_000  # of a check of the heading: a late fix costs a rewind of each filter


class FilterParts(Protocol):
    """What a navigator needs to build its filters."""

    @property
    def settings(self) -> FilterSettings:
        """Return the filters' settings."""

    @property
    def speed_check(self) -> SpeedCheck:
        """Return what knows how fast the vehicle may be; it is the same each time."""

    def noise(self, period: float) -> FilterNoise:
        """Return the noise of a new filter for an IMU's sample period [s]."""

    def gate(self) -> Gate:
        """Return a fresh gate."""


@dataclass(frozen=True, slots=True)
class Aligning:
    """No state yet."""

    alignment: Alignment

    filter: ClassVar[InsFilter | None] = None
    best: ClassVar[InsFilter | None] = None
    nav: ClassVar[Array | None] = None
    bank: ClassVar[MultipleModelBank | None] = None


@dataclass(frozen=True, slots=True)
class Searching:
    """The position is known, the heading is not: one filter for each that is possible."""

    bank: MultipleModelBank

    filter: ClassVar[InsFilter | None] = None

    @property
    def best(self) -> InsFilter:
        """The likeliest filter: its position is good already."""
        return self.bank.best

    @property
    def nav(self) -> Array:
        """Its flat state at the last IMU sample; P includes the other filters."""
        return state_at_imu(self.best, self.bank.mixture())


@dataclass(frozen=True, slots=True)
class Running:
    """One filter; ``bank`` holds others beside it: of other headings or clock offsets."""

    filter: InsFilter
    bank: MultipleModelBank | None = None

    @property
    def best(self) -> InsFilter:
        """The filter."""
        return self.filter

    @property
    def nav(self) -> Array:
        """Its flat state."""
        return self.filter.nav


Phase = Aligning | Searching | Running


def phase_after_alignment(start: Start, parts: FilterParts, ring: ImuRing) -> Searching | Running:
    """Return the phase that begins with the first states that alignment found."""
    period = sample_period(ring.latest(PERIOD_SAMPLES)["t_ns"])
    begin = _factory(parts, ring, start.t_ns, start.sample, period)
    if start.given:
        known = heading_check.prior(len(start.states))
        check = MultipleModelBank(start.states, begin, parts.settings, known, CHECK_LAG_NS)
        return Running(begin(start.states[0], parts.settings), check)
    return Searching(MultipleModelBank(start.states, begin, parts.settings))


def search_clock(
    filters: Sequence[InsFilter],
    parts: FilterParts,
    ring: ImuRing,
    prior: Array | None = None,
) -> ClockSearch:
    """Return filters under several clock offsets around filters of one time and one offset."""
    first = filters[0]
    begin = _factory(parts, ring, first.t_ns, first.sample, first.noise.process.period)
    return ClockSearch([known.state for known in filters], begin, parts.settings, prior)


def _factory(
    parts: FilterParts, ring: ImuRing, t_ns: int, sample: Array, period: float
) -> FilterFactory:
    """Return what starts a filter at an IMU sample."""

    def begin(state: NavState, settings: FilterSettings) -> InsFilter:
        noise, gate = parts.noise(period), parts.gate()
        return InsFilter(state, t_ns, sample, noise, gate, ring, settings)

    return begin
