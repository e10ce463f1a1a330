"""
The phases of a navigator, and the filters that each begins with.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.alignment.alignment import Alignment, FirstStates
from hybrid_ins.core.alignment.clock_search import MAX_OFFSET_NS, ClockSearch, probabilities
from hybrid_ins.core.alignment.multiple_model import MakeFilter, MultipleModelBank
from hybrid_ins.core.filter.filter_noise import FilterNoise
from hybrid_ins.core.filter.filter_settings import FilterSettings
from hybrid_ins.core.filter.ins_filter import InsFilter, catch_up, state_at_imu
from hybrid_ins.core.fix_checks.fix_speed import SpeedCheck
from hybrid_ins.core.imu.samples import ImuRing, sample_period
from hybrid_ins.core.inertial.state import VELOCITY, NavState
from hybrid_ins.core.navigator import heading_check
from hybrid_ins.core.update.gate import Gate

Array = NDArray[np.float64]

PERIOD_SAMPLES = 256  # that show the IMU's sample period
CHECK_LAG_NS = 500_000_000  # of a check of the heading: a late fix costs a rewind of each filter
NOTICED_NS = 900_000_000  # a motion is noticed so long after it has begun, at most
STAND_LAG_NS = MAX_OFFSET_NS + NOTICED_NS  # of filters that still stand then, by all of the clocks


class FilterParts(Protocol):
    """What a navigator needs to build its filters."""

    @property
    def settings(self) -> FilterSettings:
        """Return the filters' settings."""

    @property
    def mount(self) -> Array:
        """Return the matrix (3, 3) from the IMU's own axes to b."""

    @property
    def speed_check(self) -> SpeedCheck:
        """Return what knows how fast the vehicle may be; it is the same each time."""

    def noise(self, period: float) -> FilterNoise:
        """Return the noise of a new filter for an IMU's sample period [s]."""

    def gate(self) -> Gate:
        """Return a fresh gate."""


@dataclass(frozen=True, slots=True)
class Aligning:
    """No filter yet."""

    alignment: Alignment

    filter: ClassVar[InsFilter | None] = None
    is_provisional: ClassVar[bool] = False
    best: ClassVar[InsFilter | None] = None
    bank: ClassVar[MultipleModelBank | None] = None

    @property
    def nav(self) -> Array | None:
        """The flat state that a fix and gravity give, without a velocity or a heading."""
        return self.alignment.provisional


@dataclass(frozen=True, slots=True)
class Searching:
    """The position is known, the heading is not: one filter for each that is possible."""

    bank: MultipleModelBank

    filter: ClassVar[InsFilter | None] = None
    is_provisional: ClassVar[bool] = False

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
    """
    One filter; ``bank`` holds others beside it: of other headings or clock offsets.

    Where it ``is_provisional`` it is a copy of the likeliest of them, whose heading is known and
    whose clock offset is not: they go on, and one of them will take over.
    """

    filter: InsFilter
    bank: MultipleModelBank | None = None
    is_provisional: bool = False

    @property
    def best(self) -> InsFilter:
        """The filter."""
        return self.filter

    @property
    def nav(self) -> Array:
        """Its flat state."""
        return self.filter.nav


Phase = Aligning | Searching | Running


def speed(phase: Phase) -> float:
    """Return the speed of the filter that runs [m/s]; 0 without one."""
    return 0.0 if phase.filter is None else float(np.linalg.norm(phase.filter.nav[VELOCITY]))


def phase_after_alignment(
    start: FirstStates, parts: FilterParts, ring: ImuRing, clock_open: bool
) -> Searching | Running:
    """
    Return the phase that begins with the first states that alignment found.

    Where the clock offset is to be found as well (``clock_open``), the filters stay so far behind
    the IMU that a motion is noticed before they come to it: the search for the offset begins there.
    """
    lag_ns = STAND_LAG_NS if clock_open else 0
    period = sample_period(ring.latest(PERIOD_SAMPLES)["t_ns"])
    begin = _factory(parts, ring, start.t_ns, start.sample, partial(parts.noise, period))
    if start.given:
        known = heading_check.prior(len(start.states))
        check_lag_ns = max(lag_ns, CHECK_LAG_NS)
        check = MultipleModelBank(start.states, begin, parts.settings, known, check_lag_ns)
        running = begin(start.states[0], parts.settings)
        catch_up(running)
        return Running(running, check)
    return Searching(MultipleModelBank(start.states, begin, parts.settings, lag_ns=lag_ns))


def search_heading_and_clock(
    filters: Sequence[InsFilter],
    headings: Array,
    parts: FilterParts,
    ring: ImuRing,
    calm: tuple[int, int],
) -> ClockSearch:
    """
    Return filters under several clock offsets for each of several headings.

    Parameters
    ----------
    filters : sequence of InsFilter
        One for each heading, all of one time. Of what they have learned of the noise only the
        slow error of fixes is kept, which a stand has shown: under a wrong heading or clock the
        rest is wrong.
    headings : ndarray
        Probabilities of the headings.
    calm : tuple of int
        `ImuMonitor.calm` [ns].
    """
    first = filters[0]

    def noise() -> FilterNoise:
        fresh = parts.noise(first.noise.process.period)
        fresh.slow_error = first.noise.slow_error
        return fresh

    begin = _factory(parts, ring, first.t_ns, first.sample, noise)
    offsets = probabilities(parts.settings.clock_prior_at(first.t_ns))
    states = [known.state for known in filters]
    is_calm = calm[0] < first.t_ns - MAX_OFFSET_NS and first.t_ns + MAX_OFFSET_NS < calm[1]
    return ClockSearch(states, begin, parts.settings, headings, offsets, is_calm)


def search_clock(running: InsFilter, parts: FilterParts, ring: ImuRing) -> ClockSearch:
    """
    Return filters under several clock offsets around that of a filter that runs.

    They begin with the noise that it has learned: with an IMU that is much noisier than they
    assumed, chance would favour one of them. What the motion has shown of the heading they know.
    """

    def noise() -> FilterNoise:
        known = copy.copy(running.noise)
        known.restart(keep_weights=True)
        return known

    begin = _factory(parts, ring, running.t_ns, running.sample, noise)
    clock = running.clock
    prior = parts.settings.clock_prior_at(running.t_ns)
    offsets = probabilities(prior, clock.residual, clock.sigma)
    search = ClockSearch([running.state], begin, parts.settings, np.ones(1), offsets, False)
    for begun in search.filters:
        begun.update.heading = copy.copy(running.update.heading)
    return search


def _factory(
    parts: FilterParts,
    ring: ImuRing,
    t_ns: int,
    sample: Array,
    noise: Callable[[], FilterNoise],
) -> MakeFilter:
    """Return what starts a filter at an IMU sample."""

    def begin(state: NavState, settings: FilterSettings) -> InsFilter:
        return InsFilter(state, t_ns, sample, noise(), parts.gate(), ring, settings)

    return begin
