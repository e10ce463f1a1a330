"""Batch least squares on simulated flights: what no smoother can do better, for comparison."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.imu.samples import as_samples
from hybrid_ins.core.inertial.earth import curvature_scale
from hybrid_ins.core.inertial.rotations import matrix_from_quat
from hybrid_ins.core.inertial.state import (
    B_A,
    B_G,
    BIAS_A,
    BIAS_G,
    COVARIANCE,
    DP,
    DV,
    EPS,
    LAST_F,
    LAST_W,
    LLA,
    N_ERROR,
    N_NAV,
    PSD,
    QUAT,
    VELOCITY,
    NavState,
    covariance,
)
from hybrid_ins.core.smoothing.segments import SmootherStart, Update
from hybrid_ins.core.smoothing.smoother import Smoother
from hybrid_ins.core.smoothing.step import run_and_keep
from hybrid_ins.core.update.iterated_update import update as correct
from hybrid_ins.core.update.kalman import inject
from hybrid_ins.core.update.measurements import PositionFix
from hybrid_ins.simulation.motions import quadrotor_flight
from hybrid_ins.simulation.sensors import ImuErrors, corrupt, fixes, sample, sample_times

Array = NDArray[np.float64]

RATE = 100.0
T0_NS = 1_000_000_000
PERIOD_NS = 10_000_000
LONG_STEP_NS = 40_000_000
PSD_TRUE = np.concatenate((np.repeat([0.02**2, 0.002**2], 3) / RATE, np.repeat([1e-6, 1e-8], 3)))
STD = np.repeat((0.5, 0.3, 0.02, 0.05, 0.003), 3)


class Flight:
    """A simulated flight, and the start of a filter whose error is drawn from its covariance."""

    def __init__(
        self, seed: int, duration: float = 12.0, fix_rate: float = 5.0, std: Array = STD
    ) -> None:
        rng = np.random.default_rng(seed)
        motion = quadrotor_flight(duration, seed)
        error = std * rng.standard_normal(N_ERROR)
        self.truth = sample(motion, sample_times(duration, RATE))
        errors = ImuErrors(accelerometer_bias=error[B_A], gyroscope_bias=error[B_G])
        imu = corrupt(self.truth, errors, rng)
        t_ns = T0_NS + np.rint(imu.t * 1e9).astype(np.int64)
        self.samples = as_samples(t_ns, imu.specific_force, imu.angular_rate)
        gnss = fixes(sample(motion, sample_times(duration, fix_rate)[1:-1]), rng)
        R = np.diag(gnss.position_std**2)
        self.fixes = [
            PositionFix(T0_NS + round(t * 1e9), lla, R, np.zeros(3))
            for t, lla in zip(gnss.t, gnss.lla, strict=True)
        ]
        truth = self.truth
        self.true = [
            NavState(
                truth.lla[k],
                truth.velocity_n[k],
                truth.quat_xyzw[k],
                imu.accelerometer_bias[k],
                imu.gyroscope_bias[k],
                np.zeros((N_ERROR, N_ERROR)),
            )
            for k in range(len(truth.t))
        ]
        nav = replace(self.true[0], P=np.diag(std**2)).to_flat()
        inject(nav, -error)
        nav[BIAS_A], nav[BIAS_G] = (
            self.true[0].bias_a - error[B_A],
            self.true[0].bias_g - error[B_G],
        )
        self.start = SmootherStart(
            T0_NS, reading(self.samples[0]), NavState.from_flat(nav), PSD_TRUE
        )


def reading(sample: np.void) -> Array:
    """Return specific force and angular rate, (6,)."""
    return np.concatenate((sample["f"], sample["w"]))


def make(
    flight: Flight, updates: list[Update], samples: NDArray[np.void] | None = None
) -> tuple[Smoother, dict[int, Array], dict[int, Array]]:
    """Return a smoother of the flight, and the stores of its states and adjoints."""
    states: dict[int, Array] = {}
    adjoints: dict[int, Array] = {}
    samples = flight.samples if samples is None else samples
    smoother = Smoother(flight.start, samples, updates, 0.01 - 1e-6, LONG_STEP_NS, states, adjoints)
    return smoother, states, adjoints


def gather(smoother: Smoother) -> tuple[NDArray[np.int64], Array]:
    """Return all stamps and smoothed states."""
    smoother.run()
    t_ns, rows = map(np.concatenate, zip(*smoother.states(), strict=True))
    return t_ns, rows


def difference(of: Array, than: Array) -> Array:
    """Return the error state (15,) that leads from a flat state to another."""
    e = np.empty(N_ERROR)
    e[DP] = (of[LLA] - than[LLA]) * curvature_scale(than[LLA])
    e[DV] = of[VELOCITY] - than[VELOCITY]
    C = matrix_from_quat(of[QUAT]) @ matrix_from_quat(than[QUAT]).T
    angle = np.arccos(min(1.0, max(-1.0, 0.5 * (np.trace(C) - 1.0))))
    axis = np.array([C[2, 1] - C[1, 2], C[0, 2] - C[2, 0], C[1, 0] - C[0, 1]])
    e[EPS] = -0.5 * axis / np.sinc(angle / np.pi)
    e[B_A], e[B_G] = of[BIAS_A] - than[BIAS_A], of[BIAS_G] - than[BIAS_G]
    return e


def started(start: SmootherStart) -> Array:
    """Return the flat state at a start."""
    nav = start.state.to_flat()
    nav[LAST_F], nav[LAST_W], nav[PSD] = start.sample[:3], start.sample[3:], start.psd
    return nav


def advance(nav: Array, samples: NDArray[np.void], last_ns: int) -> Array:
    """Run a flat state over samples; return the transition matrix of its errors, (15, 15)."""
    n = len(samples)
    dt = np.diff(samples["t_ns"], prepend=last_ns) * 1e-9
    readings = np.column_stack((samples["f"], samples["w"]))
    F, lengths, at = np.empty((n, 225)), np.empty(n), np.empty(n, np.int64)
    m = run_and_keep(nav, dt, readings, 0.01 - 1e-6, np.empty((n, N_NAV)), F, lengths, at)
    phi = np.eye(N_ERROR)
    for j in range(m):
        phi = (np.eye(N_ERROR) + lengths[j] * F[j].reshape(N_ERROR, N_ERROR)) @ phi
    return phi


def batch_least_squares(flight: Flight, fused: list[PositionFix]) -> tuple[list[Array], Array]:
    """
    Solve for the states at the fixes by Gauss and Newton's method on all of them at once.

    Returns the flat states, and the covariance of all errors.
    """
    samples, n = flight.samples, len(fused) + 1
    stops = [1, *(int(np.searchsorted(samples["t_ns"], f.t_ns, side="right")) for f in fused)]
    navs = [started(flight.start)]
    for k in range(1, n):
        nav = navs[-1].copy()
        advance(nav, samples[stops[k - 1] : stops[k]], int(samples["t_ns"][stops[k - 1] - 1]))
        correct(nav, *fused[k - 1].linearise(nav))
        navs.append(nav)
    prior = np.linalg.inv(flight.start.state.P)
    for _ in range(6):
        A, b = np.zeros((n * N_ERROR, n * N_ERROR)), np.zeros(n * N_ERROR)
        own = slice(0, N_ERROR)
        A[own, own] += prior
        b[own] += prior @ difference(started(flight.start), navs[0])
        for k in range(1, n):
            one = slice((k - 1) * N_ERROR, k * N_ERROR)
            two = slice(k * N_ERROR, (k + 1) * N_ERROR)
            nav = navs[k - 1].copy()
            nav[COVARIANCE] = 0.0
            phi = advance(
                nav, samples[stops[k - 1] : stops[k]], int(samples["t_ns"][stops[k - 1] - 1])
            )
            weight = np.linalg.inv(covariance(nav))
            away = difference(nav, navs[k])  # d_k - phi d_(k-1) should be this
            A[two, two] += weight
            A[one, one] += phi.T @ weight @ phi
            A[two, one] -= weight @ phi
            A[one, two] -= phi.T @ weight
            b[two] += weight @ away
            b[one] -= phi.T @ weight @ away
            z, H, R = fused[k - 1].linearise(navs[k])
            A[two, two] += H.T @ np.linalg.solve(R, H)
            b[two] += H.T @ np.linalg.solve(R, z)
        scale = 1.0 / np.sqrt(np.diag(A))
        scaled = A * np.outer(scale, scale)
        moves = (scale * np.linalg.solve(scaled, scale * b)).reshape(n, N_ERROR)
        for nav, dx in zip(navs, moves, strict=True):
            inject(nav, dx)
    return navs, np.linalg.inv(scaled) * np.outer(scale, scale)


def mean_square(truth: list[Array], states: Sequence[Array]) -> float:
    """Return the mean square of the position errors [m²]."""
    errors = [difference(t, nav)[DP] for t, nav in zip(truth, states, strict=True)]
    return float(np.mean(np.sum(np.square(errors), axis=1)))


def compare(seed: int) -> tuple[float, float]:
    """Return the mean square position error [m²] of smoother and batch solution of a flight."""
    flight = Flight(seed)
    smoother, _, _ = make(flight, [Update(f.t_ns, PSD_TRUE, f) for f in flight.fixes])
    t_ns, rows = gather(smoother)
    at = np.searchsorted(t_ns, [T0_NS, *(f.t_ns for f in flight.fixes)])
    truth = [flight.true[int(k)].to_flat() for k in np.rint((t_ns[at] - T0_NS) / PERIOD_NS)]
    navs, _ = batch_least_squares(flight, flight.fixes)
    return mean_square(truth, rows[at]), mean_square(truth, navs)
