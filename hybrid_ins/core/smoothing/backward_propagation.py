"""
Propagation backward in time: the state before a smoothed one, by the IMU alone.

Of a smoothed state that knows nothing of what came before it, the error a time dt earlier is
(I + F dt)^-1 (error - w), where w is the process noise of that time.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.inertial.error_model import system_matrix
from hybrid_ins.core.inertial.state import (
    B_A,
    B_G,
    BIAS_A,
    BIAS_G,
    COVARIANCE,
    DV,
    EPS,
    LAST_F,
    LAST_W,
    LLA,
    N_ERROR,
    N_NAV,
    PSD,
    QUAT,
    VELOCITY,
    W_A,
    W_AB,
    W_G,
    W_GB,
    covariance,
    pack,
)
from hybrid_ins.core.inertial.strapdown import mechanise

Array = NDArray[np.float64]


def run_backward(
    nav: Array, t_ns: int, samples: NDArray[np.void], long_step_ns: int
) -> tuple[NDArray[np.int64], Array]:
    """
    Carry a flat state back over the samples before it, up to the first gap.

    Parameters
    ----------
    nav : ndarray, shape (N_FLAT,)
        Flat state, with its IMU sample and Qc's diagonal; overwritten.
    t_ns : int
        Its stamp [ns].
    samples : ndarray of ``SAMPLE_DTYPE``
        Up to that stamp, by stamp.
    long_step_ns : int
        A longer step [ns] is a gap.

    Returns
    -------
    t_ns, rows : ndarray, shape (M,), (M, N_NAV)
        Stamps [ns] and flat states, oldest first.
    """
    P, psd = covariance(nav), nav[PSD]
    f, w = nav[LAST_F].copy(), nav[LAST_W].copy()
    C, f_n, F = np.empty(9), np.empty(3), np.zeros((N_ERROR, N_ERROR))
    stamps: list[int] = []
    rows: list[Array] = []
    for sample in samples[::-1]:
        dt = (t_ns - int(sample["t_ns"])) * 1e-9
        if dt * 1e9 > long_step_ns:
            break
        if dt > 0.0:
            late = f - nav[BIAS_A], w - nav[BIAS_G]
            early = sample["f"] - nav[BIAS_A], sample["w"] - nav[BIAS_G]
            mechanise(nav[LLA], nav[VELOCITY], nav[QUAT], *late, *early, -dt, C, f_n)
            system_matrix(nav[LLA], nav[VELOCITY], f_n, C, F)
            back, C_nb = np.eye(N_ERROR) - dt * F, C.reshape(3, 3)
            for block, q in ((DV, psd[W_A]), (EPS, psd[W_G])):
                P[block, block] += dt * (C_nb * q) @ C_nb.T
            P[B_A, B_A] += dt * np.diag(psd[W_AB])
            P[B_G, B_G] += dt * np.diag(psd[W_GB])
            P = back @ P @ back.T
        t_ns, f, w = int(sample["t_ns"]), sample["f"], sample["w"]
        nav[LAST_F], nav[LAST_W] = f, w
        pack(P, nav[COVARIANCE])
        stamps.append(t_ns)
        rows.append(nav[:N_NAV].copy())
    return np.array(stamps[::-1], np.int64), np.array(rows[::-1]).reshape(-1, N_NAV)
