"""The clock offset's observer: the sensitivity is the filter's own, and sigma stays usable."""

from dataclasses import replace

import numpy as np
import pytest
from support.analytic_motion import difference
from support.runs import begin, stamped_early

from hybrid_ins.core.clock_offset import MIN_STD, ClockOffsetObserver
from hybrid_ins.core.filter_noise import FilterNoise
from hybrid_ins.core.ins_filter import InsFilter
from hybrid_ins.core.measurements import VelocityFix
from hybrid_ins.core.noise import Correction
from hybrid_ins.core.propagation import propagate_covariance
from hybrid_ins.core.state import N_ERROR, SENSITIVITY, NavState
from tools.paper.runs import Run, Scenario, draw

SECOND = 1_000_000_000


def correction(t_ns: int, velocity_n: np.ndarray, std: float) -> Correction:
    """Return a position fix of a vehicle, fused with no gain, so that nothing holds s back."""
    nav = NavState(
        np.array([0.5, 0.6, 0.0]),
        velocity_n,
        np.array([0.0, 0.0, 0.0, 1.0]),
        np.zeros(3),
        np.zeros(3),
        np.eye(N_ERROR),
    ).to_flat()
    H = np.eye(3, N_ERROR)
    S, K = std**2 * np.eye(3), np.zeros((N_ERROR, 3))
    z = np.full(3, std)
    return Correction(t_ns, z, S, H, K, np.zeros(N_ERROR), np.eye(3), 1.0, nav, True)


@pytest.mark.parametrize("std", [3.0, 1e-3, 1e-9])
def test_sigma_stays_a_number_and_above_what_stamps_resolve(std: float) -> None:
    observer = ClockOffsetObserver(0.5)
    rng = np.random.default_rng(1)
    for k in range(1, 2000):
        velocity_n = rng.normal(0.0, 10.0, 3)
        fix = correction(k * SECOND, velocity_n, std)
        observer.update(fix, observer.sensitivity_of(fix.nav, fix.t_ns, fix.H), fix.S)
        assert observer.sigma >= MIN_STD
    assert np.isfinite(observer.residual)


def test_a_huge_sensitivity_leaves_numbers() -> None:
    observer = ClockOffsetObserver(0.5)
    for k, size in enumerate((1e8, 1e100, 1e8), 1):
        fix = correction(k * SECOND, np.ones(3), 1e-3)
        observer.update(fix, np.full(3, size), fix.S)
        assert observer.sigma >= MIN_STD
    assert np.isfinite(observer.residual)


class Speed(VelocityFix):
    """A velocity from a sensor that has the IMU's clock."""

    sensor = "wheels"


def filtered(run: Run, speeds: bool) -> InsFilter:
    """Run a filter whose noise is not adapted, over fixes and the speeds of another sensor."""
    ins = begin(run)
    ins.noise = FilterNoise(ins.noise.model, ins.noise.process)
    ins.ring.extend(run.samples)
    for fix in run.fixes:
        ins.submit(fix)
    for k in range(2, len(run.scored), 7) if speeds else ():
        t_ns = int(run.samples["t_ns"][run.scored[k]])
        ins.submit(Speed(t_ns, run.velocity_n[k], 0.01 * np.eye(3), np.zeros(3)))
    ins.predict_block(run.samples[1:])
    propagate_covariance(ins.nav)
    return ins


@pytest.mark.parametrize("speeds", [False, True])
def test_sensitivity_is_the_derivative_of_the_filter_by_the_clock_offset(speeds: bool) -> None:
    run = draw(Scenario("flight", rate=100.0, duration=20.0), 1)
    run = replace(run, fixes=run.fixes[1:-1])
    late = 2e-3
    right, wrong = filtered(run, speeds), filtered(stamped_early(run, late), speeds)
    s, sigma = right.nav[SENSITIVITY], np.sqrt(np.diag(right.state.P))

    by_difference = difference(right.nav, wrong.nav) / late

    assert np.linalg.norm((by_difference - s) / sigma) < 0.1 * np.linalg.norm(s / sigma)
