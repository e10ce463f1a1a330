"""Rotations: their laws, hand-computed examples, and an independent implementation."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from hybrid_ins.core.inertial import rotations
from hybrid_ins.core.inertial.state import Array

component = st.floats(-1.0, 1.0)
vectors = st.builds(np.array, st.tuples(component, component, component))
quaternions = (
    st.builds(np.array, st.tuples(component, component, component, component))
    .filter(lambda q: np.linalg.norm(q) > 0.1)
    .map(lambda q: q / np.linalg.norm(q))
)
half = np.sqrt(0.5)


def assert_same_rotation(q: Array, expected: Array) -> None:
    assert abs(np.sum(q * expected)) == pytest.approx(1.0, abs=1e-14)


@given(vectors, vectors)
def test_skew_is_the_cross_product(a: Array, b: Array) -> None:
    np.testing.assert_allclose(rotations.skew(a) @ b, np.cross(a, b), atol=1e-16)


@given(quaternions, quaternions, vectors)
def test_product_turns_one_after_the_other(q: Array, p: Array, v: Array) -> None:
    together = rotations.matrix_from_quat(rotations.quat_multiply(q, p))

    np.testing.assert_allclose(
        together @ v,
        rotations.matrix_from_quat(q) @ (rotations.matrix_from_quat(p) @ v),
        atol=1e-14,
    )


@given(quaternions)
def test_conjugate_is_the_inverse(q: Array) -> None:
    identity = rotations.quat_multiply(q, rotations.quat_conjugate(q))

    np.testing.assert_allclose(identity, [0, 0, 0, 1], atol=1e-15)


@given(quaternions)
def test_matrix_and_back(q: Array) -> None:
    matrix = rotations.matrix_from_quat(q)

    np.testing.assert_allclose(matrix, Rotation.from_quat(q).as_matrix(), atol=1e-14)
    again = rotations.quat_from_matrix(matrix)
    assert_same_rotation(again, q)
    assert again[3] >= 0.0


@pytest.mark.parametrize("q", [(1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (half, -half, 0, 0)])
def test_half_turns_have_a_quaternion(q: tuple[float, ...]) -> None:
    assert_same_rotation(
        rotations.quat_from_matrix(rotations.matrix_from_quat(q)), np.asarray(q, float)
    )


@given(vectors.map(lambda v: np.pi * v / np.sqrt(3.0)))
def test_rotation_vector_and_back(rotvec: Array) -> None:
    q = rotations.quat_from_rotvec(rotvec)

    assert_same_rotation(q, Rotation.from_rotvec(rotvec).as_quat())
    np.testing.assert_allclose(rotations.rotvec_from_quat(q), rotvec, atol=1e-13)


@pytest.mark.parametrize("angle", [0.0, 1e-20, 1e-13, 1e-9, 1e-4])
def test_small_rotation_vectors_keep_their_digits(angle: float) -> None:
    rotvec = angle * np.array([0.6, -0.8, 0.0])

    np.testing.assert_allclose(
        rotations.rotvec_from_quat(rotations.quat_from_rotvec(rotvec)), rotvec, rtol=1e-14
    )


@pytest.mark.parametrize(
    ("rpy", "body_axes_in_n"),
    [
        ((0.0, 0.0, 90.0), ((0, 1, 0), (-1, 0, 0), (0, 0, 1))),  # nose east
        ((0.0, 90.0, 0.0), ((0, 0, -1), (0, 1, 0), (1, 0, 0))),  # nose up
        ((90.0, 0.0, 0.0), ((1, 0, 0), (0, 0, 1), (0, -1, 0))),  # right wing down
        ((90.0, 0.0, 90.0), ((0, 1, 0), (0, 0, 1), (1, 0, 0))),
    ],
)
def test_roll_pitch_yaw_by_hand(
    rpy: tuple[float, ...], body_axes_in_n: tuple[tuple[int, ...], ...]
) -> None:
    C_nb = rotations.matrix_from_quat(rotations.quat_from_rpy(*np.radians(rpy)))

    np.testing.assert_allclose(C_nb.T, body_axes_in_n, atol=1e-15)


@given(st.floats(-3.1, 3.1), st.floats(-1.5, 1.5), st.floats(-3.1, 3.1))
def test_roll_pitch_yaw_and_back(roll: float, pitch: float, yaw: float) -> None:
    q = rotations.quat_from_rpy(roll, pitch, yaw)

    assert_same_rotation(q, Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_quat())
    np.testing.assert_allclose(rotations.rpy_from_quat(q), (roll, pitch, yaw), atol=1e-12)


@given(quaternions, quaternions, st.floats(0.0, 1.0))
def test_slerp_covers_its_share_of_the_way(first: Array, second: Array, fraction: float) -> None:
    middle = rotations.slerp(first, second, fraction)

    def angle(a: Array, b: Array) -> float:
        return float(
            np.linalg.norm(
                rotations.rotvec_from_quat(rotations.quat_multiply(rotations.quat_conjugate(a), b))
            )
        )

    way = angle(first, second)
    assert angle(first, middle) == pytest.approx(fraction * way, abs=1e-12)
    assert angle(middle, second) == pytest.approx((1.0 - fraction) * way, abs=1e-12)


def test_functions_take_any_leading_axes() -> None:
    q = Rotation.random(6, rng=0).as_quat().reshape(2, 3, 4)

    assert rotations.matrix_from_quat(q).shape == (2, 3, 3, 3)
    assert rotations.quat_from_matrix(rotations.matrix_from_quat(q)).shape == (2, 3, 4)
    assert rotations.rpy_from_quat(q).shape == (2, 3, 3)
    assert rotations.rotvec_from_quat(q).shape == (2, 3, 3)
    assert rotations.slerp(q, q, np.full((2, 3), 0.5)).shape == (2, 3, 4)


@given(vectors)
def test_left_jacobian_is_the_mean_rotation_on_the_way(v: Array) -> None:
    middles = (np.arange(1000) + 0.5) / 1000.0
    mean = Rotation.from_rotvec(middles[:, None] * v).as_matrix().mean(axis=0)

    np.testing.assert_allclose(rotations.left_jacobian(v), mean, atol=1e-6)
