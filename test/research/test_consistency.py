"""
Monte Carlo: the covariance tells the truth about the errors, at every IMU rate.

Fifty seeded flights of the paper's Table I (60 s, MPU-9250 noise, 5 Hz fixes) per case. Initial
error, biases and their walks are drawn from what the filter is told, so that NEES and NIS have
chi-square distributions and every test is two-sided.

References
----------
.. [1] Y. Bar-Shalom, X. Li, T. Kirubarajan, *Estimation with Applications to Tracking and
       Navigation*, 2001, section 5.4.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
import pytest
from scipy.stats import chi2
from scipy.stats import t as student
from support.analytic_motion import difference

from hybrid_ins.core import earth, noise_spectral, propagation
from hybrid_ins.core.filter_noise import FilterNoise
from hybrid_ins.core.gate import Gate
from hybrid_ins.core.ins_filter import FilterSettings, InsFilter
from hybrid_ins.core.iterated_update import update
from hybrid_ins.core.kalman import inject
from hybrid_ins.core.measurements import PositionFix
from hybrid_ins.core.noise import (
    ConstantNoise,
    LearnedNoise,
    NoiseEstimate,
    NoiseModel,
    ProcessNoise,
)
from hybrid_ins.core.samples import SAMPLE_DTYPE, ImuRing
from hybrid_ins.core.state import (
    N_ERROR,
    N_NAV,
    PSD,
    Array,
    NavState,
    covariance,
)
from hybrid_ins.simulation.motions import quadrotor_flight
from hybrid_ins.simulation.sensors import Truth, sample

RUNS = 50
DURATION = 60.0
Q = np.repeat([0.02**2, 0.002**2], 3)  # (m/s²)², (rad/s)²: the paper's MPU-9250
BIAS_WALK = np.repeat([1e-6, 2.5e-9], 3)  # (m/s²)²/s, (rad/s)²/s
R = np.diag([0.01, 0.01, 0.02])
SIGMA_0 = np.repeat([0.2, 0.1, 0.015, 0.05, 0.003], 3)
FIX_PERIOD = 0.2
SCORED = np.arange(10.3, DURATION, 1.0)  # s, between two fixes
WINDOW = 250  # samples


@cache
def flight(rate: float) -> Truth:
    return sample(quadrotor_flight(DURATION), np.arange(int(DURATION * rate) + 1) / rate)


@dataclass(frozen=True)
class Runs:
    """What fifty runs left."""

    errors: Array  # (RUNS, epochs, 15), true minus estimated
    covariances: Array  # (RUNS, epochs, 15, 15)
    nis: Array  # (RUNS, fixes)

    def nees(self, block: slice = slice(None)) -> Array:
        """Normalised estimation error squared, shape (RUNS, epochs)."""
        e, P = self.errors[..., block], self.covariances[..., block, block]
        return np.einsum("rei,rei->re", e, np.linalg.solve(P, e[..., None])[..., 0])

    @property
    def prmse(self) -> float:
        """Root mean square of the position error [m], eq. (25) of the paper."""
        return float(np.sqrt(np.mean(np.sum(self.errors[..., :3] ** 2, axis=-1))))


def one_run(
    rate: float, interval: float, noise: NoiseModel, seed: int
) -> tuple[Array, Array, Array]:
    truth, rng = flight(rate), np.random.default_rng(seed)
    dt, count = 1.0 / rate, len(truth.t)
    walk = rng.normal(size=(count, 6)) * np.sqrt(BIAS_WALK * dt)
    walk[0] = SIGMA_0[9:] * rng.normal(size=6)
    biases = np.cumsum(walk, axis=0)
    readings = np.hstack((truth.specific_force_b, truth.angular_rate_b))
    readings += biases + np.sqrt(Q) * rng.normal(size=(count, 6))
    samples = np.empty(count, SAMPLE_DTYPE)
    samples["t_ns"] = np.round(truth.t * 1e9)
    samples["f"], samples["w"] = readings[:, :3], readings[:, 3:]

    def true_state(k: int) -> NavState:
        return NavState(
            truth.lla[k],
            truth.velocity_n[k],
            truth.quat_xyzw[k],
            biases[k, :3],
            biases[k, 3:],
            np.diag(SIGMA_0**2),
        )

    nav = true_state(0).to_flat()
    start_error = SIGMA_0 * rng.normal(size=N_ERROR)
    start_error[9:] = walk[0]  # the filter starts with biases of zero
    inject(nav, -start_error)
    ring = ImuRing()
    ins = InsFilter(
        NavState.from_flat(nav),
        0,
        readings[0],
        FilterNoise(noise, ProcessNoise(BIAS_WALK, dt)),
        Gate({3: np.inf}, 1.0),
        ring,
        FilterSettings(interval),
    )
    for at in np.arange(FIX_PERIOD, DURATION, FIX_PERIOD):
        k = round(at * rate)
        shift = np.sqrt(np.diag(R)) * rng.normal(size=3) / earth.curvature_scale(truth.lla[k])
        ins.submit(PositionFix(int(samples["t_ns"][k]), truth.lla[k] + shift, R, np.zeros(3)))

    errors, covariances, start = [], [], 1
    for at in SCORED:
        k = round(at * rate)
        if isinstance(noise, LearnedNoise):
            for end in range(start + WINDOW, k, 3 * WINDOW):
                window = readings[end - WINDOW : end].T
                ins.submit(NoiseEstimate(int(samples["t_ns"][end]), noise_spectral.plateau(window)))
        ins.predict_block(samples[start : k + 1])
        start = k + 1
        propagation.propagate_covariance(ins.nav)
        errors.append(difference(true_state(k).to_flat(), ins.nav))
        covariances.append(covariance(ins.nav))
    return np.array(errors), np.array(covariances), np.array([v.nis for v in ins.verdicts])


@cache
def monte_carlo(rate: float, interval: float, told: float = 1.0, learned: bool = False) -> Runs:
    """Fly with a filter that is told ``told`` times the true noise, or reads it off the IMU."""
    runs = []
    for seed in range(RUNS):
        noise = LearnedNoise(25.0 * Q) if learned else ConstantNoise(told * Q)
        runs.append(one_run(rate, interval, noise, seed))
    return Runs(*(np.array(part) for part in zip(*runs, strict=True)))


def share_inside(nees: Array, dof: int) -> float:
    """Share of epochs whose average over the runs lies in its 95 % band; [1]_ eq. 5.4.2-4."""
    low, high = chi2.ppf([0.025, 0.975], dof * RUNS) / RUNS
    average = nees.mean(axis=0)
    return float(np.mean((low < average) & (average < high)))


def surprise(nees: Array, dof: int) -> float:
    """How many standard errors the mean is off; epochs of a run are dependent, runs are not."""
    means = nees.mean(axis=1)
    return float((means.mean() - dof) / (means.std(ddof=1) / np.sqrt(RUNS)))


CASES = [(100.0, 0.0), (200.0, 0.0), (1000.0, 0.0), (1000.0, 0.01)]
BEYOND = float(student.ppf(0.975, RUNS - 1))


@pytest.mark.parametrize(("rate", "interval"), CASES)
def test_nees(rate: float, interval: float) -> None:
    """Of all fifteen states and of the position, two-sided."""
    runs = monte_carlo(rate, interval)
    for block, dof in ((slice(0, 15), 15), (slice(0, 3), 3)):
        nees = runs.nees(block)

        assert abs(surprise(nees, dof)) < BEYOND
        assert share_inside(nees, dof) > 0.85


@pytest.mark.parametrize(("rate", "interval"), CASES)
def test_nis(rate: float, interval: float) -> None:
    """Innovations are independent: their mean over all runs and fixes has a narrow 99 % band."""
    nis = monte_carlo(rate, interval).nis

    low, high = chi2.ppf([0.005, 0.995], 3 * nis.size) / nis.size
    assert nis.size > 14_000
    assert low < nis.mean() < high


@pytest.mark.parametrize("told", [0.6, 1.6])
def test_wrong_noise_is_found_out(told: float) -> None:
    """The test of NEES tells a filter whose noise is wrong by 1.6 from a right one, either way."""
    nees = monte_carlo(200.0, 0.01, told).nees()

    assert np.sign(1.0 - told) * surprise(nees, 15) > BEYOND


def test_coarser_covariance_is_as_consistent() -> None:
    """At 1 kHz, every 10 ms against every sample: NEES of fifteen states within 0.2."""
    every, coarse = monte_carlo(1000.0, 0.0), monte_carlo(1000.0, 0.01)

    assert coarse.nees().mean() == pytest.approx(every.nees().mean(), abs=0.2)
    assert coarse.prmse < 1.001 * every.prmse


def test_table_one_flight_with_learned_noise() -> None:
    """
    GIVEN the paper's simulated flight, and a fallback 25 times the true noise
    WHEN the noise is read off the IMU itself
    THEN NEES is in its band and PRMSE at most 1 % above that with the true figures.
    """
    known, learned = monte_carlo(1000.0, 0.0), monte_carlo(1000.0, 0.01, learned=True)

    assert abs(surprise(learned.nees(), 15)) < BEYOND
    assert share_inside(learned.nees(), 15) > 0.85
    assert learned.prmse < 1.01 * known.prmse


def test_covariance_stays_positive_definite_over_a_million_steps() -> None:
    """Symmetric it is by construction; an update every 200 steps, ten times sharper at the end."""
    truth = flight(200.0)
    rows = np.empty((0, N_NAV))
    readings = np.hstack((truth.specific_force_b, truth.angular_rate_b))[1:]
    dt = np.full(200, 0.005)
    nav = NavState(
        truth.lla[0],
        truth.velocity_n[0],
        truth.quat_xyzw[0],
        np.zeros(3),
        np.zeros(3),
        np.diag((100.0 * SIGMA_0) ** 2),
    ).to_flat()
    nav[PSD] = np.concatenate((Q * 0.005, BIAS_WALK))
    H = np.eye(3, N_ERROR)
    smallest = np.inf
    for k in range(5000):
        lap = k % 50
        propagation.run(nav, dt, readings[200 * lap : 200 * (lap + 1)], 0.0, rows)
        update(nav, np.zeros(3), H, R if k < 2500 else 0.01 * R)
        if k % 25 == 0:
            P = covariance(nav)
            sigma = np.sqrt(np.diag(P))
            smallest = min(smallest, np.linalg.eigvalsh(P / np.outer(sigma, sigma))[0])

    assert np.all(np.isfinite(nav))
    assert smallest > 1e-9
    assert np.all(np.sqrt(np.diag(covariance(nav))) < 1.1 * SIGMA_0)
