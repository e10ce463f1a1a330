"""The update against the textbook, and the law of the closed loop."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import least_squares
from support.analytic_motion import TEL_AVIV, difference

from hybrid_ins.core.aiding.measurements import BodyVelocity
from hybrid_ins.core.inertial.rotations import (
    left_jacobian,
    matrix_from_quat,
    quat_from_rpy,
    skew,
)
from hybrid_ins.core.inertial.state import (
    B_A,
    COVARIANCE,
    DP,
    DV,
    EPS,
    N_ERROR,
    Array,
    NavState,
    covariance,
    pack,
)
from hybrid_ins.core.update import iterated_update, kalman

SIGMA = np.repeat([1.0, 0.3, 0.02, 0.05, 0.005], 3)
seeds = st.integers(0, 2**31)


def problem(seed: int, m: int = 3) -> tuple[Array, Array, Array, Array]:
    """Return a flat state with a full covariance, z, H and a full R."""
    rng = np.random.default_rng(seed)
    mixing = rng.normal(size=(N_ERROR, N_ERROR))
    P = (mixing @ mixing.T + np.eye(N_ERROR)) * np.outer(SIGMA, SIGMA)
    state = NavState(
        TEL_AVIV + np.array([0, 0, 50.0]),
        rng.normal(0.0, 10.0, 3),
        quat_from_rpy(*rng.uniform(-1.0, 1.0, 3)),
        rng.normal(0.0, 0.05, 3),
        rng.normal(0.0, 0.005, 3),
        P,
    )
    root = rng.normal(size=(m, m))
    return (
        state.to_flat(),
        rng.normal(size=m),
        rng.normal(size=(m, N_ERROR)) / SIGMA,
        root @ root.T + 0.1 * np.eye(m),
    )


@given(seeds, st.integers(1, 6))
def test_innovation(seed: int, m: int) -> None:
    nav, z, H, R = problem(seed, m)
    P = covariance(nav)

    S, nis = kalman.innovation(nav, z, H, R)

    np.testing.assert_allclose(S, H @ P @ H.T + R, rtol=1e-12)
    assert nis == pytest.approx(z @ np.linalg.inv(H @ P @ H.T + R) @ z, rel=1e-9)


@given(seeds, st.integers(1, 6))
def test_update_is_the_textbooks(seed: int, m: int) -> None:
    """Gain, correction, and P both by Joseph's form and by (P^-1 + H' R^-1 H)^-1."""
    nav, z, H, R = problem(seed, m)
    H[:, :6] *= 1e-3  # what moves position or velocity far is another case
    before, P = nav.copy(), covariance(nav)
    gain = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
    A = np.eye(N_ERROR) - gain @ H
    unit = np.outer(SIGMA, SIGMA)

    dx, K, *_ = iterated_update.correct(nav, z, H, R)

    np.testing.assert_allclose(K / SIGMA[:, None], gain / SIGMA[:, None], rtol=1e-8, atol=1e-10)
    np.testing.assert_allclose(dx / SIGMA, gain @ z / SIGMA, rtol=1e-8, atol=1e-10)
    joseph = A @ P @ A.T + gain @ R @ gain.T
    np.testing.assert_allclose(covariance(nav) / unit, joseph / unit, rtol=1e-9, atol=1e-10)
    information = np.linalg.inv(P / unit) + (H * SIGMA).T @ np.linalg.inv(R) @ (H * SIGMA)
    np.testing.assert_allclose(
        covariance(nav) / unit, np.linalg.inv(information), rtol=1e-6, atol=1e-6
    )
    np.testing.assert_allclose(difference(nav, before) / SIGMA, dx / SIGMA, rtol=1e-6, atol=1e-6)


def test_correction_after_an_outage_is_the_likeliest_one() -> None:
    """
    GIVEN errors of position and velocity that grew out of one of attitude over a minute
    WHEN a fix is far off
    THEN state and covariance are those of a search for the likeliest error, bent as the error is
    """
    outage = np.eye(N_ERROR)
    outage[DV, EPS] = 60.0 * skew([0.3, -0.2, -9.8])
    outage[DP, EPS] = 30.0 * outage[DV, EPS]
    outage[DP, DV] = 60.0 * np.eye(3)
    P = outage @ np.diag(np.repeat([0.1, 0.05, 0.02, 0.001, 0.0005], 3) ** 2) @ outage.T
    P[DP, DP] += 0.01 * np.eye(3)
    state = NavState(
        TEL_AVIV,
        np.array([12.0, 3.0, 0.0]),
        quat_from_rpy(0.02, -0.05, 1.0),
        np.zeros(3),
        np.zeros(3),
        P,
    )
    z, H, R = np.array([-350.0, 200.0, 8.0]), np.eye(3, N_ERROR), 0.01 * np.eye(3)

    def bent(error: Array) -> Array:
        J = left_jacobian(-error[EPS])
        return np.concatenate((J @ error[DP], J @ error[DV], error[6:]))

    whiten = np.linalg.inv(np.linalg.cholesky(P))
    straight = P @ H.T @ np.linalg.solve(H @ P @ H.T + R, z)
    found = least_squares(
        lambda e: np.concatenate((whiten @ e, (z - H @ bent(e)) / 0.1)),
        straight,
        jac="3-point",
        x_scale=np.sqrt(np.diag(P)),
        xtol=1e-15,
        ftol=1e-15,
        gtol=1e-15,
    )
    turned = np.array(
        [(bent(found.x + step) - bent(found.x - step)) / 2e-6 for step in 1e-6 * np.eye(N_ERROR)]
    ).T
    turned[EPS, EPS] = left_jacobian(-found.x[EPS])  # seen from the new estimate
    measured = H @ turned
    gain = P @ measured.T @ np.linalg.inv(measured @ P @ measured.T + R)
    expected = turned @ (P - gain @ measured @ P) @ turned.T

    nav = state.to_flat()
    before = nav.copy()
    dx, *_ = iterated_update.correct(nav, z, H, R)

    np.testing.assert_allclose(difference(nav, before), dx, atol=1e-6)
    sigma = np.sqrt(np.diag(expected))
    assert np.all(np.abs(dx - bent(found.x)) < 0.02 * sigma)
    assert np.any(np.abs(straight - bent(found.x)) > 5.0 * sigma)
    root = np.linalg.inv(np.linalg.cholesky(expected))
    assert np.linalg.eigvalsh(root @ covariance(nav) @ root.T) == pytest.approx(1.0, abs=0.05)


def test_perfect_measurement_leaves_no_negative_variance() -> None:
    """Joseph's form holds where P - K H P has lost all digits."""
    nav, z, _, _ = problem(3)
    H = np.eye(3, N_ERROR)

    for _ in range(50):
        iterated_update.update(nav, 0.0 * z, H, 1e-12 * np.eye(3))

    eigenvalues = np.linalg.eigvalsh(covariance(nav) / np.outer(SIGMA, SIGMA))
    assert eigenvalues.min() > 0.0


errors = st.tuples(
    *(st.floats(-bound, bound) for bound in np.repeat([30.0, 20.0, 1.7, 1.0, 0.1], 3))
).map(np.array)


@given(seeds, errors)
def test_state_plus_error_minus_state_is_the_error(seed: int, dx: Array) -> None:
    """The law of the closed loop; misalignments up to half a turn."""
    nav = problem(seed)[0]
    before = nav.copy()

    kalman.inject(nav, dx)

    # Small differences of large coordinates: metres to a nanometre and 1e-5 of themselves.
    np.testing.assert_allclose(difference(nav, before)[:6], dx[:6], atol=1e-8)
    np.testing.assert_allclose(difference(nav, before)[6:], dx[6:], atol=1e-12)


@pytest.mark.parametrize("turn", [-0.4, 0.02, 1.2])
def test_errors_that_biases_make_turn_with_a_corrected_heading(turn: float) -> None:
    # GIVEN a vehicle that was levelled with biased accelerometers, and dead reckoned with them
    nav, seconds = problem(3)[0], 7.0
    S = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]]) / 9.8
    by_bias = np.zeros((N_ERROR, 3))

    def reckoned(heading: float) -> Array:
        C = matrix_from_quat(quat_from_rpy(0.1, -0.2, heading))
        by_bias[DP], by_bias[DV] = 0.5 * seconds**2 * C, seconds * C
        by_bias[EPS], by_bias[B_A] = S @ C, np.eye(3)
        P = by_bias @ np.diag((0.01, 0.04, 0.09)) @ by_bias.T
        return P + np.diag((4.0, 4.0, 9.0, 1.0, 1.0, 2.0, 1e-8, 1e-8, 0.25, *6 * (1e-6,)))

    pack(reckoned(0.7), nav[COVARIANCE])
    # WHEN its heading is corrected
    kalman.turn_errors(nav[COVARIANCE], turn)
    # THEN the errors are those of the same biases with the new heading: ε is true minus estimated
    np.testing.assert_allclose(covariance(nav), reckoned(0.7 - turn), atol=1e-12)


@pytest.mark.parametrize("by_iteration", [False, True])
def test_an_update_turns_the_errors_by_as_much_as_the_heading(by_iteration: bool) -> None:
    # GIVEN a fix that corrects the heading, and moves the position so far that it is bent, or not
    nav, z, H, R = problem(5)
    z *= 50.0
    if not by_iteration:
        H[:, :6] = 0.0
    packed, turned, plain = nav[COVARIANCE], nav.copy(), nav.copy()
    linear, _ = kalman.gain(packed, z, H, R)
    assert iterated_update.is_nonlinear(packed, linear, H, R) == by_iteration
    # WHEN it is fused
    dx, _, turn = iterated_update.update(turned, z, H, R)
    iterated_update.correct(plain, z, H, R)
    # THEN P is that of the correction, turned by what that has not turned
    assert abs(dx[8]) > 0.01
    assert turn == pytest.approx(dx[8] * (0.5 if by_iteration else 1.0), rel=0.05)
    kalman.turn_errors(plain[COVARIANCE], turn)
    np.testing.assert_allclose(covariance(turned), covariance(plain), rtol=1e-9, atol=1e-12)
    T = kalman.heading_turn(turn)
    assert np.abs(T @ T.T - np.eye(N_ERROR)).max() < 1e-15


def test_velocities_in_body_show_no_heading() -> None:
    """GIVEN that nobody knows the direction of a trajectory THEN no speed along it shows that."""

    def heading_std(update: Any) -> float:
        velocity_n, place_n, down = np.array([5.0, 1.0, 0.0]), [40.0, -20.0, 0.0], [0.0, 0.0, 1.0]
        by_turn = np.zeros(N_ERROR)
        by_turn[DP], by_turn[DV] = np.cross(place_n, down), np.cross(velocity_n, down)
        by_turn[EPS] = down
        P = np.diag(np.repeat([4.0, 1.0, 1e-8, 1e-8, 1e-12], 3)) + 0.16 * np.outer(by_turn, by_turn)
        quat, none = quat_from_rpy(0.0, 0.0, 0.7), np.zeros(3)
        nav = NavState(TEL_AVIV, velocity_n, quat, none, none, P).to_flat()
        for velocity_b in ([7.0, 0.0, 0.0], [3.0, 1.0, 0.0], [6.0, -1.0, 0.2]):
            reading = BodyVelocity(0, np.array(velocity_b), 0.01 * np.eye(3), none)
            update(nav, *reading.linearise(nav))
        return float(np.sqrt(covariance(nav)[8, 8]))

    assert heading_std(kalman.update_in_body) == pytest.approx(0.4, rel=1e-3)
    assert heading_std(iterated_update.update) < 0.2


def test_zero_error_changes_nothing() -> None:
    nav = problem(5)[0]
    before = nav.copy()

    kalman.inject(nav, np.zeros(N_ERROR))

    np.testing.assert_allclose(nav, before, rtol=1e-15)
