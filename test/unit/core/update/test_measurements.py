"""Innovations and H of the aiding measurements, against geometry on the Earth and differences."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.analytic_motion import EARTH_RATE_E, TEL_AVIV
from support.derivatives import derivative, flat_state, swing, vectors

from hybrid_ins.core.inertial import earth
from hybrid_ins.core.inertial.rotations import matrix_from_quat
from hybrid_ins.core.inertial.state import (
    BIAS_G,
    LAST_W,
    LLA,
    QUAT,
    VELOCITY,
    Array,
)
from hybrid_ins.core.update.measurements import PositionFix, VelocityFix

LEVER_B = np.array([0.4, -0.7, -1.2])
R_FULL = np.array([[0.04, 0.01, -0.02], [0.01, 0.09, 0.03], [-0.02, 0.03, 0.25]])

states = st.builds(
    flat_state,
    vectors.map(lambda v: 100.0 * v),
    vectors,
    vectors.map(lambda v: 3.0 * v),
    lat=st.floats(-1.3, 1.3),
)


def antenna_e(nav: Array) -> Array:
    """Earth-fixed position of the antenna."""
    C_eb = earth.C_en(nav[LLA]) @ matrix_from_quat(nav[QUAT])
    return earth.lla_to_ecef(nav[LLA]) + C_eb @ LEVER_B


def antenna_velocity_n(nav: Array) -> Array:
    """Velocity of the antenna over ground, NED axes at the IMU."""
    C_nb = matrix_from_quat(nav[QUAT])
    w_ib_n = C_nb @ (nav[LAST_W] - nav[BIAS_G])
    w_ie_n = earth.C_en(nav[LLA]).T @ EARTH_RATE_E
    return nav[VELOCITY] + np.cross(w_ib_n - w_ie_n, C_nb @ LEVER_B)


def true_position(nav: Array) -> PositionFix:
    return PositionFix(0, earth.ecef_to_lla(antenna_e(nav)), R_FULL, LEVER_B)


def true_velocity(nav: Array) -> VelocityFix:
    return VelocityFix(0, antenna_velocity_n(nav), R_FULL, LEVER_B)


@given(states)
def test_true_measurement_has_no_innovation(nav: Array) -> None:
    """To the curvature of the Earth over the lever arm, and to rounding."""
    np.testing.assert_allclose(true_position(nav).linearise(nav)[0], 0.0, atol=2e-6)
    np.testing.assert_allclose(true_velocity(nav).linearise(nav)[0], 0.0, atol=1e-12)


@settings(max_examples=40)
@given(states)
@pytest.mark.parametrize("measure", [true_position, true_velocity])
def test_H_is_the_derivative_of_the_innovation(measure, nav: Array) -> None:  # type: ignore[no-untyped-def]
    """
    Of a perfect measurement, by the error of the estimate; every element.

    To the lever arm's swing at the Earth's rate, 1.05e-4 m/s per rad, which H leaves out.
    """
    H = measure(nav).linearise(nav)[1]

    expected = derivative(lambda at: measure(at).linearise(nav)[0], nav)
    np.testing.assert_allclose(H, expected, atol=1.01 * swing(LEVER_B), rtol=1e-5)


def test_antenna_by_hand() -> None:
    """Nose east, antenna 2 m ahead: it is 2 m east, and a yaw rate moves it south."""
    nav = flat_state(
        np.zeros(3), np.array([0.0, 0.0, np.pi / 2]), np.array([0.0, 0.0, 0.1]), lat=0.5
    )
    nav[BIAS_G] = 0.0
    lever_b = np.array([2.0, 0.0, 0.0])

    z, H, _ = PositionFix(0, nav[LLA].copy(), R_FULL, lever_b).linearise(nav)
    np.testing.assert_allclose(z, [0.0, -2.0, 0.0], atol=1e-12)
    # C_true = (I - [eps x]) C: with eps about down the nose is really further to the north.
    np.testing.assert_allclose(H[:, 8], [2.0, 0.0, 0.0], atol=1e-12)

    z, _, _ = VelocityFix(0, np.zeros(3), R_FULL, lever_b).linearise(nav)
    np.testing.assert_allclose(z, [0.2, 0.0, 0.0], atol=1e-3)


def test_innovation_is_measured_minus_predicted_in_metres() -> None:
    nav = flat_state(np.array([3.0, -4.0, 1.0]), np.zeros(3), np.zeros(3), lat=0.5)
    offset = np.array([3.0, -5.0, 7.0])
    lla = nav[LLA] + offset / earth.curvature_scale(nav[LLA])

    z = PositionFix(0, lla, R_FULL, np.zeros(3)).linearise(nav)[0]
    np.testing.assert_allclose(z, offset, atol=1e-8)

    z = VelocityFix(0, nav[VELOCITY] + offset, R_FULL, np.zeros(3)).linearise(nav)[0]
    np.testing.assert_allclose(z, offset, atol=1e-12)


def test_fix_across_the_date_line() -> None:
    nav = flat_state(np.zeros(3), np.zeros(3), np.zeros(3), lat=0.5)
    nav[1] = np.pi - 1e-7
    lla = np.array([0.5, -np.pi + 1e-7, 800.0])

    z = PositionFix(0, lla, R_FULL, np.zeros(3)).linearise(nav)[0]

    np.testing.assert_allclose(z, [0.0, 2e-7 * earth.curvature_scale(nav[LLA])[1], 0.0], atol=1e-8)


@pytest.mark.parametrize("kind", [PositionFix, VelocityFix])
def test_component_that_is_not_given_is_left_out(kind) -> None:  # type: ignore[no-untyped-def]
    """GIVEN no height WHEN linearised THEN two rows, and R's horizontal block, cross terms too."""
    nav = flat_state(np.zeros(3), np.zeros(3), np.zeros(3), lat=0.5)
    full = kind(0, TEL_AVIV, R_FULL, LEVER_B).linearise(nav)

    z, H, R = kind(0, np.array([*TEL_AVIV[:2], np.nan]), R_FULL, LEVER_B).linearise(nav)

    np.testing.assert_array_equal(z, full[0][:2])
    np.testing.assert_array_equal(H, full[1][:2])
    np.testing.assert_array_equal(R, R_FULL[:2, :2])
    np.testing.assert_array_equal(full[2], R_FULL)
