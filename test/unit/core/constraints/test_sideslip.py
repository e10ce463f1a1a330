"""No sideslip of a fixed wing: its Jacobian, the wind that is found, and what is claimed of it."""

import numpy as np
import pytest
from hypothesis import given, settings
from support.derivatives import derivative, flat_state, vectors

from hybrid_ins.core.constraints.nonholonomic import Nose
from hybrid_ins.core.constraints.sideslip import AIRBORNE, WIND_STD, NoSideslip, WindObserver
from hybrid_ins.core.inertial.state import Array

INTERVAL = 0.5
WIND_N = np.array([4.0, -2.0, 0.0])
NOSE = Nose(0.0, 0.0, np.zeros(3))


@settings(max_examples=40, deadline=None)
@given(vectors, vectors, vectors)
def test_H_is_the_derivative_of_the_innovation(velocity: Array, rpy: Array, wind: Array) -> None:
    nav = flat_state(20.0 * velocity, rpy, np.zeros(3))
    constraint = NoSideslip(0, Nose(0.1, 0.05, np.zeros(3)).axes[0], 5.0 * wind, 1.0)

    H = constraint.linearise(nav)[1]

    expected = -derivative(lambda at: constraint.linearise(at)[0], nav)
    np.testing.assert_allclose(H, expected, atol=1e-6, rtol=1e-5)


def state(heading: float, slip: float, airspeed: float = 18.0) -> Array:
    """Return the state of a level flight; ``slip`` [m/s] is to the right, against the air."""
    forward = np.array([np.cos(heading), np.sin(heading), 0.0])
    right = np.array([-np.sin(heading), np.cos(heading), 0.0])
    velocity_n = WIND_N + airspeed * forward + slip * right
    return flat_state(velocity_n, np.array([0.0, 0.0, heading]), np.zeros(3), std=0.01)


def fly(observer: WindObserver, seconds: float, seed: int, gust: float, rate: float = 0.1) -> None:
    """Show circles in gusts that last for 3 s."""
    rng = np.random.default_rng(seed)
    decay = np.exp(-INTERVAL / 3.0)
    slip = gust * rng.standard_normal()
    for k in range(int(seconds / INTERVAL)):
        slip = decay * slip + gust * np.sqrt(1.0 - decay**2) * rng.standard_normal()
        observer.observe(
            round(1e9 * INTERVAL * k), state(rate * INTERVAL * k, slip), INTERVAL, settled=True
        )


@pytest.mark.parametrize("gust", [0.3, 1.5])
def test_wind_and_gusts_are_found_with_their_uncertainty(gust: float) -> None:
    distance = []
    for seed in range(2, 22, 2):
        observer = WindObserver(NOSE)
        fly(observer, 180.0, seed, gust)
        assert np.sqrt(observer.slip.covariance[0, 0]) == pytest.approx(gust, rel=0.6)
        distance.append((observer.wind_n - WIND_N)[:2] / observer.sigma)

    assert np.mean(np.square(distance)) < 1.5


def test_what_is_not_known_of_the_wind_is_in_the_covariance() -> None:
    """GIVEN a straight leg to the north WHEN the plane turns to the east THEN little is claimed."""
    observer = WindObserver(NOSE)
    fly(observer, 120.0, 2, 0.3, rate=0.0)

    north = observer.measurement(0, state(0.0, 0.0), INTERVAL)
    east = observer.measurement(0, state(0.5 * np.pi, 0.0), INTERVAL)

    assert north is not None and east is not None
    assert abs(observer.wind_n[1] - WIND_N[1]) < 0.5
    assert east.variance > 20.0 * north.variance
    assert east.variance > WIND_STD**2
    for k in range(240):  # two minutes without fixes
        observer.observe(
            round(1e9 * (120.0 + INTERVAL * k)), state(0.0, 0.0), INTERVAL, settled=False
        )
    later = observer.measurement(0, state(0.0, 0.0), INTERVAL)
    assert later is not None and later.variance > 1.5 * north.variance


def test_the_wind_changes_while_nothing_is_observed() -> None:
    """GIVEN a flight and hours on the ground THEN what was known of the wind is worth little."""
    observer = WindObserver(NOSE)
    fly(observer, 180.0, 2, 0.3)
    assert max(observer.sigma) < 0.5 * WIND_STD

    observer.observe(round(1e9 * 10_000.0), state(0.0, 0.0), INTERVAL, settled=False)

    assert max(observer.sigma) == pytest.approx(WIND_STD)


def test_on_the_ground_there_is_neither_wind_nor_constraint() -> None:
    observer = WindObserver(NOSE)
    taxiing = flat_state(np.array([0.9 * AIRBORNE, 1.0, 0.0]), np.zeros(3), np.zeros(3))

    observer.observe(0, taxiing, INTERVAL, settled=True)

    assert observer.measurement(0, taxiing, INTERVAL) is None
    np.testing.assert_array_equal(observer.wind_n, 0.0)
