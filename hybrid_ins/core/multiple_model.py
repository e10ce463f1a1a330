"""
Heading and clock from motion: the same filter by many of them, weighed by how well each predicts.

One filter that starts with an unknown heading linearises where it must not, and so does one that
takes the fixes to be tenths of a second younger or older than they are: within those a vehicle
turns and brakes, and it cannot tell the offset from a bad IMU (see `noise_scale`) before it has
followed the fixes to where they lead. Started from headings and clocks a cell apart, each is right
within its cell; Bayes' rule gives their weights from the likelihoods of their innovations [1]_, and
what remains of the mixture is told as one heading and one clock, each with its uncertainty. What is
left within its cell each filter finds by itself (the clock: see `time_offset`). Vehicles that only
stand or cruise straight keep their mixture: nothing is decided without evidence.

References
----------
.. [1] Y. Bar-Shalom, X. Li, T. Kirubarajan, *Estimation with Applications to Tracking and
       Navigation*, 2001, section 11.6.2 (static multiple-model estimator).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core import propagation
from hybrid_ins.core.earth import curvature_scale
from hybrid_ins.core.gate import Verdict
from hybrid_ins.core.ins_filter import Change, FilterSettings, InsFilter
from hybrid_ins.core.measurements import Measurement
from hybrid_ins.core.rotations import matrix_from_quat
from hybrid_ins.core.samples import ImuRing
from hybrid_ins.core.state import (
    COVARIANCE,
    DP,
    DV,
    EPS,
    N_ERROR,
    QUAT,
    NavState,
    covariance,
    inflate_covariance,
    pack,
)

Array = NDArray[np.float64]
FilterFactory = Callable[[NavState, FilterSettings], InsFilter]

N_HEADINGS = 12
HEADING_STD = math.pi / N_HEADINGS  # rad, half a cell: neighbours overlap
HEADING_KNOWN = ((0.1, 1_000_000_000), (0.2, 10_000_000_000))
"""The mixture's heading is known to that [rad] for so long [ns]: one filter does the rest."""

OFFSET_STEP_NS, N_OFFSET_STEPS = 100_000_000, 6
OFFSETS_NS = tuple(
    OFFSET_STEP_NS * k for k in range(-N_OFFSET_STEPS, N_OFFSET_STEPS + 1)
)  # added to the fixes' stamps
MAX_OFFSET_NS = OFFSETS_NS[-1]
OFFSET_STD = 0.05  # s, half a cell
OFFSET_KNOWN = (0.05, 2_000_000_000)  # s, ns
WRONG_CLOCK_SPEED_STD, WRONG_CLOCK_TILT_STD = (
    3.0,
    0.1,
)  # m/s, rad, that a wrong clock leads a state astray by

MIN_WEIGHT = 1e-6  # a hypothesis below that is dropped
NIS_MEMORY = 25.0  # innovations over which the best one's fit is averaged


def heading_grid() -> Array:
    """Return the headings [rad] that hypotheses start from, shape (N_HEADINGS,)."""
    return 2.0 * math.pi * np.arange(N_HEADINGS) / N_HEADINGS


def with_clock_offset(state: NavState, offset: float) -> NavState:
    """Return what is left of a state if the fixes that led to it were ``offset`` [s] younger."""
    std = np.zeros(N_ERROR)
    std[DV], std[EPS] = WRONG_CLOCK_SPEED_STD, WRONG_CLOCK_TILT_STD
    moved = np.eye(N_ERROR)
    moved[DP, DV] = -offset * np.eye(3)
    lla = state.lla - offset * state.velocity_n / curvature_scale(state.lla)
    return replace(state, lla=lla, P=moved @ inflate_covariance(state.P, std) @ moved.T)


class Decision(NamedTuple):
    """The one filter that a mixture has become."""

    filter: InsFilter
    offset: float  # s, that it adds to the fixes' stamps
    at_edge: bool  # it is the largest that was tried


class MultipleModelBank:
    """
    The same filter under several hypotheses.

    Parameters
    ----------
    states : sequence of NavState
        What to start with, all at one time: one for each heading.
    make_filter : callable
        Given a state at that time and settings, returns a filter.
    settings : FilterSettings
        For those.
    clock : bool
        Each state is started with by many clocks; the filters then follow the IMU at a distance,
        so that a fix is late by none of them.

    Attributes
    ----------
    filters : list of InsFilter
        Those that are left.
    log_weights : ndarray
        Logarithms of their weights, normalised.
    clock_open : bool
        See ``clock``.
    """

    def __init__(
        self,
        states: Sequence[NavState],
        make_filter: FilterFactory,
        settings: FilterSettings,
        clock: bool = False,
    ) -> None:
        self._heading_open, self.clock_open = len(states) > 1, clock
        if clock:
            settings = replace(settings, clock_std=OFFSET_STD)
            pairs = [
                (offset_ns, with_clock_offset(state, offset_ns * 1e-9))
                for offset_ns in OFFSETS_NS
                for state in states
            ]
        else:
            pairs = [(0, state) for state in states]
        self._offsets_ns = [offset_ns for offset_ns, _ in pairs]
        self.filters = [make_filter(state, settings) for _, state in pairs]
        self.log_weights = np.full(len(pairs), -math.log(len(pairs)))
        self._first_ns = self.best.t_ns + MAX_OFFSET_NS if clock else 0
        self._lag_ns = MAX_OFFSET_NS + OFFSET_STEP_NS if clock else 0
        self._waiting: dict[tuple[str, int], Measurement] = {}  # that are not weighed yet
        self._decided: list[dict[tuple[str, int], Verdict]] = [{} for _ in pairs]
        self._nis_scale = 1.0
        self._since: dict[object, int] = {}  # ns, when something became true that still is

    @property
    def best(self) -> InsFilter:
        """The likeliest hypothesis."""
        return self.filters[self._best]

    @property
    def _best(self) -> int:
        return int(np.argmax(self.log_weights))

    @property
    def waiting_for(self) -> str:
        """What the user can do about it."""
        clock = f" and the clock offset (to {self.clock()[1]:.2f} s)" if self.clock_open else ""
        return (
            f"motion that shows the heading (known to {math.degrees(self.heading()[1]):.0f}° "
            f"so far){clock}: speed up, brake or turn, or give it by initialpose"
        )

    def submit(self, event: Change) -> None:
        """See `InsFilter.submit`."""
        for hypothesis in self.filters:
            hypothesis.submit(event)

    def measure(self, measurement: Measurement) -> bool:
        """
        Take a measurement, an aiding one with its stamp by the clock in force.

        Returns False when that is older than the hypotheses by one of the clocks.
        """
        if measurement.aiding and measurement.t_ns <= self._first_ns:
            return False
        self._waiting[measurement.kind, measurement.t_ns] = measurement
        for offset_ns, hypothesis in zip(self._offsets_ns, self.filters, strict=True):
            t_ns = measurement.t_ns + (offset_ns if measurement.aiding else 0)
            hypothesis.submit(
                replace(  # type: ignore[type-var]  # a record, see `measurements`
                    measurement, t_ns=t_ns
                )
            )
        return True

    def advance(self, ring: ImuRing, now_ns: int) -> list[Verdict]:
        """
        Follow the IMU, which is at ``now_ns`` [ns].

        Returns the likeliest hypothesis' verdicts on what has been weighed since.
        """
        samples = ring.after(self.best.t_ns)
        samples = samples[: np.searchsorted(samples["t_ns"], now_ns - self._lag_ns, side="right")]
        if len(samples):
            for hypothesis in self.filters:
                hypothesis.predict_block(samples)
        return self._weigh_decided()

    def _weigh_decided(self) -> list[Verdict]:
        """Weigh what all have decided by now, by different clocks at different times."""
        for offset_ns, hypothesis, decided in zip(
            self._offsets_ns, self.filters, self._decided, strict=True
        ):
            for verdict in hypothesis.verdicts:
                measurement = verdict.measurement
                t_ns = measurement.t_ns - (offset_ns if measurement.aiding else 0)
                decided[measurement.kind, t_ns] = verdict
            hypothesis.verdicts.clear()
        told = []
        for key in [key for key in self._waiting if all(key in d for d in self._decided)]:
            verdicts = [decided.pop(key) for decided in self._decided]
            told.append(replace(verdicts[self._best], measurement=self._waiting.pop(key)))
            self._weigh(verdicts)
        for k in np.flatnonzero(self.log_weights < math.log(MIN_WEIGHT))[::-1].tolist():
            del self.filters[k], self._offsets_ns[k], self._decided[k]
            self.log_weights = np.delete(self.log_weights, k)
        return told

    def _weigh(self, verdicts: list[Verdict]) -> None:
        """Take what became of one measurement under each hypothesis into the weights."""
        if not all(math.isfinite(v.nis) for v in verdicts):
            return
        # Beyond the gate a measurement says no more than that: outliers hit all alike.
        nis = np.array([min(v.nis, v.threshold) for v in verdicts])
        dof = len(verdicts[0].sigma)
        log_det = np.array([v.log_det for v in verdicts])
        # Where even the best fits badly the noise is wrong, and differences mean less.
        self._nis_scale += (nis[self._best] / dof - self._nis_scale) / NIS_MEMORY
        self.log_weights -= 0.5 * (nis / max(1.0, self._nis_scale) + log_det)
        self.log_weights -= self.log_weights.max()
        self.log_weights -= math.log(np.exp(self.log_weights).sum())

    def heading(self) -> tuple[float, float]:
        """Return the mixture's heading spread about the best [rad]: mean offset and σ."""
        mean, sigma = self._mixture(*self._about_best())
        return mean, sigma * math.sqrt(max(1.0, self._nis_scale))

    def clock(self) -> tuple[float, float]:
        """Return what is missing from the fixes' stamps, and its standard deviation [s]."""
        missing = [
            offset_ns * 1e-9 + hypothesis.clock.residual
            for offset_ns, hypothesis in zip(self._offsets_ns, self.filters, strict=True)
        ]
        return self._mixture(np.array(missing), np.array([f.clock.sigma**2 for f in self.filters]))

    def _mixture(self, means: Array, variances: Array) -> tuple[float, float]:
        """Mean and standard deviation of a quantity of which each hypothesis has its own."""
        weights = np.exp(self.log_weights)
        weights /= weights.sum()
        mean = float(weights @ means)
        return mean, math.sqrt(weights @ (variances + (means - mean) ** 2))

    def _about_best(self) -> tuple[Array, Array]:
        """Headings relative to the best's, and their variances."""
        C_best = matrix_from_quat(self.best.nav[QUAT])
        offsets, variances = [], []
        for hypothesis in self.filters:
            C = matrix_from_quat(hypothesis.nav[QUAT]) @ C_best.T
            offsets.append(math.atan2(C[1, 0] - C[0, 1], C[0, 0] + C[1, 1]))
            variances.append(covariance(hypothesis.nav)[EPS, EPS][2, 2])
        return np.array(offsets), np.array(variances)

    def decide(self) -> Decision | None:
        """Return the one filter that the mixture has become, wide enough for all; or None."""
        turn, turn_std = self.heading()
        missing, clock_std = self.clock()
        heading_known = [
            self._has_lasted(("heading", std), turn_std <= std, lasting_ns)
            for std, lasting_ns in HEADING_KNOWN
        ]
        clock_known = self._has_lasted("clock", clock_std <= OFFSET_KNOWN[0], OFFSET_KNOWN[1])
        if (self._heading_open and not any(heading_known)) or (self.clock_open and not clock_known):
            return None
        winner, offset_ns = self.best, self._offsets_ns[self._best]
        propagation.flush(winner.nav)
        P = covariance(winner.nav)
        P[8, 8] += max(0.0, turn_std**2 + turn**2 - P[8, 8])
        pack(P, winner.nav[COVARIANCE])
        if self.clock_open:
            winner.clock.set_estimate(missing - offset_ns * 1e-9, clock_std)
        winner.verdicts.extendleft(reversed(self._decided[self._best].values()))
        return Decision(
            winner, offset_ns * 1e-9, self.clock_open and abs(offset_ns) == MAX_OFFSET_NS
        )

    def _has_lasted(self, what: object, true: bool, lasting_ns: int) -> bool:
        """Tell whether something is true, and was for so long."""
        if not true:
            self._since.pop(what, None)
            return False
        t_ns = self.best.t_ns
        return t_ns - self._since.setdefault(what, t_ns) >= lasting_ns
