"""
Which measurements are believed, and the way back when belief itself went wrong.

References
----------
.. [1] Y. Bar-Shalom, X. Li, T. Kirubarajan, *Estimation with Applications to Tracking and
       Navigation*, 2001, section 5.4.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.linalg import log_determinant
from hybrid_ins.core.measurements import Measurement

Array = NDArray[np.float64]

BARELY = 0.5  # of the threshold: a NIS beyond it, after refusals that agree with it, is no fit
UNSEEN_ACCELERATION = 10.0  # m/s², the most that an INS mistakes: a tilt unknown altogether


@dataclass(frozen=True, slots=True)
class Verdict:
    """
    What became of one measurement.

    Attributes
    ----------
    measurement : Measurement
        The one that was judged.
    accepted : bool
        It was fused.
    reason : str
        Why not, or what was done besides fusing; empty for a plain fusion.
    age : float
        How far it lay behind the IMU when it was decided [s].
    nis : float
        Normalised innovation squared; NaN when it did not get that far.
    threshold : float
        What the NIS was held against.
    sigma : ndarray, shape (m,)
        Standard deviations used for the measurement, NED [m or m/s].
    log_det : float
        Logarithm of the determinant of the innovation's covariance.
    inflated : bool
        The covariance was inflated for this measurement, see `Gate`.
    jump : bool
        It is refused, and belongs to a run of refusals that began with a jump: no error of an
        INS grows that fast.
    """

    measurement: Measurement
    accepted: bool
    reason: str
    age: float
    nis: float
    threshold: float
    sigma: Array
    log_det: float = 0.0
    inflated: bool = False
    jump: bool = False

    @classmethod
    def rejected(cls, measurement: Measurement, reason: str, age: float = np.nan) -> Verdict:
        """Return the verdict on a measurement that never met the state."""
        return cls(measurement, False, reason, age, np.nan, np.nan, np.empty(0))


@dataclass(frozen=True, slots=True)
class _Refusals:
    """A run of measurements refused one after the other."""

    first_ns: int
    agreeing_ns: int  # since when they agree
    z: Array  # innovation of the last
    jump: bool  # the first came out of the blue


class Gate:
    """
    Chi-square test of the innovation, with a limit on how long it may say no.

    Measurements that are refused without interruption for ``patience`` seconds, and agree with
    each other, are taken for right and the state for wrong: the next one opens the state
    (`Verdict.inflated`). Those that contradict each other have to wait three times as long, but not
    for ever. Where the covariance has grown meanwhile until such a measurement barely fits, the
    state is as wrong, and opened as well.

    Parameters
    ----------
    thresholds : mapping of int to float
        Largest NIS that is fused, by the number of components.
    patience : float
        [s].
    """

    def __init__(self, thresholds: Mapping[int, float], patience: float) -> None:
        self._thresholds = thresholds
        self._patience_ns = int(patience * 1e9)
        self._refusals: dict[str, _Refusals] = {}

    def threshold(self, components: int) -> float:
        """Return the largest NIS of a measurement with so many components that is fused."""
        return self._thresholds[components]

    def judge(
        self,
        measurement: Measurement,
        z: Array,
        R: Array,
        S: Array,
        nis: float,
        age: float,
        interval: float = np.inf,
    ) -> Verdict:
        """
        Decide by the innovation z (m,), its NIS, and the covariances R and S, (m, m).

        ``interval`` is the time since the last correction [s].
        """
        threshold = self._thresholds[len(R)]
        sigma = np.sqrt(R.diagonal())
        log_det = log_determinant(S)
        kind, t_ns = measurement.kind, measurement.t_ns
        last = self._refusals.get(kind)
        others = {k: run for k, run in self._refusals.items() if k != kind}
        first_ns = last.first_ns if last else t_ns
        agreeing_ns = last.agreeing_ns if last and _agree(last.z, z, R) else t_ns
        patience_ns = self._patience_ns
        if nis <= threshold:
            barely = nis > BARELY * threshold and t_ns - agreeing_ns > patience_ns // 3
            if not (barely and measurement.aiding):
                self._refusals = others
                return Verdict(measurement, True, "", age, nis, threshold, sigma, log_det)
        elif not measurement.aiding or (
            t_ns - agreeing_ns < patience_ns and t_ns - first_ns < 3 * patience_ns
        ):
            jump = last.jump if last else _jumps(kind, z, R, interval)
            self._refusals = {**others, kind: _Refusals(first_ns, agreeing_ns, z, jump)}
            return Verdict(
                measurement,
                False,
                "innovation beyond the gate",
                age,
                nis,
                threshold,
                sigma,
                log_det,
                jump=jump,
            )
        self._refusals = others
        return Verdict(
            measurement,
            True,
            f"refused for {(t_ns - first_ns) * 1e-9:.1f} s: state opened to the measurement",
            age,
            nis,
            threshold,
            sigma,
            log_det,
            inflated=True,
        )


def _jumps(kind: str, z: Array, R: Array, interval: float) -> bool:
    """Tell whether an innovation is larger than an unseen acceleration could have made it."""
    grown = UNSEEN_ACCELERATION * interval * (0.5 * interval if kind == "position" else 1.0)
    return float(np.linalg.norm(z)) > grown + 5.0 * float(np.sqrt(np.trace(R)))


def _agree(last: Array, z: Array, R: Array) -> bool:
    """Tell whether two innovations say the same of the state: a shift, or one that grows."""
    m = min(len(last), len(z))
    change = float(np.linalg.norm(z[:m] - last[:m]))
    return change <= max(0.5 * float(np.linalg.norm(z)), 4.0 * float(np.sqrt(np.trace(R))))
