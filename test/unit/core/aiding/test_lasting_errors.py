"""Batch means: 1 for errors as they are assumed, their low-frequency variance otherwise."""

import numpy as np
import pytest

from hybrid_ins.core.aiding.lasting_errors import LastingErrors
from hybrid_ins.core.inertial.state import Array
from hybrid_ins.simulation.sensors import gauss_markov

INTERVAL, R = 0.2, np.diag([0.05**2])


def factor_of(errors: Array) -> float:
    found = LastingErrors()
    for error in errors:
        found.add(error, np.zeros((1, 1)), R, INTERVAL)
    return found.factor


@pytest.mark.parametrize("seed", [2, 4, 6])
def test_white_errors_as_claimed_need_no_factor(seed: int) -> None:
    errors = 0.05 * np.random.default_rng(seed).standard_normal((3000, 1))

    assert factor_of(errors) < 1.6


@pytest.mark.parametrize("seed", [2, 4])
@pytest.mark.parametrize("time", [1.0, 5.0])
def test_the_factor_is_that_of_the_spectral_density(seed: int, time: float) -> None:
    """Coloured errors of the claimed variance count 2 τ / T-fold over times longer than τ."""
    rng = np.random.default_rng(seed)
    errors = gauss_markov(0.05, float(np.exp(-INTERVAL / time)), 6000, rng)[:, :1]

    assert 0.3 < factor_of(errors) / (2.0 * time / INTERVAL) < 2.0


def test_what_the_state_does_not_know_is_no_error_of_the_sensor() -> None:
    found = LastingErrors()
    for _ in range(1000):
        found.add(np.array([0.3]), np.array([[0.3**2]]), R, INTERVAL)

    assert found.factor == 1.0


def test_a_state_that_errs_as_it_claims_blames_the_sensor_rarely() -> None:
    """Half a minute at a time: in some batches by more than σ, in others by less."""
    factors = []
    for seed in range(10):
        rng, found = np.random.default_rng(seed), LastingErrors()
        for _ in range(40):
            error = 0.1 * rng.standard_normal(1)
            for _ in range(150):
                found.add(error, np.array([[0.1**2]]), R, INTERVAL)
        factors.append(found.factor)

    assert sum(factor > 1.5 for factor in factors) <= 3


def test_axes_may_come_and_go() -> None:
    found = LastingErrors()
    for k in range(1000):
        m = 1 + (k // 100) % 2
        found.add(np.full(m, 0.5), np.zeros((m, m)), 0.05**2 * np.eye(m), INTERVAL)

    assert found.factor > 100.0
