"""WGS-84: closed forms, the defining potential, and derivatives by finite differences."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hybrid_ins.core.inertial import earth
from hybrid_ins.core.inertial.rotations import skew
from hybrid_ins.core.inertial.state import Array

LATITUDES = np.radians([-90.0, -71.5, -33.0, 0.0, 1e-3, 32.1, 45.0, 89.9, 90.0])
lla_anywhere = st.builds(
    lambda lat, lon, height: np.array([lat, lon, height]),
    st.floats(-np.pi / 2, np.pi / 2),
    st.floats(-np.pi, np.pi),
    st.floats(-10e3, 2000e3),
)


def test_radii_at_the_equator_and_the_pole() -> None:
    a, b = earth.SEMI_MAJOR_AXIS, earth.SEMI_MINOR_AXIS

    np.testing.assert_allclose(earth.radii(0.0), (b * b / a, a), rtol=1e-14)
    np.testing.assert_allclose(earth.radii(np.pi / 2), (a * a / b, a * a / b), rtol=1e-14)


def test_gravity_on_the_ellipsoid_has_the_published_values() -> None:
    latitudes = np.radians([0.0, 45.0, 90.0])

    _, down = earth.normal_gravity(latitudes, 0.0)

    np.testing.assert_allclose(down, (9.7803253359, 9.8061977695, 9.8321849379), rtol=1e-10)


def normal_potential(ecef: Array) -> Array:
    """Gravity potential of the level ellipsoid [m²/s²] in closed form (ellipsoidal harmonics)."""
    x, y, z = np.moveaxis(ecef, -1, 0)
    focus_sq = earth.SEMI_MAJOR_AXIS**2 - earth.SEMI_MINOR_AXIS**2
    focus = np.sqrt(focus_sq)
    excess = x * x + y * y + z * z - focus_sq
    u_sq = 0.5 * excess * (1.0 + np.sqrt(1.0 + 4.0 * focus_sq * z * z / excess**2))
    u = np.sqrt(u_sq)
    sin_beta_sq = z * z / u_sq

    def q(u: Array | float) -> Array | float:
        return 0.5 * ((1.0 + 3.0 * u * u / focus_sq) * np.arctan(focus / u) - 3.0 * u / focus)

    centrifugal = 0.5 * earth.EARTH_RATE**2 * (x * x + y * y)
    flattening = (
        0.5
        * (earth.EARTH_RATE * earth.SEMI_MAJOR_AXIS) ** 2
        * q(u)
        / q(earth.SEMI_MINOR_AXIS)
        * (sin_beta_sq - 1.0 / 3.0)
    )
    return earth.GM / focus * np.arctan(focus / u) + flattening + centrifugal


@pytest.mark.parametrize("height", [-400.0, 0.0, 1000.0, 9000.0, 20000.0])
@pytest.mark.parametrize("lat", np.radians([-60.0, 0.0, 32.1, 45.0, 80.0]))
def test_gravity_is_the_gradient_of_the_normal_potential(lat: float, height: float) -> None:
    """Down to 0.05 µm/s² and 0.1 µm/s² per km of height; north to 1 %."""
    here, d = np.array([lat, 0.3, height]), 200.0
    steps = d * earth.C_en(here).T
    origin_e = earth.lla_to_ecef(here)
    north, _, down = (normal_potential(origin_e + steps) - normal_potential(origin_e - steps)) / (
        2.0 * d
    )

    computed_north, computed_down = earth.normal_gravity(lat, height)

    assert computed_down == pytest.approx(down, abs=5e-8 + 1e-10 * abs(height))
    assert computed_north == pytest.approx(north, abs=1e-8 + 0.01 * abs(north))


def test_gravity_gradient() -> None:
    height, d = 3000.0, 10.0
    above, below = (np.array(earth.normal_gravity(LATITUDES, height + s)) for s in (d, -d))

    np.testing.assert_allclose(
        earth.gravity_gradient(LATITUDES, height),
        (above - below) / (2.0 * d),
        rtol=1e-6,
        atol=1e-14,
    )


def test_earth_rate_is_the_axis_of_the_earth_seen_from_n() -> None:
    for lat in LATITUDES:
        north, down = earth.earth_rate_n(lat)

        np.testing.assert_allclose(
            earth.C_en(np.array([lat, 1.0, 0.0])) @ [north, 0.0, down],
            [0, 0, earth.EARTH_RATE],
            atol=1e-20,
        )


@pytest.mark.parametrize("lla", [(0.56, 0.6, 0.0), (-1.2, 3.0, 9e3), (1.3, -2.0, -300.0)])
def test_transport_rate_turns_n_over_the_earth(lla: tuple[float, float, float]) -> None:
    """w_en is the axial vector of C_en' dC_en/dt."""
    here, velocity_n, dt = np.array(lla), np.array([210.0, -150.0, 20.0]), 1.0
    rate = velocity_n / earth.curvature_scale(here)
    turned = (
        earth.C_en(here).T
        @ (earth.C_en(here + rate * dt) - earth.C_en(here - rate * dt))
        / (2.0 * dt)
    )

    w_en = earth.transport_rate_n(here[0], here[2], velocity_n[0], velocity_n[1])

    np.testing.assert_allclose(skew(w_en), turned, rtol=1e-7, atol=1e-13)


@given(lla_anywhere)
def test_ecef_and_back(lla: Array) -> None:
    again = earth.ecef_to_lla(earth.lla_to_ecef(lla))

    # Near the poles longitude is ill-defined: compare places, not numbers.
    assert np.linalg.norm(earth.lla_to_ecef(again) - earth.lla_to_ecef(lla)) < 1e-8
    assert again[0] == pytest.approx(lla[0], abs=1e-14)
    assert again[2] == pytest.approx(lla[2], abs=1e-8)


@given(lla_anywhere)
def test_height_is_along_the_normal(lla: Array) -> None:
    ground = lla * [1.0, 1.0, 0.0]

    np.testing.assert_allclose(
        earth.lla_to_ecef(lla) - earth.lla_to_ecef(ground),
        -lla[2] * earth.C_en(lla)[:, 2],
        atol=1e-8,
    )


def test_ecef_by_hand() -> None:
    a, b = earth.SEMI_MAJOR_AXIS, earth.SEMI_MINOR_AXIS
    lla = np.array([[0.0, 0.0, 10.0], [0.0, np.pi / 2, 0.0], [np.pi / 2, 0.0, -5.0]])

    np.testing.assert_allclose(
        earth.lla_to_ecef(lla), [[a + 10.0, 0, 0], [0, a, 0], [0, 0, b - 5.0]], atol=1e-9
    )


@given(lla_anywhere)
def test_curvature_scale_is_the_derivative_of_position(lla: Array) -> None:
    d = np.array([1e-6, 1e-6, 10.0])
    frame = earth.LocalFrame(lla)
    by_difference = (frame.position(lla + np.diag(d)) - frame.position(lla - np.diag(d))) / (
        2.0 * d[:, None]
    )

    np.testing.assert_allclose(
        by_difference, np.diag(earth.curvature_scale(lla)), rtol=1e-8, atol=1e-2
    )


@given(lla_anywhere, st.tuples(*[st.floats(-50e3, 50e3)] * 3))
def test_local_frame_and_back(datum: Array, position: tuple[float, float, float]) -> None:
    frame = earth.LocalFrame(datum)

    np.testing.assert_allclose(frame.position(frame.lla(np.array(position))), position, atol=1e-7)


def test_local_frame_turns_from_n() -> None:
    datum, lla = np.array([0.56, 0.6, 10.0]), np.array([0.57, 0.62, 500.0])
    frame = earth.LocalFrame(datum)
    step = np.array([1e-3, -2e-3, 5e-4])  # m, NED at lla
    d = frame.position(lla + 1e3 * step / earth.curvature_scale(lla)) - frame.position(lla)

    np.testing.assert_allclose(d, 1e3 * frame.C_from_n(lla) @ step, atol=2e-6)


def test_a_displacement_crosses_the_date_line() -> None:
    start = np.array([-0.3, np.pi - 1e-7, 20.0])
    ends = np.array([[-0.3 + 1e-7, -np.pi + 1e-7, 25.0], [-0.3, np.pi - 2e-7, 20.0]])

    moved = earth.displacement(start, ends)

    expected = np.array([[1e-7, 2e-7, 5.0], [0.0, -1e-7, 0.0]]) * earth.curvature_scale(start)
    np.testing.assert_allclose(moved, expected, rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(earth.displacement(start, ends[0]), moved[0])
