"""Chi-square bands, NEES, correlated series, and paired ratios."""

import numpy as np
import pytest
from scipy.stats import chi2

from hybrid_ins.evaluation.statistics import (
    Consistency,
    RunAverage,
    effective_count,
    mean_band,
    nees,
    paired_ratio,
)


def spread(rng: np.random.Generator, n: int) -> np.ndarray:
    """A covariance with cross terms and very different units."""
    root = rng.standard_normal((n, n)) * np.geomspace(1e-4, 10.0, n)[:, None]
    return root @ root.T


@pytest.mark.parametrize("n", [3, 15])
def test_nees_follows_the_chi_square_law(n: int) -> None:
    rng = np.random.default_rng(n)
    P = spread(rng, n)
    errors = rng.standard_normal((4000, n)) @ np.linalg.cholesky(P).T

    values = nees(errors, P)

    low, high = mean_band(n, 4000, 0.999)
    assert low < np.mean(values) < high
    assert np.mean(values < chi2.ppf(0.5, n)) == pytest.approx(0.5, abs=0.03)


def test_nees_of_a_hand_made_case() -> None:
    assert nees([3.0, -4.0], [[9.0, 0.0], [0.0, 4.0]]) == pytest.approx(1.0 + 4.0)


@pytest.mark.parametrize(
    "covariance",
    [
        np.zeros((3, 3)),
        np.diag([1.0, 1.0, 0.0]),
        np.diag([1.0, 1.0, -1.0]),
        np.full((3, 3), np.nan),
        np.ones((3, 3)),
    ],
)
def test_nees_is_nan_without_a_usable_covariance(covariance: np.ndarray) -> None:
    both = nees(np.ones((2, 3)), np.array([covariance, np.eye(3)]))

    assert np.isnan(both[0])
    assert both[1] == pytest.approx(3.0)


def test_nees_is_nan_for_an_error_that_is_none() -> None:
    assert np.isnan(nees([np.nan, 0.0, 0.0], np.eye(3)))


def test_the_band_is_two_sided_and_closes() -> None:
    assert mean_band(3, 1) == pytest.approx((chi2.ppf(0.025, 3), chi2.ppf(0.975, 3)))
    low, high = mean_band(15, 10_000)
    assert 14.8 < low < 15.0 < high < 15.2


def test_the_band_holds_95_percent_of_means() -> None:
    rng = np.random.default_rng(4)
    means = rng.chisquare(3, (2000, 50)).mean(axis=1)

    low, high = mean_band(3, 50)

    assert np.mean((means > low) & (means < high)) == pytest.approx(0.95, abs=0.02)


def test_independent_values_count_fully_and_correlated_ones_do_not() -> None:
    rng = np.random.default_rng(5)
    white = rng.standard_normal(4000)
    correlated = np.empty(40_000)
    correlated[0] = 0.0
    for k in range(1, len(correlated)):
        correlated[k] = 0.9 * correlated[k - 1] + rng.standard_normal()

    assert effective_count(white) > 3000
    assert effective_count(correlated) == pytest.approx(40_000 * 0.1 / 1.9, rel=0.25)


@pytest.mark.parametrize("values", [[], [1.0], [2.0, 2.0, 2.0, 2.0, 2.0]])
def test_few_or_equal_values_count_as_they_are(values: list[float]) -> None:
    assert effective_count(values) == len(values)


@pytest.mark.parametrize(
    ("scale", "verdict"), [(1.0, "consistent"), (2.0, "overconfident"), (0.5, "conservative")]
)
def test_the_verdict_says_on_which_side_the_mean_lies(scale: float, verdict: str) -> None:
    values = scale * np.random.default_rng(6).chisquare(3, 500)

    consistency = Consistency.of(values, 3)

    assert consistency is not None
    assert consistency.verdict == verdict
    assert consistency.per_dof == pytest.approx(np.mean(values) / 3)
    assert consistency.count == 500


def test_fixes_of_different_dimension_are_judged_together() -> None:
    rng = np.random.default_rng(7)
    dof = np.repeat([2.0, 3.0], 400)

    consistency = Consistency.of(rng.chisquare(dof), dof)

    assert consistency is not None
    assert consistency.dof == pytest.approx(2.5)
    assert consistency.verdict == "consistent"


def test_correlated_innovations_do_not_widen_the_band_of_nis() -> None:
    # GIVEN NIS values 1.35 times too large that come in slow waves, as with a wrong clock offset
    rng = np.random.default_rng(8)
    waves = 1.0 + 0.9 * np.sin(np.arange(160) * 2.0 * np.pi / 80.0)
    values = rng.chisquare(3, 160) * waves
    values *= 1.35 * 3.0 / np.mean(values)

    nees = Consistency.of(values, 3)
    nis = Consistency.of(values, 3, independent=True)

    # THEN as NEES chance may explain it, as NIS it cannot: white innovations are part of the test
    assert nees is not None
    assert nis is not None
    assert nis.effective_count < 30
    assert nees.verdict == "consistent"
    assert nis.verdict == "overconfident"


def test_nothing_finite_is_no_statistic() -> None:
    assert Consistency.of([np.nan, np.inf], 3) is None
    assert Consistency.of([], 3) is None


def inside(average: RunAverage) -> np.ndarray:
    low, high = average.band
    return (average.per_epoch >= low) & (average.per_epoch <= high)


def test_average_over_runs_of_a_consistent_filter_is_inside() -> None:
    rng = np.random.default_rng(8)
    P = np.broadcast_to(spread(rng, 15), (50, 100, 15, 15))
    errors = rng.standard_normal((50, 100, 15)) @ np.linalg.cholesky(P[0, 0]).T

    average = RunAverage.of(errors, P)

    assert average.dof == 15
    assert average.runs == 50
    assert average.mean == pytest.approx(15.0, abs=0.3)
    assert np.mean(inside(average)) > 0.88
    assert np.mean(inside(RunAverage.of(1.2 * errors, P))) < 0.1


def test_ratios_of_pairs_and_of_means() -> None:
    easy, hard = [1.0, 1.0], [10.0, 10.0]
    figures, against = [0.5, 0.5, 10.0, 10.0], easy + hard
    flights = ["a", "a", "b", "b"]

    pairs = paired_ratio(figures, against, flights)
    means = paired_ratio(figures, against, flights, of="means")

    assert pairs.ratio == pytest.approx(np.sqrt(0.5))
    assert means.ratio == pytest.approx(21.0 / 22.0)
    assert (pairs.low, pairs.high) == pytest.approx((0.5, 1.0))
    assert (pairs.pairs, pairs.clusters) == (4, 2)


def test_runs_of_one_flight_are_no_independent_evidence() -> None:
    rng = np.random.default_rng(9)
    flights = np.repeat(np.arange(12), 20)
    figures = np.exp(0.2 * rng.standard_normal(12))[flights]
    against = np.ones(len(flights))

    clustered = paired_ratio(figures, against, flights.tolist())
    naive = paired_ratio(figures, against, list(range(len(flights))))

    assert clustered.high - clustered.low > 3.0 * (naive.high - naive.low)
    assert clustered.low < clustered.ratio < clustered.high
    assert paired_ratio(figures, against, flights.tolist()) == clustered  # seeded


def test_the_interval_covers_the_true_ratio() -> None:
    rng = np.random.default_rng(10)
    covered = 0
    for _ in range(200):
        flights = np.repeat(np.arange(15), 4)
        figures = np.exp(
            np.log(0.9)
            + 0.1 * rng.standard_normal(15)[flights]
            + 0.05 * rng.standard_normal(len(flights))
        )
        ratio = paired_ratio(figures, np.ones(60), flights.tolist(), resamples=500)
        covered += ratio.low < 0.9 < ratio.high

    assert covered / 200 == pytest.approx(0.93, abs=0.05)


@pytest.mark.parametrize(
    ("figures", "against", "clusters"),
    [([], [], []), ([1.0], [1.0, 2.0], ["a"]), ([1.0], [0.0], ["a"]), ([np.nan], [1.0], ["a"])],
)
def test_figures_that_cannot_be_compared(
    figures: list[float], against: list[float], clusters: list[str]
) -> None:
    with pytest.raises(ValueError):
        paired_ratio(figures, against, clusters)
