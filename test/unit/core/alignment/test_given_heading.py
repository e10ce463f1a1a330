"""A heading that was given for a stamp long before the first fixes."""

import math

import numpy as np
import pytest

from hybrid_ins.core.alignment.given_heading import HEADING_KEPT_STD, GivenHeading
from hybrid_ins.core.imu.samples import ImuRing

DOWN_B = np.array([0.0, 0.0, 1.0])
GIVEN, GIVEN_STD = 0.3, 0.05  # rad


def carried(
    rate,
    seconds: float,
    *,
    std: float = GIVEN_STD,
    bias: float = 0.0,
    known_bias: float = 0.0,
    bias_std: float = 1e-4,
    rate_hz: int = 200,
    noise: float = 0.002,
) -> GivenHeading:
    """Return a heading that followed a turn of ``rate(t)`` [rad/s] to its right."""
    ring, rng, period_ns = ImuRing(), np.random.default_rng(1), 1_000_000_000 // rate_hz
    heading = GivenHeading(period_ns, GIVEN, std)
    for k in range(1, int(seconds * rate_hz) + 1):
        f = (*rng.normal(0.0, 0.01, 2), -9.81)
        w = (*rng.normal(0.0, noise, 2), rate(k / rate_hz) + bias + rng.normal(0.0, noise))
        ring.push(k * period_ns, *f, *w)
        if k % (rate_hz // 10) == 0 and k > rate_hz:
            window = ring.latest(rate_hz)
            known = np.array([0.0, 0.0, known_bias])
            heading.follow(ring, window, known, np.full(3, bias_std))
    return heading


@pytest.mark.parametrize(("rate_hz", "after"), [(1000, 9.0), (200, 45.0)])
def test_a_turn_longer_ago_than_the_ring_holds_is_remembered(rate_hz: int, after: float) -> None:
    heading = carried(lambda t: 0.3 * (t < 5.0), 5.0 + after, rate_hz=rate_hz)

    assert heading.now(DOWN_B) == pytest.approx(GIVEN + 1.5, abs=0.01)
    assert heading.std == pytest.approx(GIVEN_STD, rel=0.01)


@pytest.mark.parametrize("known", [True, False])
def test_a_bias_does_not_turn_a_vehicle_that_stands(known: bool) -> None:
    bias, std = (0.01, 1e-4) if known else (0.0, 0.01)

    heading = carried(lambda t: 0.0, 40.0, bias=0.01, known_bias=bias, bias_std=std)

    assert heading.now(DOWN_B) == pytest.approx(GIVEN, abs=0.01)
    assert not heading.is_outdated


def test_a_slow_turn_is_no_bias_of_a_gyroscope_whose_bias_is_known() -> None:
    heading = carried(lambda t: 0.02, 20.0)

    assert heading.now(DOWN_B) == pytest.approx(GIVEN + 0.4, abs=0.01)


def test_in_motion_an_unknown_bias_makes_it_uncertain_until_it_is_of_no_use() -> None:
    # GIVEN a vehicle that turns to and fro, its gyroscope 0.01 rad/s off
    swing = {"bias": 0.01, "bias_std": 0.01, "noise": 0.05}

    shortly, long = (carried(lambda t: 0.5 * math.sin(t), t, **swing) for t in (20.0, 60.0))

    error = shortly.now(DOWN_B) - (GIVEN + 0.5 * (1.0 - math.cos(20.0)))
    assert abs(error) < 2.0 * shortly.std and shortly.std == pytest.approx(0.2, rel=0.1)
    assert not shortly.is_outdated
    assert long.is_outdated and long.std > HEADING_KEPT_STD


def test_a_heading_that_is_given_as_hardly_known_is_used_all_the_same() -> None:
    heading = carried(lambda t: 0.5 * math.sin(t), 10.0, std=1.0, bias_std=0.01)

    assert not heading.is_outdated and heading.std == pytest.approx(1.0, rel=0.01)


def test_a_tilted_vehicle_turns_about_the_vertical() -> None:
    down_b, ring, heading = np.array([0.0, 0.8, 0.6]), ImuRing(), GivenHeading(1, GIVEN, GIVEN_STD)
    for k in range(1, 401):
        ring.push(k * 10_000_000, *(-9.81 * down_b), *(0.2 * down_b))

    heading.follow(ring, ring.latest(100), np.zeros(3), np.full(3, 1e-4))

    assert heading.now(down_b) == pytest.approx(GIVEN + 0.2 * 3.99, abs=1e-3)
