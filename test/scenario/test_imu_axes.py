"""Wrong axes and units of an IMU are named from motion; right ones never are."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from hybrid_ins.bags.reader import BagReader
from hybrid_ins.cli import convert
from hybrid_ins.core.imu.samples import SAMPLE_DTYPE
from hybrid_ins.core.imu_axes.faults import AxesFault
from hybrid_ins.core.imu_axes.level import Tilt
from hybrid_ins.core.imu_axes.monitor import ImuAxesCheck
from hybrid_ins.core.inertial.rotations import matrix_from_quat, quat_from_rpy
from hybrid_ins.ros.messages.conversions import FLIP
from hybrid_ins.ros.review.axes_monitor import describe
from hybrid_ins.simulation.motions import (
    START_LLA,
    Motion,
    integral,
    motion_through,
    quadrotor_flight,
    random_motion,
    smoothed,
    time_grid,
    velocity_of,
)
from hybrid_ins.simulation.sensors import ImuErrors, corrupt, fixes, sample, sample_times
from hybrid_ins.simulation.vehicles import VEHICLES, along_road, city_car, record
from tools.vehicles.drives import from_simulation

ONE = np.eye(3)
FRD = np.diag([1.0, -1.0, -1.0])
ON_ITS_SIDE = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
ABOUT_UP = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
ASKEW = np.array([[0.64, -0.77, 0.0], [0.77, 0.64, 0.0], [0.0, 0.0, 1.0]])  # by 50° about up
EXCHANGED = ONE[[1, 0, 2]]
DEGREES = 180.0 / np.pi

CAR, QUADROTOR = "car", "quadrotor"
Readings = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]


def readings(motion: Motion, duration: float, offset: float = 0.0) -> Readings:
    """Return t, specific force and rate (FLU), times and places of fixes."""
    rng = np.random.default_rng(3)
    truth = sample(motion, sample_times(duration, 100.0))
    imu = corrupt(truth, ImuErrors(), rng)
    gnss = fixes(sample(motion, sample_times(duration, 5.0)), rng)
    return imu.t, imu.specific_force @ FLIP, imu.angular_rate @ FLIP, gnss.t - offset, gnss.lla


@pytest.fixture(scope="module")
def drives() -> dict[str, Readings]:
    return {
        CAR: readings(city_car(90.0, 1), 90.0),
        QUADROTOR: readings(quadrotor_flight(40.0, 3), 40.0),
    }


def check(
    run: Readings, accelerometer: np.ndarray = ONE, gyroscope: np.ndarray = ONE
) -> Iterator[tuple[float, AxesFault | Tilt | None]]:
    """Yield times and what is found by them, of readings multiplied by matrices (3, 3)."""
    t, force, rate, fix_t, places = run
    checked = ImuAxesCheck(FLIP)
    samples = np.empty(len(t), SAMPLE_DTYPE)
    samples["t_ns"] = np.round((t + 100.0) * 1e9)
    samples["f"] = force @ accelerometer.T @ FLIP
    samples["w"] = rate @ gyroscope.T @ FLIP
    at = k = 0
    for i, stop in enumerate(np.arange(0.1, t[-1], 0.1)):
        if i % 5 == 0:
            end = int(np.searchsorted(t, stop))
            checked.add_samples(samples[at:end])
            at = end
        while k < len(fix_t) and fix_t[k] <= stop:
            checked.add_fix(round((fix_t[k] + 100.0) * 1e9), places[k])
            k += 1
        checked.advance(round((stop + 100.0) * 1e9))
        yield float(stop), checked.fault or checked.tilt


@pytest.mark.parametrize(
    ("vehicle", "accelerometer", "gyroscope", "words"),
    [
        (CAR, ONE, DEGREES * ONE, "divided by 57.3"),
        pytest.param(QUADROTOR, ONE, DEGREES * ONE, "divided by 57.3", marks=pytest.mark.slow),
        (CAR, ONE, ONE / DEGREES, "57.3 times too small"),
        pytest.param(QUADROTOR, ONE, ONE / DEGREES, "57.3 times too small", marks=pytest.mark.slow),
        (CAR, ONE, 0.0 * ONE, "does not change while the vehicle moves"),
        (QUADROTOR, ONE, 0.0 * ONE, "does not change while the vehicle moves"),
        (CAR, ONE, np.diag([1.0, 1.0, -1.0]), ": z of angular_velocity reversed"),
        (QUADROTOR, ONE, np.diag([-1.0, 1.0, 1.0]), ": x of angular_velocity reversed;"),
        pytest.param(
            QUADROTOR,
            ONE,
            np.diag([1.0, -1.0, 1.0]),
            ": y of angular_velocity reversed",
            marks=pytest.mark.slow,
        ),
        (QUADROTOR, ONE, np.diag([1.0, 1.0, -1.0]), ": z of angular_velocity reversed;"),
        (CAR, FRD, FRD, "imu.mount_rpy to [3.142, 0, 0], or let the driver publish forward-left"),
        (QUADROTOR, FRD, FRD, "imu.mount_rpy to [3.142, 0, 0]"),
        (CAR, ON_ITS_SIDE, ON_ITS_SIDE, "imu.mount_rpy to [-1.571, 0, 0]"),
        (QUADROTOR, -ONE, ONE, ": all axes of linear_acceleration reversed"),
        (CAR, -ONE, ONE, "negate linear_acceleration|all axes of linear_acceleration reversed"),
        (CAR, EXCHANGED, EXCHANGED, ": x and y of linear_acceleration and angular_velocity exch"),
        (QUADROTOR, ONE, EXCHANGED, ": x and y of angular_velocity exchanged;"),
        pytest.param(
            QUADROTOR,
            ONE,
            ONE[[0, 2, 1]],
            ": y and z of angular_velocity exchanged;",
            marks=pytest.mark.slow,
        ),
        (CAR, ABOUT_UP, ABOUT_UP, "moves along its nose, set imu.mount_rpy to [0, 0, -1.571]"),
        (CAR, ABOUT_UP.T, ABOUT_UP.T, "moves along its nose, set imu.mount_rpy to [0, 0, 1.571]"),
        (CAR, ASKEW, ASKEW, "set imu.mount_rpy to [0, 0, -0.87]|[0, 0, -0.88]|[0, 0, -0.86]"),
    ],
)
def test_wrong_axes_and_units_are_named_with_the_remedy(
    drives: dict[str, Readings],
    vehicle: str,
    accelerometer: np.ndarray,
    gyroscope: np.ndarray,
    words: str,
) -> None:
    found = [fault for _, fault in check(drives[vehicle], accelerometer, gyroscope)]

    assert found[-1] is not None
    text = describe(found[-1]).text
    assert any(word in text for word in words.split("|"))
    assert len(text) < 350


@pytest.mark.parametrize("vehicle", [CAR, QUADROTOR])
def test_exchanged_coordinates_of_the_fixes_are_among_the_causes(
    drives: dict[str, Readings], vehicle: str
) -> None:
    *imu, fix_t, places = drives[vehicle]
    found = [fault for _, fault in check((*imu, fix_t, places[:, [1, 0, 2]]))]

    assert "latitude and longitude of the fixes are exchanged" in describe(found[-1]).text


@pytest.mark.parametrize("vehicle", [CAR, QUADROTOR])
def test_without_gravity_no_mount_is_named(drives: dict[str, Readings], vehicle: str) -> None:
    """GIVEN a driver that has removed gravity, which the check of the samples names."""
    t, force, *rest = drives[vehicle]

    found = [fault for _, fault in check((t, force - force[: len(t) // 50].mean(axis=0), *rest))]

    assert all(fault is None or not fault.at_rest for fault in found)


def test_a_reversed_rate_is_blamed_on_no_coordinates(drives: dict[str, Readings]) -> None:
    found = [fault for _, fault in check(drives[QUADROTOR], ONE, np.diag([1.0, 1.0, -1.0]))]
    assert "latitude" not in describe(found[-1]).text


def test_what_a_quadrotor_shows_is_named_within_30_seconds_of_motion(
    drives: dict[str, Readings],
) -> None:
    for gyroscope in (DEGREES * ONE, ONE / DEGREES, np.diag([1.0, 1.0, -1.0])):
        motion = 4.0  # s, when it takes off
        first = next(t for t, fault in check(drives[QUADROTOR], ONE, gyroscope) if fault)
        assert first < motion + 30.0


@pytest.fixture(scope="module")
def recorded(flights: Path, tmp_path_factory: pytest.TempPathFactory) -> Readings:
    """A real flight that hardly turns about up, with 0.3 m between IMU and antenna."""
    return of_flight(flights / "Horizontal" / "path_4", tmp_path_factory.mktemp("recorded"))


def of_flight(flight: Path, folder: Path) -> Readings:
    bag = folder / "flight.mcap"
    assert convert.main([str(flight), str(bag)]) == 0
    imu, gnss = [], []
    with BagReader(bag) as reader:
        for topic, _, message in reader.messages("/imu/data", "/gnss/fix"):
            t = message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec
            if topic == "/imu/data":
                force, rate = message.linear_acceleration, message.angular_velocity
                imu.append((t, force.x, force.y, force.z, rate.x, rate.y, rate.z))
            else:
                place = np.radians(message.latitude), np.radians(message.longitude)
                gnss.append((t, *place, message.altitude))
    samples, places = np.array(imu), np.array(gnss)
    start = samples[0, 0]
    return (
        samples[:, 0] - start,
        samples[:, 1:4],
        samples[:, 4:],
        places[:, 0] - start,
        places[:, 1:],
    )


@pytest.mark.parametrize(
    ("accelerometer", "gyroscope", "words"),
    [
        (ONE, np.diag([-1.0, 1.0, 1.0]), "x of angular_velocity reversed"),
        (ONE, np.diag([1.0, -1.0, 1.0]), "y of angular_velocity reversed"),
        (ONE, np.diag([1.0, 1.0, -1.0]), "z of angular_velocity reversed"),
        (EXCHANGED, EXCHANGED, "x and y of linear_acceleration and angular_velocity exchanged"),
    ],
)
def test_in_a_recorded_flight_wrong_axes_are_named_within_30_seconds(
    recorded: Readings, accelerometer: np.ndarray, gyroscope: np.ndarray, words: str
) -> None:
    found = [(t, fault) for t, fault in check(recorded, accelerometer, gyroscope) if fault]

    assert found[0][0] < 30.0
    assert all(words in describe(fault).text for _, fault in (found[0], found[-1]))


def test_a_recorded_flight_is_not_accused(recorded: Readings) -> None:
    assert not any(fault for _, fault in check(recorded))


def test_turns_that_one_second_hides_show_over_longer_intervals(
    flights: Path, tmp_path: Path
) -> None:
    """Over one second the errors of a reversed z seem to be the fixes' noise in this flight."""
    flown = of_flight(flights / "Horizontal" / "path_5", tmp_path)
    found = [(t, fault) for t, fault in check(flown, ONE, np.diag([1.0, 1.0, -1.0])) if fault]

    assert found[0][0] < 30.0
    assert ": z of angular_velocity reversed;" in describe(found[-1][1]).text
    assert not any(fault for _, fault in check(flown))


@pytest.mark.parametrize(
    ("gyroscope", "words"),
    [
        (np.diag([1.0, 1.0, -1.0]), ": z of angular_velocity reversed"),
        (ONE / DEGREES, "57.3 times too small"),
        (0.0 * ONE, "does not change while the vehicle moves"),
    ],
)
def test_one_bend_after_half_a_minute_straight_on_is_enough(
    gyroscope: np.ndarray, words: str
) -> None:
    """The gyroscope's bias would explain it within 20 s, but not from the start on."""
    found = [(t, f) for t, f in check(readings(city_car(60.0, 0), 60.0), ONE, gyroscope) if f]

    assert 30.0 < found[0][0] < 60.0
    assert words in describe(found[0][1]).text


def of_vehicle(name: str) -> Readings:
    drive = from_simulation(record(VEHICLES[name], 2))
    t = (drive.imu_ns - drive.imu_ns[0]) * 1e-9
    fix_t = (drive.fix_ns - drive.imu_ns[0]) * 1e-9
    return t, drive.force, drive.rate, fix_t, drive.fix_lla


@pytest.mark.parametrize("name", ["slow rover", "car, consumer"])
def test_slow_vehicles_and_receivers_with_metres_show_their_axes(name: str) -> None:
    found = check(of_vehicle(name), ONE, np.diag([1.0, 1.0, -1.0]))

    t, fault = next((t, fault) for t, fault in found if fault)

    assert t < 60.0
    assert ": z of angular_velocity reversed" in describe(fault).text


def test_what_ordinary_errors_explain_less_well_is_named() -> None:
    """Scales and biases explain most of a pedestrian's reversed y, but not all."""
    t, fault = next(
        (t, f) for t, f in check(of_vehicle("pedestrian"), ONE, np.diag([1, -1, 1])) if f
    )

    assert t < 45.0
    assert ": y of angular_velocity reversed;" in describe(fault).text


def test_exchanged_axes_of_a_slow_rover_are_among_all_that_is_said() -> None:
    t, force, rate, fix_t, places = of_vehicle("slow rover")
    soon, seen = t < 60.0, fix_t < 60.0
    drive = t[soon], force[soon], rate[soon], fix_t[seen], places[seen]
    found = [f for _, f in check(drive, EXCHANGED, EXCHANGED) if f]

    words = "x and y of linear_acceleration and angular_velocity exchanged"
    assert found
    assert all(words in describe(fault).text for fault in found)
    assert f": {words}" in describe(found[-1]).text


@pytest.mark.slow
def test_gentle_turns_are_not_taken_for_degrees() -> None:
    found = [f for _, f in check(of_vehicle("boat"), ONE, np.diag([1.0, 1.0, -1.0])) if f]

    assert found
    assert not any("57.3" in describe(fault).text for fault in found)


def test_what_was_named_stays_while_the_vehicle_drives_straight() -> None:
    found = [fault for _, fault in check(of_vehicle("car"), ONE, 0.0 * ONE)]
    first = next(k for k, fault in enumerate(found) if fault)

    assert all(found[first:])


DIFFERENT = ("car", "fixed wing 50 Hz", "boat", "pedestrian", "quadrotor")


@pytest.mark.parametrize(
    "name",
    [
        name if name in DIFFERENT else pytest.param(name, marks=pytest.mark.slow)
        for name in sorted(VEHICLES)
    ],
)
def test_a_healthy_vehicle_is_never_accused(name: str) -> None:
    drive = from_simulation(record(VEHICLES[name], 1))
    t = (drive.imu_ns - drive.imu_ns[0]) * 1e-9
    fix_t = (drive.fix_ns - drive.imu_ns[0]) * 1e-9

    found = [f for _, f in check((t, drive.force, drive.rate, fix_t, drive.fix_lla)) if f]

    assert not found, describe(found[0]).text


def circling(bank: float) -> Readings:
    """Return a minute of right turns at 1.5 rev/min and 0.67 g, banked by so many degrees."""
    t = time_grid(60.0)
    course = integral(np.full(len(t), 0.25))
    velocity = velocity_of(np.full(len(t), 26.0), course, np.full(len(t), 0.5))
    rpy = np.stack((np.full(len(t), np.radians(bank)), np.zeros(len(t)), course), axis=-1)
    return readings(motion_through(t, velocity, rpy, START_LLA), 60.0)


@pytest.mark.parametrize("bank", [33.5, 0.0, -38.0])
@pytest.mark.parametrize("with_fixes", [True, False])
def test_a_bank_that_lasts_is_not_taken_for_a_mount(bank: float, with_fixes: bool) -> None:
    """
    GIVEN a vehicle that circles, coordinated, flat, or banked outwards by 38 degrees
    WHEN its mean specific force is up to 71 degrees off its z axis for a minute
    THEN no mount is named: the attitudes are upright, and without fixes it is more than gravity.
    """
    *imu, fix_t, places = circling(bank)
    run = (*imu, fix_t, places) if with_fixes else (*imu, fix_t[:0], places[:0])

    found = [fault for _, fault in check(run) if fault]

    assert not found, describe(found[0]).text


@pytest.mark.parametrize("bank", [33.5, 0.0])
def test_a_wrong_mount_is_named_in_circles_too(bank: float) -> None:
    found = [fault for _, fault in check(circling(bank), ON_ITS_SIDE, ON_ITS_SIDE) if fault]

    assert "imu.mount_rpy to [-1.571, 0, 0]" in describe(found[-1]).text


def test_a_mount_that_is_far_from_right_angles_is_measured() -> None:
    """
    GIVEN a car whose IMU is mounted by roll 2.0, pitch -0.9 and yaw 2.4, none of which is given
    WHEN gravity, and then the course as well, have shown it
    THEN all three are named within 6 degrees; the nearest right angle is 45 degrees off.
    """
    true = matrix_from_quat(quat_from_rpy(2.0, -0.9, 2.4))
    drive = readings(city_car(90.0, 1), 90.0)

    found = [fault for _, fault in check(drive, true.T, true.T) if fault]

    assert found[0].mount[2] @ (FLIP @ true)[2] > np.cos(np.radians(12.0))
    assert np.trace(found[-1].mount.T @ FLIP @ true) > 1.0 + 2.0 * np.cos(np.radians(6.0))


def test_flying_on_its_back_is_not_taken_for_a_mount() -> None:
    """
    GIVEN an aircraft in S-turns, upright for 40 s, then on its back for 110 s
    WHEN its axes are compared with gravity
    THEN no mount is named; where it is on its back from the start, it is.
    """
    t = time_grid(150.0)
    turn = 0.25 * np.sin(0.4 * t)
    course = integral(turn)
    velocity = velocity_of(np.full(len(t), 26.0), course, np.full(len(t), 0.5))
    bank = np.arctan(26.0 * turn / 9.8)
    on_its_back = np.pi * smoothed((t > 40.0).astype(float), 1.0)
    rolled = np.stack((bank + on_its_back, np.zeros(len(t)), course), axis=-1)
    run = readings(motion_through(t, velocity, rolled, START_LLA), 150.0)

    assert not [fault for _, fault in check(run) if fault]
    assert [fault for _, fault in check(run, FRD, FRD) if fault]


def test_a_tailsitter_that_has_cruised_is_not_accused() -> None:
    """
    GIVEN an aircraft that hovers on its tail, cruises in turns, and hovers again
    WHEN it hovers first, which looks like a wrong mount
    THEN that is withdrawn within half a minute of the cruise, and not said again.
    """
    t = time_grid(150.0)
    cruise = smoothed(((t > 40.0) & (t < 110.0)).astype(float), 1.0)
    course = integral(0.25 * cruise**3 * np.sin(0.4 * t))
    bank = -np.arctan(0.25 * cruise**3 * np.sin(0.4 * t) * 18.0 / 9.8)
    pitch = np.radians(88.0 - 83.0 * cruise) + 0.05 * (1.0 - cruise) * np.sin(0.9 * t)
    speed = 18.0 * cruise + 0.8 * (1.0 - cruise) * np.sin(0.7 * t)
    velocity = velocity_of(speed, course, np.full(len(t), 0.2))
    rpy = np.stack((-bank, pitch, course), axis=-1)
    run = readings(motion_through(t, velocity, rpy, START_LLA), 150.0)

    found = list(check(run))

    assert any(fault for time, fault in found if time < 40.0)
    assert not any(fault for time, fault in found if time > 70.0)


@pytest.mark.parametrize(
    "offset",
    [-1.5, 0.2, *(pytest.param(t, marks=pytest.mark.slow) for t in (-0.4, 0.9, 5.0, 18.0))],
)
def test_a_wrong_clock_is_not_taken_for_wrong_axes(offset: float) -> None:
    for motion in (random_motion(60.0, 2), quadrotor_flight(60.0, 5), city_car(60.0, 2)):
        assert not any(fault for _, fault in check(readings(motion, 60.0, offset)))


def on_a_field(seed: int) -> Readings:
    """Return rows by a slow tractor: biases of degrees per second that drift, and good fixes."""
    rng = np.random.default_rng(seed)
    t = time_grid(200.0)
    speed = 1.4 * smoothed((t > 6.0).astype(float), 1.0)
    rows = np.floor(integral(speed) / 90.0)
    motion = along_road(t, speed, 0.4 + np.pi * smoothed(rows % 2.0, 5.0))
    gyro_bias, force_bias, drift = rng.uniform(-1.0, 1.0, (3, 3)) * [[0.03], [0.3], [0.01]]
    errors = ImuErrors(
        gyroscope_bias=gyro_bias,
        accelerometer_bias=force_bias,
        gyroscope_scale=0.008,
        mount_rpy=(0.01, -0.01, 0.01),
    )
    imu = corrupt(sample(motion, sample_times(200.0, 50.0)), errors, rng)
    gnss = fixes(sample(motion, sample_times(200.0, 5.0)), rng, 0.012)
    rate = imu.angular_rate + drift * (1.0 - np.exp(-imu.t / 90.0))[:, None]
    return imu.t, imu.specific_force @ FLIP, rate @ FLIP, gnss.t, gnss.lla


@pytest.mark.parametrize("seed", [1, 2])
def test_a_drifting_bias_on_straight_rows_is_not_taken_for_degrees(seed: int) -> None:
    field = on_a_field(seed)

    assert not any(fault for _, fault in check(field))
    found = next((t, fault) for t, fault in check(field, ONE, DEGREES * ONE) if fault)
    assert found[0] < 60.0 and "divided by 57.3" in describe(found[1]).text


@pytest.mark.parametrize("forward", [True, False])
def test_a_vehicle_that_has_moved_along_its_nose_may_reverse(forward: bool) -> None:
    """
    GIVEN a truck that backs for minutes, after a drive or from the start
    THEN its mount is questioned in the second case alone.
    """
    t = time_grid(360.0)
    speed = smoothed(np.where(t < 60.0, 6.0 if forward else -3.0, -3.0), 1.0)
    course = integral(0.3 * np.sin(0.15 * t))
    rpy = np.stack((0.0 * t, 0.0 * t, course), axis=-1)
    motion = motion_through(t, velocity_of(speed, course, 0.0 * t), rpy, START_LLA)

    found = [fault for _, fault in check(readings(motion, 359.0)) if fault is not None]

    assert forward == (not found)
    if found:
        assert "unless it reverses" in describe(found[-1]).text
