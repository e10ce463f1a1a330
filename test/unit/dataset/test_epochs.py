"""Times of fixes by an autopilot's clock."""

from __future__ import annotations

import numpy as np
import pytest

from hybrid_ins.dataset.logs.epochs import times_of_epochs

WEEKS = 2262 * 604_800.0


def test_the_scatter_of_the_arrival_is_gone_and_the_drift_is_kept() -> None:
    # GIVEN fixes each 0.2 s, some missing, by a clock 40 ppm fast, read by a loop of 48 Hz
    rng = np.random.default_rng(1)
    epochs = WEEKS + 0.2 * np.flatnonzero(rng.random(3000) > 0.1)
    true = 100.0 + (1.0 + 4e-5) * (epochs - epochs[0])
    arrivals = np.ceil((true + 0.07) / 0.0207) * 0.0207
    arrivals += np.where(rng.random(len(true)) < 0.03, rng.exponential(0.1, len(true)), 0.0)
    arrivals = np.maximum.accumulate(arrivals)
    # WHEN they are dated, THEN by the true times, but for one delay
    late = times_of_epochs(arrivals, epochs) - true
    assert np.std(arrivals - true) > 0.01
    assert np.ptp(late) < 0.003
    assert 0.07 < late.mean() < 0.09


@pytest.mark.parametrize("case", ["few", "none", "other"])
def test_without_the_receivers_time_the_arrival_counts(case: str) -> None:
    arrivals = 100.0 + 0.2 * np.arange(5 if case == "few" else 200)
    epochs = WEEKS + arrivals
    if case == "none":
        epochs = np.zeros(len(arrivals))
    if case == "other":  # a clock of seconds, noted with each fix
        epochs = WEEKS + 7.0 * np.arange(len(arrivals))
    assert times_of_epochs(arrivals, epochs) is arrivals
