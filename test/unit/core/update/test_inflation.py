"""Where the errors may be larger than the covariance says, the antenna is where the fixes were."""

from __future__ import annotations

import numpy as np
import pytest
from support.derivatives import derivative, flat_state, swing

from hybrid_ins.core.inertial.state import DV, EPS, LLA, N_ERROR, VELOCITY, Array, covariance
from hybrid_ins.core.update.inflation import about_antenna, inflate
from hybrid_ins.core.update.measurements import position_model, velocity_model

LEVER_B = np.array([-3.0, 0.4, -1.2])
STD = np.repeat([0.0, 0.0, 0.3, 0.0, 0.0], 3)


@pytest.fixture
def nav() -> Array:
    rate_b = np.array([0.1, -0.2, 0.5])
    return flat_state(np.array([3.0, -5.0, 0.5]), np.array([0.1, -0.3, 2.0]), rate_b, std=0.02)


def test_an_error_of_attitude_turns_the_vehicle_about_its_antenna(nav: Array) -> None:
    lla, velocity_n = nav[LLA].copy(), nav[VELOCITY].copy()
    T = about_antenna(nav, LEVER_B)[:, EPS]

    position = derivative(lambda moved: -position_model(moved, lla, LEVER_B)[0], nav)
    velocity = derivative(lambda moved: -velocity_model(moved, velocity_n, LEVER_B)[0], nav)

    np.testing.assert_allclose(position @ T, 0.0, atol=1e-4)
    np.testing.assert_allclose(velocity @ T, 0.0, atol=1e-4 + swing(LEVER_B))
    assert np.abs(position[:, EPS]).max() > 1.0  # it moves about the IMU


def test_where_the_antenna_is_remains_as_certain(nav: Array) -> None:
    H = position_model(nav, nav[LLA], LEVER_B)[1]
    before, alone = covariance(nav), nav.copy()

    inflate(nav, STD, LEVER_B)
    inflate(alone, STD, np.zeros(3))

    P = covariance(nav)
    np.testing.assert_allclose(np.diag(P)[EPS], 0.3**2)
    added = 0.3**2 - 0.02**2
    np.testing.assert_allclose(H @ P @ H.T, H @ before @ H.T, atol=1e-9)
    np.testing.assert_allclose(covariance(alone), before + np.diag(added * (STD > 0.0)), atol=1e-12)
    assert np.linalg.eigvalsh(P).min() > 0.0


def test_what_is_uncertain_enough_is_left_alone(nav: Array) -> None:
    before = covariance(nav)

    inflate(nav, np.full(N_ERROR, 0.01), LEVER_B)

    np.testing.assert_array_equal(covariance(nav), before)


def test_a_speed_does_not_turn_the_vehicle(nav: Array) -> None:
    std = np.zeros(N_ERROR)
    std[DV] = 3.0

    inflate(nav, std, LEVER_B)

    P = covariance(nav)
    np.testing.assert_allclose(np.diag(P)[DV], 9.0)
    np.testing.assert_allclose(P - np.diag(np.diag(P)), 0.0, atol=1e-12)
