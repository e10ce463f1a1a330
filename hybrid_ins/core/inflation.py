"""Inflation of the covariance, where errors may be larger than the error model accounts for."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.state import COVARIANCE, DP, DV, covariance, pack

Array = NDArray[np.float64]


def inflate_covariance(P: Array, std: Array) -> Array:
    """Return P, shape (n, n), with variances of at least the square of ``std``, shape (n,)."""
    return np.asarray(P + np.diag(np.maximum(std**2 - np.diag(P), 0.0)))


def inflate_to_innovation(nav: Array, z: Array, H: Array, interval: float) -> None:
    """
    Inflate the covariance so that an innovation ``z`` far outside it is consistent with it.

    Position gets all of it; velocity what would have led there since the last correction.

    Parameters
    ----------
    nav : ndarray, shape (N_FLAT,)
        Flat state with nothing pending; its covariance is changed in place.
    z, H : ndarray, shape (m,), (m, 15)
        Innovation and measurement matrix.
    interval : float
        Time since the last correction [s].
    """
    P = covariance(nav)
    std = np.abs(H[:, :6]).T @ np.abs(z)
    P[DP, DP] += np.diag(std[:3] ** 2)
    P[DV, DV] += np.diag((std[:3] / max(interval, 1.0)) ** 2 + std[3:] ** 2)
    pack(P, nav[COVARIANCE])
