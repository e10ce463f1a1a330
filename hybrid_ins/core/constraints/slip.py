"""
How far a vehicle's motion is from that of ideal wheels: σ of the velocity across its nose.

While fixes determine the velocity, each innovation of the constraint is compared with several
standard deviations at once; their weights are the likelihoods, which fade, [1]_.

References
----------
.. [1] Y. Bar-Shalom, X. Li, T. Kirubarajan, *Estimation with Applications to Tracking and
       Navigation*, 2001, section 11.6 (multiple models).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

FACTORS: Array = 2.0 ** np.arange(-3.0, 3.5, 0.5)  # on the nominal standard deviations
PRIOR = math.log(2.0)  # σ of the logarithm of that factor
LARGEST_NIS = 16.0  # that counts: one pothole is not the road


class SlipEstimator:
    """
    Standard deviation of velocities that a vehicle does not have: across its nose, or its wings.

    Parameters
    ----------
    std : ndarray, shape (m,)
        Nominal, [m/s], of each axis: known to a factor of two.
    """

    def __init__(self, std: Array) -> None:
        self._variance = np.outer(np.asarray(std) ** 2, FACTORS**2)
        self._prior = -0.5 * (np.log(FACTORS) / PRIOR) ** 2
        self._evidence = np.zeros_like(self._variance)

    def observe(self, z: Array, S: Array, share: float, fading: float) -> None:
        """
        Take an innovation into account.

        Parameters
        ----------
        z : ndarray, shape (m,)
            Innovation of the constraint [m/s].
        S : ndarray, shape (m, m)
            Its covariance without slip.
        share : float
            Independent observations that it is worth; below 1 where others resemble it.
        fading : float
            Factor on what is known.
        """
        total = np.diag(S)[:, None] + self._variance
        nis = np.minimum(z[:, None] ** 2 / total, LARGEST_NIS)
        self._evidence = fading * self._evidence - 0.5 * share * (np.log(total) + nis)

    @property
    def _weights(self) -> Array:
        """Probabilities of the factors, (m, F)."""
        log = self._evidence + self._prior
        weights = np.exp(log - log.max(axis=1, keepdims=True))
        return np.asarray(weights / weights.sum(axis=1, keepdims=True))

    @property
    def covariance(self) -> Array:
        """Covariance of these velocities, (m, m) [(m/s)²]."""
        return np.diag((self._weights * self._variance).sum(axis=1))

    @property
    def spread(self) -> Array:
        """Standard deviation of the logarithm of each standard deviation, (2,)."""
        weights, log = self._weights, np.log(FACTORS)
        mean = weights @ log
        return np.asarray(np.sqrt(weights @ log**2 - mean**2))
