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

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core import earth, noise_spectral

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
    rng = np.random.default_rng(seed)
    readings, labels, groups = [], [], []
    for name in trajectories:
        ideal = ideal_readings(name, duration_s=duration_s).T
        count = ideal.shape[1] // window
        ideal = ideal[:, : count * window]
        for variance in variances:
            noisy = ideal + rng.normal(0.0, np.sqrt(variance), ideal.shape)
            readings.append(noisy.reshape(-1, window).astype(np.float32))
            labels.append(np.full(6 * count, float(variance)))
            groups.append(np.full(6 * count, PAPER_TRAJECTORIES.index(name)))
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


@dataclass(frozen=True)
class Mix:
    """
    How often each effect appears in randomised windows.

    Attributes
    ----------
    coloured : share of windows whose noise is not white (low-passed, vibration, blue, AR). Most
        are white: a network doubts steady white noise as often as its training gives it reason.
    moving : share with random motion; manoeuvring : share with steps, bumps, ramps or shocks.
    toned : share with one to four vibration tones.
    switching : share whose variance changes inside the window.
    outliers, duplicates, clipped, quantised : shares of these sensor faults.
    """

    coloured: float = 0.12
    moving: float = 0.6
    manoeuvring: float = 0.25
    toned: float = 0.25
    switching: float = 0.06
    outliers: float = 0.05
    duplicates: float = 0.07
    clipped: float = 0.04
    quantised: float = 0.12


def log_uniform(
    rng: np.random.Generator, low: float | Array, high: float | Array, size: int
) -> Array:
    """Return values (size,) between `low` and `high` whose logarithm is uniform."""
    return np.exp(rng.uniform(np.log(low), np.log(high), size))


def shaped_noise(rng: np.random.Generator, spectrum: Array, window: int) -> Array:
    """
    Return Gaussian noise rows whose two-sided PSD is `spectrum` (1 = unit-variance white).

    The noise is shaped over twice the window on the frequency grid of `shaping_grid`, and one
    window is cut from it, so that the rows do not wrap around.
    """
    length = 2 * (spectrum.shape[1] - 1)
    white = rng.standard_normal((spectrum.shape[0], length))
    shaped = np.fft.irfft(np.fft.rfft(white, axis=1) * np.sqrt(spectrum), n=length, axis=1)
    return shaped[:, :window]


def shaping_grid(window: int) -> Array:
    """Return the shaping grid [cycles/sample] for windows of this length."""
    length = 1 << int(np.ceil(np.log2(2 * window)))
    return np.arange(length // 2 + 1) / length


def low_pass_spectrum(frequency: Array, corner: Array, order: Array) -> Array:
    """Return |Butterworth|^2 rows (B, F) of unit plateau; corner [cycles/sample]."""
    return 1.0 / (1.0 + (frequency / corner[:, None]) ** (2.0 * order[:, None]))


def vibration_spectrum(frequency: Array, gain: Array, centre: Array, width: Array) -> Array:
    """Return rows (B, F): unit floor plus a Gaussian band of broadband vibration."""
    return 1.0 + gain[:, None] * np.exp(
        -0.5 * ((frequency - centre[:, None]) / width[:, None]) ** 2
    )


def blue_spectrum(frequency: Array, gain: Array, corner: Array, order: Array) -> Array:
    """Return rows (B, F): unit floor that rises above `corner` to `1 + gain`."""
    rise = (frequency / corner[:, None]) ** (2.0 * order[:, None])
    return 1.0 + gain[:, None] * rise / (1.0 + rise)


def ar_spectrum(frequency: Array, pole: Array) -> Array:
    """Return rows (B, F) of a first-order autoregression, unit plateau at zero frequency."""
    rotation = np.cos(2.0 * np.pi * frequency)
    return (1.0 - pole[:, None]) ** 2 / (1.0 - 2.0 * pole[:, None] * rotation + pole[:, None] ** 2)


def _noise_spectrum(rng: np.random.Generator, frequency: Array, size: int) -> Array:
    """Return random coloured spectra (B, F), unit plateau at the low end."""
    kind = rng.integers(0, 5, size)
    low_pass = low_pass_spectrum(
        frequency, log_uniform(rng, 0.08, 0.35, size), rng.uniform(0.8, 4.0, size)
    )
    vibration = vibration_spectrum(
        frequency,
        log_uniform(rng, 4.0, 1000.0, size),
        rng.uniform(0.12, 0.5, size),
        rng.uniform(0.01, 0.06, size),
    )
    blue = blue_spectrum(
        frequency,
        log_uniform(rng, 4.0, 1000.0, size),
        rng.uniform(0.12, 0.5, size),
        rng.uniform(1.0, 4.0, size),
    )
    pole = rng.uniform(0.3, 0.8, size) * rng.choice((-1.0, 1.0), size)
    autoregression = ar_spectrum(frequency, pole)
    # Propellers under a sensor's own low-pass: a floor, a band of vibration, a falling end.
    spectra = np.choose(
        kind[:, None], (low_pass, vibration, blue, autoregression, vibration * low_pass)
    )
    return np.asarray(spectra)


def _motion_rows(rng: np.random.Generator, size: int, window: int, rate_hz: Array) -> Array:
    """
    Return smooth motion (B, N) of about unit RMS.

    Random with a steep low-pass at 0.1 to 6 Hz; sums of three sines of 0.02 to 4 Hz; and the sine
    of such a sum, as gravity is seen from a body that swings, with all its overtones.
    """
    frequency = shaping_grid(window)
    corner = np.minimum(log_uniform(rng, 0.1, 6.0, size) / rate_hz, 0.05)
    order = rng.uniform(2.5, 6.0, size)
    motion = shaped_noise(rng, low_pass_spectrum(frequency, corner, order), window)
    motion /= np.sqrt(2.0 * corner)[:, None]
    time = np.arange(window) / rate_hz[:, None]
    sines = np.zeros_like(motion)
    for _ in range(3):
        pitch = log_uniform(rng, 0.02, 4.0, size)[:, None]
        loudness = log_uniform(rng, 0.1, 1.0, size)[:, None]
        sines += loudness * np.sin(2.0 * np.pi * (pitch * time + rng.random((size, 1))))
    swing = log_uniform(rng, 0.1, 2.0, size)[:, None]
    seen = np.sin(swing * sines + 2.0 * np.pi * rng.random((size, 1))) / swing
    return np.asarray(np.choose(rng.integers(0, 3, size)[:, None], (motion, sines, seen)))


def _manoeuvre_rows(rng: np.random.Generator, size: int, window: int) -> Array:
    """Return steps and smooth transitions, bumps, ramps and shocks (B, N) of unit height."""
    sample = np.arange(window)
    centre = rng.uniform(-0.1, 1.1, (size, 1)) * window
    width = log_uniform(rng, 0.05, 0.3 * window, size)[:, None]
    transition = 0.5 * (1.0 + np.tanh((sample - centre) / width))
    bump = np.exp(-0.5 * ((sample - centre) / (2.0 * width + 2.0)) ** 2)
    ramp = np.maximum(sample - centre, 0.0) / window
    kind = rng.integers(0, 4, size)[:, None]
    return np.asarray(np.choose(kind, (transition, bump, ramp, _shock_rows(rng, size, window))))


def _shock_rows(rng: np.random.Generator, size: int, window: int) -> Array:
    """Return one to four blows (B, N) that ring and die out, the strongest of unit height."""
    total = np.zeros((size, window))
    count = rng.integers(1, 5, size)
    for index in range(4):
        after = np.arange(window) - np.floor(rng.uniform(-0.2, 1.0, (size, 1)) * window)
        decay = log_uniform(rng, 1.0, 60.0, size)[:, None]
        pitch = log_uniform(rng, 0.005, 0.4, size)[:, None]
        angle = 2.0 * np.pi * (pitch * after + rng.random((size, 1)))
        loudness = 1.0 if index == 0 else log_uniform(rng, 0.05, 1.0, size)[:, None]
        ring = np.where(after >= 0, np.exp(-np.maximum(after, 0.0) / decay) * np.sin(angle), 0.0)
        total += (count > index)[:, None] * loudness * ring
    return total


def _tone_rows(rng: np.random.Generator, size: int, window: int, rate_hz: Array) -> Array:
    """Return one to four 20-200 Hz tones (B, N), the strongest of unit amplitude."""
    time = np.arange(window) / rate_hz[:, None]
    harmonics = rng.integers(1, 5, size)
    harmonic_comb = rng.random(size) < 0.4
    base = log_uniform(rng, 20.0, 200.0, size)
    total = np.zeros((size, window))
    for index in range(4):
        independent = log_uniform(rng, 20.0, 200.0, size)
        pitch = np.where(harmonic_comb, base * (index + 1), base if index == 0 else independent)
        # Rotors speed up and slow down a little within a window.
        drift = pitch * rng.normal(0.0, 0.01, size) * (rng.random(size) < 0.3)
        phase = (
            2.0
            * np.pi
            * (pitch[:, None] * time + 0.5 * drift[:, None] * time**2 + rng.random((size, 1)))
        )
        loudness = 1.0 if index == 0 else log_uniform(rng, 0.05, 1.0, size)[:, None]
        total += (harmonics > index)[:, None] * loudness * np.sin(phase)
    return total


def randomised_set(
    seed: int,
    count: int,
    window: int = 200,
    mix: Mix = Mix(),
    backgrounds: NDArray[np.float32] | None = None,
    background_share: float = 0.3,
) -> Windows:
    """
    Return domain-randomised windows labelled with their noise plateau at the window's end.

    Parameters
    ----------
    seed, count, window : int
        Seed; number of windows B; samples N in each.
    mix : Mix
        How often each effect appears.
    backgrounds : (M, N) array or None
        Real windows; each stands in for the synthetic motion of a share of the rows, with noise far
        above the recording's own plateau added on top.
    background_share : float
        Share of the rows that take a background.

    Notes
    -----
    Rates 100-1000 Hz, q 1e-8 to 10, all drawn log-uniformly. Duplicated rows keep the label of
    the readings before duplication, quantised ones gain LSB^2/12. Generates about 20 000 windows/s.
    """
    rng = np.random.default_rng(seed)
    rate_hz = log_uniform(rng, *RATE_RANGE_HZ, count)
    level = log_uniform(rng, *LEVEL_RANGE, count)
    frequency = shaping_grid(window)
    sample = np.arange(window)

    def chosen(share: float) -> NDArray[np.int64]:
        return np.flatnonzero(rng.random(count) < share)

    # All rows are made with unit noise and scaled by sqrt(level) at the end.
    noise = rng.standard_normal((count, window))
    rows = chosen(mix.coloured)
    noise[rows] = shaped_noise(rng, _noise_spectrum(rng, frequency, rows.size), window)

    rows = chosen(mix.switching)
    # A change so small or so late that chance explains it as well would only teach the network to
    # distrust steady noise: the samples after it must tell it by 8 nats.
    change = log_uniform(rng, 3.0, 100.0, rows.size) ** rng.choice((-1.0, 1.0), rows.size)
    ratio = np.sqrt(change)
    needed = 16.0 / (1.0 / change - 1.0 + np.log(change))
    instant = rng.uniform(0.0, 1.0, (rows.size, 1)) * (window - needed)[:, None]
    ramp = log_uniform(rng, 0.1, 0.3 * window, rows.size)[:, None]
    before = 0.5 * (1.0 - np.tanh((sample - instant) / ramp))
    envelope = ratio[:, None] ** before
    noise[rows] *= envelope / envelope[:, -1:]

    signal = np.zeros((count, window))
    rows = chosen(mix.moving)
    size = log_uniform(rng, 0.1, 1e4, rows.size)[:, None]
    signal[rows] = size * _motion_rows(rng, rows.size, window, rate_hz[rows])
    rows = chosen(mix.manoeuvring)
    size = (log_uniform(rng, 1.0, 1e4, rows.size) * rng.choice((-1, 1), rows.size))[:, None]
    signal[rows] += size * _manoeuvre_rows(rng, rows.size, window)
    rows = chosen(mix.toned)
    size = log_uniform(rng, 0.3, 300.0, rows.size)[:, None]
    signal[rows] += size * _tone_rows(rng, rows.size, window, rate_hz[rows])
    readings = (signal + noise) * np.sqrt(level)[:, None]

    if backgrounds is not None and len(backgrounds):
        rows = chosen(background_share)
        picks = backgrounds[rng.integers(0, len(backgrounds), rows.size)].astype(float)
        picks -= picks.mean(axis=1, keepdims=True)
        # The recording's own plateau counts as noise: far above it the label is honest, and tones
        # and vibration may still be stronger than the noise on top.
        resolution = 1e-6 * np.abs(picks).max(axis=1)
        own = noise_spectral.plateau(picks) + resolution**2
        level[rows] = own * log_uniform(rng, 10.0, 1e4, rows.size)
        readings[rows] = picks + noise[rows] * np.sqrt(level[rows])[:, None]

    deviation = np.sqrt(level)
    rows = chosen(mix.outliers)
    hits = rng.random((rows.size, window)) < log_uniform(rng, 0.003, 0.03, rows.size)[:, None]
    spikes = rng.standard_normal((rows.size, window)) * (deviation[rows])[:, None]
    readings[rows] += hits * spikes * log_uniform(rng, 5.0, 100.0, rows.size)[:, None]

    rows = chosen(mix.duplicates)
    readings[rows] = repeat_samples(rng, readings[rows], rng.uniform(0.02, 0.5, rows.size))

    label = level.copy()
    rows = chosen(mix.quantised)
    step = (deviation[rows] * log_uniform(rng, 0.01, 3.0, rows.size))[:, None]
    readings[rows] = np.round(readings[rows] / step) * step
    label[rows] += step[:, 0] ** 2 / 12.0

    rows = chosen(mix.clipped)
    low, high = np.quantile(readings[rows], (0.01, 0.99), axis=1)
    side = rng.random((rows.size, 1)) < 0.5
    readings[rows] = np.where(
        side,
        np.minimum(readings[rows], high[:, None]),
        np.clip(readings[rows], low[:, None], high[:, None]),
    )

    readings -= readings.mean(axis=1, keepdims=True)
    group = np.zeros(count, dtype=np.int64)
    return Windows(readings.astype(np.float32), label, group)


def repeat_samples(rng: np.random.Generator, readings: Array, share: Array | float) -> Array:
    """Return rows (B, N) in which a share of the samples repeats the sample before."""
    fresh = rng.random(readings.shape) >= np.reshape(share, (-1, 1))
    fresh[:, 0] = True
    source = np.maximum.accumulate(np.where(fresh, np.arange(readings.shape[1]), 0), axis=1)
    return np.take_along_axis(readings, source, axis=1)
