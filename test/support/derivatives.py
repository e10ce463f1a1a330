"""Flat states for measurement models, and the derivative of an innovation by differences."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from hypothesis import strategies as st
from support.analytic_motion import EARTH_RATE_E

from hybrid_ins.core.inertial.rotations import quat_from_rpy
from hybrid_ins.core.inertial.state import LAST_W, N_ERROR, Array, NavState
from hybrid_ins.core.update.kalman import inject

STEP = np.repeat([30.0, 1.0, 1e-4, 0.1, 0.01], 3)  # m, m/s, rad, m/s², rad/s

vectors = st.tuples(*[st.floats(-1.0, 1.0)] * 3).map(np.array)


def flat_state(
    velocity_n: Array, rpy: Array, rate_b: Array, *, std: float = 1.0, lat: float = 0.6
) -> Array:
    """Return a flat state with a covariance of ``std``² on the diagonal."""
    nav = NavState(
        np.array([lat, 0.6, 800.0]),
        np.asarray(velocity_n, float),
        quat_from_rpy(*rpy),
        np.zeros(3),
        np.array([0.01, -0.02, 0.005]),
        np.eye(N_ERROR) * std**2,
    ).to_flat()
    nav[LAST_W] = rate_b
    return nav


def derivative(value: Callable[[Array], Array], nav: Array) -> Array:
    """Return the derivative of a function of the flat state by the error state, (M, N_ERROR)."""
    columns = []
    for size, step in zip(STEP, np.diag(STEP), strict=True):
        up, down = nav.copy(), nav.copy()
        inject(up, step)
        inject(down, -step)
        columns.append((value(up) - value(down)) / (2.0 * size))
    return np.stack(columns, axis=1)


def swing(arm_b: Array) -> float:
    """Return the speed of an arm at the Earth's rate [m/s per rad], which H leaves out."""
    return float(np.linalg.norm(EARTH_RATE_E) * np.linalg.norm(arm_b))
