"""Domain-randomised windows: white noise under motion, vibration, colour and faults of sensors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.noise import spectral as noise_spectral
from tools.regressor.noise_data import LEVEL_RANGE, RATE_RANGE_HZ, Array, Windows


@dataclass(frozen=True)
class Mix:
    """
    How often each effect appears in randomised windows.

    Attributes
    ----------
    coloured : share of windows whose noise is not white (low-passed, vibration, blue, AR). Most
        are white: a network takes steady white noise for another as often as its training does.
    moving : share with random motion; manoeuvring : share with steps, bumps, ramps or shocks.
    shaken : share with the motion of a body on rough ground, which falls to the floor of the noise.
    toned : share with one to four vibration tones.
    switching : share whose variance changes inside the window.
    outliers, duplicates, clipped, quantised : shares of these sensor faults.
    """

    coloured: float = 0.12
    moving: float = 0.6
    manoeuvring: float = 0.25
    shaken: float = 0.08
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
    stages = rng.integers(1, 3, size)[:, None]
    autoregression = ar_spectrum(frequency, pole) ** stages
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


def _shaken_rows(rng: np.random.Generator, size: int, window: int, rate_hz: Array) -> Array:
    """
    Return the motion (B, N) of bodies on rough ground, beside noise of unit variance.

    Random below 0.5 to 12 Hz, all of it or a band, with a power-law fall above. It falls by 20 to
    70 dB and meets the noise below 0.4 cycles/sample: a floor is left. What falls by less may be
    the noise of a sensor that smooths its readings.
    """
    frequency = shaping_grid(window)
    corner = np.minimum(log_uniform(rng, 0.5, 12.0, size) / rate_hz, 0.1)
    gain = log_uniform(rng, 100.0, 1e7, size)
    shallowest = 0.5 * np.log(gain) / np.log(0.4 / corner)
    order = np.maximum(shallowest, 0.8) * log_uniform(rng, 1.0, 3.0, size)
    rise = rng.choice((0.0, 2.0), size)[:, None]
    band = (frequency / np.hypot(frequency, corner[:, None])) ** rise
    spectrum = band * low_pass_spectrum(frequency, corner, order)
    return shaped_noise(rng, gain[:, None] * spectrum, window)


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
    rows = chosen(mix.shaken)
    signal[rows] += _shaken_rows(rng, rows.size, window, rate_hz[rows])
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
