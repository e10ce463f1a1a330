"""The covariance is consistent with the errors: NEES and NIS, two-sided, at 200 Hz."""

from __future__ import annotations

import numpy as np
import pytest
from support.consistency import (
    BIAS_WALK,
    SIGMA_0,
    Flights,
    Q,
    constant,
    fly,
    is_consistent,
    limit,
    nis_is_consistent,
    standard_errors,
)

from hybrid_ins.core.inertial import propagation
from hybrid_ins.core.inertial.state import N_ERROR, N_NAV, PSD, NavState, covariance
from hybrid_ins.core.update.iterated_update import update
from hybrid_ins.simulation.motions import quadrotor_flight
from hybrid_ins.simulation.sensors import sample

RUNS, WRONG_RUNS = 50, 25
R = np.diag([0.01, 0.01, 0.02])


def flown(factor: float, runs: int) -> Flights:
    """Fly with a multiple of the true noise."""
    method = constant(factor, 0.01)
    return fly(200.0, 60.0, [method], runs)[method]


@pytest.fixture(scope="module")
def sound() -> Flights:
    return flown(1.0, RUNS)


def test_nees(sound: Flights) -> None:
    assert is_consistent(sound, limit(RUNS))


def test_nis(sound: Flights) -> None:
    assert sound.nis.size > 14_000
    assert nis_is_consistent(sound)


@pytest.mark.parametrize("factor", [0.6, pytest.param(1.6, marks=pytest.mark.slow)])
def test_wrong_noise_is_found_out(factor: float) -> None:
    """Half the runs tell a filter whose noise is wrong by 1.6 from a right one, either way."""
    nees = flown(factor, WRONG_RUNS).nees

    assert np.sign(1.0 - factor) * standard_errors(nees, 15) > limit(WRONG_RUNS)


def test_covariance_stays_positive_definite_over_a_million_steps() -> None:
    """Symmetric it is by construction; an update every 200 steps, ten times sharper at the end."""
    truth = sample(quadrotor_flight(60.0), np.arange(12_001) / 200.0)
    rows = np.empty((0, N_NAV))
    readings = np.hstack((truth.specific_force_b, truth.angular_rate_b))[1:]
    dt = np.full(200, 0.005)
    nav = NavState(
        truth.lla[0],
        truth.velocity_n[0],
        truth.quat_xyzw[0],
        np.zeros(3),
        np.zeros(3),
        np.diag((100.0 * SIGMA_0) ** 2),
    ).to_flat()
    nav[PSD] = np.concatenate((Q * 0.005, BIAS_WALK))
    H = np.eye(3, N_ERROR)
    smallest = np.inf
    for k in range(5000):
        lap = k % 50
        propagation.run(nav, dt, readings[200 * lap : 200 * (lap + 1)], 0.0, rows)
        update(nav, np.zeros(3), H, R if k < 2500 else 0.01 * R)
        if k % 25 == 0:
            P = covariance(nav)
            sigma = np.sqrt(np.diag(P))
            smallest = min(smallest, np.linalg.eigvalsh(P / np.outer(sigma, sigma))[0])

    assert np.all(np.isfinite(nav))
    assert smallest > 1e-9
    assert np.all(np.sqrt(np.diag(covariance(nav))) < 1.1 * SIGMA_0)
