"""
Chi-square gate on the innovation, with recovery after sustained rejection.

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
from hybrid_ins.core.measurements import GNSS, Measurement

Array = NDArray[np.float64]

MARGINAL = 0.5  # of the threshold: a NIS above it, after consistent rejections, is no agreement
MAX_ACCELERATION_ERROR = 10.0  # m/s², of an INS: its tilt is unknown altogether


@dataclass(frozen=True, slots=True)
class Verdict:
    """
    The decision on one measurement.

    Attributes
    ----------
    measurement : Measurement
        The one that was decided on.
    accepted : bool
        It was fused.
    reason : str
        Why it was rejected, or what was done besides fusing; empty for a plain fusion.
    age : float
        How far it lay behind the IMU when it was decided on [s].
    nis : float
        Normalised innovation squared; NaN where it was not computed.
    threshold : float
        Largest NIS that is accepted.
    sigma : ndarray, shape (m,)
        Standard deviations used for the measurement, NED [m or m/s].
    log_det : float
        Logarithm of the determinant of the innovation's covariance.
    inflated : bool
        The covariance was inflated for this measurement, see `Gate`.
    jump : bool
        It is rejected, in a run of rejections that began with a jump: no error of an INS grows
        that fast.
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
        """Return the verdict on a measurement that was not compared with the state."""
        return cls(measurement, False, reason, age, np.nan, np.nan, np.empty(0))


@dataclass(frozen=True, slots=True)
class _Rejections:
    """A run of measurements rejected one after the other."""

    first_ns: int
    consistent_ns: int  # since when they are consistent with each other
    z: Array  # innovation of the last
    jump: bool  # the first was one


class Gate:
    """
    Chi-square test of the innovation, with a limit on the duration of rejections.

    Measurements that are rejected without interruption for ``patience`` seconds, and are consistent
    with each other, are assumed right and the state wrong: for the next one the covariance is
    inflated (`Verdict.inflated`). Inconsistent ones have to wait three times as long. Where the
    covariance has grown meanwhile until such a measurement is just below the threshold, the state
    is as wrong, and the covariance is inflated as well.

    Parameters
    ----------
    thresholds : mapping of int to float
        Largest NIS that is accepted, by the number of components.
    patience : float
        [s].
    """

    def __init__(self, thresholds: Mapping[int, float], patience: float) -> None:
        self._thresholds = thresholds
        self._patience_ns = int(patience * 1e9)
        self._rejections: dict[str, _Rejections] = {}

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
        last = self._rejections.get(kind)
        others = {k: run for k, run in self._rejections.items() if k != kind}
        first_ns = last.first_ns if last else t_ns
        consistent_ns = last.consistent_ns if last and _are_consistent(last.z, z, R) else t_ns
        patience_ns = self._patience_ns
        if nis <= threshold:
            marginal = nis > MARGINAL * threshold and t_ns - consistent_ns > patience_ns // 3
            if not (marginal and measurement.sensor == GNSS):
                self._rejections = others
                return Verdict(measurement, True, "", age, nis, threshold, sigma, log_det)
        elif measurement.sensor != GNSS or (
            t_ns - consistent_ns < patience_ns and t_ns - first_ns < 3 * patience_ns
        ):
            jump = last.jump if last else _is_jump(kind, z, R, interval)
            self._rejections = {**others, kind: _Rejections(first_ns, consistent_ns, z, jump)}
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
        self._rejections = others
        return Verdict(
            measurement,
            True,
            f"rejected for {(t_ns - first_ns) * 1e-9:.1f} s: covariance inflated, then accepted",
            age,
            nis,
            threshold,
            sigma,
            log_det,
            inflated=True,
        )


def _is_jump(kind: str, z: Array, R: Array, interval: float) -> bool:
    """Return whether no acceleration error can have made an innovation so large."""
    grown = MAX_ACCELERATION_ERROR * interval * (0.5 * interval if kind == "position" else 1.0)
    return float(np.linalg.norm(z)) > grown + 5.0 * float(np.sqrt(np.trace(R)))


def _are_consistent(last: Array, z: Array, R: Array) -> bool:
    """Return whether two innovations show one error of the state: constant, or growing."""
    m = min(len(last), len(z))
    change = float(np.linalg.norm(z[:m] - last[:m]))
    return change <= max(0.5 * float(np.linalg.norm(z)), 4.0 * float(np.sqrt(np.trace(R))))
