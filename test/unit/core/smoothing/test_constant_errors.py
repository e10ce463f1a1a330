"""What innovations and a prior say together of a lever arm and a clock offset."""

from __future__ import annotations

import numpy as np
import pytest

from hybrid_ins.core.sensor_errors.clock_prior import SHARES, ClockPrior, _scales
from hybrid_ins.core.smoothing.constant_errors import _with_prior


@pytest.mark.parametrize("offset", [0.0, 0.012, 0.2])
def test_the_lever_arm_follows_the_prior_of_the_clock(offset: float) -> None:
    # GIVEN an estimate from innovations that hardly tell a lever arm from a clock offset
    values = np.array([0.16, 0.0, -0.2, offset])
    std = np.array([0.06, 0.03, 0.03, 0.007])
    correlation = np.eye(4)
    correlation[0, 3] = correlation[3, 0] = 0.9
    P = correlation * np.outer(std, std)
    prior = ClockPrior(0.0, 0.0)
    # WHEN the prior is put to it
    found, covariance = _with_prior(values, P, prior)
    # THEN mean and covariance are those that numerical integration over the offset gives
    c = np.linspace(-1.0, 1.0, 400_001)
    density = np.exp(-0.5 * ((c - offset) / std[3]) ** 2) * sum(
        share / scale * np.exp(-0.5 * (c / scale) ** 2)
        for share, scale in zip(SHARES, _scales(prior.scale), strict=True)
    )
    weights = density / density.sum()
    gain = P[:, 3] / P[3, 3]
    mean_c = weights @ c
    variance_c = weights @ (c - mean_c) ** 2
    assert found == pytest.approx(values + gain * (mean_c - offset), abs=1e-6)
    given_c = P - P[3, 3] * np.outer(gain, gain)
    assert covariance == pytest.approx(given_c + variance_c * np.outer(gain, gain), abs=1e-9)


def test_a_clock_that_is_probably_right_leaves_the_lever_arm() -> None:
    values, std = np.array([0.16, 0.0, -0.2, 0.012]), np.array([0.06, 0.03, 0.03, 0.007])
    P = np.diag(std**2)
    P[0, 3] = P[3, 0] = -0.9 * std[0] * std[3]

    found, covariance = _with_prior(values, P, ClockPrior(0.0, 0.0))

    assert abs(found[3]) < 0.008 and found[0] > 0.19
    assert np.linalg.eigvalsh(covariance).min() > 0.0
