"""
Fits of motion that allow for the ordinary errors of an IMU, before its axes are accused.

A gyroscope's scales and axes that are off by a per cent, an accelerometer's bias and a lever arm of
metres leave more over than the fixes' noise where a vehicle spins: an axis that the motion hardly
shows would be said to be reversed, since that happens to fit a little better.
"""

from __future__ import annotations

from collections.abc import Generator, Sequence

import numpy as np

from hybrid_ins.core.imu_axes.fit import Fit, Motion, fit
from hybrid_ins.core.imu_axes.nuisance import TOLERANT

LEVER_ARMS = 2.0 * np.vstack((np.zeros(3), np.eye(3)[:2], -np.eye(3)[:2]))
"""From the given one, where the search for the lever arm begins again: the course may be off."""
LOG_ODDS, FITTED = 6.0, 10  # of a fit that is better not by chance; unknowns of a fit


def tolerant_fits(
    motion: Motion, as_given: Fit, fits: Sequence[Fit]
) -> Generator[None, None, tuple[Fit, list[Fit]]]:
    """
    Return the best fit of the axes as given, and those of better hypotheses, with such errors.

    ``as_given`` and ``fits`` are those without; yields between the parts of the work.
    """
    starts, given = [as_given], as_given.given_arm
    for lever_arm in given + LEVER_ARMS:
        starts.append(fit(motion, Fit(1.0, np.eye(3), lever_arm=lever_arm, given_arm=given)))
        yield
    plain = Fit(1.0, np.eye(3), lever_arm=given, given_arm=given)
    found: list[Fit] = []
    for start in [*sorted(starts, key=lambda one: one.left)[:2], plain]:
        found.append(fit(motion, start, TOLERANT))
        yield
    others: list[Fit] = []
    for hypothesis in fits:
        if hypothesis.left < as_given.left:
            others.append(fit(motion, hypothesis, TOLERANT))
            yield
    return min(found, key=lambda one: one.left), others


def times_by_chance(motion: Motion) -> float:
    """Return how many times less noise may leave over of few changes, by one of the fits."""
    free = 2 * min(len(motion.triples), len(motion.fix_t) - 2) - FITTED
    return float(np.exp(2.0 * LOG_ODDS / max(free, 1)))
