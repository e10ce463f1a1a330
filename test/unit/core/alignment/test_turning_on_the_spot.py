"""An antenna that moves by the vehicle's turns alone shows no heading."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.typing import NDArray

from hybrid_ins.core.alignment.turning_on_the_spot import TurningOnTheSpot
from hybrid_ins.core.imu.samples import ImuRing
from hybrid_ins.core.inertial.earth import curvature_scale
from hybrid_ins.core.inertial.state import BIAS_G, N_FLAT, QUAT
from hybrid_ins.core.update.measurements import PositionFix

Array = NDArray[np.float64]

ORIGIN = np.array([0.8, 0.1, 50.0])
BIAS = 0.05  # rad/s
STEP_NS = 10_000_000
BEGIN_NS = 100_000_000_000


def swaying(t: Array) -> Array:
    """Return a yaw [rad] that turns to and fro on the spot."""
    return 1.2 * np.sin(0.6 * t)


def observed(
    yaw: Callable[[Array], Array],
    position: Callable[[Array], Array],
    lever: float = 0.0,
    lag: float = 0.0,
    claimed: float = 0.02,
    is_placed: bool = False,
) -> TurningOnTheSpot:
    """Observe 12 s at 100 Hz, and fixes at 5 Hz that are true ``lag`` seconds before."""
    turning, ring, nav = TurningOnTheSpot(is_placed), ImuRing(), np.zeros(N_FLAT)
    nav[BIAS_G][2], nav[QUAT][3] = BIAS, 1.0
    follower = SimpleNamespace(ring=ring, nav=nav)
    for k in range(1200):
        t = np.array([0.01 * k, 0.01 * k + 0.005, 0.01 * k - 0.005])
        rate = (yaw(t)[1] - yaw(t)[2]) / 0.01 + BIAS
        t_ns = BEGIN_NS + k * STEP_NS
        ring.push(t_ns, 0.0, 0.0, -9.8, 0.0, 0.0, float(rate))
        if k > 100 and k % 20 == 0:
            then = t[:1] - lag
            arm = lever * np.array([np.cos(yaw(then))[0], np.sin(yaw(then))[0], 0.0])
            lla = ORIGIN + (np.append(position(then), 0.0) + arm) / curvature_scale(ORIGIN)
            fix = PositionFix(t_ns, lla, claimed**2 * np.eye(3), np.zeros(3))
            turning.observe(fix, follower)  # type: ignore[arg-type]
    return turning


def still(t: Array) -> Array:
    return np.zeros(2)


@pytest.mark.parametrize("lag", [-0.5, 0.0, 0.5])
@pytest.mark.parametrize("speed", [0.0, 1.5])
def test_on_the_spot_or_in_uniform_motion_nothing_is_shown(lag: float, speed: float) -> None:
    turning = observed(swaying, lambda t: speed * np.append(t, t), lever=1.5, lag=lag)

    assert turning.hides_heading and turning.misleads


def test_of_an_antenna_that_is_placed_the_motion_is_known() -> None:
    assert not observed(swaying, still, lever=1.5, is_placed=True).hides_heading


def test_an_arc_wider_than_the_lever_arm_shows_the_heading() -> None:
    radius, rate = 5.0, 0.3

    def on_arc(t: Array) -> Array:
        return radius * np.append(np.sin(rate * t), 1.0 - np.cos(rate * t))

    turning = observed(lambda t: rate * t, on_arc, lever=0.4)

    assert not turning.hides_heading and not turning.misleads


def test_speeding_up_straight_ahead_shows_it() -> None:
    turning = observed(lambda t: 0.02 * np.sin(t), lambda t: np.append(0.3 * t**2, 0.0 * t))

    assert not turning.hides_heading


@pytest.mark.parametrize(("begin", "acceleration"), [(10.0, 0.9), (10.4, 1.4)])
def test_first_steps_in_a_turn_restart_nothing(begin: float, acceleration: float) -> None:
    def steps(t: Array) -> Array:
        return np.append(0.5 * acceleration * np.maximum(t - begin, 0.0) ** 2, 0.0)

    turning = observed(lambda t: 0.5 * np.maximum(t - begin, 0.0), steps)

    assert not turning.misleads


def test_what_fixes_do_not_resolve_is_of_no_consequence() -> None:
    assert not observed(swaying, still, lever=1.5, claimed=3.0).hides_heading
