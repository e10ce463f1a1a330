"""
Heading from motion: the same filter from headings all around, weighed by how well each predicts.

One filter that starts with an unknown heading linearises where it must not. Started from headings
a cell apart, each is right within its cell; Bayes' rule gives their weights from the likelihoods of
their innovations [1]_, and what remains of the mixture is told as one heading with one uncertainty.
Vehicles that only stand or cruise straight keep their mixture: nothing is decided without evidence.

References
----------
.. [1] Y. Bar-Shalom, X. Li, T. Kirubarajan, *Estimation with Applications to Tracking and
       Navigation*, 2001, section 11.6.2 (static multiple-model estimator).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core import propagation
from hybrid_ins.core.attitude import matrix_from_quat
from hybrid_ins.core.gate import Verdict
from hybrid_ins.core.ins_filter import Event, InsFilter
from hybrid_ins.core.samples import ImuRing
from hybrid_ins.core.state import COVARIANCE, EPS, QUAT, covariance, pack

Array = NDArray[np.float64]

CELLS = 12
CELL_STD = math.pi / CELLS  # rad, half a cell: neighbours overlap
DECIDED = ((0.1, 1_000_000_000), (0.2, 10_000_000_000))
"""The mixture's heading is known to that [rad] for so long [ns]: one filter does the rest."""
LEAST_WEIGHT = 1e-6  # a hypothesis below that is dropped
MEMORY = 25.0  # innovations over which the best one's fit is averaged


def headings() -> Array:
    """Return the headings [rad] that hypotheses start from, shape (CELLS,)."""
    return 2.0 * math.pi * np.arange(CELLS) / CELLS


class Bank:
    """
    The same filter under several hypotheses.

    Parameters
    ----------
    filters : sequence of InsFilter
        One per hypothesis, of one time.

    Attributes
    ----------
    filters : list of InsFilter
        Those that are left.
    log_weights : ndarray
        Logarithms of their weights, normalised.
    """

    def __init__(self, filters: Sequence[InsFilter]) -> None:
        self.filters = list(filters)
        self.log_weights = np.full(len(self.filters), -math.log(len(self.filters)))
        self._misfit = 1.0

    @property
    def best(self) -> InsFilter:
        """The likeliest hypothesis."""
        return self.filters[int(np.argmax(self.log_weights))]

    @property
    def weights(self) -> Array:
        """Of the hypotheses; their sum is 1."""
        weights: Array = np.exp(self.log_weights)
        weights /= weights.sum()
        return weights

    def submit(self, event: Event) -> None:
        """See `InsFilter.submit`."""
        for hypothesis in self.filters:
            hypothesis.submit(event)

    def _weigh(self, decided: list[Verdict]) -> None:
        """Take what became of one measurement under each hypothesis into the weights."""
        if not all(math.isfinite(v.nis) for v in decided):
            return
        # Beyond the gate a measurement says no more than that: outliers hit all alike.
        nis = np.array([min(v.nis, v.threshold) for v in decided])
        dof = len(decided[0].sigma)
        log_det = np.array([v.log_det for v in decided])
        best = int(np.argmax(self.log_weights))
        # Where even the best fits badly the noise is wrong, and differences mean less.
        self._misfit += (nis[best] / dof - self._misfit) / MEMORY
        self.log_weights -= 0.5 * (nis / max(1.0, self._misfit) + log_det)
        self.log_weights -= self.log_weights.max()
        self.log_weights -= math.log(np.exp(self.log_weights).sum())

    def _unlikely(self) -> list[int]:
        """Places of the hypotheses that are not worth their while any more, the last first."""
        unlikely: list[int] = np.flatnonzero(self.log_weights < math.log(LEAST_WEIGHT)).tolist()
        return unlikely[::-1]

    def _drop(self, k: int) -> None:
        del self.filters[k]
        self.log_weights = np.delete(self.log_weights, k)


class YawBank(Bank):
    """Filters that differ in their first heading."""

    def __init__(self, filters: Sequence[InsFilter]) -> None:
        super().__init__(filters)
        self._known_ns = [0] * len(DECIDED)  # since when it is known that well; 0: it is not

    @property
    def waiting_for(self) -> str:
        """What the user can do about it."""
        return (f"motion that shows the heading (known to {math.degrees(self.heading()[1]):.0f}° "
                "so far): speed up, brake or turn, or give it by initialpose")

    def advance(self, ring: ImuRing) -> None:
        """Run all up to the ring's last sample."""
        samples = ring.after(self.best.t_ns)
        if len(samples):
            for hypothesis in self.filters:
                hypothesis.process_imu_block(samples)

    def weigh(self) -> list[Verdict]:
        """Take what was decided since into the weights; return the likeliest's verdicts."""
        best = self.best
        verdicts = list(best.verdicts)
        for k in range(len(verdicts)):
            self._weigh([hypothesis.verdicts[k] for hypothesis in self.filters])
        for k in self._unlikely():
            self._drop(k)
        for hypothesis in self.filters:
            hypothesis.verdicts.clear()
        return verdicts

    def heading(self) -> tuple[float, float]:
        """Return the mixture's heading spread about the best [rad]: mean offset and σ."""
        weights = self.weights
        offsets, variances = self._about_best()
        mean = float(weights @ offsets)
        spread = float(weights @ (variances + (offsets - mean) ** 2))
        return mean, math.sqrt(spread * max(1.0, self._misfit))

    def _about_best(self) -> tuple[Array, Array]:
        """Headings relative to the best's, and their variances."""
        C_best = matrix_from_quat(self.best.nav[QUAT])
        offsets, variances = [], []
        for hypothesis in self.filters:
            C = matrix_from_quat(hypothesis.nav[QUAT]) @ C_best.T
            offsets.append(math.atan2(C[1, 0] - C[0, 1], C[0, 0] + C[1, 1]))
            variances.append(covariance(hypothesis.nav)[EPS, EPS][2, 2])
        return np.array(offsets), np.array(variances)

    def decide(self) -> InsFilter | None:
        """Return the one filter that the mixture has become, wide enough for all; or None."""
        mean, sigma = self.heading()
        winner = self.best
        decided = False
        for k, (std, lasting_ns) in enumerate(DECIDED):
            if sigma > std:
                self._known_ns[k] = 0
            elif self._known_ns[k] == 0:
                self._known_ns[k] = winner.t_ns
            elif winner.t_ns - self._known_ns[k] >= lasting_ns:
                decided = True
        if not decided:
            return None
        propagation.flush(winner.nav)
        P = covariance(winner.nav)
        P[8, 8] += max(0.0, sigma**2 + mean**2 - P[8, 8])
        pack(P, winner.nav[COVARIANCE])
        return winner
