"""A stand with the engine on: its spectrum, what it says of the speed, and when it says nothing."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from support.derivatives import derivative, flat_state, swing, vectors

from hybrid_ins.core.constraints.near_standstill import (
    CRAWL_STD,
    NearStandstill,
    NearStandstillDetector,
    only_vibrates,
)
from hybrid_ins.core.constraints.nonholonomic import Nose
from hybrid_ins.core.imu.samples import SAMPLE_DTYPE
from hybrid_ins.core.inertial.state import BIAS_G, DV, VELOCITY, Array, covariance
from hybrid_ins.core.update.iterated_update import update
from hybrid_ins.simulation.vehicles import engine_phases

RATE = 100.0
INTERVAL = 0.5
NOSE = Nose(0.0, 0.0, np.zeros(3))


def window(end: float, seed: int = 0, road: float = 0.0, **changes: float) -> NDArray[np.void]:
    """Return a second of samples with an engine's vibration, [s], on a road that shakes [m/s²]."""
    n = int(changes.get("seconds", 1.0) * RATE)
    t = end - (n - 1 - np.arange(n)) / RATE
    rng = np.random.default_rng([seed, round(1e3 * end)])
    table = np.zeros(n, SAMPLE_DTYPE)
    table["t_ns"] = np.rint(t * 1e9)
    engine = np.sin(engine_phases(t, 31.0, 0.05, rng)[:, :1])
    slow = np.sin(2.0 * np.pi * 2.3 * t + rng.uniform(0.0, 6.0))[:, None]
    table["f"] = [0.0, 0.0, -9.8] + 0.5 * engine + road * slow
    table["f"] += changes.get("jerk", 0.0) * t[:, None] + 0.02 * rng.standard_normal((n, 3))
    table["f"][:, 0] += changes.get("acceleration", 0.0)
    table["w"] = 0.02 * engine + 0.002 * rng.standard_normal((n, 3)) + changes.get("rate", 0.0)
    return table


def drive(detector: NearStandstillDetector, seconds: float, road: float, speed: float) -> float:
    """Show a detector a drive with fixes; return when it ends [s]."""
    times = np.arange(1.0, seconds, INTERVAL)
    nav = flat_state(np.array([speed, 0.0, 0.0]), np.zeros(3), np.zeros(3), std=0.05)
    for t in times:
        detector.learn(window(t, road=road), nav, INTERVAL, NOSE)
    return float(times[-1])


def outage(
    detector: NearStandstillDetector, begin: float, speed: float, std: float, **changes: float
) -> list[float]:
    """Return when [s] of 6 s without fixes there is a measurement."""
    nav = flat_state(np.array([speed, 0.0, 0.0]), np.zeros(3), np.zeros(3), std=std)
    nav[BIAS_G] = 0.0
    times = begin + np.arange(INTERVAL, 6.0, INTERVAL)
    found = (
        detector.measurement(window(t, **changes), nav, np.zeros(3), NOSE) is not None
        for t in times
    )
    return [float(t - begin) for t, one in zip(times, found, strict=True) if one]


@settings(max_examples=40, deadline=None)
@given(vectors, vectors, vectors, st.floats(-0.5, 0.5), st.floats(-0.3, 0.3))
def test_H_is_the_derivative_of_the_innovation(
    velocity: Array, rpy: Array, rate: Array, yaw: float, pitch: float
) -> None:
    point_b = np.array([-1.2, 0.3, 0.5])
    nav = flat_state(3.0 * velocity, rpy, rate)
    found = NearStandstill(0, rate, Nose(yaw, pitch, point_b))

    H = found.linearise(nav)[1]

    expected = -derivative(lambda at: found.linearise(at)[0], nav)
    np.testing.assert_allclose(H, expected, atol=1.01 * swing(point_b), rtol=1e-5)


def test_an_engine_that_idles_only_vibrates() -> None:
    assert all(only_vibrates(window(3.0, seed)) for seed in range(20))


@pytest.mark.parametrize(
    ("what", "changes"),
    [
        ("a road", {"road": 0.2}),
        ("a turn", {"rate": 0.1}),
        ("braking that ends", {"jerk": 1.0}),
        ("half a second", {"seconds": 0.5}),
        ("no samples", {"seconds": 0.0}),
    ],
)
def test_motion_does_not(what: str, changes: dict) -> None:
    assert not only_vibrates(window(3.0, **changes)), what


def test_a_stand_is_found_once_the_drive_has_shown_the_difference() -> None:
    """GIVEN a minute on a road WHEN the car stands in an outage THEN it is found after 1.5 s."""
    detector = NearStandstillDetector()
    assert not outage(detector, 0.0, 0.4, 1.0)

    end = drive(detector, 70.0, road=0.3, speed=10.0)

    assert outage(detector, end, 0.4, 1.0) == np.arange(2.0, 6.0, INTERVAL).tolist()


def test_a_road_is_no_stand() -> None:
    detector = NearStandstillDetector()
    end = drive(detector, 70.0, road=0.3, speed=10.0)

    assert not outage(detector, end, 0.4, 1.0, road=0.3)


def test_a_ferry_that_sets_off_gently_ends_the_stand() -> None:
    """GIVEN a car that stands WHEN the mean specific force changes THEN it stands no more."""
    detector = NearStandstillDetector()
    end = drive(detector, 70.0, road=0.3, speed=10.0)
    assert outage(detector, end, 0.4, 1.0)

    assert not outage(detector, end + 6.0, 0.4, 1.0, acceleration=0.4)
    assert not outage(detector, end + 12.0, 0.4, 1.0)  # nor at a steady speed
    assert not outage(detector, end + 18.0, 0.4, 1.0, road=0.3)
    assert outage(detector, end + 24.0, 0.4, 1.0)


def test_nothing_is_concluded_of_a_vehicle_whose_drive_looks_like_a_stand() -> None:
    """GIVEN a drive of which a tenth is as smooth as a stand WHEN fixes are missing."""
    detector = NearStandstillDetector()
    for _ in range(9):
        drive(detector, 20.0, road=0.3, speed=10.0)
    assert detector.distinguishes

    end = drive(detector, 20.0, road=0.0, speed=10.0)

    assert not detector.distinguishes
    assert not outage(detector, end, 0.4, 1.0)


def test_stands_with_fixes_say_nothing_of_the_drive() -> None:
    detector = NearStandstillDetector()
    drive(detector, 200.0, road=0.0, speed=0.3)
    assert detector.moving == detector.alike == 0.0


@pytest.mark.parametrize(
    ("what", "speed", "std"),
    [
        ("a speed that excludes a stand", 4.0, 1.0),
        ("a speed that is hardly known", 4.0, 4.0),
        ("a speed that is known better", 0.1, 0.15),
    ],
)
def test_the_speed_must_allow_a_stand(what: str, speed: float, std: float) -> None:
    detector = NearStandstillDetector()
    end = drive(detector, 70.0, road=0.3, speed=10.0)

    assert not outage(detector, end, speed, std), what


def test_a_long_stand_claims_no_more_than_its_first_second() -> None:
    """
    GIVEN a speed of 1.2 ± 1.0 m/s
    WHEN a stand is fused a hundred times, which may be a crawl
    THEN the speed is 0.04 ± 0.17 m/s as after the first time.
    """
    nav = flat_state(np.array([1.2, 0.0, 0.0]), np.zeros(3), np.zeros(3), std=1.0)
    nav[BIAS_G] = 0.0
    found = NearStandstill(0, np.zeros(3), NOSE)
    update(nav, *found.linearise(nav))
    assert nav[VELOCITY][0] == pytest.approx(1.2 * CRAWL_STD**2, abs=1e-3)

    for _ in range(100):
        update(nav, *found.linearise(nav))

    P = covariance(nav)[DV, DV]
    assert P[0, 0] == pytest.approx(CRAWL_STD**2, rel=1e-3)
    assert P[1, 1] > 1.0
    assert nav[VELOCITY][0] == pytest.approx(1.2 * CRAWL_STD**2, abs=1e-3)
