"""The non-holonomic constraint: its Jacobian, its evidence, and its nose."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.derivatives import derivative, flat_state, swing, vectors

from hybrid_ins.core.constraints.constraint_observer import ConstraintObserver, ConstraintSettings
from hybrid_ins.core.constraints.nonholonomic import NonHolonomic, Nose, point_velocity
from hybrid_ins.core.inertial.rotations import matrix_from_quat, quat_from_rpy
from hybrid_ins.core.inertial.state import (
    ACCELERATION,
    BIAS_G,
    DV,
    EPS,
    LAST_W,
    N_ERROR,
    QUAT,
    VELOCITY,
    Array,
)
from hybrid_ins.core.sensor_errors.scale_sensitivity import N_SCALE
from hybrid_ins.core.update.kalman import inject

POINT_B = np.array([-1.2, 0.3, 0.5])
INTERVAL = 0.5


@settings(max_examples=40, deadline=None)
@given(vectors, vectors, vectors, st.floats(-0.5, 0.5), st.floats(-0.3, 0.3))
def test_H_is_the_derivative_of_the_innovation(
    velocity: Array, rpy: Array, rate: Array, yaw: float, pitch: float
) -> None:
    """By every element of the error, to the swing of the point at the Earth's rate."""
    nav = flat_state(20.0 * velocity, rpy, rate)
    constraint = NonHolonomic(0, rate, Nose(yaw, pitch, POINT_B), np.eye(2))
    H = constraint.linearise(nav)[1]

    expected = -derivative(lambda at: constraint.linearise(at)[0], nav)
    np.testing.assert_allclose(H, expected, atol=1.01 * swing(POINT_B), rtol=1e-5)


@given(st.floats(-3.0, 3.0), st.floats(-1.0, 1.0))
def test_axes_are_across_the_nose_and_right_handed(yaw: float, pitch: float) -> None:
    nose = Nose(yaw, pitch, np.zeros(3))

    C = np.vstack((nose.forward, nose.axes))

    np.testing.assert_allclose(C @ C.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(C) == pytest.approx(1.0)
    np.testing.assert_allclose(C.T, matrix_from_quat(quat_from_rpy(0.0, pitch, yaw)), atol=1e-12)


def test_by_hand() -> None:
    """Nose north, 10 m/s towards 0.1 rad east of it; the axle 2 m behind swings in a turn."""
    nav = flat_state(
        10.0 * np.array([np.cos(0.1), np.sin(0.1), 0.0]), np.zeros(3), np.array([0.0, 0.0, 0.3])
    )
    nav[BIAS_G] = 0.0
    nose = Nose(0.0, 0.0, np.array([-2.0, 0.0, 0.0]))

    z, H, _ = NonHolonomic(0, nav[LAST_W], nose, np.eye(2)).linearise(nav)

    np.testing.assert_allclose(z, [-(10.0 * np.sin(0.1) - 0.6), 0.0], atol=1e-3)
    # C_true = (I - [eps x]) C: with eps_D > 0 the nose is really further left, the velocity right.
    assert H[0, EPS][2] == pytest.approx(10.0 * np.cos(0.1))


def car(observer: ConstraintObserver, seconds: float, seed: int, **motion: float) -> None:
    """Show an observer a drive with turns, at 8 to 12 m/s."""
    yaw, pitch, along = (motion.get(name, 0.0) for name in ("yaw", "pitch", "along"))
    rng = np.random.default_rng(seed)
    nose = Nose(yaw, pitch, np.array([along, 0.0, 0.0]))
    for k in range(int(seconds / INTERVAL)):
        t = INTERVAL * k
        rate = np.array([0.0, 0.0, 0.5 * np.sin(0.4 * t)])
        speed = 10.0 + 2.0 * np.sin(0.13 * t)
        slip = motion.get("slip", 0.05) * rng.standard_normal(2)
        if motion.get("free"):
            slip += motion["free"] * np.array([np.sin(0.5 * t), np.cos(0.31 * t)])
        point_velocity_b = speed * nose.forward + slip @ nose.axes
        velocity_b = point_velocity_b - np.cross(rate, nose.point_b)
        nav = flat_state(velocity_b, np.zeros(3), rate, std=motion.get("std", 0.01))
        nav[BIAS_G] = 0.0
        nav[ACCELERATION] = 2.0 * nose.forward * np.sin(0.2 * t)
        nav[VELOCITY] += speed * motion.get("squat", 0.0) * 2.0 * np.sin(0.2 * t) * nose.axes[1]
        variance = motion.get("answer", 0.0) ** 2
        answer = variance * np.eye(2) if variance else None
        observer.observe(nav, rate, INTERVAL, fused=False, answer=answer)


def test_scale_errors_move_state_and_nose_together() -> None:
    """
    GIVEN a state whose attitude and velocity two scale errors put off, as much for minutes
    WHEN the nose has been learned from it
    THEN what they do to the constraint through the nose cancels what they do through the state.
    """
    rng = np.random.default_rng(3)
    by_scale = np.zeros((N_ERROR, N_SCALE))
    by_scale[EPS, :2] = 0.005 * rng.standard_normal((3, 2))
    by_scale[DV, :2] = 0.01 * rng.standard_normal((3, 2))
    m = np.zeros(N_SCALE)
    m[:2] = 1.0, -2.0
    right, wrong = new_observer(), new_observer()
    for k in range(240):
        rate = np.array([0.0, 0.0, 0.4 * np.sin(0.2 * k)])
        velocity = np.array([10.0 + np.sin(0.05 * k), 0.0, 0.0])
        nav = flat_state(velocity, np.zeros(3), rate, std=0.02)
        nav[ACCELERATION] = [np.sin(0.1 * k), 0.0, 0.0]
        off = nav.copy()
        inject(off, -by_scale @ m)
        right.observe(nav, rate, INTERVAL, fused=False)
        wrong.observe(off, rate, INTERVAL, fused=False, by_scale=by_scale)

    exact, found = (
        observer.measurement(0, at, rate, INTERVAL, np.eye(2))
        for observer, at in ((right, nav), (wrong, off))
    )
    (expected, _, _), (z, H, _) = exact.linearise(nav), found.linearise(off)
    through_state, through_nose = H @ by_scale @ m, found.by_scale @ m
    assert np.all(np.abs(through_state) > 0.02)
    assert np.all(np.abs(through_state + through_nose) < 0.1 * np.abs(through_state))
    np.testing.assert_allclose(z - expected, through_state + through_nose, atol=1e-3)


def new_observer(assumed: bool = False) -> ConstraintObserver:
    nominal = Nose(0.0, 0.0, np.zeros(3))
    return ConstraintObserver(ConstraintSettings(nominal, 0.05, 1.5, np.full(2, 0.1), assumed))


@pytest.mark.parametrize("seed", [2, 4, 6])
def test_nose_and_axle_are_found_from_the_motion(seed: int) -> None:
    observer = new_observer()

    car(observer, 180.0, seed, yaw=0.04, pitch=-0.03, along=-1.2)

    assert observer.holds
    found = np.array([observer.nose.yaw, observer.nose.pitch, observer.nose.point_b[0]])
    error = found - [0.04, -0.03, -1.2]
    assert np.all(np.abs(error) < 3.0 * observer.sigma[:3] + [0.002, 0.002, 0.02])
    assert np.all(observer.sigma[:3] < [0.006, 0.006, 0.15])
    assert np.all(np.abs(error) < [0.005, 0.005, 0.1])


@pytest.mark.parametrize("squat", [-0.002, 0.0, 0.004])
def test_squat_is_found_and_taken_out_of_the_constraint(squat: float) -> None:
    """
    GIVEN a body that pitches up by ``squat`` times its acceleration
    WHEN it has sped up and braked for three minutes
    THEN that is found, and the constraint expects the velocity to point that much below the nose.
    """
    observer = new_observer()

    car(observer, 180.0, 2, squat=squat)

    assert observer.nose.squat == pytest.approx(squat, abs=3.0 * float(observer.sigma[3]))
    assert observer.nose.squat == pytest.approx(squat, abs=0.0015)
    assert observer.sigma[3] < 0.003
    nav = flat_state(np.array([10.0, 0.0, 30.0 * squat]), np.zeros(3), np.zeros(3))
    nav[BIAS_G] = 0.0
    nav[ACCELERATION] = [3.0, 0.0, 0.0]
    z = [float(observer.measurement(0, nav, np.zeros(3), INTERVAL, np.eye(2)).linearise(nav)[0][1])]
    nav[ACCELERATION] = 0.0
    z.append(
        float(observer.measurement(0, nav, np.zeros(3), INTERVAL, np.eye(2)).linearise(nav)[0][1])
    )
    assert z[0] - z[1] == pytest.approx(30.0 * observer.nose.squat, rel=0.02, abs=1e-6)


def test_the_derivative_by_the_nose_is_that_of_the_innovation() -> None:
    """By yaw, pitch, place along the nose and squat, in a turn in which the vehicle speeds up."""
    nav = flat_state(np.array([9.0, 0.1, -0.4]), np.array([0.02, 0.03, 0.02]), np.zeros(3))
    nav[ACCELERATION] = [2.5, 1.0, 0.1]
    rate = np.array([0.02, -0.03, 0.4])
    nose = Nose(0.03, -0.02, POINT_B, 0.003)
    settings_ = ConstraintSettings(nose, 0.05, 1.5, np.full(2, 0.1), True)
    z, J, *_ = ConstraintObserver(settings_)._innovation(nav, rate)

    step = 1e-6
    for i, moved in enumerate(
        (
            replace(nose, yaw=nose.yaw + step),
            replace(nose, pitch=nose.pitch + step),
            replace(nose, point_b=POINT_B + step * nose.squatting(nav).forward),
            replace(nose, squat=nose.squat + step),
        )
    ):
        at = ConstraintObserver(replace(settings_, nose=moved))._innovation(nav, rate)[0]
        # z = -E v, and what an error of the nose adds to z has to be taken off it.
        np.testing.assert_allclose((at - z) / step, -J[:, i], atol=5e-2, rtol=1e-2)


def test_the_speed_is_not_read_off_the_squat() -> None:
    """An error of the squat lasts: a speed found by it would be wrong by its share, and sure."""
    nose = Nose(0.03, -0.02, POINT_B, 0.01)
    nav = flat_state(np.array([9.0, 0.1, -0.4]), np.zeros(3), np.zeros(3))
    nav[ACCELERATION] = [3.0, 0.0, 0.0]

    z, H, _ = NonHolonomic(0, np.zeros(3), nose, np.eye(2)).linearise(nav)
    level, same, _ = NonHolonomic(0, np.zeros(3), replace(nose, squat=0.0), np.eye(2)).linearise(
        nav
    )

    assert abs(z[1] - level[1]) == pytest.approx(0.03 * 9.0, rel=0.05)
    np.testing.assert_array_equal(H, same)
    C_bn = matrix_from_quat(nav[QUAT]).T
    np.testing.assert_allclose(H[:, DV] @ C_bn.T @ nose.forward, 0.0, atol=1e-12)


@pytest.mark.parametrize("lasting", [0.0, 0.01])
def test_the_speed_is_not_read_off_the_swing_on_the_springs(lasting: float) -> None:
    """
    GIVEN a body that pitches by 0.5° at 1 Hz, at 16 m/s, about a nose that may be wrong
    WHEN it is constrained for half a minute
    THEN no swing tells the speed along the path: z is the same angle, and would tell zero.
    A path that is off for long does not turn the axes.
    """
    observer, interval, along = new_observer(), 0.5, []
    for k in range(60):
        pitch = 0.009 * np.sin(2.0 * np.pi * 1.1 * interval * k)
        path = 16.0 * np.array([1.0, 0.0, lasting])
        nav = flat_state(path, np.array([0.0, pitch, 0.0]), np.zeros(3), std=0.01)
        nav[ACCELERATION] = nav[BIAS_G] = 0.0
        observer.observe(nav, np.zeros(3), interval, fused=True)
        constraint = observer.measurement(0, nav, np.zeros(3), interval, np.eye(2))
        H = constraint.linearise(nav)[1][1, DV]
        along.append(H @ [1.0, 0.0, 0.0])

    np.testing.assert_allclose(along[20:], 0.0, atol=2e-3)


@pytest.mark.parametrize("answer", [0.02, 0.05, 0.15])
def test_how_far_a_model_of_slip_is_off_is_found(answer: float) -> None:
    """GIVEN slip of 0.05 m/s and a model that answers otherwise."""
    observer = new_observer()
    car(observer, 240.0, 2, slip=0.05, std=0.001, answer=answer)

    scaled = np.sqrt(np.diag(answer**2 * observer.ratio.covariance))
    np.testing.assert_allclose(scaled, 0.05, rtol=0.25)


@pytest.mark.parametrize("seed", [2, 4])
def test_free_motion_is_never_constrained(seed: int) -> None:
    observer = new_observer()

    car(observer, 300.0, seed, free=2.0)

    assert not observer.holds
    assert observer.evidence < 0.0


def test_a_straight_leg_fits_any_nose_and_proves_nothing() -> None:
    observer = new_observer()
    for _ in range(600):
        nav = flat_state(np.array([10.0, 0.5, 0.0]), np.zeros(3), np.zeros(3), std=0.02)
        nav[BIAS_G] = 0.0
        observer.observe(nav, np.zeros(3), INTERVAL, fused=False)

    assert not observer.holds


@pytest.mark.parametrize("assumed", [False, True])
def test_constraint_ends_soon_when_it_is_broken_and_comes_back(assumed: bool) -> None:
    observer = new_observer(assumed)
    car(observer, 120.0, 1)
    assert observer.holds

    car(observer, 6.0, 2, free=3.0)
    assert not observer.holds

    car(observer, 120.0, 3)
    assert observer.holds


def straight(observer: ConstraintObserver, velocity_b: list[float], seconds: float) -> None:
    nav = flat_state(np.array(velocity_b), np.zeros(3), np.zeros(3), std=0.02)
    nav[BIAS_G] = 0.0
    for _ in range(int(seconds / INTERVAL)):
        observer.observe(nav, np.zeros(3), INTERVAL, fused=False)


@pytest.mark.parametrize("velocity_b", [[0.0, 1.2, 0.0], [0.5, -1.5, 0.0], [0.0, 6.0, 0.0]])
def test_a_vehicle_that_slews_or_moves_sideways_is_not_on_wheels(velocity_b: list[float]) -> None:
    """However fast it is along its nose; and a car that stands or crawls proves nothing."""
    observer = new_observer(assumed=True)
    car(observer, 60.0, 1)
    straight(observer, [0.3, 0.05, 0.0], 60.0)
    assert observer.holds

    straight(observer, velocity_b, 8.0)

    assert not observer.holds


def test_wheels_that_were_assumed_and_disproven_have_to_be_shown() -> None:
    """A tug that moves ahead for a while after it went sideways has no wheels."""
    observer = new_observer(assumed=True)
    car(observer, 6.0, 2, free=3.0)
    assert not observer.holds

    straight(observer, [5.0, 0.0, 0.0], 60.0)

    assert not observer.holds


def test_a_rough_road_does_not_disprove_wheels_and_ice_does() -> None:
    """GIVEN a nominal slip of 0.1 m/s WHEN the axle moves by 0.18, 0.25, then by 1 m/s."""
    observer = new_observer()
    car(observer, 120.0, 1, slip=0.18)

    for seed in range(2, 12):
        car(observer, 60.0, seed, slip=0.25)
        assert observer.holds
    car(observer, 20.0, 12, slip=1.0)
    assert not observer.holds
    car(observer, 300.0, 13, slip=1.0)
    assert not observer.holds


@pytest.mark.parametrize("seed", [2, 4, 6])
def test_a_boat_that_hardly_drifts_proves_no_wheels(seed: int) -> None:
    """It sways by 0.2 m/s and heaves by 0.35: more than a nominal car, less than `FREE_ANGLE`."""
    observer = new_observer()
    rng = np.random.default_rng(seed)
    for k in range(900):
        rate = np.array([0.0, 0.0, 0.3 * np.sin(0.1 * k)])
        across = [0.2 * np.sin(0.09 * k), 0.5 * np.sin(0.7 * k)] + 0.05 * rng.standard_normal(2)
        nav = flat_state(np.array([5.0, *across]), np.zeros(3), rate, std=0.02)
        nav[BIAS_G] = 0.0
        observer.observe(nav, rate, INTERVAL, fused=False)
        assert not observer.holds


def test_a_day_of_skids_does_not_put_the_constraint_out_of_reach() -> None:
    """GIVEN ten disproofs WHEN the car rolls for ten minutes THEN the constraint is shown."""
    observer = new_observer()
    car(observer, 120.0, 1)
    for skid in range(10):
        observer.holds = True
        car(observer, 6.0, 2 * skid, free=3.0)
        assert not observer.holds
        car(observer, 60.0, 2 * skid + 1)

    car(observer, 540.0, 3)
    assert observer.holds


def test_the_covariance_of_the_constraint_is_that_of_slip_and_nose() -> None:
    """Slip lasts for 0.3 s, an error of the nose for longer: both count for more than once."""
    observer = new_observer()
    nav = flat_state(np.array([10.0, 0.0, 0.0]), np.zeros(3), np.zeros(3), std=0.02)
    nav[BIAS_G] = 0.0
    nominal, given = (
        observer.measurement(0, nav, np.zeros(3), INTERVAL, slip).covariance
        for slip in (np.diag([0.01, 0.01]), np.diag([0.04, 0.25]))
    )

    white, lasting = (
        (1.0 + np.exp(-INTERVAL / time)) / (1.0 - np.exp(-INTERVAL / time)) for time in (0.3, 1.0)
    )
    np.testing.assert_allclose(given - nominal, white * np.diag([0.03, 0.24]), atol=1e-9)
    nose = lasting * (10.0 * 0.05) ** 2
    np.testing.assert_allclose(np.diag(nominal), white * 0.01 + nose, rtol=1e-3)


def test_what_is_fused_cannot_confirm_itself() -> None:
    observer = new_observer()
    nav = flat_state(np.array([10.0, 0.0, 0.0]), np.zeros(3), np.zeros(3), std=0.02)
    nav[BIAS_G] = 0.0
    for _ in range(600):
        observer.observe(nav, np.array([0.0, 0.0, 0.3]), INTERVAL, fused=True)

    assert observer.evidence <= 0.0
    assert not observer.holds


def test_point_velocity_is_that_of_a_turning_body() -> None:
    nav = flat_state(np.array([3.0, -2.0, 1.0]), np.array([0.2, -0.1, 1.0]), np.zeros(3))
    rate = np.array([0.1, 0.2, -0.4])
    velocity_b, _ = point_velocity(nav, rate, POINT_B)

    expected = matrix_from_quat(nav[QUAT]).T @ nav[VELOCITY]
    expected = expected + np.cross(rate - nav[BIAS_G], POINT_B)
    np.testing.assert_allclose(velocity_b, expected, atol=2e-4)
