"""
Monte Carlo flights whose NEES and NIS have chi-square distributions where the covariance is right.

Seeded flights of the paper's Table I (MPU-9250 noise, 5 Hz fixes). Initial error, biases and their
walks are drawn from what the filter is told.

References
----------
.. [1] Y. Bar-Shalom, X. Li, T. Kirubarajan, *Estimation with Applications to Tracking and
       Navigation*, 2001, section 5.4.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2
from scipy.stats import t as student

from hybrid_ins.core.inertial.state import Array
from hybrid_ins.simulation.sensors import ImuErrors
from tools.paper.montecarlo import Method, fly_all
from tools.paper.runs import Scenario

Q = np.repeat([0.02**2, 0.002**2], 3)  # (m/s²)², (rad/s)²: the paper's MPU-9250
BIAS_WALK = np.repeat([1e-6, 2.5e-9], 3)  # (m/s²)²/s, (rad/s)²/s
SIGMA_0 = np.repeat([0.2, 0.1, 0.015, 0.05, 0.003], 3)


@dataclass(frozen=True)
class Flights:
    """NEES (runs, epochs) of the state and of the position, NIS (runs, fixes), PRMSE [m]."""

    nees: Array
    position_nees: Array
    nis: Array
    prmse: float


def constant(factor: float, interval: float) -> Method:
    """Take ``factor`` times the true noise, with a covariance every ``interval`` [s]."""
    q = (factor * Q[0], factor * Q[3])
    return Method(f"{factor:g}, {interval:g}", "constant", q, covariance_interval=interval)


def fly(
    rate: float, duration: float, methods: Sequence[Method], runs: int
) -> dict[Method, Flights]:
    """Fly the same runs with each method."""
    scenario = Scenario(
        "Table I",
        rate=rate,
        duration=duration,
        scored_from=10.0,
        score_every=2,
        start_std=tuple(SIGMA_0),
        errors=ImuErrors(gyroscope_bias_walk=5e-5),
    )
    flown = [flights for _, flights in fly_all(scenario, methods, range(runs))]
    return {
        method: Flights(
            np.array([f.nees for f in flights]),
            np.array([f.position_nees for f in flights]),
            np.array([f.nis for f in flights]),
            float(np.sqrt(np.mean([f.prmse**2 for f in flights]))),
        )
        for method, flights in zip(methods, zip(*flown, strict=True), strict=True)
    }


def share_inside(nees: Array, dof: int) -> float:
    """Share of epochs whose average over the runs lies in its 95 % band; [1]_ eq. 5.4.2-4."""
    runs = len(nees)
    low, high = chi2.ppf([0.025, 0.975], dof * runs) / runs
    average = nees.mean(axis=0)
    return float(np.mean((low < average) & (average < high)))


def standard_errors(nees: Array, dof: int) -> float:
    """By how many standard errors the mean is off; only the epochs of a run are dependent."""
    means = nees.mean(axis=1)
    return float((means.mean() - dof) / (means.std(ddof=1) / np.sqrt(len(nees))))


def limit(runs: int, confidence: float = 0.95) -> float:
    """Standard errors that the mean of so many runs stays within, two-sided."""
    return float(student.ppf(0.5 + 0.5 * confidence, runs - 1))


def is_consistent(flights: Flights, most: float) -> bool:
    """Whether NEES of all fifteen states and of the position have their mean and their spread."""
    return all(
        abs(standard_errors(nees, dof)) < most and share_inside(nees, dof) > 0.85
        for nees, dof in ((flights.nees, 15), (flights.position_nees, 3))
    )


def nis_is_consistent(flights: Flights) -> bool:
    """Whether the mean NIS lies in its 99 % band: innovations are independent."""
    nis = flights.nis
    low, high = chi2.ppf([0.005, 0.995], 3 * nis.size) / nis.size
    return bool(low < nis.mean() < high)
