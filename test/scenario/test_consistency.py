"""
Monte Carlo: the covariance is consistent with the errors, at every IMU rate.

A hundred seeded flights of the paper's Table I (MPU-9250 noise, 5 Hz fixes) per case. Initial
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

from hybrid_ins.core import propagation
from hybrid_ins.core.iterated_update import update
from hybrid_ins.core.state import N_ERROR, N_NAV, PSD, Array, NavState, covariance
from hybrid_ins.simulation.motions import quadrotor_flight
from hybrid_ins.simulation.sensors import ImuErrors, sample
from tools.paper.montecarlo import Method, Scenario, fly_all

RUNS = 100
Q = np.repeat([0.02**2, 0.002**2], 3)  # (m/s²)², (rad/s)²: the paper's MPU-9250
BIAS_WALK = np.repeat([1e-6, 2.5e-9], 3)  # (m/s²)²/s, (rad/s)²/s
R = np.diag([0.01, 0.01, 0.02])
SIGMA_0 = np.repeat([0.2, 0.1, 0.015, 0.05, 0.003], 3)


@dataclass(frozen=True)
class Flights:
    """NEES (RUNS, epochs) of the state and of the position, NIS (RUNS, fixes), PRMSE [m]."""

    nees: Array
    position_nees: Array
    nis: Array
    prmse: float


def constant(factor: float, interval: float) -> Method:
    """Take ``factor`` times the true noise, with a covariance every ``interval`` [s]."""
    q = (factor * Q[0], factor * Q[3])
    return Method(f"{factor:g}, {interval:g}", "constant", q, covariance_interval=interval)


TRUE, COARSE = constant(1.0, 0.0), constant(1.0, 0.01)
LEARNED = Method("learned", "learned", (25.0 * Q[0], 25.0 * Q[3]), model="spectral", refresh=0.5)
METHODS = {
    100.0: (TRUE,),
    200.0: (TRUE, constant(0.6, 0.01), constant(1.6, 0.01)),
    1000.0: (TRUE, COARSE, LEARNED),
}


@cache
def flown(rate: float) -> dict[Method, Flights]:
    """Fly the same runs with each method."""
    scenario = Scenario(
        "Table I",
        rate=rate,
        duration=40.0 if rate == 1000.0 else 60.0,
        scored_from=10.0,
        score_every=2,
        start_std=tuple(SIGMA_0),
        errors=ImuErrors(gyroscope_bias_walk=5e-5),
    )
    methods = METHODS[rate]
    runs = [flights for _, flights in fly_all(scenario, methods, range(RUNS))]
    return {
        method: Flights(
            np.array([f.nees for f in flights]),
            np.array([f.position_nees for f in flights]),
            np.array([f.nis for f in flights]),
            float(np.sqrt(np.mean([f.prmse**2 for f in flights]))),
        )
        for method, flights in zip(methods, zip(*runs, strict=True), strict=True)
    }


def share_inside(nees: Array, dof: int) -> float:
    """Share of epochs whose average over the runs lies in its 95 % band; [1]_ eq. 5.4.2-4."""
    low, high = chi2.ppf([0.025, 0.975], dof * RUNS) / RUNS
    average = nees.mean(axis=0)
    return float(np.mean((low < average) & (average < high)))


def standard_errors(nees: Array, dof: int) -> float:
    """By how many standard errors the mean is off; only the epochs of a run are dependent."""
    means = nees.mean(axis=1)
    return float((means.mean() - dof) / (means.std(ddof=1) / np.sqrt(RUNS)))


CASES = [(100.0, TRUE), (200.0, TRUE), (1000.0, TRUE), (1000.0, COARSE)]
LIMIT = float(student.ppf(0.995, RUNS - 1))


@pytest.mark.parametrize(("rate", "method"), CASES)
def test_nees(rate: float, method: Method) -> None:
    """Of all fifteen states and of the position, two-sided."""
    runs = flown(rate)[method]
    for nees, dof in ((runs.nees, 15), (runs.position_nees, 3)):
        assert abs(standard_errors(nees, dof)) < LIMIT
        assert share_inside(nees, dof) > 0.85


@pytest.mark.parametrize(("rate", "method"), CASES)
def test_nis(rate: float, method: Method) -> None:
    """Innovations are independent: their mean over all runs and fixes has a narrow 99 % band."""
    nis = flown(rate)[method].nis

    low, high = chi2.ppf([0.005, 0.995], 3 * nis.size) / nis.size
    assert nis.size > 14_000
    assert low < nis.mean() < high


@pytest.mark.parametrize("factor", [0.6, 1.6])
def test_wrong_noise_is_found_out(factor: float) -> None:
    """The test of NEES tells a filter whose noise is wrong by 1.6 from a right one, either way."""
    nees = flown(200.0)[constant(factor, 0.01)].nees

    assert np.sign(1.0 - factor) * standard_errors(nees, 15) > LIMIT


def test_coarser_covariance_is_as_consistent() -> None:
    """At 1 kHz, every 10 ms against every sample: NEES of fifteen states within 0.2."""
    every, coarse = flown(1000.0)[TRUE], flown(1000.0)[COARSE]

    assert coarse.nees.mean() == pytest.approx(every.nees.mean(), abs=0.2)
    assert coarse.prmse < 1.001 * every.prmse


def test_table_one_flight_with_learned_noise() -> None:
    """
    GIVEN the paper's simulated flight, and a fallback 25 times the true noise
    WHEN the noise is read off the IMU itself
    THEN NEES is in its band and PRMSE at most 1 % above that with the true figures.
    """
    known, learned = flown(1000.0)[TRUE], flown(1000.0)[LEARNED]

    assert abs(standard_errors(learned.nees, 15)) < LIMIT
    assert share_inside(learned.nees, 15) > 0.85
    assert learned.prmse < 1.01 * known.prmse


def test_covariance_stays_positive_definite_over_a_million_steps() -> None:
    """Symmetric it is by construction; an update every 200 steps, ten times sharper at the end."""
    truth = sample(quadrotor_flight(60.0), np.arange(12_001) / 200.0)
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
