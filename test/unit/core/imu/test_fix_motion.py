"""Motion by fixes alone is told from their steps, and at a calm IMU from their wander."""

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray
from support.wander import smooth_wander

from hybrid_ins.core.imu.fix_motion import FixMotion, significant_speed

Array = NDArray[np.float64]

PER_METRE = 1.0 / 6.37e6
SECOND = 1_000_000_000


def test_a_speed_across_the_date_line_is_no_other() -> None:
    t_ns = np.arange(20) * 100_000_000
    lla = np.zeros((20, 3))
    lla[:, 1] = np.linspace(0.0, 2e-7, 20)
    beyond = lla.copy()
    beyond[:, 1] = (lla[:, 1] + np.pi - 1e-7 + np.pi) % (2.0 * np.pi) - np.pi

    assert beyond[0, 1] > 0.0 > beyond[-1, 1]
    assert significant_speed(t_ns, beyond) == pytest.approx(significant_speed(t_ns, lla), rel=1e-6)
    assert significant_speed(t_ns, lla) > 0.5


@pytest.mark.parametrize("rate", [1.0, 5.0])
@pytest.mark.parametrize("at", [0.3, 0.5, 0.8])
def test_a_step_of_the_fixes_is_no_speed_and_a_steady_one_is(rate: float, at: float) -> None:
    t = np.arange(0.0, 5.0, 1.0 / rate)
    noise = np.random.default_rng(5).normal(0.0, 0.01, (len(t), 2)) / 6.4e6

    def speed(north: np.ndarray) -> float:
        lla = np.zeros((len(t), 3))
        lla[:, :2] = noise
        lla[:, 0] += north / 6.335e6
        return float(significant_speed(np.round(t * 1e9).astype(np.int64), lla))

    assert speed(np.where(t > 5.0 * at, 1.0, 0.0)) == 0.0
    assert speed(0.5 * t) == pytest.approx(0.5, rel=0.1)


@pytest.mark.parametrize(("speed", "moves"), [(0.0, False), (0.1, False), (0.8, True)])
def test_fixes_show_motion_by_their_scatter_not_their_claims(speed: float, moves: bool) -> None:
    motion = FixMotion()
    rng = np.random.default_rng(1)
    for k in range(40):
        error = rng.normal(0.0, 0.1, 2) * PER_METRE
        place = np.array([0.0, 0.0]) + error + [speed * 0.2 * k * PER_METRE, 0.0]
        motion.observe(200_000_000 * (k + 1), np.array([*place, 0.0]), 0.1)

    assert (motion.speed > 0.0) == moves
    if moves:
        assert motion.speed == pytest.approx(speed, rel=0.15)


def test_fixes_without_a_height_show_motion_too() -> None:
    motion = FixMotion()
    for k in range(20):
        north = 0.8 * 0.2 * k * PER_METRE
        motion.observe(200_000_000 * (k + 1), np.array([north, 0.0, np.nan]), 0.1)

    assert motion.speed == pytest.approx(0.8, rel=0.15)


def shows_wander(
    path: Callable[[Array], Array],
    std: float,
    seed: int,
    seconds: float = 20.0,
    time: float = 15.0,
    white: float = 0.1,
) -> bool:
    """
    Return what fixes at 4 Hz show that claim 1.5 m: a path (N, 2) [m], noise, and smooth wander.

    ``std`` [m] and correlation ``time`` [s] are those of the wander, ``white`` [m] of the noise.
    """
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, seconds, 0.25)
    wander = smooth_wander(rng, (len(t), 2), 0.25, std, time)
    places = path(t) + wander + rng.normal(0.0, white, (len(t), 2))
    motion = FixMotion()
    for at, place in zip(t, places, strict=True):
        motion.observe(round(at * SECOND) + SECOND, np.array([*(place * PER_METRE), 0.0]), 1.5)
    return motion.wanders(SECOND, round(t[-1] * SECOND) + 2 * SECOND)


def stand(t: Array) -> Array:
    return np.zeros((len(t), 2))


def straight(speed: float, acceleration: float = 0.0) -> Callable[[Array], Array]:
    return lambda t: np.outer(speed * t + 0.5 * acceleration * t**2, [0.8, -0.6])


def circle(t: Array) -> Array:
    return 40.0 * np.stack((np.sin(0.05 * t), np.cos(0.05 * t)), axis=1)  # at 2 m/s


def test_fixes_that_wander_at_a_stand_are_told_from_motion() -> None:
    shown = [shows_wander(stand, 8.0, seed) for seed in range(60)]

    assert np.mean(shown) > 0.85


@pytest.mark.parametrize(
    ("path", "std"),
    [
        (straight(0.5), 0.0),
        (straight(1.5), 1.0),
        (straight(20.0), 8.0),
        (straight(0.0, 0.03), 0.0),  # a train that sets off gently
        (straight(2.5, -0.12), 0.3),  # steady braking
        (circle, 1.0),
    ],
)
def test_a_motion_that_no_accelerometer_shows_is_no_wander(
    path: Callable[[Array], Array], std: float
) -> None:
    shown = [shows_wander(path, std, seed) for seed in range(60)]

    assert np.mean(shown) < 0.05


@pytest.mark.parametrize(
    ("path", "std", "time", "white"),
    [
        (stand, 0.0, 15.0, 1.5),  # that neighbours share nothing of
        (stand, 1.5, 100.0, 0.1),  # as is claimed
        (straight(0.2), 1.5, 100.0, 0.1),  # a boat that drifts
    ],
)
def test_errors_as_they_are_claimed_are_no_wander(
    path: Callable[[Array], Array], std: float, time: float, white: float
) -> None:
    shown = [shows_wander(path, std, seed, time=time, white=white) for seed in range(60)]

    assert np.mean(shown) < 0.05


def test_wander_takes_time_to_be_told() -> None:
    assert not any(shows_wander(stand, 8.0, seed, 7.0) for seed in range(20))
