"""The parts of the check of axes that are compiled or vectorised, against their plain forms."""

import numpy as np
import pytest

from hybrid_ins.core.imu_axes_fit import (
    LEAST_STEP,
    STEP,
    TOLERANCE,
    attitudes,
    integrate_force,
    triples_of,
)


def plain_triples(t: np.ndarray, interval: float) -> np.ndarray:
    rows, taken = [], -np.inf
    for k in range(1, len(t) - 1):
        first = int(np.argmin(np.abs(t[:k] - (t[k] - interval))))
        last = k + 1 + int(np.argmin(np.abs(t[k + 1 :] - (t[k] + interval))))
        spans = t[k] - t[first], t[last] - t[k]
        low, high = interval * TOLERANCE[0], interval * TOLERANCE[1]
        if low <= min(spans) and max(spans) <= high and t[k] - taken >= LEAST_STEP:
            rows.append((first, k, last))
            taken = t[k]
    return np.array(rows, np.intp).reshape(-1, 3)


@pytest.mark.parametrize("interval", [1.0, 2.5])
@pytest.mark.parametrize("seed", range(10))
def test_triples_are_those_of_a_search_one_by_one(seed: int, interval: float) -> None:
    rng = np.random.default_rng(seed)
    steps = rng.choice([0.05, 0.1, 0.2, 1.0, 4.0], 60, p=[0.2, 0.3, 0.3, 0.15, 0.05])
    t = np.cumsum(steps * rng.uniform(0.9, 1.1, 60))

    np.testing.assert_array_equal(triples_of(t, interval), plain_triples(t, interval))


@pytest.mark.parametrize("count", [3, 4])
def test_few_fixes_have_few_triples(count: int) -> None:
    t = np.arange(count) * 1.0
    np.testing.assert_array_equal(triples_of(t, 1.0), plain_triples(t, 1.0))


@pytest.mark.parametrize("size", [0.0, 0.05, 3.0])
def test_integrated_force_is_that_of_products_of_rotations(size: float) -> None:
    rng = np.random.default_rng(1)
    turns, impulse = rng.normal(0.0, size, (3, 40, 3)), rng.normal(0.0, 1.0, (40, 3))
    paths = np.zeros((3, 41, 3))

    integrate_force(turns, impulse, paths)

    force = impulse + 0.5 * np.cross(turns, impulse)
    steps = np.einsum("...ij,...j->...i", attitudes(turns), force)
    velocity = np.cumsum(steps, axis=-2)
    expected = np.cumsum(STEP * (velocity - 0.5 * steps), axis=-2)
    np.testing.assert_allclose(paths[:, 1:], expected, rtol=1e-11, atol=1e-11)
