"""Seeded runs: a simulated flight, what its sensors report, and the filter's error at the start."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.imu.samples import as_samples
from hybrid_ins.core.inertial.earth import curvature_scale
from hybrid_ins.core.inertial.rotations import (
    quat_from_rotvec,
    quat_multiply,
)
from hybrid_ins.core.inertial.state import B_A, B_G, DP, DV, EPS, N_ERROR, NavState
from hybrid_ins.core.update.measurements import PositionFix
from hybrid_ins.simulation.motions import Motion, quadrotor_flight
from hybrid_ins.simulation.sensors import ImuErrors, corrupt, fixes, sample, sample_times

Array = NDArray[np.float64]
START_STD = (*(0.5,) * 3, *(0.3,) * 3, 0.02, 0.02, 0.05, *(0.05,) * 3, *(0.003,) * 3)
T0_NS = 1_000_000_000


@dataclass(frozen=True)
class Scenario:
    """
    What is flown; everything random in it is drawn anew for each seed.

    Attributes
    ----------
    name : str
        For tables.
    motion : callable
        Makes the trajectory from duration [s] and seed.
    rate : float
        IMU samples per second [Hz].
    duration, scored_from : float
        Length of a run, and the time from which its errors count [s].
    fix_rate : float
        GNSS fixes per second [Hz].
    score_every : int
        Fixes from one scored epoch to the next.
    start_std : tuple of float
        Of the error that the filter starts with: position [m], velocity [m/s], misalignment [rad],
        accelerometer [m/s²] and gyroscope biases [rad/s], three each.
    errors : ImuErrors
        Its biases at the start are drawn from ``start_std`` instead.
    rough : (float, float), optional
        Range of the factor by which the noise's standard deviation rises in rough stretches
        (log-uniform, one factor a run); None: the noise is constant.
    dwell : (float, float)
        Range of the length of quiet and of rough stretches [s].
    outages : tuple of (float, float)
        Start and duration [s] without fixes.
    """

    name: str
    motion: Callable[[float, int], Motion] = quadrotor_flight
    rate: float = 200.0
    duration: float = 120.0
    scored_from: float = 20.0
    fix_rate: float = 5.0
    score_every: int = 1
    start_std: tuple[float, ...] = START_STD
    errors: ImuErrors = field(default_factory=ImuErrors)
    rough: tuple[float, float] | None = None
    dwell: tuple[float, float] = (4.0, 15.0)
    outages: tuple[tuple[float, float], ...] = ()


@dataclass(frozen=True)
class Run:
    """
    One draw of a scenario.

    Attributes
    ----------
    seed : int
        Of the draw.
    samples : ndarray of SAMPLE_DTYPE, shape (N,)
        What the IMU reports.
    q : ndarray, shape (N, 6)
        True variance of the white noise in each sample.
    fixes : tuple of PositionFix
        In order.
    start : NavState
        What the filter begins with, at the first sample.
    scored : ndarray, shape (K,)
        Indices of the samples at which errors are taken: midway between two fixes.
    lla, velocity_n, quat_xyzw, biases : ndarray, shape (K, 3), (K, 3), (K, 4), (K, 6)
        Truth there.
    bias_walk : ndarray, shape (6,)
        PSD of the biases' random walks.
    """

    seed: int
    samples: NDArray[np.void]
    q: Array
    fixes: tuple[PositionFix, ...]
    start: NavState
    scored: NDArray[np.int64]
    lla: Array
    velocity_n: Array
    quat_xyzw: Array
    biases: Array
    bias_walk: Array

    @property
    def t(self) -> Array:
        """Time of the scored epochs [s], shape (K,)."""
        return np.asarray((self.samples["t_ns"][self.scored] - T0_NS) * 1e-9)


def draw(scenario: Scenario, seed: int) -> Run:
    """Return the run that a scenario makes of a seed."""
    rng = np.random.default_rng(seed)
    start_rng, schedule_rng, imu_rng, fix_rng = rng.spawn(4)
    flight = scenario.motion(scenario.duration, seed)
    error = np.array(scenario.start_std) * start_rng.standard_normal(N_ERROR)
    errors = replace(
        scenario.errors,
        accelerometer_bias=error[B_A],
        gyroscope_bias=error[B_G],
        noise_schedule=_schedule(scenario, schedule_rng),
    )
    truth = sample(flight, sample_times(scenario.duration, scenario.rate))
    imu = corrupt(truth, errors, imu_rng)
    samples = as_samples(_stamps(imu.t), imu.specific_force, imu.angular_rate)

    gnss = fixes(sample(flight, sample_times(scenario.duration, scenario.fix_rate)[1:]), fix_rng)
    gnss = gnss.without(scenario.outages)
    covariance_n = np.diag(gnss.position_std**2)
    aiding = tuple(
        PositionFix(int(t_ns), lla, covariance_n, np.zeros(3))
        for t_ns, lla in zip(_stamps(gnss.t), gnss.lla, strict=True)
    )

    start = NavState(
        truth.lla[0] - error[DP] / curvature_scale(truth.lla[0]),
        truth.velocity_n[0] - error[DV],
        quat_multiply(quat_from_rotvec(error[EPS]), truth.quat_xyzw[0]),
        np.zeros(3),
        np.zeros(3),
        np.diag(np.square(scenario.start_std)),
    )
    step = scenario.score_every / scenario.fix_rate
    between = np.arange(scenario.scored_from, scenario.duration, step)
    scored = np.searchsorted(imu.t, between + 0.5 / scenario.fix_rate - 1e-6)
    scored = scored[scored < len(imu.t)]
    walk = [
        np.broadcast_to(w, 3)
        for w in (scenario.errors.accelerometer_bias_walk, scenario.errors.gyroscope_bias_walk)
    ]
    return Run(
        seed,
        samples,
        np.hstack((imu.accelerometer_std, imu.gyroscope_std)) ** 2,
        aiding,
        start,
        scored,
        truth.lla[scored],
        truth.velocity_n[scored],
        truth.quat_xyzw[scored],
        np.hstack((imu.accelerometer_bias, imu.gyroscope_bias))[scored],
        np.concatenate(walk) ** 2,
    )


def _schedule(scenario: Scenario, rng: np.random.Generator) -> tuple[tuple[float, float], ...]:
    """Return (time [s], factor) of the changes between quiet and rough."""
    if scenario.rough is None:
        return ()
    factor = float(np.exp(rng.uniform(*np.log(scenario.rough))))
    t, rough, changes = float(rng.uniform(0.0, scenario.dwell[1])), True, []
    while t < scenario.duration:
        changes.append((t, factor if rough else 1.0))
        t, rough = t + float(rng.uniform(*scenario.dwell)), not rough
    return tuple(changes)


def _stamps(t: Array) -> NDArray[np.int64]:
    return np.rint(t * 1e9).astype(np.int64) + T0_NS
