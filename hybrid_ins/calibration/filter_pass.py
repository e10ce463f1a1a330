"""The filter over one recording for given parameters, from its initial state to its innovations."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.calibration.innovations import (
    N_SAID,
    POSITION,
    empty_states,
    innovations,
    log_likelihood,
)
from hybrid_ins.calibration.recording import Recording
from hybrid_ins.core.inertial.earth import curvature_scale, displacement, normal_gravity
from hybrid_ins.core.inertial.rotations import (
    matrix_from_quat,
    quat_from_matrix,
    quat_from_rotvec,
    quat_from_rpy,
)
from hybrid_ins.core.inertial.state import N_ERROR, PSD, SENSITIVITY, NavState
from hybrid_ins.core.sensor_errors.clock_sensitivity import initial_sensitivity

Array = NDArray[np.float64]

TAIL = 8.0  # degrees of freedom of the Student-t innovations
INTERVAL = 0.02 - 1e-6  # s between propagations of the covariance
TILT_STD = 0.1  # rad


@dataclass(frozen=True, slots=True)
class Nominal:
    """Nominal parameters: where the search starts, and the initial biases."""

    time_offset: float  # s
    lever_b: Array  # (3,) m, antenna relative to the IMU
    psd_a: float  # (m/s²)²/Hz
    psd_g: float  # (rad/s)²/Hz
    walk_a: float  # m/s²/√s
    walk_g: float  # rad/s/√s
    bias_a: Array  # (3,) m/s², b
    bias_a_std: Array  # (3,) m/s²
    bias_g: Array  # (3,) rad/s, b
    bias_g_std: Array  # (3,) rad/s
    scale_std: float = 0.0  # of the IMU's scale factors

    @property
    def antenna_is_given(self) -> bool:
        """Somebody has said where the antenna is."""
        return bool(self.lever_b.any())


class Model(NamedTuple):
    """What the filter runs with over recordings, besides their clock offsets and headings."""

    lever_b: Array  # (3,) m, antenna relative to the IMU
    psd: Array  # (12,) diagonal of Qc
    follow: tuple[float, float] = (0.0, 0.0)  # powers of the loudness on those of the IMU's noise
    position_scale: float = 1.0  # factors on the covariances of the measurements
    velocity_scale: float = 1.0
    slow_share: float = 0.0  # variance of the slow error of positions, of that they claim
    velocity_age: float = 0.0  # s, added to the stamps of velocities, besides the clock offset


@dataclass(frozen=True, eq=False)
class FilterPass:
    """The innovations of the filter over one recording."""

    z: Array  # (M, 3)
    S: Array  # (M, 3, 3)
    nis: Array  # (M,)
    states: Array  # (M, N_NAV) after each measurement, or (0, N_NAV)
    clock: Array = field(default_factory=lambda: np.empty((0, N_SAID)))  # likewise, of the clock

    @property
    def log_likelihood(self) -> Array:
        """Log-density of each innovation, shape (M,)."""
        return log_likelihood(self.z, self.S, self.nis, TAIL)


@dataclass(frozen=True, eq=False, slots=True)
class FirstState:
    """What the first fixes, and the samples around them, say of the state, but for the heading."""

    offset: float  # s, added to the stamps of fixes
    sample: int  # number of the sample that it holds at
    origin: Array  # (3,) latitude, longitude [rad], height [m]
    position: Array  # (3,) m, of the antenna from there, n
    velocity: Array  # (3,) m/s, n
    up_b: Array  # (3,) direction of the specific force, b
    up_n: Array  # (3,) likewise, n: without acceleration, upwards
    bias_a: Array  # (3,) m/s², b: nominal
    bias_g: Array  # (3,) rad/s, b: likewise
    P: Array  # (15, 15)


def first_state(recording: Recording, offset: float, nominal: Nominal) -> FirstState:
    """
    Return the state at the first fixes.

    A polynomial through them, robust to outliers, gives position, velocity and acceleration; the
    specific force that corresponds to this acceleration gives the tilt. Samples and fixes on both
    sides of the start are used.

    Parameters
    ----------
    recording : Recording
    offset : float
        Clock offset added to the stamps of fixes [s].
    nominal : Nominal
    """
    fixes = np.flatnonzero(recording.aid_kind == POSITION)
    t_fix = recording.aid_t[fixes] + offset
    first = int(np.searchsorted(recording.t, t_fix[0]))
    first = min(max(first, 0), len(recording.t) - 2)
    now = recording.t[first]
    window = fixes[: max(4, int(np.searchsorted(t_fix, now + 1.5)))]
    dt = recording.aid_t[window] + offset - now
    origin = recording.aid[window[0]].copy()
    height = recording.aid[window, 2]
    origin[2] = height[np.isfinite(height)][0] if np.any(np.isfinite(height)) else 0.0
    positions = np.nan_to_num(displacement(origin, recording.aid[window]))
    order = 2 if len(window) > 3 and np.ptp(dt) > 0.5 else 1
    design = np.vander(dt, order + 1, increasing=True)
    R0 = np.nan_to_num(recording.aid_R[window[0]], posinf=1e4)
    coefficients, weights = _robust_polynomial(design, positions, np.sqrt(np.diag(R0)))
    spread = np.linalg.pinv((design * weights[:, None]).T @ design)
    position, velocity = coefficients[0], coefficients[1]
    acceleration = 2.0 * coefficients[2] if order == 2 else np.zeros(3)
    acceleration = np.clip(acceleration, -5.0, 5.0)
    near = slice(
        int(np.searchsorted(recording.t, now - 0.5)),
        int(np.searchsorted(recording.t, now + min(max(dt[-1], 0.5), 1.5))) + 1,
    )
    force_n = acceleration - np.array([0.0, 0.0, normal_gravity(origin[0], origin[2])[1]])
    P = np.zeros((N_ERROR, N_ERROR))
    P[:3, :3] = R0 * max(spread[0, 0], 0.2) + 0.05**2 * np.eye(3)
    P[3:6, 3:6] = R0 * spread[1, 1] + 0.5**2 * np.eye(3)
    P[range(6, 15), range(6, 15)] = (
        np.concatenate((np.full(3, TILT_STD), nominal.bias_a_std, nominal.bias_g_std)) ** 2
    )
    up_b = _mean_force(recording, near, first, nominal)
    up_n = force_n / np.linalg.norm(force_n)
    biases = nominal.bias_a, nominal.bias_g
    return FirstState(offset, first, origin, position, velocity, up_b, up_n, *biases, P)


def initial_state(first: FirstState, lever_b: Array, yaw: float, yaw_std: float) -> Array:
    """
    Return the flat state at which the filter starts.

    Parameters
    ----------
    first : FirstState
    lever_b : ndarray, shape (3,)
        Antenna relative to the IMU [m].
    yaw, yaw_std : float
        Heading from north and its standard deviation [rad].
    """
    quat = _levelled(first.up_b, first.up_n, yaw)
    P = first.P.copy()
    P[8, 8] = yaw_std**2
    position = first.position - matrix_from_quat(quat) @ lever_b
    lla = first.origin + position / curvature_scale(first.origin)
    return NavState(lla, first.velocity, quat, first.bias_a, first.bias_g, P).to_flat()


def _robust_polynomial(design: Array, positions: Array, std: Array) -> tuple[Array, Array]:
    """Return coefficients (order + 1, 3) of least absolute residuals and row weights (K,)."""
    weights: Array = np.ones(len(design))
    for _ in range(20):
        root = np.sqrt(weights)[:, None]
        coefficients = np.linalg.lstsq(root * design, root * positions, rcond=None)[0]
        away = np.linalg.norm((positions - design @ coefficients) / std, axis=1)
        weights = np.asarray(1.0 / np.maximum(away, 1.5), float)
    return np.asarray(coefficients, float), weights / np.max(weights)


def _mean_force(recording: Recording, near: slice, first: int, nominal: Nominal) -> Array:
    """Return the direction of the mean specific force of ``near``, in b at sample ``first``."""
    f, w = (
        recording.samples[near, :3] - nominal.bias_a,
        recording.samples[near, 3:] - nominal.bias_g,
    )
    dt = np.diff(recording.t[near], prepend=recording.t[near][0])
    angle = np.cumsum(w * dt[:, None], axis=0)
    angle -= angle[max(first - near.start, 0)]
    C_first = matrix_from_quat(quat_from_rotvec(angle))  # b of each sample to b of sample `first`
    f_b = np.mean(np.einsum("kij,kj->ki", C_first, f), axis=0)
    return np.asarray(f_b / np.linalg.norm(f_b))


def _levelled(up_b: Array, up_n: Array, yaw: float) -> Array:
    """Return the attitude (4,) that turns ``up_b`` to ``up_n`` and has this heading."""
    roll, pitch = math.atan2(-up_b[1], -up_b[2]), math.atan2(up_b[0], math.hypot(up_b[1], up_b[2]))
    C = matrix_from_quat(quat_from_rpy(roll, pitch, yaw))
    axis = np.cross(C @ up_b, up_n)
    return quat_from_matrix(matrix_from_quat(quat_from_rotvec(axis)) @ C)


def slow_variance(recording: Recording, model: Model) -> Array:
    """Return the variance (M, 3) of the slow error: a share of what positions claim."""
    variance = np.diagonal(recording.aid_R, axis1=1, axis2=2)
    return np.where(np.isfinite(variance), model.slow_share * variance, 0.0)


def scaled_covariances(recording: Recording, model: Model) -> Array:
    """
    Return the covariances (M, 3, 3) that measurements claim, times a factor by their kind.

    A receiver may claim the whole error of its positions, slow ones included, and of its velocities
    their scatter: what is known of the one says nothing about the other.
    """
    is_position = recording.aid_kind == POSITION
    factor = np.where(is_position, model.position_scale, model.velocity_scale)
    return np.asarray(recording.aid_R * factor[:, None, None])


def run_filter(
    recording: Recording,
    first: FirstState,
    model: Model,
    noise: Array,
    yaw: float,
    yaw_std: float,
    keep_states: bool = False,
) -> FilterPass:
    """
    Run the filter over a recording.

    Parameters
    ----------
    recording : Recording
    first : FirstState
        With the clock offset, see `first_state`.
    model : Model
    noise : ndarray, shape (N, 2)
        Factors on the noise densities of accelerometer and gyroscope, at each sample, by the
        model's powers of the loudness.
    yaw, yaw_std : float
        Heading at the start, from north, and its standard deviation [rad].
    keep_states : bool
        Keep the state after each measurement, and what it says of the clock offset.
    """
    nav = initial_state(first, model.lever_b, yaw, yaw_std)
    nav[PSD] = model.psd
    nav[SENSITIVITY] = initial_sensitivity(first.velocity, np.zeros(3))
    times = recording.measured_at(first.offset, model.velocity_age)
    order = np.argsort(times, kind="stable")
    M = len(times)
    kept = M if keep_states else 0
    result = FilterPass(
        np.empty((M, 3)),
        np.empty((M, 3, 3)),
        np.empty(M),
        empty_states(kept),
        np.empty((kept, N_SAID)),
    )
    innovations(
        nav,
        recording.t[first.sample :],
        recording.samples[first.sample :],
        noise[first.sample :],
        times[order],
        recording.aid_kind[order],
        recording.aid[order],
        scaled_covariances(recording, model)[order],
        slow_variance(recording, model)[order],
        model.lever_b,
        INTERVAL,
        TAIL,
        result.z,
        result.S,
        result.nis,
        result.states,
        result.clock,
    )
    if model.velocity_age == 0.0:
        return result
    places = np.argsort(order)
    kept_places = places[:kept]
    return FilterPass(
        result.z[places],
        result.S[places],
        result.nis[places],
        result.states[kept_places],
        result.clock[kept_places],
    )
