"""Weights of the noise hypotheses: Bayes' rule, two memories, what a slow error of fixes adds."""

import numpy as np
import pytest
from scipy.special import logsumexp

from hybrid_ins.core.inertial.state import Array
from hybrid_ins.core.noise.hypotheses import (
    AGE_STD,
    COUNT,
    HYPOTHESES,
    LOG_PRIOR,
    ON_HEIGHT,
    ON_VELOCITY,
    SLOW_HEIGHT_STD,
    SLOW_RATIO,
    SLOW_STD,
    STAMP_STD,
    claims_in_search,
)
from hybrid_ins.core.noise.weights import (
    DEAD_BAND,
    FAMILIES,
    FAMILY,
    FAMILY_STD,
    MEMORY,
    SLOW_MEMORY,
    add_likelihood,
    average,
    fade,
    weigh,
)

SLOW = HYPOTHESES[SLOW_STD]
SLOW_HEIGHT = HYPOTHESES[SLOW_HEIGHT_STD]
CENTIMETRE = (0.01, 0.01)  # m, claimed horizontally and of the height


def weighed(found: Array, of_family: Array, claimed_stds: tuple[float, float]) -> Array:
    weights = np.empty(COUNT)
    weigh(found, of_family, claimed_stds, weights)
    return weights


def test_without_fading_the_weights_are_those_of_bayes_rule() -> None:
    rng = np.random.default_rng(3)
    found, of_family, plain = np.zeros(COUNT), np.zeros(FAMILIES), HYPOTHESES[LOG_PRIOR].copy()
    for _ in range(6):
        one = rng.normal(0.0, 0.5, COUNT)
        add_likelihood(one, CENTIMETRE, found, of_family)
        plain = plain + one

    expected = np.exp(plain - logsumexp(plain))
    np.testing.assert_allclose(weighed(found, of_family, CENTIMETRE), expected, rtol=1e-9)


def test_that_fixes_have_a_slow_error_is_remembered_longer_than_what_the_noise_is() -> None:
    found, of_family = np.zeros(COUNT), np.zeros(FAMILIES)
    one = -5.0 * (FAMILY == 0) - 3.0 * (np.arange(COUNT) % 2)
    add_likelihood(one, CENTIMETRE, found, of_family)
    before = of_family.copy()

    fade(60.0, found, of_family)

    np.testing.assert_allclose(of_family, before * np.exp(-60.0 / SLOW_MEMORY))
    assert found.min() == pytest.approx(-3.0 * np.exp(-60.0 / MEMORY))


def test_a_claim_that_contains_a_slow_error_is_no_evidence_on_it() -> None:
    found, of_family = np.zeros(COUNT), np.zeros(FAMILIES)

    add_likelihood(-5.0 * (FAMILY == 0), (0.3, 0.3), found, of_family)

    contained = (FAMILY_STD > 0.0) & (FAMILY_STD < 0.6)
    assert contained.any()
    np.testing.assert_allclose(of_family[contained], of_family[0])
    np.testing.assert_allclose(of_family[FAMILY_STD > 0.6], 0.0)
    assert of_family[0] == pytest.approx(-5.0)


def test_a_slow_error_has_the_second_moment_of_what_is_probable() -> None:
    rng = np.random.default_rng(4)
    weights = rng.uniform(size=COUNT) * np.where(SLOW + SLOW_HEIGHT > 0.0, 3.0, 1.0)
    weights /= weights.sum()
    factors, lowest = np.ones(12), np.ones(8)

    average(weights, factors, lowest)
    assert factors[3] == pytest.approx(np.sqrt(weights @ SLOW**2))
    assert factors[11] == pytest.approx(np.sqrt(weights @ (SLOW**2 + SLOW_HEIGHT**2)))

    weights[SLOW > 0.0] *= 0.05 / weights[SLOW > 0.0].sum()
    average(weights, factors, lowest)
    assert factors[3] == 0.0
    assert factors[4] == pytest.approx(0.05 + weights[SLOW_HEIGHT > 0.0].sum())
    # One of heights alone is none of the rest.
    assert factors[11] == pytest.approx(np.sqrt(weights @ SLOW_HEIGHT**2))


@pytest.mark.parametrize(("row", "place"), [(STAMP_STD, 5), (AGE_STD, 7)])
def test_stamps_and_ages_have_the_second_moment_of_what_is_probable_and_move_the_state(
    row: int, place: int
) -> None:
    rng, stds = np.random.default_rng(4), HYPOTHESES[row]
    weights = rng.uniform(size=COUNT) * (stds > 0.0)
    weights /= weights.sum()
    factors, lowest = np.ones(12), np.ones(8)

    assert average(weights, factors, lowest)
    assert factors[place] == pytest.approx(np.sqrt(weights @ stds**2))
    assert not average(weights, factors, lowest)

    weights = np.where(stds > 0.0, 0.05 * weights, 0.95 / np.sum(stds == 0.0))
    average(weights, factors, lowest)
    assert factors[place] == 0.0


def test_factors_on_velocities_are_the_mean_of_the_decades_and_move_the_state() -> None:
    weights = np.random.default_rng(4).uniform(size=COUNT) * (HYPOTHESES[ON_VELOCITY][1] > 0.0)
    weights /= weights.sum()
    factors, lowest = np.ones(12), np.ones(8)

    assert average(weights, factors, lowest)
    decades = HYPOTHESES[ON_VELOCITY] @ weights
    assert 0.0 < decades[0] < decades[1]  # vertical velocities may err alone
    assert factors[8:10] == pytest.approx(10.0 ** (decades - DEAD_BAND))
    assert not average(weights, factors, lowest)


def test_the_factor_on_heights_is_the_mean_of_the_decades_and_moves_the_state() -> None:
    weights = np.random.default_rng(4).uniform(size=COUNT) * (HYPOTHESES[ON_HEIGHT] > 0.0)
    weights /= weights.sum()
    factors, lowest = np.ones(12), np.ones(8)

    assert average(weights, factors, lowest)
    assert factors[2] == 1.0
    assert factors[10] == pytest.approx(10.0 ** (HYPOTHESES[ON_HEIGHT] @ weights - DEAD_BAND))
    assert not average(weights, factors, lowest)


def test_nothing_is_found_of_stamps_and_velocities_before_there_is_evidence() -> None:
    factors = np.zeros(12)

    assert not average(
        weighed(np.zeros(COUNT), np.zeros(FAMILIES), (0.3, 0.3)), factors, np.ones(8)
    )

    assert factors[[5, 7, 8, 9, 10]].tolist() == [0.0, 0.0, 1.0, 1.0, 1.0]


@pytest.mark.parametrize("claimed_stds", [(0.01, 0.01), (0.1, 0.4), (1.2, 2.0), (20.0, 20.0)])
def test_what_a_receiver_claims_contains_slow_errors_of_less_than_twice_that(
    claimed_stds: tuple[float, float],
) -> None:
    weights = weighed(np.zeros(COUNT), np.zeros(FAMILIES), claimed_stds)

    of_all = (SLOW == 0.0) | (2.0 * claimed_stds[0] <= SLOW)
    of_heights = (SLOW_HEIGHT == 0.0) | (2.0 * claimed_stds[1] <= SLOW_HEIGHT)
    assert np.all((weights > 0.0) == (of_all & of_heights))
    assert weights.sum() == pytest.approx(1.0)
    assert FAMILY_STD[0] == 0.0


@pytest.mark.parametrize(
    ("claimed_std", "smallest"), [(0.01, 0.02), (0.1, 0.2), (0.3, 0.6), (1.0, 20.0), (2.0, 40.0)]
)
def test_in_a_search_uncorrected_receivers_contain_slow_errors_already(
    claimed_std: float, smallest: float
) -> None:
    claims = np.array(claims_in_search(claimed_std, 1.5 * claimed_std))

    assert SLOW_RATIO * claims == pytest.approx([smallest, 1.5 * smallest])
