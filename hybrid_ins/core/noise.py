"""
The seam behind which the process noise varies.

A `NoiseModel` tells the noise level ``q`` of each IMU channel before a prediction and may learn
from a correction; the filter never knows which one it holds. `ProcessNoise` turns q into the power
spectral densities Qc that the error model takes.

References
----------
.. [1] B. Or, I. Klein, "A hybrid model and learning-based adaptive navigation filter", IEEE TIM
       2022, eq. (7), (16)-(19).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Correction:
    """
    What a fused measurement tells about the process noise.

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
    dx : ndarray, shape (15,)
        Correction applied, the gain times z.
    C_nb : ndarray, shape (3, 3)
        Attitude.
    interval : float
        Time since the previous correction [s].
    """

    t_ns: int
    z: Array
    S: Array
    H: Array
    dx: Array
    C_nb: Array
    interval: float


class NoiseModel(Protocol):
    """Levels before a prediction, learn after a correction. Copied for every rewind point."""

    @property
    def source(self) -> str:
        """What the levels in force come from: constant, learned, fallback, innovation."""
        ...

    def levels(self) -> Array:
        """Per-sample variances now: accelerometer x y z, gyroscope x y z, shape (6,), b frame."""
        ...

    def refresh(self, q: Array | None) -> None:
        """Take a regressor's levels, shape (6,), or None when it could not tell."""
        ...

    def learn(self, correction: Correction) -> None:
        """Take a correction into account."""
        ...


class ConstantNoise:
    """
    Levels that never change.

    Parameters
    ----------
    q : ndarray, shape (6,)
        Per-sample variances [(m/s²)², (rad/s)²].
    """

    source = "constant"

    def __init__(self, q: Array) -> None:
        self._q = np.array(q, float)

    def levels(self) -> Array:
        """See `NoiseModel.levels`."""
        return self._q

    def refresh(self, q: Array | None) -> None:
        """Ignore the estimate."""

    def learn(self, correction: Correction) -> None:
        """Ignore the correction."""


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
