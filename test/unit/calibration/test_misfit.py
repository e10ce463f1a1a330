"""What cannot be true of a robot whose units, axes and mount are right is named."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from hybrid_ins.calibration.filter_pass import FilterPass, Nominal
from hybrid_ins.calibration.fit import Fit
from hybrid_ins.calibration.likelihood import Prior
from hybrid_ins.calibration.misfit import misfits
from hybrid_ins.core.inertial.state import N_NAV, NavState

PERIOD = 0.01
LEVELS = np.repeat([1e-2, 1e-5], 3)
NOMINAL = Nominal(
    0.0, np.array([0.1, 0.0, 0.0]), 1e-4, 1e-7, 1e-3, 1e-4,
    np.zeros(3), np.full(3, 0.3), np.zeros(3), np.full(3, 0.01),
)  # fmt: skip
FITTED = Fit(
    ("lever_x", "lever_y", "lever_z", "psd_a", "psd_g"),
    np.array([0.5, 0.0, 0.0, math.log(1e-2 * PERIOD), math.log(1e-5 * PERIOD)]),
    np.full(5, 0.01),
    (
        *(Prior(f"lever_{axis}", 0.0, 1.0, 0.01) for axis in "xyz"),
        Prior("psd_a", 0.0, 4.0, 0.1),
        Prior("psd_g", 0.0, 4.0, 0.1),
    ),
    frozenset(), (), (), np.zeros(1), np.zeros((1, 1)), np.zeros(5), True, np.zeros((0, 5)),
)  # fmt: skip


def a_pass(size: float = 1.0, outliers: int = 0, bias_g: float = 0.0) -> FilterPass:
    """Innovations of ``size`` standard deviations, and some outliers."""
    z = size * np.random.default_rng(0).standard_normal((400, 3))
    z[:outliers] *= 100.0
    nav = NavState(
        np.zeros(3),
        np.zeros(3),
        np.array([0.0, 0.0, 0.0, 1.0]),
        np.zeros(3),
        np.array([0.0, 0.0, bias_g]),
        np.diag(np.full(15, 1e-6)),
    ).to_flat()
    states = np.tile(nav[:N_NAV], (400, 1))
    return FilterPass(z, np.tile(np.eye(3), (400, 1, 1)), np.sum(z**2, axis=1), states)


def reasons(fitted: Fit = FITTED, one: FilterPass | None = None) -> list[str]:
    return misfits(fitted, [one or a_pass()], NOMINAL, LEVELS, PERIOD)


def test_a_right_model_with_outliers_fits() -> None:
    assert reasons(one=a_pass(size=1.2, outliers=40)) == []


@pytest.mark.parametrize("known", [True, False])
def test_innovations_that_are_too_large(known: bool) -> None:
    levels = LEVELS if known else None
    [text] = misfits(FITTED, [a_pass(size=1.8)], NOMINAL, levels, PERIOD)
    assert "the innovations are 1.8 times larger than the fitted model allows" in text


def test_a_bias_far_beyond_its_spread() -> None:
    assert reasons(one=a_pass(bias_g=0.03)) == []
    [text] = reasons(one=a_pass(bias_g=-0.13))
    assert "the gyroscope bias is 0.13 rad/s from the given one, 13 times" in text


@pytest.mark.parametrize(("name", "sensor"), [("psd_a", "accelerometer"), ("psd_g", "gyroscope")])
def test_noise_that_the_readings_do_not_show(name: str, sensor: str) -> None:
    x = FITTED.x.copy()
    x[FITTED.names.index(name)] += math.log(1e5)
    [text] = reasons(replace(FITTED, x=x))
    assert f"the {sensor}'s noise would be 1e+05 times what its readings show" in text
    assert reasons(replace(FITTED, x=x, frozen=frozenset({name}))) == []


def test_an_antenna_off_the_vehicle_and_a_fit_without_end() -> None:
    x = FITTED.x.copy()
    x[1] = -3.5
    assert reasons(replace(FITTED, x=x, converged=False)) == [
        "the antenna is 3.5 m from the given place, left",
        "the fit did not converge",
    ]
    not_given = replace(NOMINAL, lever_b=np.zeros(3))
    assert not misfits(replace(FITTED, x=x), [a_pass()], not_given, LEVELS, PERIOD)
