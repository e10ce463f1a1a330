"""Fixes that no vehicle of a given speed could have reached."""

from __future__ import annotations

import math

import numpy as np
import pytest

from hybrid_ins.core.fix_checks.fix_speed import SpeedCheck
from hybrid_ins.core.inertial.earth import LocalFrame
from hybrid_ins.core.update.measurements import PositionFix, Standstill, VelocityFix

FRAME = LocalFrame(np.array([math.radians(32.0), math.radians(179.9999), 50.0]))  # at the date line


def fix(t: float, north: float = 0.0, east: float = 0.0, sigma: float = 0.02) -> PositionFix:
    lla = FRAME.lla(np.array([[north, east, 0.0]]))[0]
    return PositionFix(round(t * 1e9), lla, np.eye(3) * sigma**2, np.zeros(3))


def check(*fixes: PositionFix, max_speed: float = 10.0, patience: float = 3.0) -> list[bool]:
    speed = SpeedCheck(max_speed, patience)
    return [speed.is_reachable(f) for f in fixes]


def test_a_vehicle_within_its_speed_is_never_refused() -> None:
    assert all(check(*(fix(0.1 * k, north=0.9 * k, east=0.4 * k) for k in range(200))))


def test_a_single_jump_is_refused_and_what_follows_is_not() -> None:
    jump = [fix(0.2 * k, east=60.0 if k == 5 else 0.2 * k) for k in range(20)]

    assert check(*jump) == [k != 5 for k in range(20)]


def test_noise_that_the_fix_claims_is_no_speed() -> None:
    rng = np.random.default_rng(1)
    noisy = [fix(0.1 * k, *rng.normal(0.0, 5.0, 2), sigma=5.0) for k in range(500)]

    assert all(check(*noisy, max_speed=1.0))


def test_an_outage_lets_the_vehicle_get_far() -> None:
    """GIVEN 60 s without fixes WHEN they come again 550 m away THEN they are admitted at once."""
    assert check(fix(0.0), fix(60.0, north=550.0), fix(60.2, north=551.0)) == [True] * 3


def test_a_place_that_lasts_is_admitted_after_the_patience() -> None:
    """GIVEN a wrong first fix WHEN the right ones agree THEN they are admitted after 3 s."""
    away = [fix(1.0 + 0.5 * k, east=5000.0 + k) for k in range(12)]

    admitted = check(fix(0.0), *away)[1:]

    assert admitted == [0.5 * k >= 3.0 for k in range(12)]


def test_jumps_that_do_not_agree_stay_refused() -> None:
    wild = [fix(0.5 * k, east=1000.0 * (k % 7) + 2000.0) for k in range(1, 40)]

    assert not any(check(fix(0.0), *wild)[1:])


def test_a_late_fix_does_not_take_the_place_of_a_newer_one() -> None:
    admitted = check(fix(0.0), fix(10.0, north=90.0), fix(1.0, north=9.0), fix(10.5, north=95.0))

    assert all(admitted)


def test_after_a_reset_any_place_will_do() -> None:
    speed = SpeedCheck(10.0, 3.0)
    assert speed.is_reachable(fix(0.0))
    speed.reset()

    assert speed.is_reachable(fix(0.1, east=5000.0))


@pytest.mark.parametrize(("velocity", "admitted"), [(9.0, True), (10.3, True), (11.0, False)])
def test_velocity_is_compared_with_its_own_noise(velocity: float, admitted: bool) -> None:
    north = np.array([velocity, 0.0, math.nan])
    measured = VelocityFix(0, north, np.eye(3) * 0.1**2, np.zeros(3))

    assert SpeedCheck(10.0, 3.0).is_reachable(measured) == admitted


def test_other_measurements_are_not_its_matter() -> None:
    assert SpeedCheck(0.1, 3.0).is_reachable(Standstill(0, np.zeros(3), np.ones(3)))
