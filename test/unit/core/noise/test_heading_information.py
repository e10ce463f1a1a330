"""How well the heading is known by motion: what noise of the IMU feigns does not count."""

import copy

import numpy as np
import pytest

from hybrid_ins.core.inertial.state import COVARIANCE, HEADING_VARIANCE, N_FLAT, pack
from hybrid_ins.core.noise.heading_information import (
    IN_FULL,
    SUMS,
    VARIANCE,
    HeadingInformation,
    heading_information,
)
from hybrid_ins.core.noise.motion_share import SHARE_TIME

Shown = tuple[float, float]


@pytest.mark.parametrize("m", [2, 3])
def test_the_information_is_that_of_motion_and_of_noise(m: int) -> None:
    """GIVEN a velocity wrong by b per radian of heading, and by N besides THEN both are found."""
    rng = np.random.default_rng(m)
    variance, b, root = 0.02, rng.normal(size=m), rng.normal(size=(m, m))
    N, P, H = 0.3 * root @ root.T, 1e-3 * np.eye(15), np.zeros((m, 15))
    H[:, 3 : 3 + m] = np.eye(m)
    P[3 : 3 + m, 3 : 3 + m] = N + variance * np.outer(b, b)
    P[8, 8], P[3 : 3 + m, 8], P[8, 3 : 3 + m] = variance, variance * b, variance * b
    packed, R = np.zeros(120), np.diag(rng.uniform(0.1, 1.0, m))
    pack(P, packed)
    S = H @ P @ H.T + R

    information, of_noise = heading_information(packed, H, S, R)

    assert information == pytest.approx(b @ np.linalg.solve(S, b))
    assert of_noise == pytest.approx(np.trace(np.linalg.solve(S, N)))


def corrected(shown: Shown, count: int = 50) -> tuple[HeadingInformation, float]:
    """Return what is known after many fixes that each take a tenth, and the filter's variance."""
    found, variance = HeadingInformation(), 0.01
    for _ in range(count):
        before = variance + 1e-3
        variance = 0.9 * before
        found.update(1.0, shown, before, variance)
    return found, variance


def test_by_motion_alone_the_variance_is_the_filters() -> None:
    found, variance = corrected((5.0, 0.0))

    assert found.values[VARIANCE] == pytest.approx(variance)


def test_by_noise_alone_the_variance_grows_as_the_filters_would_without_fixes() -> None:
    found, _ = corrected((5.0, 6.0))

    assert found.values[VARIANCE] == pytest.approx(0.9 * 0.011 + 49 * 1e-3)


def test_the_share_of_motion_is_that_of_the_information() -> None:
    half, variance = corrected((5.0, 2.5))
    none, _ = corrected((5.0, 6.0))

    assert variance < half.values[VARIANCE] < 0.5 * none.values[VARIANCE]


def test_what_is_no_fix_counts_in_full() -> None:
    found, _ = corrected((5.0, 6.0))

    sums = found.values[SUMS].copy()

    found.update(1.0, IN_FULL, 0.02, 0.005)

    assert 1.0 / found.values[VARIANCE] > 1.0 / 0.005 - 1.0 / 0.02
    assert np.array_equal(found.values[SUMS], sums)  # it is no fix: they fade with the next one


def test_a_motion_is_forgotten() -> None:
    """GIVEN a manoeuvre WHEN nothing moves for long THEN its information counts no more."""
    found, nav = HeadingInformation(), np.zeros(N_FLAT)
    found.update(1.0, (1000.0, 1.0), 0.01, 0.009)
    found.update(1.0, (1.0, 2.0), 0.01, 0.009)
    assert found.values[VARIANCE] == pytest.approx(0.009, rel=0.02)
    before = copy.copy(found)

    found.update(10.0 * SHARE_TIME, (1.0, 2.0), 0.01, 0.009)

    assert found.values[VARIANCE] == pytest.approx(before.values[VARIANCE] + 0.001)
    nav[HEADING_VARIANCE] = 0.009
    assert found.considered(nav) == pytest.approx(found.values[VARIANCE] - 0.009)
    nav[COVARIANCE][:] = 1.0
    assert found.considered(nav) == 0.0
