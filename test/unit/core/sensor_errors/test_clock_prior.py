"""The prior of the clock offset: noise does not move a right clock; a wrong one is corrected."""

import numpy as np
import pytest

from hybrid_ins.core.alignment.clock_search import OFFSET_BOUNDED, OFFSETS_NS, probabilities
from hybrid_ins.core.sensor_errors.clock_offset import ClockOffsetObserver, observe
from hybrid_ins.core.sensor_errors.clock_prior import RATIOS, SHARES, ClockDrift, ClockPrior


def by_integration(prior: ClockPrior, estimate: float, sigma: float) -> tuple[float, float]:
    """Return mean and variance of the posterior, from densities on a grid."""
    tau = np.linspace(-2.0, 2.0, 400_001)
    density = sum(
        share * np.exp(-0.5 * ((tau - prior.mean) / s) ** 2) / s
        for share, s in zip(SHARES, (min(prior.scale * r, 0.3) for r in RATIOS), strict=True)
    )
    density = density * np.exp(-0.5 * ((tau - estimate) / sigma) ** 2)
    density /= density.sum()
    mean = float(tau @ density)
    return mean, float((tau - mean) ** 2 @ density)


def of_steady_clock(prior: ClockPrior, estimate: float, sigma: float) -> tuple[float, float]:
    """Return the posterior of a clock that does not drift: the offset is that of the start."""
    return prior.posterior(estimate, sigma**2, estimate, sigma**2, sigma**2)


@pytest.mark.parametrize(
    ("estimate", "sigma", "given"), [(0.01, 0.01, 0.0), (0.06, 0.01, 0.0), (-0.2, 0.05, 0.1)]
)
def test_the_posterior_is_bayes_rule(estimate: float, sigma: float, given: float) -> None:
    prior = ClockPrior(given, 0.001)
    mean, variance = of_steady_clock(prior, estimate, sigma)
    expected = by_integration(prior, estimate, sigma)
    assert mean == pytest.approx(expected[0], abs=1e-5)
    assert variance == pytest.approx(expected[1], rel=1e-3)


def test_the_prior_of_a_drifting_clock_is_that_of_its_start() -> None:
    # GIVEN offsets now and at the start of 0.03 and 0.005 s, 6 and 12 ms uncertain, correlated
    now, start, C = 0.03, 0.005, np.array([[0.006**2, 3e-5], [3e-5, 0.012**2]])
    prior = ClockPrior(0.0, 0.001)

    mean, variance = prior.posterior(now, C[0, 0], start, C[1, 1], C[0, 1])

    # Of the offset now given that at the start, normal distributions know mean and variance.
    start_mean, start_variance = by_integration(prior, start, 0.012)
    slope = C[0, 1] / C[1, 1]
    assert mean == pytest.approx(now + slope * (start_mean - start), abs=1e-6)
    assert variance == pytest.approx(
        C[0, 0] - slope * C[0, 1] + slope**2 * start_variance, rel=1e-3
    )


def test_a_drifting_clock_leaves_its_given_offset() -> None:
    """Given to 2 ms at the start, 100 ppm: the estimate follows, and its σ holds the truth."""
    rng = np.random.default_rng(5)
    observer = ClockOffsetObserver(0.5, ClockPrior(0.0, 0.002))
    errors = []
    for k in range(1, 301):
        true = 1e-4 * k
        h = np.array([[8.0 * np.cos(k), 0.0], [8.0 * np.sin(k), 0.0]])
        z = h[:, 0] * true + 0.3 * rng.standard_normal(2)
        observe(observer.values, 1.0 if k > 1 else np.inf, z, h, 0.09 * np.eye(2), 0.0, True)
        observer.on_corrected(k * 1_000_000_000)
        missing, variance = observer.missing
        errors.append((missing - true) / np.sqrt(variance))
    assert np.mean(np.square(errors)) < 1.5
    assert np.sqrt(variance) < 0.01


def test_a_given_drift_moves_a_prior_and_what_is_not_known_of_it_widens_it() -> None:
    prior, drift = ClockPrior(0.02, 0.003, t_ns=5_000_000_000), ClockDrift(3e-4, 4e-5)

    assert prior.at(105_000_000_000, drift) == pytest.approx((0.05, 0.005, 0))
    assert prior._replace(t_ns=0).at(105_000_000_000, drift) == (0.02, 0.003, 0)


def test_an_offset_given_for_a_time_long_ago_is_expected_where_the_drift_took_it() -> None:
    """
    GIVEN an offset of 0.02 s a quarter of an hour before the first correction, and 300 ppm
    THEN 0.29 s is what is expected of an observer that knows next to nothing itself.
    """
    seconds = 1_000_000_000
    observer = ClockOffsetObserver(3.0, ClockPrior(0.02, 0.005, seconds), ClockDrift(3e-4, 1e-5))
    observer.on_corrected(901 * seconds)

    missing, variance = observer.missing

    assert missing == pytest.approx(0.29, abs=0.01)
    assert observer.drift == 3e-4
    assert np.sqrt(variance) > 0.1  # half of the clocks are anything

    observer.set_estimate(0.3, 0.02)
    assert observer.missing[0] == pytest.approx(0.29, abs=0.01)
    assert observer.drift == 3e-4


def test_chance_is_shrunk_and_evidence_is_not() -> None:
    prior = ClockPrior(0.0, 0.001)
    assert of_steady_clock(prior, 0.01, 0.01)[0] < 0.004
    assert of_steady_clock(prior, 0.1, 0.01)[0] == pytest.approx(0.1, abs=0.002)


def test_a_calibrated_clock_that_has_been_replaced_is_still_corrected() -> None:
    mean, variance = of_steady_clock(ClockPrior(0.1, 0.005), -0.3, 0.01)
    assert mean == pytest.approx(-0.3, abs=0.005)
    assert variance < 0.02**2


def test_a_correction_leaves_the_given_offset_where_it_is() -> None:
    observer = ClockOffsetObserver(0.5, ClockPrior(0.02, 0.001))
    observer.set_estimate(0.08, 0.005)
    before = observer.missing[0]
    observer.shift(before, np.zeros(4096))
    assert observer.prior is not None
    assert observer.prior.mean == pytest.approx(0.02 - before)
    missing, variance = observer.missing
    assert abs(missing) < 0.5 * np.sqrt(variance)


def test_without_a_prior_all_offsets_of_a_search_are_equally_likely() -> None:
    assert np.ptp(probabilities(None)) == 0.0


def test_a_search_expects_the_given_offset_first() -> None:
    found = probabilities(ClockPrior(0.3, 0.001))
    assert OFFSETS_NS[int(np.argmax(found))] == 300_000_000
    assert found.sum() == pytest.approx(1.0)
    assert found.min() > 1e-6


def test_no_offset_is_excluded_before_there_is_evidence() -> None:
    found = probabilities(ClockPrior(0.0, 0.001), 0.0, 0.002)
    assert found.min() > 0.03
    std = np.sqrt(found @ (np.array(OFFSETS_NS) * 1e-9) ** 2)
    assert std > OFFSET_BOUNDED[0], "the prior alone must not be enough to decide"


def test_a_search_beside_a_filter_expects_the_offset_that_it_has_found() -> None:
    """The given offset, 0.6 s away, is not what the second search begins with."""
    found = probabilities(ClockPrior(0.6, 0.001), 0.03, 0.1)
    assert abs(OFFSETS_NS[int(np.argmax(found))]) <= 200_000_000
