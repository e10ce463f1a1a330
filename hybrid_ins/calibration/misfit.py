"""Signs that a fitted model is not that of the recording, whatever its parameters."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.calibration.derived import next_biases
from hybrid_ins.calibration.filter_pass import FilterPass, Nominal
from hybrid_ins.calibration.fit import Fit
from hybrid_ins.calibration.likelihood import LEVER
from hybrid_ins.core.update import chi_square

Array = NDArray[np.float64]

SHARE = 0.85  # of the innovations: a receiver's outliers are rarer than the rest
EXCESS = 2.5  # times the chi-square quantile of that share
BIAS = 5.0  # prior standard deviations
NOISE = 1e3  # times what the regressor reads
LONGEST_WAY = 3.0  # m, of an antenna from where it was said to be


def misfits(
    fitted: Fit, after: Sequence[FilterPass], nominal: Nominal, levels: Array | None, period: float
) -> list[str]:
    """
    Return what cannot be true of a robot whose units, axes and mount are right; empty if it fits.

    Parameters
    ----------
    fitted : Fit
    after : sequence of FilterPass
        With the fitted parameters, states kept.
    nominal : Nominal
        Means and standard deviations of the biases.
    levels : ndarray, shape (6,), optional
        Noise variances per sample that the regressor rarely exceeds.
    period : float
        Between IMU samples [s].
    """
    found = []
    squares = np.concatenate([one.nis[np.isfinite(one.nis)] for one in after])
    size = np.concatenate([np.isfinite(one.z[np.isfinite(one.nis)]).sum(axis=1) for one in after])
    expected = np.array([np.nan, *(chi_square.quantile(SHARE, m) for m in (1, 2, 3))])[size]
    ratio = float(np.quantile(squares / expected, SHARE))
    if ratio > EXCESS:
        found.append(
            f"the innovations are {ratio**0.5:.1f} times larger than the fitted model allows "
            f"({100.0 * SHARE:.0f} % quantile)"
        )
    (bias_a, _), (bias_g, _) = next_biases(after)
    for sensor, unit, away, std in (
        ("accelerometer", "m/s²", bias_a - nominal.bias_a, nominal.bias_a_std),
        ("gyroscope", "rad/s", bias_g - nominal.bias_g, nominal.bias_g_std),
    ):
        worst = int(np.argmax(np.abs(away) / std))
        if abs(away[worst]) > BIAS * std[worst]:
            found.append(
                f"the {sensor} bias is {abs(away[worst]):.2g} {unit} from the given one, "
                f"{abs(away[worst]) / std[worst]:.0f} times its standard deviation"
            )
    for sensor, name, axes in (
        ("accelerometer", "psd_a", slice(0, 3)),
        ("gyroscope", "psd_g", slice(3, 6)),
    ):
        if levels is None or name in fitted.frozen:
            continue
        times = np.exp(fitted.value(name)) / period / max(float(np.max(levels[axes])), 1e-300)
        if times > NOISE:
            found.append(f"the {sensor}'s noise would be {times:.0e} times what its readings show")
    places = zip(("forward", "left", "up"), LEVER, nominal.lever_b.tolist(), strict=True)
    for label, name, given in places:
        away_m = abs(fitted.value(name) - given)
        if away_m > LONGEST_WAY and nominal.antenna_is_given:
            found.append(f"the antenna is {away_m:.1f} m from the given place, {label}")
    if not fitted.converged:
        found.append("the fit did not converge")
    return found
