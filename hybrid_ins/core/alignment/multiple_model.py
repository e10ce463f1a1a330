"""
Multiple-model initialisation: one filter per hypothesis, weighted by innovation likelihood.

A filter that starts with an unknown heading linearises far from the truth. Filters that start from
headings a cell apart are each accurate within their cell; Bayes' rule gives their weights from the
likelihoods of their innovations, [1]_, and the mixture becomes one filter once its heading is
known. Within its cell each filter estimates the heading by itself. A vehicle that only stands or
cruises straight keeps its mixture: nothing is decided without evidence. `clock_search` adds
hypotheses of the clock offset of fixes.

References
----------
.. [1] Y. Bar-Shalom, X. Li, T. Kirubarajan, *Estimation with Applications to Tracking and
       Navigation*, 2001, section 11.6.2 (static multiple-model estimator).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.alignment.motion_evidence import MotionEvidence
from hybrid_ins.core.alignment.turning_on_the_spot import TurningOnTheSpot
from hybrid_ins.core.alignment.unexplained import Unexplained
from hybrid_ins.core.filter.events import Change, CovarianceInflation, FilterChosen
from hybrid_ins.core.filter.filter_settings import FilterSettings
from hybrid_ins.core.filter.ins_filter import InsFilter
from hybrid_ins.core.imu.samples import SAMPLE_DTYPE, ImuRing
from hybrid_ins.core.inertial.earth import displacement
from hybrid_ins.core.inertial.rotations import (
    matrix_from_quat,
    quat_conjugate,
    quat_multiply,
    rotvec_from_quat,
)
from hybrid_ins.core.inertial.state import (
    BIAS_A,
    BIAS_G,
    COVARIANCE,
    EPS,
    HEADING_VARIANCE,
    LLA,
    N_ERROR,
    N_NAV,
    PLACES,
    QUAT,
    VELOCITY,
    NavState,
    pack,
)
from hybrid_ins.core.update.gate import Verdict
from hybrid_ins.core.update.measurements import GNSS, Measurement

Array = NDArray[np.float64]
MakeFilter = Callable[[NavState, FilterSettings], InsFilter]

N_HEADINGS = 12
HEADING_STD = math.pi / N_HEADINGS  # rad, half a cell: neighbours overlap
HEADING_KNOWN = (
    (0.1, 1_000_000_000),
    (0.15, 3_000_000_000),
    (0.2, 6_000_000_000),
    (0.3, 10_000_000_000),
)
"""Standard deviation of the mixture's heading [rad], for how long [ns]: any is enough."""

SPREAD_NS = 80_000_000  # over which a block's work is spread; it ends after 100 ms
MIN_WEIGHT = 1e-6  # a hypothesis below that is dropped
NIS_MEMORY = 25.0  # innovations over which the best hypothesis' NIS is averaged


def heading_grid() -> Array:
    """Return the headings [rad] that hypotheses start from, shape (N_HEADINGS,)."""
    return 2.0 * math.pi * np.arange(N_HEADINGS) / N_HEADINGS


def _errors(nav: Array, others: Array) -> Array:
    """Return the errors (N, 15) of a flat state if others (N, N_NAV) are right."""
    return np.hstack(
        (
            displacement(nav[LLA], others[:, LLA]),
            others[:, VELOCITY] - nav[VELOCITY],
            -rotvec_from_quat(quat_multiply(others[:, QUAT], quat_conjugate(nav[QUAT]))),
            others[:, BIAS_A] - nav[BIAS_A],
            others[:, BIAS_G] - nav[BIAS_G],
        )
    )


def headings(filters: Sequence[InsFilter], best: InsFilter) -> Array:
    """Return the headings [rad] of filters relative to the best's, (-pi, pi]."""
    C = matrix_from_quat(np.stack([f.nav[QUAT] for f in filters]))
    C = C @ matrix_from_quat(best.nav[QUAT]).T
    turns: Array = np.arctan2(C[:, 1, 0] - C[:, 0, 1], C[:, 0, 0] + C[:, 1, 1])
    return turns


def _states(filters: Sequence[InsFilter]) -> tuple[Array, NDArray[np.bool_]]:
    """Return the flat states of several filters, (K, N_NAV), and which of them are finite."""
    navs = np.stack([one.nav[:N_NAV] for one in filters])
    return navs, np.asarray(np.isfinite(navs).all(axis=1))


def _excluded(log_weights: Array, filters: Sequence[InsFilter]) -> NDArray[np.intp]:
    """Return which hypotheses are unlikely, or have a state that is not finite, unless all have."""
    _, sound = _states(filters)
    return np.flatnonzero((log_weights < math.log(MIN_WEIGHT)) | (~sound & sound.any()))


def _restore_cells(filters: Sequence[InsFilter], lever_b: Array) -> None:
    """Make each filter as uncertain of its heading as it was: what a stand showed is chance."""
    for hypothesis in filters:
        std = np.zeros(N_ERROR)
        variance = hypothesis.nav.item(HEADING_VARIANCE)
        std[EPS.stop - 1] = math.sqrt(max(HEADING_STD**2 - variance, 0.0))
        hypothesis.submit(CovarianceInflation(hypothesis.t_ns, std, lever_b))


def mixture_of(means: Array, variances: Array, log_weights: Array) -> tuple[float, float]:
    """Return mean and standard deviation of a quantity of which each hypothesis has its own."""
    weights = np.exp(log_weights - log_weights.max())
    weights /= weights.sum()
    mean = float(weights @ means)
    return mean, math.sqrt(weights @ (variances + (means - mean) ** 2))


class Decision(NamedTuple):
    """The one filter that a mixture has become."""

    filter: InsFilter
    offset: float  # s, that it adds to the stamps of fixes
    at_edge: bool  # what is missing from them is no less than the largest that was tried
    is_final: bool = True  # otherwise the clock offset is still open: the hypotheses go on


class MultipleModelBank:
    """
    The same filter under several hypotheses.

    Parameters
    ----------
    states : sequence of NavState
        Initial states, all at one time: one for each heading.
    make_filter : callable
        Given a state at that time and settings, returns a filter.
    settings : FilterSettings
        For those.
    prior : ndarray, optional
        Probability of each state; by default all are equally likely.
    lag_ns : int
        The filters stay behind the IMU by that much [ns], so that no measurement is late to them.

    Attributes
    ----------
    filters : list of InsFilter
        The hypotheses that are left.
    log_weights : ndarray
        Logarithms of their weights, normalised.
    heading_open : bool
        Each state has another heading.
    clock_open : bool
        The hypotheses also differ in the clock offset of fixes.
    motion : MotionEvidence
        Whether the vehicle moves: before, nothing is evidence on the heading.
    """

    clock_open: ClassVar[bool] = False

    def __init__(
        self,
        states: Sequence[NavState],
        make_filter: MakeFilter,
        settings: FilterSettings,
        prior: Array | None = None,
        lag_ns: int = 0,
    ) -> None:
        self.filters = [make_filter(state, settings) for state in states]
        self.log_weights = np.log(np.full(len(states), 1.0) if prior is None else prior)
        self.log_weights -= math.log(np.exp(self.log_weights).sum())
        self._log_prior = self.log_weights.copy()
        self.heading_open = len(states) > 1
        self._began_as = list(range(len(states)))  # which state each hypothesis began with
        self._offsets_ns = [0] * len(states)  # added to the stamps of aiding measurements
        self._first_ns = 0  # aiding measurements must be younger than that
        self._lag_ns, self._lever_b = lag_ns, settings.lever_b
        self._block_ns = 0  # they follow it in steps of at least that
        self._begun_ns = 0  # where the IMU was when the block was chosen
        self._behind: list[InsFilter] = []  # that have not taken ``_block`` yet
        self._block = np.empty(0, SAMPLE_DTYPE)
        self._waiting: dict[tuple[str, int], Measurement] = {}  # that are not weighed yet
        self._decided: list[dict[tuple[str, int], Verdict]] = [{} for _ in states]
        self._nis_scale, self._unexplained = 1.0, Unexplained()
        self.motion = MotionEvidence()
        self._turns = TurningOnTheSpot(settings.antenna_is_placed)
        self._told: set[tuple[str, int]] = set()  # of those that wait: their verdicts are known
        self._since: dict[object, int] = {}  # ns, when a condition became true that still is

    @property
    def best(self) -> InsFilter:
        """The likeliest hypothesis."""
        return self.filters[self._best]

    @property
    def is_misled(self) -> bool:
        """The filters were moved by an antenna that turns about the vehicle on the spot."""
        return self._turns.misleads

    @property
    def _best(self) -> int:
        return int(np.argmax(self.log_weights))

    def submit(self, event: Change) -> None:
        """See `InsFilter.submit`."""
        self._end_block_before(event.t_ns)
        for hypothesis in self.filters:
            hypothesis.submit(event)

    def measure(self, measurement: Measurement) -> bool:
        """
        Submit a measurement, an aiding one with its stamp by the clock in force.

        Returns False when that is older than the hypotheses by one of the clocks.
        """
        if measurement.sensor == GNSS and measurement.t_ns <= self._first_ns:
            return False
        self._end_block_before(measurement.t_ns)
        self._waiting[measurement.kind, measurement.t_ns] = measurement
        shifted = {
            offset_ns: replace(  # type: ignore[type-var]  # a record, see `measurements`
                measurement,
                t_ns=measurement.t_ns + (offset_ns if measurement.sensor == GNSS else 0),
            )
            for offset_ns in set(self._offsets_ns)
        }
        for offset_ns, hypothesis in zip(self._offsets_ns, self.filters, strict=True):
            hypothesis.submit(shifted[offset_ns])
        return True

    def take_over(self, running: InsFilter) -> list[Measurement]:
        """
        Go on without a filter that ran beside: what it has judged is not told again.

        Returns what neither has judged nor will.
        """
        left = {(m.kind, m.t_ns): m for m in running.withdraw()}
        self._told = self._waiting.keys() - left.keys()
        return [measurement for key, measurement in left.items() if key not in self._waiting]

    def advance(self, ring: ImuRing, now_ns: int) -> list[Verdict]:
        """
        Propagate the filters; the IMU is at ``now_ns`` [ns].

        Returns the likeliest hypothesis' verdicts on what has been weighed since.
        """
        self.begin_block(ring, now_ns)
        return self.end_block()

    def begin_block(self, ring: ImuRing, now_ns: int) -> None:
        """Choose the samples that the filters take until `end_block`; see `advance`."""
        samples = ring.between(self.best.t_ns, now_ns - self._lag_ns)
        if len(samples) and samples["t_ns"][-1] - self.best.t_ns >= self._block_ns:
            self._block, self._behind, self._begun_ns = samples, self.filters[::-1], now_ns

    def continue_block(self, now_ns: int) -> None:
        """
        Propagate one filter, or as many as are due when the IMU is at ``now_ns`` [ns].

        The work is spread evenly; the result does not depend on when it is done.
        """
        left = 1.0 - (now_ns - self._begun_ns) / SPREAD_NS
        may_be_behind = int(max(left, 0.0) * len(self.filters))
        for _ in range(min(len(self._behind), max(1, len(self._behind) - may_be_behind))):
            self._behind.pop().predict_block(self._block)

    def end_block(self) -> list[Verdict]:
        """Propagate the filters that are behind; see `advance`."""
        while self._behind:
            self._behind.pop().predict_block(self._block)
        return self._weigh_decided()

    def _end_block_before(self, t_ns: int) -> None:
        """Propagate the filters that an event [ns] finds behind: to the others it is late."""
        while self._behind and t_ns + min(self._offsets_ns) <= self._block["t_ns"][-1]:
            self._behind.pop().predict_block(self._block)

    def _weigh_decided(self) -> list[Verdict]:
        """Weigh what all have decided by now, by different clocks at different times."""
        for offset_ns, hypothesis, decided in zip(
            self._offsets_ns, self.filters, self._decided, strict=True
        ):
            for verdict in hypothesis.verdicts:
                measurement = verdict.measurement
                t_ns = measurement.t_ns - (offset_ns if measurement.sensor == GNSS else 0)
                decided[measurement.kind, t_ns] = verdict
            hypothesis.verdicts.clear()
        weighed = []
        for key in [key for key in self._waiting if all(key in d for d in self._decided)]:
            verdicts = [decided.pop(key) for decided in self._decided]
            verdict = replace(verdicts[self._best], measurement=self._waiting.pop(key))
            if key not in self._told:
                weighed.append(verdict)
            if self.motion.observe(verdict.measurement, self.best):
                _restore_cells(self.filters, self._lever_b)
            hidden = self.heading_open and self._turns.observe(verdict.measurement, self.best)
            if (self.motion.counts or not self.heading_open) and not hidden:
                self._weigh(verdicts)
        for k in _excluded(self.log_weights, self.filters)[::-1].tolist():
            del self.filters[k], self._began_as[k], self._offsets_ns[k], self._decided[k]
            self.log_weights = np.delete(self.log_weights, k)
            self._log_prior = np.delete(self._log_prior, k)
        return weighed

    def _weigh(self, verdicts: list[Verdict]) -> None:
        """Update the weights by the verdicts on one measurement under each hypothesis."""
        if not all(math.isfinite(v.nis) for v in verdicts) or self._unexplained.observe(verdicts):
            return
        # The likelihood of a measurement beyond the gate is that at the gate: outliers hit all.
        nis = np.array([min(v.nis, v.threshold) for v in verdicts])
        dof = len(verdicts[0].sigma)
        log_det = np.array([v.log_det for v in verdicts])
        # Where even the best hypothesis has a large NIS the noise is wrong: differences mean less.
        self._nis_scale += (nis[self._best] / dof - self._nis_scale) / NIS_MEMORY
        log_likelihood = -0.5 * (nis / max(1.0, self._nis_scale) + log_det)
        self.log_weights += self._evidence(log_likelihood)
        self.log_weights -= self.log_weights.max()
        self.log_weights -= math.log(np.exp(self.log_weights).sum())

    def _evidence(self, log_likelihood: Array) -> Array:
        """Return what of the log-likelihoods is evidence and not chance."""
        return log_likelihood

    def heading(self) -> tuple[float, float]:
        """Return the mixture's heading relative to the best's, and its standard deviation [rad]."""
        variances = np.array([h.nav.item(HEADING_VARIANCE) for h in self.filters])
        mean, std = mixture_of(headings(self.filters, self.best), variances, self.log_weights)
        return mean, std * math.sqrt(max(1.0, self._nis_scale))

    def mixture(self) -> Array:
        """
        Return the flat state, shape (N_FLAT,), of the best, its P that of the mixture about it.

        P = Σ w_k (P_k + d_k d_kᵀ), where d_k is the best's error if hypothesis k is right; [1]_,
        section 1.4.16.
        """
        best, weights = self.best.nav, np.exp(self.log_weights)
        navs, sound = _states(self.filters)  # others are removed with the next measurement
        nav: Array = best.copy()
        if sound.any():
            navs, weights = navs[sound], weights[sound] / weights[sound].sum()
            d = _errors(best, navs)
            P = np.tensordot(weights, navs[:, COVARIANCE], 1)[PLACES] + (d.T * weights) @ d
            pack(P, nav[COVARIANCE])
        return nav

    def decide(self) -> Decision | None:
        """Return the one filter that the mixture has become, its P including all; or None."""
        return self._decision(self.best) if self._is_known() else None

    def _decision(self, winner: InsFilter) -> Decision:
        """Return the decision for the best filter or its copy, whose P then includes all."""
        turn, turn_std = self.heading()
        std = np.zeros(N_ERROR)
        std[EPS.stop - 1] = math.hypot(turn_std, turn)
        winner.submit(FilterChosen(winner.t_ns, std, self._lever_b))
        winner.verdicts.extendleft(reversed(self._decided[self._best].values()))
        return Decision(winner, self._offsets_ns[self._best] * 1e-9, False)

    def _is_known(self) -> bool:
        """Return whether one filter can do the rest."""
        if not (self.heading_open and (self.motion.moves or self.motion.shows_heading)):
            return not self.heading_open  # what was known at rest is not once a motion begins
        std = self.heading()[1]
        known = [
            self.has_lasted(("heading", limit), std <= limit, lasting_ns)
            for limit, lasting_ns in HEADING_KNOWN
        ]
        return self.motion.shows_heading and any(known)

    def has_lasted(self, condition: object, true: bool, lasting_ns: int) -> bool:
        """Return whether a condition is true, and was for so long [ns]."""
        if not true:
            self._since.pop(condition, None)
            return False
        t_ns = self.best.t_ns
        return t_ns - self._since.setdefault(condition, t_ns) >= lasting_ns
