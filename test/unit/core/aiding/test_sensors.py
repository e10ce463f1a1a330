"""Aiding sensors: Jacobians, life cycle, scale, a wrong heading, a pressure offset."""

import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from support.derivatives import derivative, flat_state, swing, vectors

from hybrid_ins.core.aiding.life_cycle import AidingState
from hybrid_ins.core.aiding.measurements import BarometricHeight, BodyVelocity, Heading
from hybrid_ins.core.aiding.sensors import HeadingSensor, HeightSensor, VelocitySensor
from hybrid_ins.core.inertial.rotations import rpy_from_quat
from hybrid_ins.core.inertial.state import (
    BIAS_G,
    HEADING_CONSIDERED,
    HEADING_DOUBT,
    LLA,
    QUAT,
    SLOW_VARIANCE,
    Array,
)

POINT_B = np.array([-1.2, 0.3, 0.5])
SECOND = 1_000_000_000


@settings(max_examples=40, deadline=None)
@given(vectors, vectors, vectors)
@pytest.mark.parametrize("kind", ["velocity", "heading", "height"])
def test_H_is_the_derivative_of_the_innovation(
    kind: str, velocity: Array, rpy: Array, rate: Array
) -> None:
    nav = flat_state(20.0 * velocity, 1.2 * rpy, rate)
    measured = {
        "velocity": BodyVelocity(0, np.array([5.0, np.nan, 0.1]), np.eye(3), POINT_B),
        "heading": Heading(0, float(1.2 * rpy[2]) + 0.1, 0.01),
        "height": BarometricHeight(0, 810.0, 1.0),
    }[kind]
    z, H, R = measured.linearise(nav)

    assert len(z) == len(H) == len(R)
    expected = -derivative(lambda at: measured.linearise(at)[0], nav)
    np.testing.assert_allclose(H, expected, atol=1.01 * swing(POINT_B), rtol=1e-4)


@given(st.floats(-3.1, 3.1), st.floats(-3.1, 3.1))
def test_heading_is_compared_the_short_way_round(yaw: float, measured: float) -> None:
    nav = flat_state(np.zeros(3), np.array([0.1, -0.2, yaw]), np.zeros(3))
    assume(abs(abs(measured - yaw) - math.pi) > 1e-6)

    z = Heading(0, measured, 0.01).linearise(nav)[0][0]

    assert abs(z) <= math.pi
    assert math.cos(z) == pytest.approx(math.cos(measured - rpy_from_quat(nav[QUAT])[2]))


def wheels(sensor: VelocitySensor, seconds: float, factor: float, start: float, seed: int) -> None:
    """Drive with wheels that read ``1 / factor`` of the speed, σ 0.05 m/s."""
    rng = np.random.default_rng(seed)
    for k in range(int(seconds / 0.1)):
        t = start + 0.1 * k
        speed = 10.0 + 4.0 * math.sin(0.1 * t)
        nav = flat_state(np.array([speed, 0.0, 0.0]), np.zeros(3), np.zeros(3), std=0.003)
        nav[BIAS_G] = 0.0
        reading = np.array([speed / factor + 0.05 * rng.standard_normal(), np.nan, np.nan])
        t_ns = round(t * SECOND)
        if sensor.admit(t_ns):
            measured = BodyVelocity(t_ns, reading, 0.05**2 * np.eye(3), np.zeros(3))
            sensor.check(measured, nav, checked=True, outage=False)


@pytest.mark.parametrize("seed", [2, 4, 6])
def test_scale_of_wheels_is_found_to_a_tenth_of_a_percent(seed: int) -> None:
    sensor = VelocitySensor(1.0, 0.03, np.ones(3))

    wheels(sensor, 120.0, 1.02, 10.0, seed)

    assert sensor.state(130 * SECOND) is AidingState.AIDING
    assert abs(sensor.scale - 1.02) < 3.0 * sensor.sigma[0]
    assert sensor.sigma[0] < 0.002


def test_a_restart_keeps_what_is_known_of_the_errors() -> None:
    sensor = VelocitySensor(1.0, 0.03, np.ones(3))
    wheels(sensor, 60.0, 1.02, 1000.0, 2)
    known = sensor.scale, sensor.sigma.tolist(), sensor.factor

    sensor.restart()

    assert sensor.state(1060 * SECOND) is AidingState.ABSENT
    assert (sensor.scale, sensor.sigma.tolist(), sensor.factor) == known
    wheels(sensor, 10.0, 1.02, 0.5, 2)
    assert sensor.state(10 * SECOND) is AidingState.AIDING


@pytest.mark.parametrize("stray", [5000.0, -3000.0, 1.5], ids=["back", "ahead", "little"])
def test_stamps_that_go_back_are_a_new_time_base(stray: float) -> None:
    # GIVEN a reading that is stamped far ahead, or stamps that go back from then on
    sensor = VelocitySensor(1.0, 0.03, np.ones(3))
    wheels(sensor, 20.0, 1.0, 6000.0, 2)

    start = 6020.0 - stray
    admitted = sum(sensor.admit(round((start + 0.1 * k) * SECOND)) for k in range(100))
    wheels(sensor, 10.0, 1.0, start + 10.0, 2)

    # THEN the next ones are used: every second one, as they come twice as often as needed
    assert admitted >= (42 if stray == 1.5 else 50)
    assert sensor.state(round((start + 19.9) * SECOND)) is AidingState.AIDING


@pytest.mark.parametrize("seed", [2, 4])
def test_place_of_a_velocity_sensor_is_found_in_turns(seed: int) -> None:
    """
    GIVEN a velocity sensor of two axes, nominally at the IMU
    WHEN the vehicle turns
    THEN its place ahead and aside is found, and nothing is claimed of its height.
    """
    rng = np.random.default_rng(seed)
    sensor, place_b = VelocitySensor(1.0, 0.03, np.ones(3)), np.array([-1.2, 0.4, 0.0])
    for k in range(1200):
        t = 10.0 + 0.1 * k
        rate_b = np.array([0.0, 0.0, 0.5 * math.sin(0.3 * t)])
        nav = flat_state(np.array([10.0, 0.0, 0.0]), np.zeros(3), rate_b, std=0.003)
        nav[BIAS_G] = 0.0
        reading = np.array([10.0, 0.0, np.nan]) + np.cross(rate_b, place_b)
        reading += 0.05 * rng.standard_normal(3)
        if sensor.admit(round(t * SECOND)):
            measured = BodyVelocity(round(t * SECOND), reading, 0.05**2 * np.eye(3), np.zeros(3))
            sensor.check(measured, nav, checked=True, outage=False)

    assert np.all(np.abs(sensor.shift_b - place_b)[:2] < 3.0 * sensor.sigma[1:3])
    assert np.all(sensor.sigma[1:3] < 0.06)
    assert sensor.sigma[3] > 0.9


def test_life_cycle_of_wheels() -> None:
    sensor = VelocitySensor(1.0, 0.03, np.ones(3))
    assert sensor.state(SECOND) is AidingState.ABSENT
    wheels(sensor, 1.0, 1.0, 10.0, 2)
    assert sensor.state(11 * SECOND) is AidingState.WAITING
    wheels(sensor, 10.0, 1.0, 11.0, 2)
    assert sensor.state(21 * SECOND) is AidingState.AIDING
    wheels(sensor, 10.0, 2.0, 21.0, 2)
    assert sensor.state(31 * SECOND) is AidingState.REFUSED
    assert sensor.state(40 * SECOND) is AidingState.LOST


def test_velocity_is_used_in_outages_only_and_its_errors_are_not_white() -> None:
    sensor = VelocitySensor(1.0, 0.03, np.ones(3))
    wheels(sensor, 60.0, 1.0, 10.0, 2)
    nav = flat_state(np.array([10.0, 0.0, 0.0]), np.zeros(3), np.zeros(3), std=0.01)
    reading = BodyVelocity(
        70_200_000_000, np.array([10.0, np.nan, np.nan]), 0.05**2 * np.eye(3), np.zeros(3)
    )
    assert sensor.admit(70_200_000_000)

    assert sensor.check(reading, nav, checked=True, outage=False) is None
    used = sensor.check(reading, nav, checked=False, outage=True)

    assert used is not None
    white, lasting = (
        (1.0 + math.exp(-0.4 / time)) / (1.0 - math.exp(-0.4 / time)) for time in (0.2, 5.0)
    )
    expected = white * (sensor.scale * 0.05) ** 2 + lasting * sensor.nuisance(reading, nav)[0, 0]
    assert sensor.factor == 1.0
    assert used.linearise(nav)[2][0, 0] == pytest.approx(expected, rel=1e-6)


def in_outage(sensor: VelocitySensor, start: float, read: float, std: float) -> list[bool]:
    """Show 6 s of readings to a filter at 10 m/s with that σ; return which are used."""
    used = []
    for k in range(30):
        t_ns = round((start + 0.2 * k) * SECOND)
        nav = flat_state(np.array([10.0, 0.0, 0.0]), np.zeros(3), np.zeros(3), std=std)
        velocity_b = np.array([read + 0.001 * (k % 2), np.nan, np.nan])
        reading = BodyVelocity(t_ns, velocity_b, 0.05**2 * np.eye(3), np.zeros(3))
        assert sensor.admit(t_ns)
        used.append(sensor.check(reading, nav, checked=False, outage=True) is not None)
    return used


def test_wheels_that_stop_reading_in_an_outage_are_refused_until_a_known_state_agrees() -> None:
    sensor = VelocitySensor(1.0, 0.03, np.ones(3))
    wheels(sensor, 60.0, 1.0, 10.0, 2)

    assert all(in_outage(sensor, 70.2, 10.0, 0.3))
    assert not any(in_outage(sensor, 76.2, 0.0, 0.3)[5:])
    assert sensor.state(82 * SECOND) is AidingState.REFUSED
    assert not any(in_outage(sensor, 82.2, 0.0, 5.0)), "it agrees with anything"
    assert not in_outage(sensor, 88.2, 10.0, 0.4)[0]
    assert in_outage(sensor, 94.2, 10.0, 0.4)[-1], "a state that is known as well as then"


def test_a_reading_far_off_is_not_fused_in_an_outage() -> None:
    sensor = VelocitySensor(1.0, 0.03, np.ones(3))
    wheels(sensor, 60.0, 1.0, 10.0, 2)

    assert all(in_outage(sensor, 70.2, 10.0, 0.05))
    assert not in_outage(sensor, 76.2, 12.0, 0.05)[0]


def test_a_sensor_that_takes_the_filter_along_is_refused_by_what_the_imu_measures() -> None:
    """GIVEN a reading that the filter has followed WHEN a state without aid contradicts it."""
    sensor = VelocitySensor(1.0, 0.03, np.ones(3))
    wheels(sensor, 60.0, 1.0, 10.0, 2)
    used, told = [], []
    for k in range(12):
        t_ns = round((70.2 + 0.2 * k) * SECOND)
        nav, unaided = (
            flat_state(np.array([speed, 0.0, 0.0]), np.zeros(3), np.zeros(3), std=0.1)
            for speed in (10.0, 12.0)
        )
        velocity_b = np.array([10.0 + 0.001 * (k % 2), np.nan, np.nan])
        reading = BodyVelocity(t_ns, velocity_b, 0.05**2 * np.eye(3), np.zeros(3))
        assert sensor.admit(t_ns)
        fused = sensor.check(reading, nav, checked=False, outage=True, unaided=unaided)
        used.append(fused is not None)
        told.append(sensor.took_along)

    assert all(used[:3]) and not any(used[6:])
    assert told == [not one for one in used], "until who restores the state has done it"


def test_one_reading_again_and_again_is_not_used_while_the_vehicle_moves() -> None:
    sensor = VelocitySensor(1.0, 0.03, np.ones(3))
    wheels(sensor, 60.0, 1.0, 10.0, 2)
    used = []
    for k in range(30):
        t_ns = round((70.2 + 0.2 * k) * SECOND)
        nav = flat_state(np.array([10.0, 0.0, 0.0]), np.zeros(3), np.zeros(3), std=0.3)
        velocity_b = np.array([10.0 if k < 20 else 10.1, np.nan, np.nan])
        reading = BodyVelocity(t_ns, velocity_b, 0.05**2 * np.eye(3), np.zeros(3))
        assert sensor.admit(t_ns)
        used.append(sensor.check(reading, nav, checked=False, outage=True) is not None)
        if k == 19:
            assert sensor.state(t_ns) is AidingState.FROZEN

    assert all(used[:10]) and not any(used[12:20]) and all(used[20:])


def test_a_sensor_may_read_zero_for_long_and_anything_at_rest() -> None:
    for read, speed in ((0.0, 0.31), (0.2, 0.0)):
        sensor = VelocitySensor(1.0, 0.03, np.ones(3))
        wheels(sensor, 60.0, 1.0, 10.0, 2)
        for k in range(30):
            t_ns = round((70.2 + 0.2 * k) * SECOND)
            nav = flat_state(np.array([speed, 0.0, 0.0]), np.zeros(3), np.zeros(3), std=0.3)
            velocity_b = np.array([read, np.nan, np.nan])
            reading = BodyVelocity(t_ns, velocity_b, 0.05**2 * np.eye(3), np.zeros(3))
            assert sensor.admit(t_ns)
            assert sensor.check(reading, nav, checked=False, outage=True) is not None


def test_a_scale_that_was_shown_is_not_learned_from_readings_that_are_wrong() -> None:
    """GIVEN wheels that are stuck for 10 s THEN they are used soon after, with their scale."""
    sensor = VelocitySensor(1.0, 0.03, np.ones(3))
    wheels(sensor, 60.0, 1.02, 10.0, 2)
    scale, sigma = sensor.scale, sensor.sigma[0]

    wheels(sensor, 10.0, 1e9, 70.0, 2)
    assert sensor.state(80 * SECOND) is AidingState.REFUSED
    assert abs(sensor.scale - scale) < sigma
    wheels(sensor, 15.0, 1.02, 80.0, 2)

    assert sensor.state(95 * SECOND) is AidingState.AIDING
    assert abs(sensor.scale - 1.02) < 3.0 * sensor.sigma[0]


def test_a_scale_that_fixes_contradict_for_a_minute_is_learned_anew() -> None:
    sensor = VelocitySensor(1.0, 0.03, np.ones(3))
    wheels(sensor, 60.0, 1.02, 10.0, 2)

    wheels(sensor, 55.0, 0.9, 70.0, 2)
    assert sensor.state(125 * SECOND) is AidingState.REFUSED
    wheels(sensor, 40.0, 0.9, 125.0, 2)

    assert sensor.state(165 * SECOND) is AidingState.AIDING
    assert abs(sensor.scale - 0.9) < 3.0 * sensor.sigma[0]


def test_a_scale_is_learned_from_readings_in_another_unit() -> None:
    sensor = VelocitySensor(1.0, 0.03, np.ones(3))
    wheels(sensor, 60.0, 1.0 / 3.6, 10.0, 2)

    assert sensor.state(70 * SECOND) is AidingState.AIDING
    assert sensor.scale == pytest.approx(1.0 / 3.6, rel=0.01)


def test_what_fixes_have_refused_does_not_aid_in_the_next_outage() -> None:
    sensor = VelocitySensor(1.0, 0.03, np.ones(3))
    wheels(sensor, 60.0, 1.0, 10.0, 2)
    assert all(in_outage(sensor, 70.2, 10.0, 0.3))
    wheels(sensor, 10.0, 2.0, 76.4, 2)
    assert sensor.state(86 * SECOND) is AidingState.REFUSED

    assert not any(in_outage(sensor, 86.6, 10.0, 0.05))


@pytest.mark.parametrize(("factor", "used"), [(1.0, True), (2.0, False)])
def test_wheels_that_were_silent_in_an_outage_go_on_unless_the_filter_contradicts(
    factor: float, used: bool
) -> None:
    sensor = VelocitySensor(1.0, 0.01, np.full(3, 0.1))
    wheels(sensor, 30.0, 1.0, 10.0, 2)
    assert all(in_outage(sensor, 40.0, 10.0, 0.05))

    after = in_outage(sensor, 48.0, 10.0 / factor, 0.05)

    assert len(after) > 5
    assert all(after) is used
    assert after[-1] is used


def compass(
    sensor: HeadingSensor,
    seconds: float,
    wrong: float,
    start: float,
    considered: dict[int, float] | None = None,
) -> int:
    """
    Show headings at 10 Hz to a filter that knows its own to 2°; return how many are used.

    ``considered`` are standard deviations [rad] beside that, by their places in the flat state.
    """
    used = 0
    for k in range(int(seconds * 10)):
        t_ns = round((start + 0.1 * k) * SECOND)
        yaw = 0.1 * k * 0.3
        nav = flat_state(
            np.array([5.0, 0.0, 0.0]), np.array([0.0, 0.0, yaw]), np.zeros(3), std=math.radians(2.0)
        )
        for place, std in (considered or {}).items():
            nav[place] = std**2
        if sensor.admit(t_ns):
            reading = Heading(t_ns, yaw + wrong, math.radians(2.0) ** 2)
            used += sensor.check(reading, nav, checked=True, outage=False) is not None
    return used


def test_a_heading_is_not_believed_before_the_motion_has_confirmed_it() -> None:
    sensor = HeadingSensor()

    assert compass(sensor, 2.0, 0.0, 10.0) == 0
    assert compass(sensor, 20.0, 0.0, 12.0) > 10


@pytest.mark.parametrize("place", [HEADING_DOUBT, HEADING_CONSIDERED])
def test_a_heading_that_motion_does_not_show_confirms_and_refuses_no_other(place: int) -> None:
    """GIVEN a filter that is surer of its heading than motion is THEN another one waits."""
    for wrong in (0.0, 15.0):
        sensor = HeadingSensor()

        assert compass(sensor, 30.0, math.radians(wrong), 10.0, {place: math.radians(20.0)}) == 0
        assert sensor.state(40 * SECOND) is AidingState.WAITING


def test_a_wrong_heading_is_never_used_and_a_right_one_that_goes_wrong_is_dropped() -> None:
    sensor = HeadingSensor()
    assert compass(sensor, 60.0, math.radians(30.0), 10.0) == 0
    assert sensor.state(70 * SECOND) is AidingState.REFUSED

    sensor = HeadingSensor()
    assert compass(sensor, 30.0, 0.0, 10.0) > 20
    assert compass(sensor, 15.0, math.radians(30.0), 40.0) <= 3
    assert sensor.state(55 * SECOND) is AidingState.REFUSED


@pytest.mark.parametrize("seed", [2, 4])
def test_offset_of_a_pressure_height_is_found_and_wanders(seed: int) -> None:
    rng = np.random.default_rng(seed)
    sensor = HeightSensor()
    offset = 35.0
    for k in range(600):
        t_ns = (10 * SECOND) + k * SECOND // 2
        nav = flat_state(np.zeros(3), np.zeros(3), np.zeros(3), std=0.3)
        nav[LLA][2] = 100.0 + 0.3 * rng.standard_normal()
        offset += 0.02 * rng.standard_normal()
        if sensor.admit(t_ns):
            height = 100.0 + offset + 0.2 * rng.standard_normal()
            sensor.check(BarometricHeight(t_ns, height, 0.04), nav, checked=True, outage=False)

    assert sensor.state(t_ns) is AidingState.AIDING
    assert abs(sensor.offset - offset) < 3.0 * sensor.offset_std
    assert sensor.offset_std < 1.0


def test_offset_of_a_pressure_height_wanders_while_nothing_is_read() -> None:
    sensor, sigmas = HeightSensor(), []
    nav = flat_state(np.zeros(3), np.zeros(3), np.zeros(3), std=0.3)
    for seconds in (*range(10, 200), 3800):
        t_ns = seconds * SECOND
        assert sensor.admit(t_ns)
        reading = BarometricHeight(t_ns, 100.0 + nav[LLA][2], 0.04)
        sensor.check(reading, nav, checked=seconds < 3800, outage=False)
        sigmas.append(sensor.offset_std)

    assert sigmas[-1] == pytest.approx(math.hypot(sigmas[-2], sensor.WANDER * math.sqrt(3601.0)))


def test_nothing_is_used_of_a_sensor_that_was_never_checked() -> None:
    sensor = HeightSensor()
    nav = flat_state(np.zeros(3), np.zeros(3), np.zeros(3))
    reading = BarometricHeight(SECOND, 100.0, 0.04)
    assert sensor.admit(SECOND)

    assert sensor.check(reading, nav, checked=False, outage=True) is None


@pytest.mark.parametrize("considered", [True, False])
def test_a_pressure_height_is_not_blamed_for_slow_errors_of_the_fixes(considered: bool) -> None:
    rng = np.random.default_rng(2)
    sensor, slow, seen = HeightSensor(), 0.0, set()
    for k in range(800):
        t_ns = (10 * SECOND) + k * SECOND // 2
        slow += -0.01 * slow + 2.5 * math.sqrt(0.02) * rng.standard_normal()
        nav = flat_state(np.zeros(3), np.zeros(3), np.zeros(3), std=0.3)
        nav[SLOW_VARIANCE] = 2.5**2 if considered else 0.0
        nav[LLA][2] = 100.0 + slow
        reading = BarometricHeight(t_ns, 135.0 + 0.2 * rng.standard_normal(), 0.04)
        if sensor.admit(t_ns):
            sensor.check(reading, nav, checked=True, outage=False)
        seen.add(sensor.state(t_ns))

    assert (AidingState.REFUSED in seen or sensor.factor > 10.0) == (not considered)
