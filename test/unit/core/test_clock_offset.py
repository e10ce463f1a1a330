"""The clock offset's observer keeps a usable estimate whatever it is fed."""

import numpy as np
import pytest

from hybrid_ins.core.clock_offset import MIN_STD, ClockOffsetObserver
from hybrid_ins.core.noise import Correction
from hybrid_ins.core.state import N_ERROR, NavState

SECOND = 1_000_000_000


def correction(t_ns: int, velocity_n: np.ndarray, std: float) -> Correction:
    """Return a position fix of a vehicle, fused with no gain, so that nothing holds s back."""
    nav = NavState(
        np.array([0.5, 0.6, 0.0]),
        velocity_n,
        np.array([0.0, 0.0, 0.0, 1.0]),
        np.zeros(3),
        np.zeros(3),
        np.eye(N_ERROR),
    ).to_flat()
    H = np.eye(3, N_ERROR)
    S, K = std**2 * np.eye(3), np.zeros((N_ERROR, 3))
    z = np.full(3, std)
    return Correction(t_ns, z, S, H, K, np.zeros(N_ERROR), np.eye(3), 1.0, nav, True)


@pytest.mark.parametrize("std", [3.0, 1e-3, 1e-9])
def test_sigma_stays_a_number_and_above_what_stamps_resolve(std: float) -> None:
    observer = ClockOffsetObserver(0.5)
    rng = np.random.default_rng(1)
    for k in range(1, 2000):
        observer.update(correction(k * SECOND, rng.normal(0.0, 10.0, 3), std))
        assert observer.sigma >= MIN_STD
    assert np.isfinite(observer.residual)


def test_a_sensitivity_beyond_any_motion_starts_anew() -> None:
    observer = ClockOffsetObserver(0.5)
    observer.update(correction(SECOND, np.array([1.0, 0.0, 0.0]), 1.0))
    observer._s = np.full(N_ERROR, 1e11)
    before = observer.sigma
    observer.update(correction(2 * SECOND, np.array([1.0, 0.0, 0.0]), 1.0))
    assert observer.sigma > 0.9 * before  # a drive at constant velocity says nothing of the offset
