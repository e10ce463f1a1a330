"""
Weights of the hypotheses of `multiple_model`, by the likelihood of the innovations.

What the noise is may change within seconds: a vehicle sets off, a receiver loses its solution. So
the likelihood of a hypothesis is remembered for ``MEMORY``. That fixes have a slow error changes
over minutes, and shows little by little: hypotheses with the same slow error are a family, whose
likelihood is that of the mixture of its members, predicted before each innovation, [1]_. It is
remembered for ``SLOW_MEMORY``.

References
----------
.. [1] A. P. Dawid, "Statistical theory: the prequential approach", Journal of the Royal
       Statistical Society A 147, 1984.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray

from hybrid_ins.core.noise.hypotheses import (
    AGE_STD,
    COUNT,
    HYPOTHESES,
    LOG_FACTORS,
    LOG_PRIOR,
    ON_HEIGHT,
    ON_VELOCITY,
    R_LEVELS,
    SLOW_HEIGHT_STD,
    SLOW_RATIO,
    SLOW_STD,
    STAMP_STD,
)

Array = NDArray[np.float64]

DEAD_BAND = 0.1  # decades that count as none
IMPROBABLE = 0.1  # probability of a slow error, of stamps that scatter, or of ages: that of none
MEMORY = 20.0  # s over which the likelihood of a hypothesis is remembered
SLOW_MEMORY = 200.0  # s over which that of a family is
UNLIKELIEST = -50.0  # log-likelihood of a hypothesis, to the best: any may be true from now on
UNLIKELIEST_FAMILY = -10.0  # of a family: a slow error may begin and end
AT_START = -7.0  # of families with a slow error: clock and heading may look like one at first
ANY_CLAIM = 1e-6  # m: of positions beside which any slow error would be found
EXACT_STAMP = 0.005  # s, of stamps: by less they do hardly any harm
EXACT_AGE = 0.1  # s, likewise of the age of velocities
CORRECTION_RATIO = 3.0  # rise of a factor at which the running filter's state is corrected

_OF_FAMILY, FAMILY = np.unique(HYPOTHESES[[SLOW_STD, SLOW_HEIGHT_STD]], axis=1, return_inverse=True)
FAMILY_STD, FAMILY = _OF_FAMILY.max(axis=0), FAMILY.ravel()  # m; of each hypothesis
FAMILIES = len(FAMILY_STD)
_OF_HEIGHTS = _OF_FAMILY[1] > 0.0
_PRIOR_OF_FAMILY = np.array(
    [np.logaddexp.reduce(HYPOTHESES[LOG_PRIOR][f == FAMILY]) for f in range(FAMILIES)]
)
_PRIOR_OF_R = [np.logaddexp.reduce(HYPOTHESES[LOG_PRIOR][level]) for level in R_LEVELS]


class NoiseFactors(NamedTuple):
    """What the mixture of the hypotheses assumes, in the order of `average`."""

    accelerometer: float = 1.0  # on its variance, 0.04 to 10⁴
    gyroscope: float = 1.0  # likewise, up to 10³
    fixes: float = 1.0  # on the covariance that fixes claim, 1 to 2·10⁴: many claim too small ones
    slow_std: float = 0.0  # m, horizontally, of a slow error of fixes; 0: the innovations show none
    slow_probability: float = 0.0  # of one
    stamp_std: float = 0.0  # s, of the stamps of positions, likewise
    stamp_probability: float = 0.0
    age_std: float = 0.0  # s, of the age of velocities, likewise
    horizontal_velocity: float = 1.0  # on the covariance that velocities claim, besides ``fixes``
    vertical_velocity: float = 1.0
    heights: float = 1.0  # on the variance that positions claim of the height, besides ``fixes``
    slow_height_std: float = 0.0  # m, of all slow errors of heights, as ``slow_std``


@register_jitable
def fade(T, log_likelihood, of_family):  # type: ignore[no-untyped-def]
    """Let likelihoods fade over a time [s]."""
    fading, slow_fading = np.exp(-T / MEMORY), np.exp(-T / SLOW_MEMORY)
    for h in range(COUNT):
        log_likelihood[h] *= fading
    for f in range(FAMILIES):
        of_family[f] *= slow_fading


@register_jitable
def add_likelihood(one, claimed_stds, log_likelihood, of_family):  # type: ignore[no-untyped-def]
    """
    Add the log-likelihoods of an innovation, (COUNT,) or more.

    A position whose claim, ``claimed_stds`` horizontally and of the height [m], contains the slow
    error of a family is no evidence on that. The largest of a family, and the largest of all
    families, are 0 afterwards.
    """
    largest, before = np.full(FAMILIES, -np.inf), np.zeros(FAMILIES)
    for h in range(COUNT):
        before[FAMILY[h]] += np.exp(log_likelihood[h] + HYPOTHESES[LOG_PRIOR, h])
        largest[FAMILY[h]] = max(largest[FAMILY[h]], one[h])
    after, best = np.zeros(FAMILIES), np.full(FAMILIES, -np.inf)
    for h in range(COUNT):
        f = FAMILY[h]
        after[f] += np.exp(log_likelihood[h] + HYPOTHESES[LOG_PRIOR, h] + one[h] - largest[f])
        log_likelihood[h] += one[h]
        best[f] = max(best[f], log_likelihood[h])
    most, shown = -np.inf, np.empty(FAMILIES)
    for f in range(FAMILIES):  # the first has no slow error
        shown[f] = largest[f] + np.log(max(after[f] / before[f], 1e-300))
        of_family[f] += shown[0] if _is_claimed(f, claimed_stds) else shown[f]
        most = max(most, of_family[f])
    for f in range(FAMILIES):
        of_family[f] = max(of_family[f] - most, UNLIKELIEST_FAMILY)
    for h in range(COUNT):
        log_likelihood[h] = max(log_likelihood[h] - best[FAMILY[h]], UNLIKELIEST)


@register_jitable
def _is_claimed(f, claimed_stds):  # type: ignore[no-untyped-def]
    """Return whether the slow error of a family is within what a position claims, [m]."""
    claimed_std = claimed_stds[1] if _OF_HEIGHTS[f] else claimed_stds[0]
    return 0.0 < FAMILY_STD[f] < SLOW_RATIO * claimed_std


@register_jitable
def weigh(log_likelihood, of_family, claimed_stds, weights):  # type: ignore[no-untyped-def]
    """Write the weights of the hypotheses, given what positions claim, see `add_likelihood`."""
    within, of_each = np.zeros(FAMILIES), np.empty(FAMILIES)
    for h in range(COUNT):
        weights[h] = np.exp(log_likelihood[h] + HYPOTHESES[LOG_PRIOR, h])
        within[FAMILY[h]] += weights[h]
    largest, total = -np.inf, 0.0
    for f in range(FAMILIES):
        of_each[f] = of_family[f] + _PRIOR_OF_FAMILY[f]
        if _is_claimed(f, claimed_stds):
            of_each[f] = -np.inf
        largest = max(largest, of_each[f])
    for f in range(FAMILIES):
        of_each[f] = np.exp(of_each[f] - largest)
        total += of_each[f]
    for h in range(COUNT):
        weights[h] *= of_each[FAMILY[h]] / (within[FAMILY[h]] * total)


def likelihood_of_r(log_likelihood: Array, of_family: Array) -> Array:
    """Return the log-likelihood of what the hypotheses assume of R alone, for each, (COUNT,)."""
    posterior, found = np.empty(COUNT), np.empty(COUNT)
    weigh(log_likelihood, of_family, (ANY_CLAIM, ANY_CLAIM), posterior)
    for level, prior in zip(R_LEVELS, _PRIOR_OF_R, strict=True):
        found[level] = np.log(posterior[level].sum()) - prior
    return np.asarray(found - found.max())


@register_jitable
def average(weights, factors, lowest):  # type: ignore[no-untyped-def]
    """
    Set the factors to the mixture's mean; return whether one has risen much.

    ``factors``, shape (12,), are those of `NoiseFactors`. Standard deviations are the mixture's
    second moment, and 0 where they are improbable.
    """
    for i in range(3):
        factors[i] = _mean_factor(LOG_FACTORS.start + i, weights)
    factors[3], probability = _std_and_probability(SLOW_STD, weights)
    of_heights, factors[4] = _std_and_probability(SLOW_HEIGHT_STD, weights)
    factors[11] = np.hypot(factors[3], of_heights)
    factors[4] += probability
    factors[5], factors[6] = _std_and_probability(STAMP_STD, weights)
    factors[7], _ = _std_and_probability(AGE_STD, weights)
    for i in range(2):
        factors[8 + i] = _mean_factor(ON_VELOCITY.start + i, weights)
    factors[10] = _mean_factor(ON_HEIGHT, weights)
    in_question, risen = np.empty(8), False
    in_question[0], in_question[1], in_question[2] = factors[0], factors[1], factors[2]
    in_question[3] = 1.0 + (factors[5] / EXACT_STAMP) ** 2
    in_question[4] = 1.0 + (factors[7] / EXACT_AGE) ** 2
    in_question[5], in_question[6], in_question[7] = factors[8], factors[9], factors[10]
    for i in range(len(in_question)):
        risen |= in_question[i] >= CORRECTION_RATIO * lowest[i]
    for i in range(len(in_question)):
        lowest[i] = in_question[i] if risen else min(lowest[i], in_question[i])
    return risen


@register_jitable
def _mean_factor(row, weights):  # type: ignore[no-untyped-def]
    """Return the mixture's mean of a factor whose decades are a row of `HYPOTHESES`."""
    decades = 0.0
    for h in range(COUNT):
        decades += HYPOTHESES[row, h] * weights[h]
    beyond = max(0.0, abs(decades) - DEAD_BAND)
    return 10.0 ** (beyond if decades > 0.0 else -beyond)


@register_jitable
def _std_and_probability(row, weights):  # type: ignore[no-untyped-def]
    """Return the mixture's standard deviation of a row of `HYPOTHESES`, and the weight of it."""
    variance, probability = 0.0, 0.0
    for h in range(COUNT):
        if HYPOTHESES[row, h] > 0.0:
            probability += weights[h]
            variance += HYPOTHESES[row, h] ** 2 * weights[h]
    return np.sqrt(variance) if probability > IMPROBABLE else 0.0, probability
