"""
How far the fixes' clock is off, where nothing is known of it: the same filter by many clocks.

Within tenths of a second a vehicle turns and brakes: what so wrong a clock does to the innovations
is not proportional to it any more, and one filter cannot tell the offset from a bad IMU (see
`noise_scale`) before it has followed the fixes to where they lead. Filters that add so much more or
less to the fixes' stamps can: one of them is right to half a step, needs no other noise, and finds
what is left, see `time_offset`. They are weighed as headings are, see `hypotheses`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.earth import curvature_scale
from hybrid_ins.core.gate import Verdict
from hybrid_ins.core.hypotheses import Bank
from hybrid_ins.core.ins_filter import FilterSettings, InsFilter
from hybrid_ins.core.measurements import Measurement
from hybrid_ins.core.samples import ImuRing
from hybrid_ins.core.state import DP, DV, EPS, LAST_F, LAST_W, N_ERROR, NavState

Array = NDArray[np.float64]
Begin = Callable[[NavState, Array, FilterSettings], InsFilter]

STEP_NS, STEPS = 100_000_000, 6  # offsets that are tried, to both sides
REACH_NS = STEP_NS * STEPS
LAG_NS = REACH_NS + STEP_NS  # behind the IMU: a fix in time is not late by any of the clocks
CELL_STD = 0.05  # s, of each
MISLED_SPEED, MISLED_TURN = 3.0, 0.1  # m/s, rad, that the wrong clock has led the state astray by
DECIDED_STD = 0.05  # s
DECIDED_NS = 1_000_000_000  # known that well for so long: one filter does the rest


def opened(state: NavState, offset: float) -> NavState:
    """Return what is left of a state if the fixes that led to it were ``offset`` [s] younger."""
    std = np.zeros(N_ERROR)
    std[DV], std[EPS] = MISLED_SPEED, MISLED_TURN
    P = state.P + np.diag(np.maximum(std**2 - np.diag(state.P), 0.0))
    moved = np.eye(N_ERROR)
    moved[DP, DV] = -offset * np.eye(3)
    lla = state.lla - offset * state.velocity_n / curvature_scale(state.lla)
    return replace(state, lla=lla, P=moved @ P @ moved.T)


class ClockSearch(Bank):
    """
    Filters that differ in what they add to the fixes' stamps.

    Parameters
    ----------
    running : InsFilter
        They begin where it is.
    settings : FilterSettings
        As those of ``running``.
    begin : callable
        Given a state at that time, the IMU sample (6,) there and settings, returns a filter.

    Attributes
    ----------
    at_edge : bool
        The likeliest offset is the last one that was tried.
    """

    def __init__(self, running: InsFilter, settings: FilterSettings, begin: Begin) -> None:
        state, settings = running.state, replace(settings, clock_std=CELL_STD)
        sample = np.concatenate((running.nav[LAST_F], running.nav[LAST_W]))
        self._offsets_ns = [k * STEP_NS for k in range(-STEPS, STEPS + 1)]
        super().__init__([
            begin(opened(state, offset_ns * 1e-9), sample, settings)
            for offset_ns in self._offsets_ns])
        self._first_ns = running.t_ns + REACH_NS
        self._open: list[tuple[str, int]] = []  # measurements that are not weighed yet
        self._decided: list[dict[tuple[str, int], Verdict]] = [{} for _ in self.filters]
        self._known_ns = 0  # since when it is known well enough; 0: it is not

    @property
    def at_edge(self) -> bool:
        """See the class."""
        return abs(self._offsets_ns[int(np.argmax(self.log_weights))]) == REACH_NS

    def measure(self, measurement: Measurement) -> None:
        """Take a measurement with a stamp by the clock in force."""
        if measurement.t_ns <= self._first_ns:
            return
        self._open.append((measurement.kind, measurement.t_ns))
        for offset_ns, hypothesis in zip(self._offsets_ns, self.filters, strict=True):
            hypothesis.submit(replace(  # type: ignore[type-var]  # a record, see `measurements`
                measurement, t_ns=measurement.t_ns + offset_ns))

    def advance(self, ring: ImuRing, now_ns: int) -> None:
        """Follow the IMU, which is at ``now_ns`` [ns], at a distance."""
        samples = ring.after(self.best.t_ns)
        samples = samples[:np.searchsorted(samples["t_ns"], now_ns - LAG_NS, side="right")]
        if len(samples) == 0:
            return
        for hypothesis in self.filters:
            hypothesis.process_imu_block(samples)
        self._weigh_decided()

    def _weigh_decided(self) -> None:
        """Weigh what has been decided under each hypothesis, by each at another time."""
        for offset_ns, hypothesis, decided in zip(
                self._offsets_ns, self.filters, self._decided, strict=True):
            for verdict in hypothesis.verdicts:
                m = verdict.measurement
                decided[m.kind, m.t_ns - offset_ns] = verdict
            hypothesis.verdicts.clear()
        known = [key for key in self._open if all(key in d for d in self._decided)]
        for key in known:
            self._open.remove(key)
            self._weigh([decided[key] for decided in self._decided])
        for decided in self._decided:
            for key in decided.keys() - self._open:
                del decided[key]
        for k in self._unlikely():
            self._drop(k)
            del self._offsets_ns[k], self._decided[k]

    def found(self) -> tuple[float, float]:
        """Return what is missing from the offset in force, and its standard deviation [s]."""
        weights = self.weights
        missing = np.array([offset_ns * 1e-9 + hypothesis.clock.missing for offset_ns, hypothesis
                            in zip(self._offsets_ns, self.filters, strict=True)])
        variances = np.array([hypothesis.clock.sigma**2 for hypothesis in self.filters])
        mean = float(weights @ missing)
        return mean, math.sqrt(weights @ (variances + (missing - mean) ** 2))

    def decide(self) -> tuple[float, InsFilter] | None:
        """Return what to add [s], and the filter that does; None while it is not known."""
        mean, sigma = self.found()
        t_ns = self.best.t_ns
        if sigma > DECIDED_STD:
            self._known_ns = 0
            return None
        self._known_ns = self._known_ns or t_ns
        if t_ns - self._known_ns < DECIDED_NS:
            return None
        by = self._offsets_ns[int(np.argmax(self.log_weights))] * 1e-9
        self.best.clock.believe(mean - by, sigma)
        return by, self.best
