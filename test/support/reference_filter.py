"""Propagation of state and covariance as the textbook writes it, and a flight to compare with."""

from __future__ import annotations

import numpy as np
from support.analytic_motion import Series, Truth, Wave, travel

from hybrid_ins.core.inertial import propagation
from hybrid_ins.core.inertial.error_model import system_matrix
from hybrid_ins.core.inertial.state import (
    B_A,
    B_G,
    BIAS_A,
    BIAS_G,
    DV,
    EPS,
    LAST_F,
    LAST_W,
    LLA,
    N_ERROR,
    N_NAV,
    N_NOISE,
    NAVIGATION,
    PSD,
    QUAT,
    VELOCITY,
    W_A,
    W_AB,
    W_G,
    W_GB,
    Array,
    covariance,
)
from hybrid_ins.core.inertial.strapdown import mechanise

NO_ROWS = np.empty((0, N_NAV))
PSD_MEMS = np.repeat([4e-6, 4e-8, 1e-6, 1e-10], 3)
SIGMA = np.repeat([1.0, 0.3, 0.02, 0.05, 0.005], 3)


def some_covariance(seed: int) -> Array:
    mixing = np.random.default_rng(seed).normal(size=(N_ERROR, N_ERROR))
    correlation = mixing @ mixing.T + N_ERROR * np.eye(N_ERROR)
    scale = SIGMA / np.sqrt(np.diag(correlation))
    return correlation * np.outer(scale, scale)


def flight(rate: float, duration: float) -> Truth:
    return travel(
        np.arange(int(rate * duration) + 1) / rate,
        Series(rate=(80, 30, 0), waves=[Wave((40, 40, 5), 0.05, (0, 1.57, 0))]),
        Series(waves=[Wave((0.3, 0.2, 1.0), 0.07), Wave((0.02, 0.03, 0.02), 1.3, (1, 0, 2))]),
    )


def start(truth: Truth) -> Array:
    nav = truth.flat(P=some_covariance(1))
    nav[BIAS_A], nav[BIAS_G] = (0.03, -0.02, 0.05), (0.002, 0.001, -0.003)
    nav[PSD] = PSD_MEMS
    return nav


def propagated(P: Array, F: Array, C_nb: Array, psd: Array, dt: float) -> Array:
    """Phi P Phi' + G Qc G' dt with Phi = I + F dt, as the textbook writes it."""
    Phi, G = np.eye(N_ERROR) + F * dt, np.zeros((N_ERROR, N_NOISE))
    G[DV, W_A], G[EPS, W_G] = C_nb, -C_nb
    G[B_A, W_AB] = G[B_G, W_GB] = np.eye(3)
    return Phi @ P @ Phi.T + G @ np.diag(psd) @ G.T * dt


def reference_step(nav: Array, P: Array, dt: float, reading: Array) -> Array:
    """Mechanisation, F and P <- Phi P Phi' + Q^d as the textbook writes them; P is returned."""
    C, f_n, F = np.empty(9), np.empty(3), np.zeros((N_ERROR, N_ERROR))
    f0, w0 = nav[LAST_F] - nav[BIAS_A], nav[LAST_W] - nav[BIAS_G]
    f1, w1 = reading[:3] - nav[BIAS_A], reading[3:] - nav[BIAS_G]
    mechanise(nav[LLA], nav[VELOCITY], nav[QUAT], f0, w0, f1, w1, dt, C, f_n)
    nav[LAST_F], nav[LAST_W] = reading[:3], reading[3:]
    system_matrix(nav[LLA], nav[VELOCITY], f_n, C, F)
    return propagated(P, F, C.reshape(3, 3), nav[PSD], dt)


def difference_to_reference(rate: float, duration: float) -> float:
    """
    Return by how much the compiled kernel differs from the reference at the end of a flight.

    Of the state relative to itself, of the covariance relative to its standard deviations.
    """
    truth = flight(rate, duration)
    nav, reference = start(truth), start(truth)
    P = covariance(reference)
    steps = np.diff(truth.t)

    propagation.run(nav, steps, truth.readings[1:], 0.0, NO_ROWS)
    for dt, reading in zip(steps, truth.readings[1:], strict=True):
        P = reference_step(reference, P, dt, reading)

    state = np.abs(nav[NAVIGATION] - reference[NAVIGATION]) / np.abs(reference[NAVIGATION])
    unit = np.sqrt(np.outer(np.diag(P), np.diag(P)))
    return float(max(np.max(state), np.max(np.abs(covariance(nav) - P) / unit)))
