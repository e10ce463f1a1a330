"""
Process-noise models: per-sample variances of the IMU, and their way to the density Qc.

A `NoiseModel` gives the variance ``q`` of each IMU channel before a prediction and may learn from
what is observed afterwards; the filter never knows which one it holds. `ProcessNoise` turns q into
the power spectral densities Qc that the error model takes.

References
----------
.. [1] B. Or, I. Klein, "A hybrid model and learning-based adaptive navigation filter", IEEE TIM
       2022, eq. (7), (19).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.shallow_copy import ShallowCopy

Array = NDArray[np.float64]
Linearisation = tuple[Array, Array, Array, Array]  # see `iterated_update.linearisation`


@dataclass(frozen=True, slots=True)
class NoiseEstimate:
    """Variances that a regressor estimated from a window of IMU samples."""

    t_ns: int  # ns, end of the window
    q: Array | None  # (6,) per-sample variances; None where the window was unusable
    at_least: bool = False  # readings were cut off: the noise may be more, and is no less
    kind: ClassVar[str] = "noise estimate"


@dataclass(frozen=True, slots=True)
class Correction:
    """
    What a measurement shows of the noise, and what it did to the state.

    Attributes
    ----------
    t_ns : int
        Stamp of the measurement [ns].
    z : ndarray, shape (m,)
        Innovation.
    S : ndarray, shape (m, m)
        Its predicted covariance.
    H : ndarray, shape (m, 15)
        Measurement matrix.
    K : ndarray, shape (15, m)
        Gain.
    dx : ndarray, shape (15,)
        Correction applied, K z.
    C_nb : ndarray, shape (3, 3)
        Attitude.
    interval : float
        Time since the previous correction [s].
    nav : ndarray, shape (N_FLAT,)
        Flat state before it.
    fused : bool
        False for a measurement that the gate rejected: K and dx are zero.
    restarted : bool
        The state was changed by other means than measurements since the previous correction.
    weight : float
        With which it was fused: its covariance was divided by that.
    linear : tuple of ndarray, optional
        Where the correction was found by iteration, `iterated_update.linearisation`.
    of_stamp : ndarray, shape (m, m), optional
        Covariance by an error of the stamp of 1 s: `stamp_scatter.stamp_covariance` of a position,
        that by the acceleration of a velocity; None where neither stamps nor velocities are to be
        doubted.
    fix_factor : float
        Factor on the covariance of a fix that is in S.
    stamp_std : float
        Standard deviation of the stamp of a position, or of the age of a velocity [s], that is in
        S, times ``of_stamp``.
    slow_growth : ndarray, shape (3,), optional
        Variance [m²], NED, by which a position's slow error has changed as claimed since the last.
    claimed_stds : (float, float)
        Standard deviations [m] that a position claims horizontally and of the height; 0 of others.
    kind : str
        Of the measurement.
    factors_by_axis : (float, float)
        Factors on its covariance that are in S besides ``fix_factor``, horizontally and vertically.
    turn : float
        Angle [rad] by which the errors were turned with the heading, see `kalman.turn_errors`.
    """

    t_ns: int
    z: Array
    S: Array
    H: Array
    K: Array
    dx: Array
    C_nb: Array
    interval: float
    nav: Array
    fused: bool
    restarted: bool = False
    weight: float = 1.0
    linear: Linearisation | None = None
    of_stamp: Array | None = None
    fix_factor: float = 1.0
    stamp_std: float = 0.0
    slow_growth: Array | None = None
    claimed_stds: tuple[float, float] = (0.0, 0.0)
    kind: str = ""
    factors_by_axis: tuple[float, float] = (1.0, 1.0)
    turn: float = 0.0


class NoiseModel(Protocol):
    """
    Variances before a prediction, learning after a measurement.

    Implementations replace their arrays and never change them in place: a shallow copy is a
    checkpoint.

    Attributes
    ----------
    uses_corrections : bool
        `learn` depends on corrections; otherwise they need not be given.
    """

    uses_corrections: ClassVar[bool]

    def levels(self) -> Array:
        """Per-sample variances now: accelerometer x y z, gyroscope x y z, shape (6,), b frame."""
        ...

    def learn(self, observation: NoiseEstimate | Correction) -> bool:
        """
        Use an observation.

        Returns True where stand-in variances have given way to estimated ones: what was found
        out about the former does not hold for the latter.
        """
        ...


@dataclass(frozen=True, slots=True)
class ProcessNoise:
    """
    From per-sample variances to Qc.

    Attributes
    ----------
    bias_walk : ndarray, shape (6,)
        PSD of the bias random walks: [(m/s²)²/s] and [(rad/s)²/s]; IMU parameters.
    period : float
        Nominal IMU sample period [s].
    consistent : bool
        True: Qc = q * period, so that Q^d on velocity is q * period². False: the paper's literal
        reading, Qc = q, which inflates Q^d by 1 / period.
    """

    bias_walk: Array
    period: float
    consistent: bool = True

    def psd(self, q: Array) -> Array:
        """Return Qc's diagonal, shape (12,), for levels ``q``, shape (6,); eq. (19) of [1]_."""
        return np.concatenate((q * self.period if self.consistent else q, self.bias_walk))

    def q(self, psd: Array) -> Array:
        """Return the levels, shape (6,), whose Qc is ``psd``, shape (6,)."""
        return psd / self.period if self.consistent else psd


# MB-EKF-CQ1 to CQ3 of section IV-B of [1]_: variances of accelerometer and gyroscope.
PAPER_CONSTANTS = {"cq1": (0.002, 0.02), "cq2": (0.001, 0.01), "cq3": (0.002, 0.01)}


class ConstantNoise(ShallowCopy):
    """
    Variances that never change.

    Parameters
    ----------
    q : ndarray, shape (6,)
        Per-sample variances [(m/s²)², (rad/s)²].
    """

    uses_corrections: ClassVar[bool] = False

    def __init__(self, q: Array) -> None:
        self._q = np.array(q, float)

    def levels(self) -> Array:
        """See `NoiseModel.levels`."""
        return self._q

    def learn(self, observation: NoiseEstimate | Correction) -> bool:
        """Ignore the observation."""
        return False


class LearnedNoise(ShallowCopy):
    """
    Variances that a regressor estimates from the IMU; a constant while it has no estimate.

    The estimate contains motion and vibration besides noise, so it is an upper bound. Where
    recordings have shown the noise of ordinary motion (``fallback``) and the level that is rarely
    exceeded there (B, ``background``), an estimate L counts as L - B²/L above the fallback:
    nothing below B, nearly all of L far above.

    Parameters
    ----------
    fallback : ndarray, shape (6,)
        Variances before the first estimate, and once the last one is older than ``HOLD_NS``. With
        an estimate requested at least once a second, the fallback is in force within a second.
    background : ndarray, shape (6,), optional
        See above; zero where it is not known: estimates are used as they are.

    Attributes
    ----------
    on_fallback : bool
        There is no usable estimate.
    """

    HOLD_NS = 500_000_000
    uses_corrections: ClassVar[bool] = False

    def __init__(self, fallback: Array, background: Array | None = None) -> None:
        self._fallback = np.array(fallback, float)
        self._background = np.zeros(6) if background is None else np.array(background, float)
        self._q = self._fallback
        self._estimated_ns: int | None = None

    @property
    def on_fallback(self) -> bool:
        """See above."""
        return self._estimated_ns is None

    def levels(self) -> Array:
        """See `NoiseModel.levels`."""
        return self._q

    def learn(self, observation: NoiseEstimate | Correction) -> bool:
        """Use a regressor's estimate, or let the last one expire."""
        if isinstance(observation, Correction):
            return False
        t_ns, q = observation.t_ns, observation.q
        if q is not None:
            replaced = self._estimated_ns is None
            self._q, self._estimated_ns = self._above_background(q), t_ns
            if observation.at_least:
                self._q = np.maximum(self._q, self._fallback)
            return replaced
        if self._estimated_ns is not None and t_ns - self._estimated_ns > self.HOLD_NS:
            self._q, self._estimated_ns = self._fallback, None
        return False

    def _above_background(self, q: Array) -> Array:
        share = np.divide(self._background, q, out=np.ones(6), where=q > self._background)
        return np.asarray(np.minimum(q, self._fallback + q * (1.0 - share**2)))
