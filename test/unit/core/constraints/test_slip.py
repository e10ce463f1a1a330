"""Standard deviation of the velocity across the nose, from innovations."""

import math

import numpy as np
import pytest

from hybrid_ins.core.constraints.slip import SlipEstimator

NOMINAL = np.array([0.1, 0.1])
S = 0.03**2 * np.eye(2)


def watch(estimator: SlipEstimator, std: tuple[float, float], count: int, seed: int) -> None:
    """Observe innovations of slip of a standard deviation, twice a second."""
    rng = np.random.default_rng(seed)
    total = np.sqrt(np.asarray(std) ** 2 + np.diag(S))
    for _ in range(count):
        estimator.observe(total * rng.standard_normal(2), S, 0.25, math.exp(-0.5 / 120.0))


def std_of(estimator: SlipEstimator) -> np.ndarray:
    return np.asarray(np.sqrt(np.diag(estimator.covariance)))


@pytest.mark.parametrize("seed", [2, 4, 6])
@pytest.mark.parametrize("std", [(0.04, 0.08), (0.1, 0.1), (0.1, 0.3)])
def test_slip_is_found(std: tuple[float, float], seed: int) -> None:
    estimator = SlipEstimator(NOMINAL)

    watch(estimator, std, 480, seed)

    assert np.all(np.abs(np.log(std_of(estimator) / std)) < 3.0 * estimator.spread)
    assert np.all(estimator.spread < 0.35)


def test_without_evidence_the_slip_is_nominal_to_a_factor_of_two() -> None:
    estimator = SlipEstimator(NOMINAL)
    before = std_of(estimator)

    for _ in range(500):  # a filter that knows nothing of the velocity
        estimator.observe(np.array([3.0, -2.0]), 1e4 * np.eye(2), 0.25, 1.0)

    np.testing.assert_allclose(std_of(estimator), before, rtol=0.01)
    assert np.all((before > NOMINAL) & (before < 2.0 * NOMINAL))
    np.testing.assert_allclose(estimator.spread, math.log(2.0), rtol=0.1)


def test_a_rough_road_after_a_smooth_one_is_found_within_a_minute() -> None:
    estimator = SlipEstimator(NOMINAL)
    watch(estimator, (0.03, 0.03), 960, 2)
    assert std_of(estimator)[1] < 0.06

    watch(estimator, (0.03, 0.3), 120, 4)

    assert std_of(estimator)[1] > 0.15
    assert std_of(estimator)[0] < 0.06


def test_one_pothole_is_not_the_road() -> None:
    estimator = SlipEstimator(NOMINAL)
    watch(estimator, (0.05, 0.05), 480, 2)
    before = std_of(estimator)

    estimator.observe(np.array([5.0, 5.0]), S, 0.25, 1.0)

    np.testing.assert_allclose(std_of(estimator), before, rtol=0.2)
