"""Outages in which scale errors of the IMU are considered, smoothed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.runs import Q

from hybrid_ins.core.constraints.nonholonomic import NonHolonomic, Nose
from hybrid_ins.core.filter.events import Outage
from hybrid_ins.core.filter.filter_noise import FilterNoise
from hybrid_ins.core.filter.filter_settings import FilterSettings
from hybrid_ins.core.filter.ins_filter import InsFilter
from hybrid_ins.core.imu.samples import ImuRing
from hybrid_ins.core.inertial.state import N_NAV, covariance
from hybrid_ins.core.noise.process_noise import ConstantNoise, ProcessNoise
from hybrid_ins.core.sensor_errors.scale_errors import SCALE
from hybrid_ins.core.sensor_errors.scale_sensitivity import N_SCALE
from hybrid_ins.core.smoothing import hindsight
from hybrid_ins.core.smoothing.smoother import Smoother
from hybrid_ins.core.update.gate import Gate
from hybrid_ins.simulation.motions import car_drive
from tools.field.batch_least_squares import difference, gather
from tools.paper.runs import Run, Scenario, draw

SECOND = 1_000_000_000
DRIVE = Scenario("drive", car_drive, rate=100.0, duration=60.0, fix_rate=1.0)


def without_fixes(begin: float, end: float) -> Run:
    run = draw(DRIVE, 3)
    t = np.array([fix.t_ns - run.samples["t_ns"][0] for fix in run.fixes]) * 1e-9
    kept = np.flatnonzero((t < begin) | (t > end))
    return replace(run, fixes=tuple(run.fixes[k] for k in kept))


def filtered(run: Run, begin: float, end: float, wheels: bool) -> InsFilter:
    """Run a filter that has found scale errors, and knows of the outage after three seconds."""
    samples, rng = run.samples, np.random.default_rng(1)
    ring = ImuRing()
    ring.extend(samples)
    running = InsFilter(
        run.start,
        int(samples["t_ns"][0]),
        np.concatenate((samples["f"][0], samples["w"][0])),
        FilterNoise(ConstantNoise(Q), ProcessNoise(run.bias_walk, 0.01)),
        Gate(dict.fromkeys((1, 2, 3), np.inf), 3.0),
        ring,
        FilterSettings(scale_std=0.01, keep_record=True),
    )
    running.update.scale_errors._parameters[SCALE] = rng.standard_normal(N_SCALE)
    for fix in run.fixes:
        running.submit(fix)
    by_scale = 0.3 * rng.standard_normal((2, N_SCALE))
    nose = Nose(0.0, 0.0, np.zeros(3))
    first = int(samples["t_ns"][0])
    for t in np.arange(begin + 3.0, min(end, 59.9), 0.5):
        t_ns = first + round(t * SECOND)
        running.submit(Outage(t_ns))
        if wheels:
            rate_b = samples["w"][np.searchsorted(samples["t_ns"], t_ns)]
            running.submit(NonHolonomic(t_ns, rate_b, nose, 4.0 * np.eye(2), by_scale=by_scale))
    running.predict_block(samples[1:])
    return running


def smoothed(run: Run, running: InsFilter) -> np.ndarray:
    """Return the smoothed flat states at all samples."""
    filters = [(running, 0.0)]
    start, updates = hindsight._plan(filters, *hindsight._steps(filters))
    interval, gap_ns = running.covariance_interval, running.long_step_ns
    smoother = Smoother(start, run.samples, updates, interval, gap_ns, {}, {})
    smoother.run()
    return gather(smoother)[1]


@pytest.mark.parametrize("wheels", [False, True])
def test_the_end_of_an_outage_that_lasts_is_that_of_the_filter(wheels: bool) -> None:
    # GIVEN a drive that ends without fixes, whose scale errors are known in part
    run = without_fixes(40.0, 61.0)
    running = filtered(run, 40.0, 61.0, wheels)
    # WHEN it is smoothed
    rows = smoothed(run, running)
    # THEN its last state, which nothing follows, is the filter's
    last = running.flat_state()
    np.testing.assert_allclose(difference(rows[-1], last)[:9], 0.0, atol=1e-5)
    P, P_filter = covariance(rows[-1]), covariance(last)
    assert np.abs(P - P_filter).max() < 1e-5 * np.abs(P_filter).max()


@pytest.mark.parametrize("wheels", [False, True])
def test_covariances_of_an_outage_in_turns_stay_positive_definite(wheels: bool) -> None:
    # GIVEN an outage in turns that take away what others have brought, and fixes behind it
    run = without_fixes(20.0, 45.0)
    running = filtered(run, 20.0, 45.0, wheels)
    # WHEN it is smoothed
    rows = smoothed(run, running)[:, :N_NAV]
    # THEN each covariance is one
    stds = [np.sqrt(np.diag(covariance(row))) for row in rows[::25]]
    smallest = [
        np.linalg.eigvalsh(covariance(row) / np.outer(std, std)).min()
        for row, std in zip(rows[::25], stds, strict=True)
    ]
    assert min(smallest) > 0.0
