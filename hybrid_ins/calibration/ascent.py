"""
The ascent of the posterior of some recordings to its maximum, clock offsets included.

References
----------
.. [1] E. Berndt, B. Hall, R. Hall, J. Hausman, "Estimation and inference in nonlinear structural
       models", Annals of Economic and Social Measurement 3, 1974.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.calibration.likelihood import Likelihood, holding

Array = NDArray[np.float64]

NEARBY, MOST_CLIMBS = np.linspace(-0.1, 0.1, 21), 6  # s, offsets tried beside the one found
REACHES = (1, 4, 8, 16)  # samples, to either side, over which the likelihood is compared with
SMOOTH = 0.1  # a parabola: it departs from that by less than this share of the parabola's drop


def maximise(likelihood: Likelihood, x: Array, iterations: int = 40) -> tuple[Array, bool]:
    """
    Return the parameters of the largest posterior, starting from ``x``, and whether it is reached.

    Scoring with the outer product of the scores as information [1]_, damped until it ascends.
    """
    free = likelihood.free()
    reach = np.array([25.0 * likelihood.prior[i].step for i in free])
    prior = np.diag([likelihood.prior[i].std ** -2.0 for i in free])
    value, damping = likelihood.value_at(x), 0.01
    for _ in range(iterations):
        _, slopes = likelihood.scores(x)
        gradient = likelihood.gradient(slopes, x)[free]
        rows = np.vstack(slopes)[:, free]
        information = rows.T @ rows + prior
        gain = 0.0
        while damping < 1e4 and gain <= 0.0:
            move = np.linalg.solve(information + damping * np.diag(np.diag(information)), gradient)
            y = x.copy()
            y[free] += np.clip(move, -reach, reach)
            new_value = likelihood.value_at(y)
            gain = new_value - value if math.isfinite(new_value) else -math.inf
            damping *= 0.2 if gain > 0.0 else 5.0
        if gain > 0.0:
            x, value = y, new_value
        if gain < 0.05:
            return x, True
        damping = max(damping, 1e-4)
    return x, False


def climb(likelihood: Likelihood, x: Array) -> tuple[Array, bool]:
    """
    Return what `maximise` does, for which ever clock offset nearby is the likeliest.

    Every offset compares the fixes with other samples of a vibration: where that is strong the
    likelihood is rough from sample to sample, and an ascent stops far from the likeliest offset.
    """
    offsets = _free_offsets(likelihood)
    for _ in range(MOST_CLIMBS):
        x, converged = maximise(likelihood, x)
        y = x.copy()
        for i in offsets:
            y[i] = likelihood.likeliest(x, likelihood.names[i], x[i] + NEARBY)
        if np.all(y == x):
            break
        x = y
    return x, converged


def settle_offsets(likelihood: Likelihood, x: Array, converged: bool) -> tuple[Array, bool]:
    """Return what `climb` has found, with other offsets where the likelihood is rough in them."""
    smooth = _smooth_offsets(likelihood, x)
    if np.all(smooth == x):
        return x, converged
    with holding(likelihood, likelihood.frozen | {likelihood.names[i] for i in likelihood.offsets}):
        return maximise(likelihood, smooth)


def _smooth_offsets(likelihood: Likelihood, x: Array) -> Array:
    """
    Return ``x`` with offsets at the vertex of a parabola where the likelihood is rough.

    The parabola is as wide as it takes to stand out from what is chance.
    """
    x = x.copy()
    for i in _free_offsets(likelihood):
        for reach in REACHES:
            away = np.linspace(-reach, reach, 17) * likelihood.period
            profile = likelihood.profile(x, likelihood.names[i], x[i] + away)
            parabola = np.polynomial.Polynomial.fit(away, profile, 2)
            _, slope, curvature = parabola.convert().coef
            roughness = float(np.sqrt(np.mean((profile - parabola(away)) ** 2)))
            if roughness < SMOOTH * -curvature * away[-1] ** 2:
                break
        if reach > REACHES[0] and curvature < 0.0:
            x[i] += float(np.clip(-0.5 * slope / curvature, away[0], away[-1]))
    return x


def _free_offsets(likelihood: Likelihood) -> list[int]:
    """Return the indices of the clock offsets that are varied."""
    return [i for i in likelihood.free() if i in likelihood.offsets]
