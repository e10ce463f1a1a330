"""Inflation of the covariance, where errors may be larger than the error model accounts for."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.inertial.state import (
    COVARIANCE,
    DP,
    DV,
    EPS,
    LLA,
    N_ERROR,
    VELOCITY,
    covariance,
    pack,
)
from hybrid_ins.core.update.measurements import position_model, velocity_model

Array = NDArray[np.float64]


def inflate(nav: Array, std: Array, lever_b: Array) -> None:
    """
    Inflate the covariance of a flat state to variances of at least the square of ``std``.

    Parameters
    ----------
    nav : ndarray, shape (N_FLAT,)
        Flat state with nothing pending; its covariance is changed in place.
    std : ndarray, shape (15,)
        In the order of the error state; 0 where nothing is inflated.
    lever_b : ndarray, shape (3,)
        Antenna relative to the IMU [m], b: see `about_antenna`.
    """
    P, T = covariance(nav), about_antenna(nav, lever_b)
    added = np.maximum(std**2 - np.diag(P), 0.0)
    pack(P + (T * added) @ T.T, nav[COVARIANCE])


def about_antenna(nav: Array, lever_b: Array) -> Array:
    """
    Return what an error of attitude does to the others where the antenna is known, shape (15, 15).

    Fixes show where the antenna is, not the IMU: a vehicle whose attitude may be another turns
    about it. As independent errors, position and attitude would let the next fix take the
    difference for evidence on the attitude.
    """
    T = np.eye(N_ERROR)
    T[DP, EPS] = -position_model(nav, nav[LLA], lever_b)[1][:, EPS]
    T[DV, EPS] = -velocity_model(nav, nav[VELOCITY], lever_b)[1][:, EPS]
    return T


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
