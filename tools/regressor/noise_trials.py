"""
Windows to judge noise regressors by; `noise_data` makes those to train on.

Each set is a list of named trials, drawn from a seed. `validation_trials` may be looked at while a
model is chosen; the rest may not: `level_trials` and `disturbance_trials` are what the models are
to reach, `once_unseen_trials` and `fresh_trials` hold what no training window holds.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.inertial.rotations import matrix_from_quat, quat_from_rotvec, quat_multiply
from tools.regressor.noise_data import PAPER_RATE_HZ, PAPER_TRAJECTORIES, Windows, ideal_readings
from tools.regressor.noise_randomised import (
    log_uniform,
    low_pass_spectrum,
    repeat_samples,
    shaped_noise,
    shaping_grid,
)

Array = NDArray[np.float64]


class Trial(NamedTuple):
    """One named evaluation: windows whose label is the level that the estimate should show."""

    name: str
    windows: Windows


def _trial(name: str, readings: Array, level: Array) -> Trial:
    group = np.zeros(level.size, dtype=np.int64)
    return Trial(name, Windows(readings.astype(np.float32), level, group))


def _gentle_motion(rng: np.random.Generator, count: int, window: int) -> Array:
    """Return random stretches (B, N) of the paper's trajectories, any channel."""
    ideal = np.vstack([ideal_readings(name, duration_s=200.0).T for name in PAPER_TRAJECTORIES])
    channel = rng.integers(0, len(ideal), count)
    start = rng.integers(0, ideal.shape[1] - window, count)
    return np.asarray(ideal[channel[:, None], start[:, None] + np.arange(window)])


def _tumbling(rng: np.random.Generator, count: int, window: int) -> Array:
    """
    Return random channels (B, N) of a body that tumbles and is thrown about, at 100 Hz.

    Rates and accelerations are white noise through three slow poles at 0.5 to 2 Hz; the attitude is
    their integral, the readings are gravity and acceleration in the body: another road to agile
    motion than the sums of sines of the paper's and of the training's trajectories.
    """
    settle = 200
    pole = np.exp(-2.0 * np.pi * log_uniform(rng, 0.5, 2.0, count) / PAPER_RATE_HZ)[:, None]
    driven = np.zeros((3, count, 6))
    quat = quat_from_rotvec(rng.normal(0.0, 1.0, (count, 3)))
    rms = np.repeat((0.7, 2.0), 3)  # rad/s, m/s²
    gain = rms * np.sqrt(8.0 / 3.0 * (1.0 - pole) / (1.0 + pole))
    readings = np.empty((count, window, 6))
    for index in range(-settle, window):
        value = rng.standard_normal((count, 6)) * gain / (1.0 - pole)
        for stage in driven:
            stage += (1.0 - pole) * (value - stage)
            value = stage.copy()
        quat = quat_multiply(quat, quat_from_rotvec(value[:, :3] / PAPER_RATE_HZ))
        if index >= 0:
            felt = value[:, 3:] - [0.0, 0.0, 9.81]
            force = np.einsum("nji,nj->ni", matrix_from_quat(quat), felt)
            readings[:, index] = np.hstack((force, value[:, :3]))
    return np.asarray(readings[np.arange(count), :, rng.integers(0, 6, count)])


def validation_trials(seed: int, count: int = 2000, window: int = 200) -> list[Trial]:
    """Return the windows by which choices are made, at random levels."""
    rng = np.random.default_rng(seed)
    level = log_uniform(rng, 1e-6, 0.1, count)
    sigma = np.sqrt(level)[:, None]
    sample = np.arange(window)

    def white() -> Array:
        return rng.standard_normal((count, window))

    trials = [
        _trial("still", sigma * white(), level),
        _trial("tumbling", sigma * white() + _tumbling(rng, count, window), level),
    ]
    for name, before in (("quieter by 25", 5.0), ("rougher by 25", 0.2)):
        start = rng.integers(20, window - 20, (count, 1))
        envelope = np.where(sample < start, before, 1.0)
        trials.append(_trial(f"{name} before the end", sigma * envelope * white(), level))
    start = rng.integers(0, window, (count, 1))
    after = np.maximum(sample - start, 0)
    bounce = np.where(sample >= start, after * np.exp(-after / 9.0), 0.0)
    bounce += np.roll(bounce, 70, axis=1) * (sample >= 70)
    trials.append(_trial("bounces, 30 sigma", sigma * (white() + 10.0 * bounce), level))
    pitch = rng.uniform(0.13, 0.45, (count, 1)) * (1.0 + 0.02 * np.sin(0.05 * sample))
    tone = np.sin(2.0 * np.pi * np.cumsum(pitch, axis=1)) + 0.3 * np.sin(
        4.0 * np.pi * np.cumsum(pitch, axis=1)
    )
    trials.append(_trial("wavering tones, 20 sigma", sigma * (white() + 20.0 * tone), level))
    return trials


def level_trials(seed: int, count: int = 2000, window: int = 200) -> list[Trial]:
    """Return white noise of 1e-6 to 1 on the paper's trajectories, one trial for each level."""
    rng = np.random.default_rng(seed)
    trials = []
    for level in 10.0 ** np.arange(-6.0, 1.0):
        motion = _gentle_motion(rng, count, window)
        noise = rng.standard_normal((count, window)) * np.sqrt(level)
        trials.append(_trial(f"q = {level:.0e}", motion + noise, np.full(count, level)))
    return trials


def disturbance_trials(seed: int, count: int = 2000, window: int = 200) -> list[Trial]:
    """Return the named disturbances of the model cards, with q = 0.01 on the paper's motion."""
    rng = np.random.default_rng(seed)
    level = np.full(count, 0.01)
    frequency = shaping_grid(window)
    time = np.arange(window) / PAPER_RATE_HZ

    def base(spectrum: Array | None = None) -> tuple[Array, Array]:
        noise = (
            rng.standard_normal((count, window))
            if spectrum is None
            else shaped_noise(rng, np.broadcast_to(spectrum, (count, frequency.size)), window)
        )
        return _gentle_motion(rng, count, window), 0.1 * noise

    motion, noise = base()
    trials = [_trial("clean", motion + noise, level)]
    for strength in (1.0, 10.0, 100.0):
        motion, noise = base()
        pitch = rng.uniform(20.0, 200.0, (count, 1))
        tone = np.sin(2 * np.pi * (pitch * time + rng.random((count, 1))))
        trials.append(
            _trial(f"tone of {strength:g} sigma", motion + noise + 0.1 * strength * tone, level)
        )
    motion, noise = base()
    trials.append(_trial("bias of 1000", motion + noise + 1000.0, level))
    motion, noise = base()
    trials.append(_trial("30 % duplicates", repeat_samples(rng, motion + noise, 0.3), level))
    for order in (1.0, 2.0, 4.0):
        spectrum = low_pass_spectrum(frequency, np.array([0.25]), np.array([order]))
        motion, noise = base(spectrum)
        trials.append(_trial(f"low-pass at fs/4, order {order:g}", motion + noise, level))
    return trials


def once_unseen_trials(seed: int, count: int = 2000, window: int = 200) -> list[Trial]:
    """
    Return the first set kept aside, at random levels.

    Each is made by other means than `randomised_set`: filters in the time domain, other
    distributions, other manoeuvres. The first model that was scored on them failed at the knocks;
    since then training holds blows that ring (of other shape and pitch), so that this set is kept
    aside no more. `fresh_trials` is.
    """
    rng = np.random.default_rng(seed)
    level = log_uniform(rng, 1e-6, 1.0, count)
    sigma = np.sqrt(level)[:, None]
    sample = np.arange(window)

    def white(samples: int = window) -> Array:
        return rng.standard_normal((count, samples))

    def angle() -> Array:
        return 2.0 * np.pi * rng.random((count, 1))

    # Four rotors that beat against each other, with harmonics and a wobble in strength, at 400 Hz.
    rotors = np.zeros((count, window))
    base = rng.uniform(70.0, 130.0, (count, 1))
    for _ in range(4):
        speed = base * rng.normal(1.0, 0.03, (count, 1))
        for harmonic, strength in ((1, 1.0), (2, 0.5), (3, 0.2)):
            turn = 2.0 * np.pi * harmonic * speed * sample / 400.0
            rotors += strength * np.sin(turn + angle()) * (1.0 + 0.2 * white(1))
    # Decaying knocks: a suspension or landing gear at 15 Hz seen at 200 Hz.
    knocks = np.zeros((count, window))
    for _ in range(3):
        after = sample - rng.integers(0, window, (count, 1))
        ring = np.exp(-np.maximum(after, 0) / 12.0) * np.sin(2.0 * np.pi * 15.0 / 200.0 * after)
        knocks += np.where(after >= 0, ring, 0.0)
    chirp = np.sin(2.0 * np.pi * (0.05 * sample + 0.5 * 0.25 / window * sample**2) + angle())
    triangle = np.abs((sample / 70.0 + rng.random((count, 1))) % 2.0 - 1.0)
    boxcar = white(window + 2)
    boxcar = (boxcar[:, 2:] + boxcar[:, 1:-1] + boxcar[:, :-2]) / 3.0
    settled = np.where(sample < rng.integers(20, 120, (count, 1)), np.sqrt(10.0), 1.0)
    roughened = np.where(sample < rng.integers(20, 120, (count, 1)), np.sqrt(0.1), 1.0)
    heavy = rng.standard_t(5.0, (count, window)) / np.sqrt(5.0 / 3.0)
    frozen = repeat_samples(rng, white(), 0.0)
    start = rng.integers(0, window - 12, count)
    for row in range(count):
        frozen[row, start[row] : start[row] + 12] = frozen[row, start[row]]
    coarse = np.round(sigma * white() / (1.5 * sigma)) * (1.5 * sigma)
    return [
        _trial("four rotors, 10 sigma", sigma * (white() + 10.0 * rotors), level),
        _trial("knocks, 30 sigma", sigma * (white() + 30.0 * knocks), level),
        _trial("chirp, 10 sigma", sigma * (white() + 10.0 * chirp), level),
        _trial("triangle, 300 sigma", sigma * (white() + 300.0 * triangle), level),
        _trial("mean of three (plateau)", sigma * boxcar, level),
        _trial("quieter by 10 before the end", sigma * settled * white(), level),
        _trial("rougher by 10 before the end", sigma * roughened * white(), level),
        _trial("Student's t, 5 degrees", sigma * heavy, level),
        _trial("12 samples frozen", sigma * frozen, level),
        _trial("quantised at 1.5 sigma", coarse, level * (1.0 + 1.5**2 / 12.0)),
    ]


def fresh_trials(seed: int, count: int = 2000, window: int = 200) -> list[Trial]:
    """
    Return the second set kept aside, at random levels: nothing about a model is chosen by it.

    Made by other means than `randomised_set` and `once_unseen_trials`: pulses, random switching,
    resonances, recursive filters, resampling, rounding downwards.
    """
    rng = np.random.default_rng(seed)
    level = log_uniform(rng, 1e-6, 1.0, count)
    sigma = np.sqrt(level)[:, None]
    sample = np.arange(window)

    def white(samples: int = window) -> Array:
        return rng.standard_normal((count, samples))

    def recursive(drive: Array, pitch: Array, radius: float) -> Array:
        """Return drive through two poles, without the first 300 samples."""
        out = np.zeros_like(drive)
        turn = 2.0 * radius * np.cos(2.0 * np.pi * pitch)
        for k in range(2, drive.shape[1]):
            out[:, k] = drive[:, k] + turn * out[:, k - 1] - radius**2 * out[:, k - 2]
        return out[:, 300:]

    # An engine's strokes, one every 5 to 12 samples and not quite evenly.
    strokes = np.zeros((count, window))
    gap = rng.uniform(5.0, 12.0, (count, 1))
    beats = np.cumsum(gap * rng.normal(1.0, 0.04, (count, 60)), axis=1) - gap
    for beat in beats.T[:, :, None]:
        after = sample - beat
        strokes += np.where(after >= 0, np.exp(-np.maximum(after, 0.0) / 1.5), 0.0)
    # Stick and slip.
    sawtooth = (sample / rng.uniform(15.0, 60.0, (count, 1)) + rng.random((count, 1))) % 1.0
    # Gusts that come and go at random, softened over a few samples.
    gusts = np.cumsum(rng.random((count, window)) < 1.0 / 40.0, axis=1) % 2.0
    for k in range(1, window):
        gusts[:, k] = gusts[:, k - 1] + 0.4 * (gusts[:, k] - gusts[:, k - 1])
    # A mast's random sway at its resonance.
    sway = recursive(white(window + 300), rng.uniform(0.1, 0.35, count), 0.99)
    sway /= sway.std()
    # A sensor's two-pole low-pass: its gain at zero frequency is taken out.
    pitch, radius = np.full(count, 0.06), 0.7
    filtered = recursive(white(window + 300), pitch, radius)
    filtered *= 1.0 - 2.0 * radius * np.cos(2.0 * np.pi * 0.06) + radius**2
    # Motors that start within the window.
    spun = np.clip((sample - rng.integers(0, window, (count, 1))) / 20.0, 0.0, 1.0)
    spun = spun * np.sin(2.0 * np.pi * rng.uniform(0.15, 0.4, (count, 1)) * sample)
    # Readings resampled to 0.9 of their rate along straight lines: their density stays.
    source = white(round(window / 0.9) + 2)
    place = sample / 0.9
    whole = place.astype(int)
    resampled = source[:, whole] + (place - whole) * (source[:, whole + 1] - source[:, whole])
    laplace = rng.laplace(0.0, np.sqrt(0.5), (count, window))
    return [
        _trial("engine strokes, 20 sigma", sigma * (white() + 20.0 * strokes), level),
        _trial("stick and slip, 50 sigma", sigma * (white() + 50.0 * sawtooth), level),
        _trial("gusts, 20 sigma", sigma * (white() + 20.0 * gusts), level),
        _trial("swaying mast, 10 sigma", sigma * (white() + 10.0 * sway), level),
        _trial("two-pole low-pass (plateau)", sigma * filtered, level),
        _trial("motors start, 30 sigma", sigma * (white() + 30.0 * spun), level),
        _trial("resampled along lines (plateau)", sigma * resampled, 0.9 * level),
        _trial("Laplace's distribution", sigma * laplace, level),
        _trial(
            "cut off below 2 sigma",
            np.floor(white() / 2.0) * 2.0 * sigma,
            level * (1.0 + 2.0**2 / 12.0),
        ),
    ]
