"""The likelihood is of the same measurements wherever it is taken."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from hybrid_ins.calibration.filter_pass import Nominal
from hybrid_ins.calibration.fit import kept_within
from hybrid_ins.calibration.innovations import POSITION, VELOCITY
from hybrid_ins.calibration.likelihood import VELOCITY_AGE, VELOCITY_AGES, Likelihood
from hybrid_ins.calibration.recording import Recording

MARGIN = 0.2  # s


def standing() -> Recording:
    """Return positions and velocities with common stamps, some of them those of samples."""
    t, fix_t = np.arange(0.0, 20.0, 0.02), np.repeat(np.arange(0.1, 19.9, 0.2), 2)
    kinds = np.tile([POSITION, VELOCITY], len(fix_t) // 2)
    measured = np.where(kinds[:, None] == POSITION, [0.5, 1.0, 100.0], np.zeros(3))
    samples = np.tile([0.0, 0.0, -9.8, 0.0, 0.0, 0.0], (len(t), 1))
    return Recording(
        "standing", t, samples, fix_t, kinds, measured, np.tile(np.eye(3), (len(fix_t), 1, 1))
    )


def used(likelihood: Likelihood) -> Iterator[tuple[int, ...]]:
    """Yield the measurements that are used at clock offsets and velocity ages of a search."""
    x = np.array([prior.mean for prior in likelihood.prior])
    for offset in (-0.15, -0.01, 0.0, 0.013, 0.15):
        for age in (*VELOCITY_AGES, -0.001, 0.001):
            x[likelihood.names.index("offset")] = offset
            x[likelihood.names.index(VELOCITY_AGE)] = age
            yield tuple(np.flatnonzero(np.isfinite(likelihood.run(0, x).nis)))


@pytest.mark.parametrize("shift", [0.0, 0.007])
def test_it_is_of_the_same_measurements_at_any_offset_and_velocity_age(shift: float) -> None:
    """A velocity that was used at one age and not at the next made a step of its own."""
    whole, none, std = standing(), np.zeros(3), np.full(3, 0.1)
    whole.aid_t[:] += shift
    nominal = Nominal(0.0, none, 1e-4, 1e-8, 1e-3, 1e-5, none, std, none, std)

    (found,) = set(used(Likelihood([kept_within(whole, 0.0, MARGIN)], nominal, False)))

    assert len(found) > 0.9 * len(whole.aid_t)
