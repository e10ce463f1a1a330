"""
Labelled IMU windows for noise regressors: the paper's set and a domain-randomised one.

Everything is generated on demand from a seed, nothing is stored. A *window* is a stretch of ``N``
readings of one IMU channel; its label ``q`` is a noise level as a per-sample variance [unit^2]:

- of the paper's set (section III-B of the paper): the variance of the white noise that was added;
- of the randomised set: the low-frequency *plateau* of the noise's power spectral density, written
  as the variance of the white noise that has the same plateau, at the window's end. That is what
  integrates into velocity and attitude: velocity noise grows with PSD ``q * dt``. White noise:
  plateau = variance. Low-passed noise: above its variance. Vibration that rises with frequency:
  far below its variance. Tones, steps, manoeuvres and bias do not count as noise.

Variables
---------
B : number of windows; N : samples in a window; C : channels (6: specific force, angular rate).

References
----------
Or & Klein, "A Hybrid Model and Learning-Based Adaptive Navigation Filter", IEEE TIM 2022:
section III-B (data set) and appendix B (eq. 29-37).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.inertial import earth

Array = NDArray[np.float64]

PAPER_RATE_HZ = 100.0
PAPER_DURATION_S = 400.0
PAPER_VARIANCES: Array = np.linspace(0.001, 0.025, 15)
PAPER_TRAJECTORIES = ("stop and go", "circle", "figure eight", "helix", "weave", "agile")
RATE_RANGE_HZ = (100.0, 1000.0)
LEVEL_RANGE = (1e-8, 10.0)

START_LLA = (np.deg2rad(32.1), np.deg2rad(34.8), 0.0)
"""Where the trajectories begin: the paper's Table I."""


class Windows(NamedTuple):
    """
    Labelled windows.

    Attributes
    ----------
    readings : (B, N) array, float32
        Each row one channel's window [m/s^2 or rad/s], oldest sample first.
    variance : (B,) array
        Label: noise level as a per-sample variance [unit^2].
    group : (B,) int array
        Index of the trajectory in `PAPER_TRAJECTORIES`; 0 where there is none.
    """

    readings: NDArray[np.float32]
    variance: Array
    group: NDArray[np.int64]

    def take(self, rows: NDArray[np.int64] | NDArray[np.bool_]) -> Windows:
        """Return the chosen rows."""
        return Windows(self.readings[rows], self.variance[rows], self.group[rows])


def cramer_rao_rmse(variance: Array, window: int) -> float:
    """
    Return the least RMSE of any unbiased variance estimate from white Gaussian noise.

    Parameters
    ----------
    variance : (B,) array
        True per-sample variances; window : samples in each window.
    """
    return float(np.sqrt(np.mean(2.0 * np.square(variance) / window)))


# --- The paper's baseline trajectories -----------------------------------------------------------


def _stepwise(t: Array, edges: Sequence[float], values: Sequence[float]) -> Array:
    """Return a piecewise constant signal: ``values[i]`` from ``edges[i]`` on, repeated."""
    period = edges[-1]
    index = np.searchsorted(np.asarray(edges[:-1]), np.mod(t, period), side="right") - 1
    return np.asarray(values, dtype=float)[index]


def _motion(name: str, t: Array) -> tuple[Array, Array]:
    """
    Return Euler angle rates (N, 3) [rad/s] and NED accelerations (N, 3) [m/s^2] of a trajectory.

    The paper prints the method ("tuning vehicle angular rates and accelerations", eq. 33-34) and
    pictures of the six paths, no numbers: these six are ours, chosen to differ in what an IMU sees.
    """
    zero = np.zeros_like(t)
    turn = 2.0 * np.pi
    if name == "stop and go":
        thrust = _stepwise(t, (0, 8, 18, 26, 40), (1.5, 0.0, -1.5, 0.0))
        return np.column_stack((zero, zero, zero)), np.column_stack((thrust, zero, zero))
    if name == "circle":
        rate, speed = turn / 40.0, 10.0
        course = rate * t
        centripetal = rate * speed
        return (
            np.column_stack((zero, zero, np.full_like(t, rate))),
            np.column_stack((-centripetal * np.sin(course), centripetal * np.cos(course), zero)),
        )
    if name == "figure eight":
        rate = turn / 30.0
        return (
            np.column_stack((0.05 * np.cos(rate * t), zero, 0.6 * np.cos(rate * t))),
            np.column_stack((2.0 * np.sin(2 * rate * t), 1.5 * np.sin(rate * t), zero)),
        )
    if name == "helix":
        rate, speed = turn / 16.0, 6.0
        course = rate * t
        centripetal = rate * speed
        climb = 0.4 * np.sin(turn * t / 50.0)
        return (
            np.column_stack((zero, 0.02 * np.cos(turn * t / 50.0), np.full_like(t, rate))),
            np.column_stack((-centripetal * np.sin(course), centripetal * np.cos(course), climb)),
        )
    if name == "weave":
        sway = turn * 0.25
        return (
            np.column_stack(
                (0.4 * np.cos(sway * t), 0.1 * np.sin(0.5 * sway * t), 0.3 * np.sin(sway * t))
            ),
            np.column_stack((0.3 * np.sin(turn * t / 60), 2.5 * np.sin(sway * t), zero)),
        )
    if name == "agile":
        rates, accelerations = [], []
        for axis in range(3):
            frequencies = np.array([0.11, 0.37, 0.83, 1.7]) * (1.0 + 0.13 * axis)
            phases = turn * np.array([0.1, 0.45, 0.7, 0.25]) * (axis + 1)
            waves = np.cos(turn * frequencies * t[:, None] + phases)
            rates.append(waves @ np.array([0.05, 0.15, 0.4, 0.5]))
            accelerations.append(waves @ np.array([0.4, 1.0, 1.5, 1.0]))
        return np.column_stack(rates), np.column_stack(accelerations)
    raise ValueError(f"unknown trajectory {name!r}; choose from {', '.join(PAPER_TRAJECTORIES)}")


def _integrate(values: Array, dt: float) -> Array:
    """Return the running trapezoidal integral along the first axis, starting at zero."""
    steps = 0.5 * dt * (values[1:] + values[:-1])
    return np.concatenate((np.zeros_like(values[:1]), np.cumsum(steps, axis=0)))


def ideal_readings(
    name: str, rate_hz: float = PAPER_RATE_HZ, duration_s: float = PAPER_DURATION_S
) -> Array:
    """
    Return the noise-free IMU of one baseline trajectory.

    Parameters
    ----------
    name : str
        One of `PAPER_TRAJECTORIES`.
    rate_hz, duration_s : float
        Sampling rate [Hz] and length [s]; the paper's are 100 Hz and 400 s.

    Returns
    -------
    (N, 6) array
        Specific force [m/s^2], then angular rate [rad/s], in the body frame (FRD).

    Notes
    -----
    Paper's eq. (29)-(37): Euler angles and NED velocity and position are integrals of the chosen
    rates and accelerations; readings follow from Earth rate, transport rate and gravity.
    """
    dt = 1.0 / rate_hz
    t: Array = np.arange(round(duration_s * rate_hz), dtype=np.float64) * dt
    euler_rate, acceleration_n = _motion(name, t)
    euler = _integrate(euler_rate, dt)
    velocity_n = _integrate(acceleration_n, dt)
    height = -_integrate(velocity_n[:, 2:], dt)[:, 0]

    # The latitude changes the radii by parts in a million here: one pass of integration is enough.
    start = np.full_like(t, START_LLA[0])
    north_angle = velocity_n[:, 0] / (earth.radii(start)[0] + height)
    latitude = start + _integrate(north_angle[:, None], dt)[:, 0]
    transport_n = np.column_stack(
        earth.transport_rate_n(latitude, height, velocity_n[:, 0], velocity_n[:, 1])
    )
    earth_north, earth_down = earth.earth_rate_n(latitude)
    earth_n = np.column_stack((earth_north, np.zeros_like(t), earth_down))
    gravity_north, gravity_down = earth.normal_gravity(latitude, height)
    gravity_n = np.column_stack((gravity_north, np.zeros_like(t), gravity_down))

    roll, pitch, yaw = euler.T
    sin_r, cos_r, sin_p, cos_p = np.sin(roll), np.cos(roll), np.sin(pitch), np.cos(pitch)
    sin_y, cos_y = np.sin(yaw), np.cos(yaw)
    C_bn = np.empty((t.size, 3, 3))
    C_bn[:, 0] = np.column_stack((cos_p * cos_y, cos_p * sin_y, -sin_p))
    C_bn[:, 1] = np.column_stack(
        (
            sin_r * sin_p * cos_y - cos_r * sin_y,
            sin_r * sin_p * sin_y + cos_r * cos_y,
            sin_r * cos_p,
        )
    )
    C_bn[:, 2] = np.column_stack(
        (
            cos_r * sin_p * cos_y + sin_r * sin_y,
            cos_r * sin_p * sin_y - sin_r * cos_y,
            cos_r * cos_p,
        )
    )
    roll_rate, pitch_rate, yaw_rate = euler_rate.T
    own_rate_b = np.column_stack(
        (
            roll_rate - sin_p * yaw_rate,
            cos_r * pitch_rate + sin_r * cos_p * yaw_rate,
            -sin_r * pitch_rate + cos_r * cos_p * yaw_rate,
        )
    )
    coriolis_n = np.cross(transport_n + 2.0 * earth_n, velocity_n)
    specific_force_n = acceleration_n - gravity_n + coriolis_n
    specific_force_b = np.einsum("nij,nj->ni", C_bn, specific_force_n)
    angular_rate_b = np.einsum("nij,nj->ni", C_bn, transport_n + earth_n) + own_rate_b
    return np.hstack((specific_force_b, angular_rate_b))


def paper_set(
    seed: int,
    window: int = 200,
    variances: Array | Sequence[float] = PAPER_VARIANCES,
    trajectories: Sequence[str] = PAPER_TRAJECTORIES,
    duration_s: float = PAPER_DURATION_S,
) -> Windows:
    """
    Return the paper's data set: every trajectory and channel under every noise variance.

    Parameters
    ----------
    seed : int
        Seed of the noise.
    window : int
        Samples N in a window; windows do not overlap.
    variances : sequence of float
        Per-sample variances of the white noise; the paper's 15, or any others.
    trajectories, duration_s
        Baselines and their length [s].

    Returns
    -------
    Windows
        Six trajectories x 15 variances x 6 channels x 200 windows = 108 000 rows with the paper's
        numbers; `group` is the index in `PAPER_TRAJECTORIES`.
    """
    ideals = {
        PAPER_TRAJECTORIES.index(name): ideal_readings(name, duration_s=duration_s)
        for name in trajectories
    }
    return noisy_windows(seed, ideals, window, variances)


def noisy_windows(
    seed: int,
    ideals: Mapping[int, Array],
    window: int = 200,
    variances: Array | Sequence[float] = PAPER_VARIANCES,
) -> Windows:
    """
    Return windows of ideal readings (N, 6) under every noise variance; by the number of a group.

    Parameters
    ----------
    seed, window, variances
        See `paper_set`.
    ideals : mapping
        Readings of an ideal IMU, by the group of their windows.
    """
    rng = np.random.default_rng(seed)
    readings, labels, groups = [], [], []
    for group, table in ideals.items():
        ideal = table.T
        count = ideal.shape[1] // window
        ideal = ideal[:, : count * window]
        for variance in variances:
            noisy = ideal + rng.normal(0.0, np.sqrt(variance), ideal.shape)
            readings.append(noisy.reshape(-1, window).astype(np.float32))
            labels.append(np.full(6 * count, float(variance)))
            groups.append(np.full(6 * count, group))
    return Windows(np.concatenate(readings), np.concatenate(labels), np.concatenate(groups))


def random_split(windows: Windows, seed: int, share: float = 0.8) -> tuple[Windows, Windows]:
    """Return (train, test) by a seeded random draw of rows; the paper's share is 80:20."""
    order = np.random.default_rng(seed).permutation(len(windows.variance))
    cut = round(share * order.size)
    return windows.take(order[:cut]), windows.take(order[cut:])


def trajectory_split(windows: Windows, held_out: int) -> tuple[Windows, Windows]:
    """Return (train, test) where the test rows are those of one whole trajectory."""
    test = windows.group == held_out
    return windows.take(~test), windows.take(test)


# --- Domain-randomised windows -------------------------------------------------------------------
