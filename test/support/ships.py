"""
A large ship: slow roll, pitch and heave, wide turns.

References
----------
.. [1] T. Fossen, *Handbook of Marine Craft Hydrodynamics and Motion Control*, 2011, section 8.2
       (motion in waves).
"""

from __future__ import annotations

import math

import numpy as np

from hybrid_ins.ros.messages.trajectory import Array
from hybrid_ins.simulation.motions import (
    START_LLA,
    Motion,
    integral,
    motion_through,
    smoothed,
    time_grid,
    velocity_of,
)

COMPONENTS = 3  # of a wave


def ship(duration: float, seed: int, rest: float = 10.0) -> Motion:
    """Lie in waves, then sail at 5 to 10 m/s, with turns of one or two degrees a second."""
    t, rng = time_grid(duration), np.random.default_rng([seed, 5])
    speed, rate, begin = np.zeros_like(t), np.zeros_like(t), rest + 15.0
    while begin < duration:
        length = rng.uniform(20.0, 60.0)
        during = (t >= begin) & (t < begin + length)
        speed[during] = rng.uniform(5.0, 10.0)
        rate[during] = rng.choice([-1.0, 0.0, 1.0]) * rng.uniform(0.01, 0.04)
        begin += length
    speed = smoothed(speed, 30.0)
    course = rng.uniform(-np.pi, np.pi) + integral(smoothed(rate, 10.0))
    roll = _wave(t, math.radians(rng.uniform(3.0, 8.0)), rng.uniform(8.0, 15.0), rng)
    pitch = _wave(t, math.radians(rng.uniform(2.0, 3.5)), rng.uniform(8.0, 12.0), rng)
    yaw = course + _wave(t, math.radians(1.0), rng.uniform(10.0, 15.0), rng)
    heave = _wave(t, 0.4, rng.uniform(8.0, 12.0), rng)
    sway = _wave(t, 0.3, rng.uniform(8.0, 14.0), rng)
    velocity_n = velocity_of(speed, course, heave)
    velocity_n[:, 0] -= np.sin(course) * sway
    velocity_n[:, 1] += np.cos(course) * sway
    return motion_through(t, velocity_n, np.stack((roll, pitch, yaw), axis=-1), START_LLA)


def _wave(t: Array, amplitude: float, period: float, rng: np.random.Generator) -> Array:
    """Return a narrow-band wave at times (N,) [s]; its period is in seconds."""
    total = np.zeros_like(t)
    for _ in range(COMPONENTS):
        frequency, phase = rng.uniform(0.9, 1.1) / period, rng.uniform(0.0, 2.0 * np.pi)
        total += np.sin(2.0 * np.pi * frequency * t + phase) / math.sqrt(COMPONENTS)
    return np.asarray(amplitude * total)
