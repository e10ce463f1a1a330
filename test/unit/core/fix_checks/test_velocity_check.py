"""Velocities that contradict the displacements of the positions."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from hybrid_ins.core.fix_checks.velocity_check import VelocityCheck
from hybrid_ins.core.inertial.earth import LocalFrame
from hybrid_ins.core.update.measurements import PositionFix, VelocityFix

Array = NDArray[np.float64]
FRAME = LocalFrame(np.array([math.radians(32.0), math.radians(179.9999), 50.0]))  # at the date line
SECONDS = 90.0


def drive(t: Array) -> tuple[Array, Array]:
    """Return positions and velocities, NED, of a car that turns, slows down and climbs."""
    grid = np.arange(0.0, SECONDS, 0.01)
    speed, yaw = 8.0 + 5.0 * np.sin(0.2 * grid), 1.5 * np.sin(0.1 * grid)
    velocity_n = np.stack((speed * np.cos(yaw), speed * np.sin(yaw), 0.0 * grid - 2.0), axis=1)
    place_n = np.cumsum(velocity_n, axis=0) * 0.01
    return tuple(  # type: ignore[return-value]
        np.stack([np.interp(t, grid, column) for column in both.T], axis=1)
        for both in (place_n, velocity_n)
    )


def contradicted(
    change: Callable[[Array], Array], sigma: float = 0.05, age: float = 0.0, seed: int = 1
) -> list[bool]:
    """Show fixes with changed velocities once a second; return the verdict after each."""
    check, rng, found = VelocityCheck(), np.random.default_rng(seed), []
    t = np.arange(1.0, SECONDS - 1.0, 0.2)
    place_n, velocity_n = drive(t)[0], change(drive(t - age)[1])
    places = FRAME.lla(place_n + sigma * rng.standard_normal(place_n.shape))
    for k, stamp in enumerate((1e9 * t).astype(np.int64).tolist()):
        check.observe(VelocityFix(stamp, velocity_n[k], 0.01 * np.eye(3), np.zeros(3)))
        check.observe(PositionFix(stamp, places[k], sigma**2 * np.eye(3), np.zeros(3)))
        found.append(check.contradiction is not None)
    return found


@pytest.mark.parametrize(
    ("change", "sigma", "age"),
    [
        (lambda v: v, 0.05, 0.0),
        (lambda v: v, 0.05, 1.0),
        (lambda v: v, 3.0, 0.3),
        (lambda v: 1.1 * v, 0.05, 0.0),
        (lambda v: v * [1.0, 1.0, math.nan], 0.05, 0.0),
    ],
    ids=["right", "a second old", "poor positions", "a tenth too large", "no vertical one"],
)
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_right_velocities_are_never_contradicted(
    change: Callable[[Array], Array], sigma: float, age: float, seed: int
) -> None:
    assert not any(contradicted(change, sigma, age, seed))


@pytest.mark.parametrize(
    "change",
    [
        lambda v: v[:, [1, 0, 2]],
        lambda v: np.stack((0.0 * v[:, 0], np.linalg.norm(v, axis=1), 0.0 * v[:, 2]), axis=1),
        lambda v: 0.0 * v,
        lambda v: 3.6 * v,
        lambda v: -v,
        lambda v: v * [1.0, 1.0, -1.0],
    ],
    ids=["north first", "along the vehicle", "zero", "km/h", "reversed", "down for up"],
)
@pytest.mark.parametrize("sigma", [0.05, 1.5])
def test_wrong_velocities_are_contradicted_within_a_minute(
    change: Callable[[Array], Array], sigma: float
) -> None:
    found = contradicted(change, sigma)

    assert not any(found[: round(15.0 / 0.2)]), "three ways of five seconds"
    assert found[round(60.0 / 0.2)]


def test_velocities_that_become_right_are_believed_again() -> None:
    def mended(velocity_n: Array) -> Array:
        half = len(velocity_n) // 2
        return np.concatenate((velocity_n[:half, [1, 0, 2]], velocity_n[half:]))

    found = contradicted(mended)

    assert found[len(found) // 2] and not found[-1]


def test_positions_that_stay_in_a_tunnel_do_not_discredit_velocities() -> None:
    def stopping(velocity_n: Array) -> Array:
        return np.where(np.arange(len(velocity_n))[:, None] < 300, velocity_n, 0.0)

    assert not any(contradicted(stopping)), "28 s against 60 s in which they agreed"


def test_positions_that_jump_a_few_times_are_no_evidence() -> None:
    check, found = VelocityCheck(), []
    t = np.arange(1.0, SECONDS - 1.0, 0.2)
    place_n, velocity_n = drive(t)
    place_n = place_n + 60.0 * ((t > 20.0) & (t < 30.0))[:, None] * [1.0, -1.0, 0.0]
    for k, stamp in enumerate((1e9 * t).astype(np.int64).tolist()):
        lla = FRAME.lla(place_n[k : k + 1])[0]
        check.observe(VelocityFix(stamp, velocity_n[k], 0.01 * np.eye(3), np.zeros(3)))
        check.observe(PositionFix(stamp, lla, 0.01 * np.eye(3), np.zeros(3)))
        found.append(check.contradiction is not None)

    assert not any(found)
