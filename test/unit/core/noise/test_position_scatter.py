"""The share of the claimed variance of positions that is white, and the slow rest."""

import copy
import math

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from hybrid_ins.core.inertial.state import (
    COVARIANCE,
    DP,
    N_ERROR,
    SLOW_VARIANCE,
    Array,
    NavState,
    covariance,
    pack,
    total_std,
    unpack_total,
)
from hybrid_ins.core.noise.position_scatter import (
    LEAST_SEARCHED,
    MARGIN,
    REFLECTED_STD,
    PositionScatter,
    Split,
)
from hybrid_ins.core.noise.scatter_evidence import scatter_evidence
from hybrid_ins.core.noise.slow_error import NO_GROWTH, SLOW_TIME, change_slow_error
from hybrid_ins.core.update import iterated_update
from hybrid_ins.core.update.measurements import scaled_by_axis

SECOND = 1_000_000_000
STEP = 1e-5
H = np.eye(3, N_ERROR)
ANY = Split(np.eye(3), np.zeros(3), 0.2)


def standing(P: Array) -> Array:
    """Return a flat state whose position has the covariance P (3, 3)."""
    full = 1e-12 * np.eye(N_ERROR)
    full[DP, DP] = P
    lla, identity = np.array([0.5, 0.6, 10.0]), np.array([0.0, 0.0, 0.0, 1.0])
    return NavState(lla, np.zeros(3), identity, np.zeros(3), np.zeros(3), full).to_flat()


def learned(
    scatter: float | Array, claimed: float, walk: float, count: int = 400, believed: float = 1.0
) -> PositionScatter:
    """Return what fixes at 5 Hz teach, whose errors about a wandering position are white."""
    rng = np.random.default_rng(3)
    found, nav = PositionScatter(learning=True), standing(np.eye(3))
    found.in_force = True
    R, offset = claimed**2 * np.eye(3), rng.normal(0.0, 1.0, 3)  # true minus estimated
    for k in range(1, count):
        P = covariance(nav)
        P[DP, DP] += (believed * walk) ** 2 * np.eye(3)
        pack(P, nav[COVARIANCE])
        offset += rng.normal(0.0, walk, 3)
        z = offset + rng.normal(0.0, 1.0, 3) * scatter
        factors = found.shares(R)
        white = scaled_by_axis(R, *factors)
        evidence = scatter_evidence(nav[COVARIANCE], z, H, white, np.zeros((3, 3)))
        dx, *_ = iterated_update.update(nav, z, H, white)
        offset -= dx[DP]
        found.learn(ANY._replace(factors=factors), evidence, k * SECOND // 5)
    return found


@pytest.mark.parametrize(("claimed", "least"), [(0.1, 0.0), (0.3, 0.0), (0.65, 0.25), (3.0, 0.5)])
def test_metres_without_corrections_are_slow_in_part_whatever_they_scatter(
    claimed: float, least: float
) -> None:
    covariance = claimed**2 * np.diag([1.0, 1.0, 4.0])

    split = PositionScatter().split(covariance, SECOND)
    np.testing.assert_array_equal(split.white, covariance)
    np.testing.assert_allclose(split.slow_variance, least * covariance.diagonal(), atol=1e-12)
    # A receiver that scatters by less shows a larger slow part.
    split = PositionScatter(given=0.2).split(covariance, SECOND)
    assert (split.slow_variance + split.white.diagonal() >= covariance.diagonal()).all()


@pytest.mark.parametrize("walk", [0.02, 0.2])
@pytest.mark.parametrize(("scatter", "claimed"), [(0.4, 1.0), (0.6, 3.0)])
def test_a_scatter_below_the_claim_is_learned(scatter: float, claimed: float, walk: float) -> None:
    true = (scatter / claimed) ** 2
    assert learned(scatter, claimed, walk).learned == pytest.approx([MARGIN * true] * 2, rel=0.4)


@pytest.mark.parametrize("count", [60, 400])
def test_a_covariance_that_is_too_large_does_not_make_the_scatter_vanish(count: int) -> None:
    """Innovations far below P show less than no scatter, and change by it nonetheless."""
    shares = learned(0.3, 1.0, 0.02, count, believed=15.0).learned
    assert shares == pytest.approx([MARGIN * 0.3**2] * 2, rel=0.3)


@pytest.mark.parametrize("walk", [0.02, 0.3])
def test_a_right_claim_stays(walk: float) -> None:
    assert min(learned(1.0, 1.0, walk).learned) > 0.9


@pytest.mark.parametrize("walk", [0.1, 0.5])
def test_more_scatter_than_claimed_is_learned(walk: float) -> None:
    assert learned(3.0, 1.0, walk).learned == pytest.approx([9.0, 9.0], rel=0.3)


def test_the_factor_of_the_innovations_is_not_counted_twice() -> None:
    """GIVEN fixes with 9 times the claimed variance WHEN a factor of 4 is in force THEN 9 it is."""
    found, claimed = learned(3.0, 1.0, 0.1), np.eye(3)
    split = found.split(claimed, SECOND, fix_factor=4.0)
    assert split.factors == pytest.approx(found.learned)
    assert 4.0 * np.array(split.excess) == pytest.approx(found.learned)
    np.testing.assert_allclose(4.0 * split.white, np.diag(np.repeat(found.learned, (2, 1))))
    assert found.split(claimed, SECOND, fix_factor=100.0).excess == pytest.approx(
        (1.0, 1.0), abs=0.1
    )
    # Centimetres are left as they are.
    assert found.split(1e-4 * claimed, SECOND).factors == (1.0, 1.0)


def test_centimetres_are_not_split() -> None:
    found = learned(0.1, 1.0, 0.02)
    assert max(found.shares(np.eye(3))) < 0.1
    assert found.shares(1e-4 * np.eye(3)) == (1.0, 1.0)


@pytest.mark.parametrize(("scatter", "waits"), [(0.2, False), (3.0, True)])
def test_a_larger_share_than_the_given_one_waits_until_it_is_in_force(
    scatter: float, waits: bool
) -> None:
    found = learned(scatter, 1.0, 0.02)
    before = copy.copy(found)
    before.in_force = False
    expected = found.learned if waits else pytest.approx([0.05, 0.05], abs=0.03)
    assert found.shares(np.eye(3)) == expected
    assert before.shares(1e3 * np.eye(3)) == (2 * (1.0,) if waits else 2 * (LEAST_SEARCHED,))


def test_reflections_are_no_evidence_on_a_heading_that_is_searched_for() -> None:
    # GIVEN positions that scatter by less than they claim, while a heading is searched for
    found = learned(0.2, 1.0, 0.02)
    found.in_force = False
    metres, one = 9.0 * np.eye(3), np.eye(3)
    # THEN no position counts as better than reflections near walls leave it
    assert found.shares(one) == (1.0, 1.0)
    assert 9.0 * np.array(found.shares(metres)) == pytest.approx(REFLECTED_STD**2)
    # AND what one claims beyond the smallest claim counts in full: the receiver sees them
    found.learn(found.split(metres, SECOND), None, SECOND)
    assert 36.0 * np.array(found.shares(4.0 * metres)) == pytest.approx(REFLECTED_STD**2 + 27.0)


def test_a_claim_of_centimetres_is_split_and_none_of_a_centimetre() -> None:
    """GIVEN positions that scatter by half of what they claim."""
    found = learned(0.02, 0.04, 0.002)

    split = found.split(0.04**2 * np.eye(3), 1_000_000_000)
    assert 0.2 < min(split.factors) <= max(split.factors) < 0.5
    np.testing.assert_allclose(split.slow_variance + split.white.diagonal(), 0.04**2)
    assert found.split(0.01**2 * np.eye(3), 1_000_000_000).factors == (1.0, 1.0)


def test_heights_that_scatter_by_more_than_the_claimed_constant_are_found_alone() -> None:
    # GIVEN a claim of 1 m, and a scatter of 0.3 m horizontally and 3 m vertically
    found, claimed = learned(np.array([0.3, 0.3, 3.0]), 1.0, 0.1), np.eye(3)
    assert found.learned == pytest.approx([MARGIN * 0.09, 9.0], rel=0.4)
    # WHEN the innovations show no other factor, or one on all of R, or on the height
    for fix_factor, height_factor in ((1.0, 1.0), (5.0, 1.0), (1.0, 5.0)):
        split = found.split(claimed, SECOND, (0.0, 0.0), fix_factor, height_factor)
        # THEN nothing counts twice, and the factor on all of R is the one that is too large
        learned_here = np.array(found.learned)
        np.testing.assert_allclose(split.white.diagonal()[1:], learned_here)
        assert split.factors == pytest.approx(fix_factor * learned_here)
        assert split.excess[0] == 1.0
        assert split.excess[1] == pytest.approx(found.learned[1] / height_factor)
        assert split.slow_variance[0] == pytest.approx(1.0 - found.learned[0])


def test_a_given_share_above_1_is_kept_and_is_no_excess() -> None:
    found = PositionScatter(9.0, learning=True)
    found.in_force = True
    for k in range(200):
        found.learn(ANY, (np.array([18.0, 9.0]), np.array([2.0, 1.0]), np.zeros(3)), k * SECOND)
    split = found.split(np.eye(3), SECOND, fix_factor=4.0)
    assert split.factors == pytest.approx([36.0, 36.0], rel=0.05)
    assert split.excess == (1.0, 1.0)


TRUE = 0.3, 2.0


@pytest.mark.parametrize("used", [(0.01, 0.01), TRUE, (2.0, 0.3)])
def test_evidence_on_the_scatter_is_unbiased_whatever_factors_are_in_use(
    used: tuple[float, float],
) -> None:
    # GIVEN innovations with factors of 0.3 and 2 on what is claimed, among other errors
    rng = np.random.default_rng(5)
    root, other, third = rng.normal(size=(3, 3, 3))
    nav, claimed, others = standing(root @ root.T), other @ other.T + np.eye(3), third @ third.T
    S = root @ root.T + scaled_by_axis(claimed, *TRUE) + others
    drawn = rng.multivariate_normal(np.zeros(3), S, 4000)
    # WHEN they are used with others
    R = scaled_by_axis(claimed, *used)
    evidence = [scatter_evidence(nav[COVARIANCE], z, H, R, others)[:2] for z in drawn]
    totals, counts = np.array(evidence).transpose(1, 2, 0)
    # THEN their slope is the likelihood's by each factor, and how much they show is the information
    S_used = S - scaled_by_axis(claimed, *TRUE) + R
    log_likelihood = [
        multivariate_normal.logpdf(drawn[:20], cov=S_used + scaled_by_axis(R, *factors) - R)
        for factors in ((1.0 + STEP, 1.0), (1.0 - STEP, 1.0), (1.0, 1.0 + STEP), (1.0, 1.0 - STEP))
    ]
    slopes = (totals - counts)[:, :20]  # twice those
    assert slopes[0] == pytest.approx((log_likelihood[0] - log_likelihood[1]) / STEP, rel=1e-5)
    assert slopes[1] == pytest.approx((log_likelihood[2] - log_likelihood[3]) / STEP, rel=1e-5)
    for part, own in enumerate((np.diag([1.0, 1.0, 0.0]), np.diag([0.0, 0.0, 1.0]))):
        shown = np.linalg.solve(S_used, 0.5 * (own @ R + R @ own))
        assert counts[part] == pytest.approx(np.trace(shown @ shown))
    # AND those in use stay where they are true
    if used == TRUE:
        error = totals.std(axis=1) / len(drawn) ** 0.5
        assert (np.abs(totals.mean(axis=1) - counts.mean(axis=1)) < 4.0 * error).all()


def test_a_scatter_far_below_what_the_imu_does_between_fixes_is_learned() -> None:
    assert max(learned(0.05, 1.0, 0.1, count=1500).learned) < 0.01


def test_innovations_below_all_scatter_are_forgotten_at_once() -> None:
    # GIVEN a filter whose P is far too large, so that its innovations show less than no scatter
    found = PositionScatter(learning=True)
    found.in_force = True
    for k in range(200):
        found.learn(
            ANY, (np.array([-0.3, -0.2]), np.array([1.2, 0.6]), np.full(3, 0.1)), k * SECOND // 5
        )
    assert max(found.learned) < 0.005
    # WHEN they show a share of 0.09, THEN it is learned as from nothing
    for k in range(200, 350):
        found.learn(
            ANY, (np.array([0.12, 0.06]), np.array([1.3, 0.7]), np.full(3, 0.1)), k * SECOND // 5
        )
    assert min(found.learned) > 0.05


def test_the_slow_error_is_reported_and_walks() -> None:
    nav, P = standing(0.01 * np.eye(3)), np.empty((N_ERROR, N_ERROR))
    change_slow_error(nav, np.array([0.9, 0.9, 2.0]), 5.0, NO_GROWTH)
    np.testing.assert_allclose(covariance(nav)[DP, DP], 0.01 * np.eye(3))  # there was none before

    change_slow_error(nav, np.array([0.8, 0.8, 1.8]), 0.5, NO_GROWTH)

    np.testing.assert_allclose(np.diag(covariance(nav))[DP], 0.01 + np.array([0.009, 0.009, 0.02]))
    unpack_total(nav, P)
    np.testing.assert_allclose(np.diag(P)[DP], [0.819, 0.819, 1.83])
    np.testing.assert_allclose(total_std(nav), np.sqrt(np.diag(P)))


@pytest.mark.parametrize(("walks", "least", "most"), [(False, 0.0, 0.1), (True, 0.3, 1.0)])
def test_the_slow_error_walks_as_successive_innovations_show(
    walks: bool, least: float, most: float
) -> None:
    """
    GIVEN positions that scatter by 0.1 m about a slow error, which walks as claimed, or does not
    WHEN a filter believes the walk of a claimed metre
    THEN it learns from the sign of successive innovations how much of it there is.
    """
    rng = np.random.default_rng(4)
    found, nav = PositionScatter(0.01, learning=True), standing(0.01 * np.eye(3))
    found.in_force = True
    claimed, offset = np.eye(3), np.zeros(3)  # offset: slow error minus estimate
    walk = math.sqrt(2.0 * 0.2 / SLOW_TIME) if walks else 0.0
    for k in range(1, 1500):
        split = found.split(claimed, k * SECOND // 5)
        change_slow_error(nav, split.slow_variance, split.interval, split.claimed_growth)
        offset += rng.normal(0.0, walk, 3)
        z = offset + rng.normal(0.0, 0.1, 3)
        evidence = scatter_evidence(nav[COVARIANCE], z, H, split.white, np.zeros((3, 3)))
        dx, *_ = iterated_update.update(nav, z, H, split.white)
        offset -= dx[DP]
        found.learn(split, evidence, k * SECOND // 5)

    later = found.split(claimed, 1500 * SECOND // 5)
    assert least <= later.interval / 0.2 <= most


@pytest.mark.parametrize(
    ("innovation", "count", "least", "most"),
    [(0.05, 0.3, 0.0, 0.05), (0.05, 3.0, 0.9, 1.0), (0.9, 0.3, 0.9, 1.0)],
    ids=["far too large", "R is what is too large", "about right"],
)
def test_a_walk_that_alone_makes_innovations_small_falls_whatever_their_signs(
    innovation: float, count: float, least: float, most: float
) -> None:
    found = PositionScatter(0.01, learning=True)
    found.in_force = True
    counts = count * np.array([2.0, 1.0]) / 3.0
    alike = counts, counts, np.full(3, innovation)  # as a wrong clock offset makes them
    split = ANY._replace(factors=(0.01, 0.01))
    for k in range(1, 300):
        found.learn(split, alike, k * SECOND // 5)

    share = found.split(9.0 * np.eye(3), 60 * SECOND).interval / (60.0 - 299.0 / 5.0)
    assert least <= share <= most


def test_a_better_solution_leaves_the_slow_error_in_the_state() -> None:
    """GIVEN metres WHEN a fix claims a centimetre THEN it can correct what the former left."""
    nav = standing(0.01 * np.eye(3))
    nav[SLOW_VARIANCE] = 0.9, 0.9, 2.0

    change_slow_error(nav, np.zeros(2), 0.2, NO_GROWTH)  # a fix without height

    np.testing.assert_allclose(np.diag(covariance(nav))[DP], [0.91, 0.91, 0.01])
    np.testing.assert_allclose(nav[SLOW_VARIANCE], [0.0, 0.0, 2.0])


def test_a_poorer_solution_has_a_slow_error_of_its_own() -> None:
    # GIVEN a receiver that has claimed centimetres, which are its scatter
    found, nav = PositionScatter(), standing(1e-4 * np.eye(3))
    fixed, lost = (std**2 * np.diag([1.0, 1.0, 3.0]) for std in (0.02, 0.4))
    split = found.split(fixed, SECOND)
    found.learn(split, None, SECOND)
    change_slow_error(nav, split.slow_variance, split.interval, split.claimed_growth)
    assert not split.slow_variance.any()
    # WHEN it claims decimetres
    split = found.split(lost, 2 * SECOND)
    change_slow_error(nav, split.slow_variance, split.interval, split.claimed_growth)
    # THEN what they claim beyond the centimetres is a slow error, to which the state can move
    new = lost.diagonal() - 0.02**2 / 0.4**2 * lost.diagonal()
    np.testing.assert_allclose(split.slow_variance, new)
    np.testing.assert_allclose(split.claimed_growth, new)
    np.testing.assert_allclose(np.diag(covariance(nav))[DP], 1e-4 + new)
    # AND it counts as one only once
    found.learn(split, None, 2 * SECOND)
    later = found.split(lost, 3 * SECOND).claimed_growth
    np.testing.assert_allclose(later, 2.0 * new / SLOW_TIME)


def test_a_slow_error_that_innovations_show_is_added_where_it_is_not_claimed() -> None:
    scatter, claimed = PositionScatter(), np.diag([0.01, 0.01, 0.04]) ** 2
    none, some = (scatter.split(claimed, SECOND, (std, std)) for std in (0.0, 0.5))
    assert none.slow_variance == pytest.approx(np.zeros(3)) and none.unclaimed_stds[1] == 0.0
    assert some.slow_variance == pytest.approx([0.25, 0.25, 0.5625])
    assert some.unclaimed_stds == pytest.approx((0.5, 0.75))
    # One of heights alone is none of the rest.
    alone = scatter.split(claimed, SECOND, (0.0, 0.5))
    assert alone.slow_variance == pytest.approx([0.0, 0.0, 0.5625])
    assert alone.unclaimed_stds == pytest.approx((0.0, 0.75))
    # A receiver that claims metres has claimed it.
    given = PositionScatter(0.1)
    split = given.split(np.diag([4.0, 4.0, 9.0]), SECOND, (0.5, 0.5))
    assert split.slow_variance == pytest.approx([3.6, 3.6, 8.1])
    assert split.unclaimed_stds[0] == 0.0
