"""What scattering stamps add to the covariance of a position."""

from __future__ import annotations

import numpy as np
import pytest

from hybrid_ins.core.noise.stamp_scatter import stamp_covariance

VELOCITY_N = np.array([3.0, 4.0, -1.0])


@pytest.mark.parametrize("m", [2, 3])
def test_it_is_along_the_velocity_where_the_motion_shows_the_clock(m: int) -> None:
    delays = np.random.default_rng(1).standard_normal(100_000)

    found = stamp_covariance(VELOCITY_N, 1.0, m)

    np.testing.assert_allclose(found, np.cov(np.outer(VELOCITY_N[:m], delays)), rtol=0.02)


def test_it_is_as_large_in_all_horizontal_directions_where_noise_shows_it() -> None:
    np.testing.assert_array_equal(stamp_covariance(VELOCITY_N, 0.0, 3), np.diag([25.0, 25.0, 0.0]))


def test_a_share_of_motion_is_that_of_the_first() -> None:
    along, around = stamp_covariance(VELOCITY_N, 1.0, 3), stamp_covariance(VELOCITY_N, 0.0, 3)

    found = stamp_covariance(VELOCITY_N, 0.3, 3)

    np.testing.assert_allclose(found, 0.3 * along + 0.7 * around)
