"""The first position and velocity, from fixes alone."""

from __future__ import annotations

import numpy as np
import pytest

from hybrid_ins.core.alignment.first_motion import (
    CLIMB_STD,
    HEIGHT_STD,
    first_motion,
)
from hybrid_ins.core.inertial.earth import curvature_scale
from hybrid_ins.core.update.measurements import PositionFix, VelocityFix

STEP_NS = 200_000_000
START = np.array([0.5, np.pi - 2e-6, 120.0])  # the date line is 10 m away
VELOCITY_N = np.array([3.0, 12.0, 0.0])


def fixes(height: float) -> list[PositionFix]:
    """Return fixes of a straight drive with a constant velocity."""
    found = []
    for k in range(1, 7):
        lla = START + 0.2 * k * VELOCITY_N / curvature_scale(START)
        lla[1] = (lla[1] + np.pi) % (2.0 * np.pi) - np.pi
        lla[2] = height
        found.append(PositionFix(k * STEP_NS, lla, np.diag([1e-4] * 3), np.zeros(3)))
    return found


@pytest.mark.parametrize("height", [120.0, np.nan])
def test_velocity_is_the_slope_of_the_fixes_with_a_height_and_without(height: float) -> None:
    motion = first_motion(fixes(height), None, 6 * STEP_NS)

    assert motion.has_velocity
    np.testing.assert_allclose(motion.velocity_n, VELOCITY_N, atol=2e-3)
    assert np.isfinite(motion.lla).all()
    if np.isnan(height):
        assert motion.p_cov[2, 2] == pytest.approx(HEIGHT_STD**2)
        assert motion.v_cov[2, 2] >= CLIMB_STD**2 > 100.0 * motion.v_cov[0, 0]
    else:
        assert motion.p_cov[2, 2] < 1.0 and motion.v_cov[2, 2] == motion.v_cov[0, 0]


def test_the_last_height_serves_where_a_fix_has_none() -> None:
    series = fixes(120.0)
    series[-1].lla[2] = np.nan

    motion = first_motion(series, None, 6 * STEP_NS)

    assert motion.lla[2] == 120.0 and motion.p_cov[2, 2] == pytest.approx(HEIGHT_STD**2)


@pytest.mark.parametrize("height", [120.0, np.nan])
def test_a_velocity_without_a_vertical_part_leaves_that_to_the_fixes(height: float) -> None:
    series = fixes(height)
    if np.isfinite(height):  # climbing at 5 m/s
        for k, fix in enumerate(series):
            fix.lla[2] += k * 1.0
    velocity = VelocityFix(
        6 * STEP_NS, np.array([3.5, 12.5, np.nan]), np.diag([0.04, 0.04, 0.16]), np.zeros(3)
    )

    motion = first_motion(series, velocity, 6 * STEP_NS)

    alone = first_motion(series, None, 6 * STEP_NS)
    assert motion.velocity_n[:2].tolist() == [3.5, 12.5]
    assert motion.v_cov[0, 0] == pytest.approx(0.04)
    assert motion.velocity_n[2] == pytest.approx(-5.0 if np.isfinite(height) else 0.0)
    assert motion.v_cov[2, 2] == pytest.approx(alone.v_cov[2, 2])
