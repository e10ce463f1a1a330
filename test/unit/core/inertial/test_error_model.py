"""F and G against the navigation equations they linearise, element by element."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.analytic_motion import EARTH_RATE_E, difference

from hybrid_ins.core.inertial import earth, error_model
from hybrid_ins.core.inertial.rotations import (
    matrix_from_quat,
    quat_from_matrix,
    quat_from_rotvec,
    quat_from_rpy,
    skew,
)
from hybrid_ins.core.inertial.state import (
    B_A,
    B_G,
    BIAS_A,
    BIAS_G,
    DP,
    DV,
    EPS,
    LLA,
    N_ERROR,
    N_NOISE,
    QUAT,
    VELOCITY,
    W_A,
    W_AB,
    W_G,
    W_GB,
    Array,
    NavState,
)
from hybrid_ins.core.inertial.strapdown import mechanise

# Errors large enough to stand out of the rounding, small enough to be linear.
STEP = np.repeat([300.0, 1.0, 1e-4, 0.1, 0.01], 3)  # m, m/s, rad, m/s², rad/s


def state(lat: float, height: float, velocity_n: Array, rpy: Array) -> Array:
    return NavState(
        np.array([np.radians(lat), 0.6, height]),
        np.asarray(velocity_n, float),
        quat_from_rpy(*rpy),
        np.array([0.02, -0.03, 0.05]),
        np.array([0.003, 0.001, -0.002]),
        np.eye(N_ERROR),
    ).to_flat()


FAST = state(-47.0, 3000.0, (230.0, -170.0, 40.0), (0.3, -0.2, 2.0))
DYNAMIC = np.array([3.0, -2.0, -15.0, 0.4, -0.7, 0.2])

states = st.builds(
    state,
    st.floats(-80.0, 80.0),
    st.floats(-400.0, 12e3),
    st.tuples(*[st.floats(-300.0, 300.0)] * 3),
    st.tuples(*[st.floats(-1.4, 1.4)] * 3),
)
readings = st.builds(
    np.array, st.tuples(*[st.floats(-20.0, 20.0)] * 3, *[st.floats(-2.0, 2.0)] * 3)
)


def navigation_equations(nav: Array, reading: Array) -> tuple[Array, Array, Array]:
    """Time derivatives of lla, velocity_n and C_nb."""
    lla, velocity_n = nav[LLA], nav[VELOCITY]
    C_nb = matrix_from_quat(nav[QUAT])
    f_b, w_b = reading[:3] - nav[BIAS_A], reading[3:] - nav[BIAS_G]
    w_ie = earth.C_en(lla).T @ EARTH_RATE_E
    w_en = np.array(earth.transport_rate_n(lla[0], lla[2], velocity_n[0], velocity_n[1]))
    gravity_north, gravity_down = earth.normal_gravity(lla[0], lla[2])
    gravity_n = np.array([gravity_north, 0.0, gravity_down])
    return (
        velocity_n / earth.curvature_scale(lla),
        C_nb @ f_b + gravity_n - np.cross(2.0 * w_ie + w_en, velocity_n),
        C_nb @ skew(w_b) - skew(w_ie + w_en) @ C_nb,
    )


def perturbed(nav: Array, dx: Array) -> Array:
    true = nav.copy()
    true[LLA] += dx[DP] / earth.curvature_scale(nav[LLA])
    true[VELOCITY] += dx[DV]
    C_nb = matrix_from_quat(quat_from_rotvec(-dx[EPS])) @ matrix_from_quat(nav[QUAT])
    true[QUAT] = quat_from_matrix(C_nb)
    true[BIAS_A] += dx[B_A]
    true[BIAS_G] += dx[B_G]
    return true


def error_rate(nav: Array, dx: Array, reading: Array) -> Array:
    true = perturbed(nav, dx)
    lla_rate, v_rate, C_rate = navigation_equations(nav, reading)
    lla_rate_true, v_rate_true, C_rate_true = navigation_equations(true, reading)
    scale = earth.curvature_scale(nav[LLA])
    scale_rate = 0.5 * (
        earth.curvature_scale(nav[LLA] + lla_rate) - earth.curvature_scale(nav[LLA] - lla_rate)
    )
    turned = C_rate_true @ matrix_from_quat(nav[QUAT]).T + matrix_from_quat(true[QUAT]) @ C_rate.T
    rate = np.zeros(N_ERROR)
    rate[DP] = scale_rate * (true[LLA] - nav[LLA]) + scale * (lla_rate_true - lla_rate)
    rate[DV] = v_rate_true - v_rate
    rate[EPS] = -0.5 * np.array(
        [turned[2, 1] - turned[1, 2], turned[0, 2] - turned[2, 0], turned[1, 0] - turned[0, 1]]
    )
    return rate


def F_by_differences(nav: Array, reading: Array) -> Array:
    columns = [
        (error_rate(nav, step, reading) - error_rate(nav, -step, reading)) / (2.0 * size)
        for step, size in zip(np.diag(STEP), STEP, strict=True)
    ]
    return np.stack(columns, axis=1)


def system_matrix(nav: Array, reading: Array) -> Array:
    C_nb = matrix_from_quat(nav[QUAT])
    F = np.zeros((N_ERROR, N_ERROR))
    f_n = C_nb @ (reading[:3] - nav[BIAS_A])
    error_model.system_matrix(nav[LLA], nav[VELOCITY], f_n, C_nb.ravel(), F)
    return F


def tolerance(F: Array) -> Array:
    """What the differences resolve."""
    atol = np.full((N_ERROR, N_ERROR), 1e-16)
    atol[DP] = 1e-12
    atol[DV, DV] = atol[EPS, DV] = 1e-13
    atol[DV, EPS] = 2e-7
    atol[DV, B_A] = atol[EPS, B_G] = atol[EPS, EPS] = 1e-10
    return atol + 1e-5 * np.abs(F)


def left_out(nav: Array) -> Array:
    """What F leaves out on purpose: that the height terms of gravity vary with latitude."""
    (lat, _, height), d = nav[LLA], 1e-5
    north, south = (
        np.subtract(earth.normal_gravity(at, height), earth.normal_gravity(at, 0.0))
        for at in (lat + d, lat - d)
    )
    F = np.zeros((N_ERROR, N_ERROR))
    F[[3, 5], 0] = (north - south) / (2.0 * d) / earth.curvature_scale(nav[LLA])[0]
    return F


@settings(max_examples=40)
@given(states, readings)
def test_F_is_the_derivative_of_the_navigation_equations(nav: Array, reading: Array) -> None:
    F = F_by_differences(nav, reading) - left_out(nav)

    assert np.all(np.abs(system_matrix(nav, reading) - F) <= tolerance(F))


def test_differences_resolve_every_element_of_F() -> None:
    """A term of F that was missing or of wrong sign would not pass the test above."""
    F = F_by_differences(FAST, DYNAMIC) - left_out(FAST)
    written = system_matrix(FAST, DYNAMIC) != 0.0

    assert np.all(np.abs(F)[written] > 50.0 * tolerance(F)[written])


@pytest.mark.parametrize(
    "nav", [FAST, state(71.0, 9e3, (-100.0, 250.0, -20.0), (1.0, 0.5, -1.0))], ids=["-47°", "71°"]
)
def test_F_is_the_derivative_of_the_mechanisation(nav: Array) -> None:
    """Of the code that runs, over a millisecond: Phi = I + F dt to a percent of each block."""
    dt, C, f_n = 1e-3, np.empty(9), np.empty(3)

    def advanced(nav: Array) -> Array:
        after = nav.copy()
        f, w = DYNAMIC[:3] - nav[BIAS_A], DYNAMIC[3:] - nav[BIAS_G]
        mechanise(after[LLA], after[VELOCITY], after[QUAT], f, w, f, w, dt, C, f_n)
        return after

    columns = []
    for size, step in zip(STEP, np.diag(STEP), strict=True):
        up, down = (difference(advanced(perturbed(nav, s)), advanced(nav)) for s in (step, -step))
        columns.append((up - down) / (2.0 * size))
    by_difference = (np.stack(columns, axis=1) - np.eye(N_ERROR)) / dt
    F = system_matrix(nav, DYNAMIC)

    for rows in (DP, DV, EPS):
        for columns_of in (DP, DV, EPS, B_A, B_G):
            block = F[rows, columns_of]
            if np.any(block):
                np.testing.assert_allclose(
                    by_difference[rows, columns_of], block, atol=0.01 * np.abs(block).max()
                )


@settings(max_examples=40)
@given(states, readings)
def test_process_noise_is_that_of_the_readings_through_the_mechanisation(
    nav: Array, reading: Array
) -> None:
    """G is the derivative by the negative of a reading's noise; a bias wanders by its own."""
    G = np.zeros((N_ERROR, N_NOISE))
    for noise, block in ((W_A, B_A), (W_G, B_G)):
        # A reading that is too large by d is an estimated bias that is too small by d.
        G[:, noise] = -F_by_differences(nav, reading)[:, block]
    G[B_A, W_AB] = G[B_G, W_GB] = np.eye(3)
    psd, dt = np.arange(1.0, 13.0), 0.004
    expected = dt * G @ np.diag(psd) @ G.T

    q_v, q_eps, q_a, q_g = error_model.process_noise(matrix_from_quat(nav[QUAT]).ravel(), psd, dt)

    blocks = np.zeros((N_ERROR, N_ERROR))
    for block, upper in ((DV, q_v), (EPS, q_eps)):
        square = np.zeros((3, 3))
        square[np.triu_indices(3)] = upper
        blocks[block, block] = square + np.triu(square, 1).T
    blocks[B_A, B_A], blocks[B_G, B_G] = np.diag(q_a), np.diag(q_g)
    np.testing.assert_allclose(blocks, expected, atol=1e-9)
