"""
Multiple-model search for the clock offset of fixes: one filter per offset (and heading).

A filter that assumes the fixes to be tenths of a second younger or older than they are linearises
far from the truth: within those a vehicle turns and brakes, and it cannot distinguish the offset
from a bad IMU (see `noise.multiple_model`) before its state has followed the fixes. Filters that
start with offsets a cell apart are each accurate within their cell, where `clock_offset` estimates
the rest.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.alignment.multiple_model import (
    Decision,
    MakeFilter,
    MultipleModelBank,
    mixture_of,
)
from hybrid_ins.core.filter.events import ClockFound
from hybrid_ins.core.filter.filter_settings import FilterSettings
from hybrid_ins.core.inertial.earth import curvature_scale
from hybrid_ins.core.inertial.state import (
    COVARIANCE,
    DIAGONAL,
    DP,
    DV,
    EPS,
    N_ERROR,
    VELOCITY,
    NavState,
    covariance,
)
from hybrid_ins.core.noise.position_scatter import horizontal_variance
from hybrid_ins.core.sensor_errors.clock_offset import share_of_motion
from hybrid_ins.core.sensor_errors.clock_prior import ClockPrior
from hybrid_ins.core.update.gate import Verdict
from hybrid_ins.core.update.inflation import inflate
from hybrid_ins.core.update.measurements import GNSS, Measurement, PositionFix

Array = NDArray[np.float64]

STEP_NS, N_STEPS = 100_000_000, 6
OFFSETS_NS = tuple(STEP_NS * k for k in range(-N_STEPS, N_STEPS + 1))
MAX_OFFSET_NS = OFFSETS_NS[-1]
OFFSET_STD = 0.05  # s, half a cell
OFFSET_KNOWN = (0.05, 2_000_000_000)  # s, standard deviation of the mixture's; ns, for how long
OFFSET_BOUNDED = (0.15, 4_000_000_000)  # is enough: the rest is considered, see `clock_offset`
HARMLESS_NS = 20_000_000_000  # so is, for so long, what moves no fix by more than its claimed σ
BLOCK_NS = 500_000_000  # the filters are many: in longer blocks they cost less
MIN_SPACING_NS = 150_000_000  # between two fixes of a kind: more of them show hardly more
IDLE_SPACING_NS = 950_000_000  # the same of a vehicle that has hovered for `IDLE_NS`
IDLE_NS = 20_000_000_000
IDLE_SPEED = 0.2  # m/s, at a claimed σ of 1 m: clock and heading move fixes by much less
WARM_UP_NS, WARM_UP_FIXES = 2_000_000_000, 3
"""Before that the filters differ by the time since their inflation: no evidence on the clock."""

SHAKEN_NS = 30_000_000_000
"""In which fixes show a motion; else what seems to be one is the vibration of a vehicle at rest."""

MIN_SHIFT = 0.15  # s: `clock_offset` corrects smaller ones beside a running filter
EXCLUDED = 0.01  # weight of offsets below that, at which a running filter is replaced
TINY = 1e-300  # a weight, in place of 0
SPEED_STD, TILT_STD = 3.0, 0.1  # m/s, rad: errors of a state that followed a wrong clock


def state_at_offset(state: NavState, offset: float, calm: bool, lever_b: Array) -> NavState:
    """
    Return a state as if the fixes that led to it were ``offset`` [s] younger.

    It is inflated, unless the motion has been ``calm``: see `ClockSearch`.
    """
    nav = state.to_flat()
    if not calm:
        std = np.zeros(N_ERROR)
        std[DV], std[EPS] = SPEED_STD, TILT_STD
        inflate(nav, std, lever_b)
    moved = np.eye(N_ERROR)
    moved[DP, DV] = -offset * np.eye(3)
    lla = state.lla - offset * state.velocity_n / curvature_scale(state.lla)
    return replace(state, lla=lla, P=moved @ covariance(nav) @ moved.T)


def probabilities(
    prior: ClockPrior | None, estimate: float = 0.0, sigma: float = math.inf
) -> Array:
    """
    Return the probability of each of the offsets that are tried, shape (len(OFFSETS_NS),).

    ``estimate`` and its standard deviation ``sigma`` [s] are those of a filter that has followed
    fixes with the offset in force. Prior and estimate may both be wrong: half of the probability
    is spread evenly, so that only evidence excludes an offset.
    """
    offsets, half = np.array(OFFSETS_NS) * 1e-9, 0.5e-9 * STEP_NS
    known = np.exp(-0.5 * ((offsets - estimate) / max(sigma, half)) ** 2)
    if prior is not None:
        known *= [prior.probability(o - half, o + half) for o in offsets]
    return 0.5 * known / known.sum() + 0.5 / len(offsets)


class ClockSearch(MultipleModelBank):
    """
    The same filter under several clock offsets of fixes, for each of several headings.

    The filters follow the IMU at a distance, so that a fix is late by none of the clocks. A search
    begins when the IMU is not at rest. Fixes show a slow motion late, or that there is none, see
    `SHAKEN_NS`: what the weights were until then was chance.

    Parameters
    ----------
    states, make_filter, settings
        See `MultipleModelBank`.
    headings : ndarray
        Probability of each state.
    offsets : ndarray, shape (len(OFFSETS_NS),)
        Probability of each offset.
    calm : bool
        The vehicle stood, or its velocity was constant, for the longest offset before and after the
        time of the states: with a wrong offset they are displaced, and no more.

    Attributes
    ----------
    begun_ns : int
        Stamp of the states [ns].
    in_force_ns : int
        What has been added to the stamps of fixes since the search began [ns].
    """

    clock_open: ClassVar[bool] = True

    def __init__(
        self,
        states: Sequence[NavState],
        make_filter: MakeFilter,
        settings: FilterSettings,
        headings: Array,
        offsets: Array,
        calm: bool,
    ) -> None:
        self._prior = settings.clock_prior
        super().__init__(
            [
                state_at_offset(s, offset * 1e-9, calm, settings.lever_b)
                for offset in OFFSETS_NS
                for s in states
            ],
            make_filter,
            replace(settings, clock_std=OFFSET_STD, clock_prior=None),
            (offsets[:, None] * headings).ravel(),
            MAX_OFFSET_NS + STEP_NS,
        )
        self.heading_open = len(states) > 1
        self.motion.may_rest = False  # by the IMU
        self.in_force_ns = 0
        self._began_as = len(OFFSETS_NS) * list(range(len(states)))
        self._offsets_ns = [offset for offset in OFFSETS_NS for _ in states]
        self._prior_of_offset = dict(zip(OFFSETS_NS, np.log(offsets).tolist(), strict=True))
        self.begun_ns = self.best.t_ns
        self._first_ns = self.begun_ns + MAX_OFFSET_NS
        self._block_ns = BLOCK_NS
        self._measured_ns: dict[str, int] = {}  # stamp of the last fix of each kind
        self._spacing_ns = MIN_SPACING_NS
        warm_up_ns, self._warm_up_fixes = (0, 0) if calm else (WARM_UP_NS, WARM_UP_FIXES)
        self._weighed_from_ns = self._first_ns + warm_up_ns
        self._fixes = 0
        self._top_speed = 0.0  # m/s
        self._harmless = 0.0  # s, an offset that moves fixes by no more than they claim

    def measure(self, measurement: Measurement) -> bool:
        """See `MultipleModelBank.measure`; also False for a fix that follows another too soon."""
        if measurement.sensor == GNSS:
            if self.in_force_ns:
                as_at_first = measurement.t_ns - self.in_force_ns
                measurement = replace(measurement, t_ns=as_at_first)  # type: ignore[type-var]
            last_ns = self._measured_ns.get(measurement.kind, 0)
            if abs(measurement.t_ns - last_ns) < self._spacing_ns:
                return False
            self._measured_ns[measurement.kind] = measurement.t_ns
        return super().measure(measurement)

    def _weigh(self, verdicts: list[Verdict]) -> None:
        """See `MultipleModelBank`; the first fixes only make inflated filters alike."""
        measurement = verdicts[self._best].measurement
        if isinstance(measurement, PositionFix):
            self._fixes += 1
            speed = float(np.linalg.norm(self.best.nav[VELOCITY]))
            self._top_speed = max(self._top_speed, speed)
            claimed = math.sqrt(horizontal_variance(measurement.claimed))
            self._harmless = claimed / max(self._top_speed, 1e-3)
            variance = self.best.nav[COVARIANCE][DIAGONAL[DV]][:2].sum()
            is_idle = speed < max(IDLE_SPEED * claimed, 3.0 * math.sqrt(max(variance, 0.0)))
            hovers = self.has_lasted("idle", is_idle, IDLE_NS)
            self._spacing_ns = IDLE_SPACING_NS if hovers else MIN_SPACING_NS
        seems_to_move = self.heading_open and not self.motion.may_rest
        if seems_to_move and self.has_lasted("rest", not self.motion.shown, SHAKEN_NS):
            self.motion.may_rest, self.log_weights = True, self._log_prior.copy()
        elif self._fixes > self._warm_up_fixes and measurement.t_ns > self._weighed_from_ns:
            super()._weigh(verdicts)

    def _evidence(self, log_likelihood: Array) -> Array:
        """
        See `MultipleModelBank`; of what clocks differ in, under one heading, the share of motion.

        Where a shaken IMU cruises, each hypothesis compares the fixes with another stretch of the
        same noise: its likelihood is chance, see `clock_offset`. A wrong clock may hide the motion
        from the likeliest: while the heading is open, too, any that has seen one counts.
        """
        weights = np.exp(self.log_weights)
        total = np.bincount(self._began_as, weights)
        mean = np.bincount(self._began_as, weights * log_likelihood) / np.maximum(total, TINY)
        of_heading = mean[self._began_as]
        seen_by = self.filters if self.heading_open else [self.best]
        share = max(float(share_of_motion(one.clock.values)) for one in seen_by)
        return np.asarray(of_heading + share * (log_likelihood - of_heading))

    @property
    def shift_is_certain(self) -> bool:
        """The offset is not one that a running filter corrects by itself."""
        offsets_ns = np.abs(np.array(self._offsets_ns) - self.in_force_ns)
        weights = np.exp(self.log_weights)
        return bool(weights[offsets_ns < 1e9 * MIN_SHIFT].sum() < EXCLUDED * weights.sum())

    def clock(self) -> tuple[float, float]:
        """Return the offset still to be added to the stamps of fixes, and its σ [s]."""
        return self._clock(self.log_weights)

    def _clock(self, log_weights: Array) -> tuple[float, float]:
        residuals = [
            (offset_ns - self.in_force_ns) * 1e-9 + hypothesis.clock.residual
            for offset_ns, hypothesis in zip(self._offsets_ns, self.filters, strict=True)
        ]
        variances = [hypothesis.clock.sigma**2 for hypothesis in self.filters]
        return mixture_of(np.array(residuals), np.array(variances), log_weights)

    def decide(self) -> Decision | None:
        """
        See `MultipleModelBank.decide`; the filter takes over the mixture's clock offset.

        That by the innovations alone: the filter's clock has a prior of its own.
        """
        decision = super().decide()
        return None if decision is None else self._with_clock(decision)

    def decide_on_heading(self) -> Decision | None:
        """
        Return a copy of the likeliest filter once the heading is known; None before.

        It runs while the hypotheses go on to find the clock offset, which it takes for the
        mixture's.
        """
        if not (self.heading_open and super()._is_known()):
            return None
        decision = self._decision(copy.copy(self.best))
        return self._with_clock(decision)._replace(is_final=False)

    def _with_clock(self, decision: Decision) -> Decision:
        """Give the decision's filter the mixture's clock offset."""
        tried = self._offsets_ns[self._best] * 1e-9
        decision = decision._replace(offset=tried - self.in_force_ns * 1e-9)
        log_prior = np.array([self._prior_of_offset[offset_ns] for offset_ns in self._offsets_ns])
        residual, sigma = self._clock(self.log_weights - log_prior)
        prior = self._prior and self._prior._replace(mean=self._prior.mean - tried)
        t_ns, found = decision.filter.t_ns, residual - decision.offset
        decision.filter.submit(ClockFound(t_ns, found, sigma, prior))
        from_first = residual + self.in_force_ns * 1e-9
        return decision._replace(at_edge=abs(from_first) >= MAX_OFFSET_NS * 1e-9)

    def _is_known(self) -> bool:
        std = self.clock()[1]
        limits = (OFFSET_KNOWN, OFFSET_BOUNDED, (self._harmless, HARMLESS_NS))
        known = [
            self.has_lasted(("clock", k), std <= limit, lasting_ns)
            for k, (limit, lasting_ns) in enumerate(limits)
        ]
        return super()._is_known() and any(known)
