"""
What a fit says of an IMU's noise: its variance, the random walks of the biases, its background.

What recordings allow for a level is log-normal. The walk that is used is the root of its mean
square: the errors in an outage have the covariance that belongs to that, [1]_.

References
----------
.. [1] A. Gelman et al., *Bayesian Data Analysis*, 3rd ed., 2013, section 1.3 (predictions average
       over the posterior).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.calibration.findings import SIGNIFICANT, Finding, Verdict, kept_below
from hybrid_ins.calibration.fit import Fit
from hybrid_ins.calibration.likelihood import FOLLOW
from hybrid_ins.calibration.loudness import ORDINARY

Array = NDArray[np.float64]

SENSORS = (("accelerometer", "m/s²"), ("gyroscope", "rad/s"))


def noise_findings(
    fitted: Fit, period: float, levels: Array | None, values: Mapping[str, Any]
) -> list[Finding]:
    """
    Return what was found of the noise.

    Parameters
    ----------
    fitted : Fit
    period : float
        Between IMU samples [s].
    levels : ndarray, shape (6,), optional
        Variances per sample that the regressor rarely exceeds.
    values : mapping
        Checked parameters: nominal values, kept where nothing better is found.
    """
    found: list[Finding] = []
    powers = [fitted.value(name) for name in FOLLOW]
    louder = np.mean([one.noise(*powers).mean(axis=0) for one in fitted.recordings], axis=0)
    for (sensor, unit), power, factor in zip(SENSORS, FOLLOW, louder, strict=True):
        name, exponent, sigma = f"psd_{sensor[0]}", fitted.value(power), fitted.sigma(power)
        value = math.exp(fitted.value(name)) * float(factor) / period
        note = f"mean; goes with noise.model to the power of {exponent:.1f} ± {sigma:.1f}"
        note = note if exponent > SIGNIFICANT * sigma else ""
        parameter, label = f"noise.q_{sensor}", f"{sensor} noise"
        found.append(_level(fitted, name, value, note, values, parameter, label, f"({unit})²"))
    for sensor, unit in SENSORS:
        name = f"walk_{sensor[0]}"
        likeliest = math.exp(fitted.value(name))
        value = likeliest * math.exp(fitted.sigma(name) ** 2)
        note = f"root mean square; most probable {likeliest:.2g}"
        parameter, label = f"imu.{sensor}_bias_walk", f"{sensor} bias walk"
        found.append(_level(fitted, name, value, note, values, parameter, label, f"{unit}/√s"))
    if levels is not None:
        found += [
            _background(sensor, unit, level, values["noise.model"])
            for (sensor, unit), level in zip(SENSORS, levels.reshape(2, 3), strict=True)
        ]
    return found


def _level(
    fitted: Fit,
    name: str,
    value: float,
    note: str,
    values: Mapping[str, Any],
    parameter: str,
    label: str,
    unit: str,
) -> Finding:
    """Return a level whose logarithm was fitted as ``name``."""
    prior, sigma = fitted.prior[fitted.names.index(name)], fitted.sigma(name)
    verdict: Verdict = "identified"
    if sigma > 0.75 * prior.std:
        verdict, value = "not identifiable", values[parameter]
        walk = f"needs more than {fitted.recordings[0].t[-1]:.0f} s"
        note = walk if name.startswith("walk") else "smaller than the other errors"
    elif sigma > 0.35 * prior.std:
        verdict, note = "weak", "order of magnitude only"
        if abs(fitted.value(name) - prior.mean) < SIGNIFICANT * sigma:
            value, note = values[parameter], kept_below(SIGNIFICANT)
    spread = f"×/÷ {math.exp(min(sigma, 9.0)):.1f}"
    changed = {parameter: float(f"{value:.3g}")}
    return Finding(label, f"{value:.2g} {unit}", spread, verdict, note, changed)


def _background(sensor: str, unit: str, background: Array, model: str) -> Finding:
    """Return the level that the regressor rarely exceeds in motion whose noise is now known."""
    text = ", ".join(f"{level:.2g}" for level in background)
    note = f"noise.model {model} reads less for {100.0 * ORDINARY:g} % of the time"
    changed = {f"noise.background_{sensor}": [float(f"{level:.3g}") for level in background]}
    label, value = f"{sensor} background", f"[{text}] ({unit})²"
    return Finding(label, value, "", "identified", note, changed)
