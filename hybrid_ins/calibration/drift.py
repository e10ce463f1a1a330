"""
The drift of the receiver's clock against the IMU's, over recordings with fitted parameters.

Fixes lie at t + offset + drift (t - middle). The likelihood's slope by the drift, beside those by
the other parameters, gives the step to its maximum and how well it is known, [1]_. The recordings
are put on a clock without that drift and fitted again, until nothing moves.

References
----------
.. [1] E. Berndt, B. Hall, R. Hall, J. Hausman, "Estimation and inference in nonlinear structural
       models", Annals of Economic and Social Measurement 3, 1974.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.calibration.findings import SIGNIFICANT
from hybrid_ins.calibration.likelihood import Likelihood, sums_of_blocks
from hybrid_ins.calibration.recording import Recording

Array = NDArray[np.float64]

PRIOR = 1e-3  # standard deviation; crystals agree to 1e-4, logger software to less
STEP = 0.004  # s, of finite differences, at the ends of a recording
CERTAIN = 4.0  # standard deviations, from which what was found is one: 3.4 were chance
NOTICEABLE = 0.005  # s, of the offset at the ends of the longest recording
SETTLED = 0.1  # standard deviations
MOST_PASSES = 8
MOST_STEPS = 4.0  # of the method's, that are taken at a time


class Drift(NamedTuple):
    """Rate of change of the clock offset [s/s]."""

    value: float  # 0: none is significant
    std: float  # root of the mean square of what it may be besides


def without_drift(recording: Recording, drift: float) -> Recording:
    """Return a recording whose GNSS times run without a drift; its middle stays where it is."""
    middle = float(np.mean(recording.aid_t))
    aid_t = recording.aid_t + drift * (recording.aid_t - middle)
    attitude = recording.attitude
    if attitude is not None:
        attitude = attitude[0] + drift * (attitude[0] - middle), attitude[1]
    return replace(recording, aid_t=aid_t, attitude=attitude)


def remove_drift(
    likelihood: Likelihood, x: Array, refit: Callable[[Array], tuple[Array, bool]]
) -> tuple[Array, bool, Drift]:
    """
    Put the recordings on a clock without drift, if they show one.

    Parameters
    ----------
    likelihood : Likelihood
        Its recordings are replaced where a drift is found.
    x : ndarray, shape (n,)
        The fitted parameters.
    refit : callable
        Given parameters, returns those of the largest posterior and whether it was reached.

    Returns
    -------
    x, converged, drift
        The parameters that go with the drift; 0 where it is not significant.
    """
    given = likelihood.recordings
    longest = max(float(np.ptp(recording.aid_t)) for recording in given)
    total, converged = 0.0, True
    last: tuple[float, float] | None = None  # a drift, and the step from there
    for _ in range(MOST_PASSES):
        step = _newton_step(likelihood, x, longest, total)
        moved = total + _lengthened(total, step.value, last)
        last = total, step.value
        shown = abs(moved) > max(SIGNIFICANT * step.std, 2.0 * NOTICEABLE / longest)
        if not total and not shown:
            return x, converged, Drift(0.0, step.std)
        total = moved
        likelihood.use([without_drift(recording, total) for recording in given])
        x, converged = refit(x)
        if abs(step.value) < SETTLED * step.std:
            break
    else:
        converged = False
    if abs(total) < CERTAIN * step.std:
        likelihood.use(given)
        return *refit(x), Drift(0.0, math.hypot(total, step.std))
    return x, converged, Drift(total, step.std)


def _lengthened(drift: float, step: float, last: tuple[float, float] | None) -> float:
    """
    Return the step by the secant through the last one, where that goes further.

    The outer product of the scores contains information that they repeat: steps by it are short.
    """
    if last is None or drift == last[0]:
        return step
    shortening = (last[1] - step) / (drift - last[0])
    return step / min(max(shortening, 1.0 / MOST_STEPS), 1.0)


def _newton_step(likelihood: Likelihood, x: Array, longest: float, drift: float) -> Drift:
    """Return the step to the most probable drift, and the standard deviation of that."""
    h = STEP / (0.5 * longest)
    values, slopes = likelihood.scores(x)
    free = likelihood.free()
    given, rows, sums = likelihood.recordings, [], []
    likelihood.use([without_drift(recording, h) for recording in given])
    high = [likelihood.run(k, x).log_likelihood for k in range(len(given))]
    likelihood.use(given)
    for recording, low, up, slope in zip(given, values, high, slopes, strict=True):
        score = np.column_stack((slope[:, free], (up - low) / h))
        by_block = sums_of_blocks(recording, score)
        rows.append(score)
        sums.append(by_block - by_block.mean(axis=0))
    precision = np.append([likelihood.prior[i].std ** -2.0 for i in free], PRIOR**-2.0)
    scores, blocks = np.vstack(rows), np.vstack(sums)
    gradient = np.append(
        likelihood.gradient(slopes, x)[free], scores[:, -1].sum() - drift / PRIOR**2
    )
    inverse = np.linalg.inv(scores.T @ scores + np.diag(precision))
    variance = inverse[-1, -1]
    if len(blocks) > 2 * len(precision):
        variance = max(variance, float((inverse @ blocks.T @ blocks @ inverse)[-1, -1]))
    return Drift(float(inverse[-1] @ gradient), float(np.sqrt(variance)))
