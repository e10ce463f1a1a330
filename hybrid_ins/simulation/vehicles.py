"""
Vehicles to simulate besides the quadrotor: motion, vibration and receiver errors.

A `Vehicle` joins a motion, the errors of its IMU, vibration that depends on speed, and the errors
of its GNSS receiver: white and slowly varying ones, a claimed standard deviation that need not be
the true one, and a clock with offset and drift against the IMU's.

References
----------
.. [1] P. Groves, *Principles of GNSS, Inertial, and Multisensor Integrated Navigation Systems*,
       2nd ed., sections 4.4.5 (vibration) and 9.3 (GNSS error sources and correlation).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from hybrid_ins.core.inertial import earth
from hybrid_ins.ros.messages.trajectory import Array
from hybrid_ins.simulation.motions import (
    START_LLA,
    Motion,
    along_and_across,
    gravity_at,
    integral,
    motion_through,
    quadrotor_flight,
    smoothed,
    time_grid,
    velocity_of,
)
from hybrid_ins.simulation.sensors import (
    ImuData,
    ImuErrors,
    Tone,
    Truth,
    antenna_velocity,
    corrupt,
    gauss_markov,
    sample,
    sample_times,
)


@dataclass(frozen=True)
class Receiver:
    """
    A GNSS receiver's rate and errors; vectors are north, east, down.

    ``offset`` + ``drift`` t is what has to be added to its stamps to get the IMU's time.
    """

    rate: float = 1.0  # Hz
    white_std: tuple[float, float, float] = (0.01, 0.01, 0.02)  # m
    slow_std: tuple[float, float, float] = (0.0, 0.0, 0.0)  # m, first-order Gauss-Markov
    slow_time: float = 100.0  # s, its correlation time
    claimed_std: tuple[float, float, float] = (0.01, 0.01, 0.02)  # m
    offset: float = 0.0  # s
    drift: float = 0.0  # s/s
    velocity_std: float | None = None  # m/s; None: it reports no velocity
    velocity_age: float = 0.0  # s, of a velocity behind the position with the same stamp
    antenna_b: tuple[float, float, float] = (0.0, 0.0, 0.0)  # m, relative to the IMU


@dataclass(frozen=True)
class Vehicle:
    """A vehicle with its sensors."""

    name: str
    motion: Callable[[float, int], Motion]  # duration [s], seed
    receiver: Receiver
    errors: ImuErrors = field(default_factory=ImuErrors)
    imu_rate: float = 100.0  # Hz
    rest: float = 10.0  # s, before the motion begins
    engine_time: float = 0.0  # s, from which the engine's tones are on
    road_std: float = 0.0  # m/s2 at 10 m/s of speed: vibration, coloured
    duration: float = 240.0  # s


@dataclass(frozen=True)
class Recording:
    """A simulated run: truth, IMU and fixes, all times [s] on the IMU's clock but the stamps."""

    vehicle: Vehicle
    truth: Truth
    imu: ImuData
    fix_t: Array  # (M,) s, when the fixes were true
    fix_stamp: Array  # (M,) s, as the receiver stamps them
    fix_lla: Array  # (M, 3)
    fix_velocity_n: Array | None  # (M, 3) m/s


def record(vehicle: Vehicle, seed: int) -> Recording:
    """Simulate a run of a vehicle."""
    rng = np.random.default_rng([seed, len(vehicle.name)])
    motion = vehicle.motion(vehicle.duration, seed)
    truth = sample(motion, sample_times(vehicle.duration, vehicle.imu_rate))
    tones = vehicle.errors.tones
    imu = corrupt(truth, replace(vehicle.errors, tones=()), rng)
    force, rate = imu.specific_force.copy(), imu.angular_rate.copy()
    on = (truth.t >= vehicle.engine_time)[:, None]
    for tone in tones:
        angle = engine_phases(truth.t, tone.frequency, 0.05, rng)
        force += on * np.asarray(tone.accelerometer) * np.sin(angle)
        rate += on * np.asarray(tone.gyroscope) * np.cos(angle)
    speed = np.linalg.norm(truth.velocity_n, axis=1)[:, None]
    if vehicle.road_std:
        decay = float(np.exp(-1.0 / vehicle.imu_rate / 0.01))
        force += 0.1 * speed * gauss_markov(vehicle.road_std, decay, len(truth.t), rng)
        rate += 0.1 * speed * gauss_markov(0.03 * vehicle.road_std, decay, len(truth.t), rng)
    imu = replace(imu, specific_force=force, angular_rate=rate)
    receiver = vehicle.receiver
    fix_t = np.arange(0.35, vehicle.duration - 0.05, 1.0 / receiver.rate)
    at = sample(motion, fix_t)
    error = np.asarray(receiver.white_std) * rng.standard_normal((len(fix_t), 3))
    decay = float(np.exp(-1.0 / receiver.rate / receiver.slow_time))
    error += gauss_markov(receiver.slow_std, decay, len(fix_t), rng)
    error += at.C_nb @ np.asarray(receiver.antenna_b)
    lla = at.lla + error / np.array([earth.curvature_scale(place) for place in at.lla])
    stamp = fix_t - receiver.offset - receiver.drift * fix_t
    velocity_n = None
    if receiver.velocity_std is not None:
        then = sample(motion, fix_t - receiver.velocity_age)
        velocity_n = antenna_velocity(then, receiver.antenna_b)
        velocity_n = velocity_n + receiver.velocity_std * rng.standard_normal((len(fix_t), 3))
    return Recording(vehicle, truth, imu, fix_t, stamp, lla, velocity_n)


def engine_phases(t: Array, frequency: float, wander: float, rng: np.random.Generator) -> Array:
    """
    Return phases (N, 3) [rad] of an engine's vibration, one for each axis, at times (N,) [s].

    No engine keeps its phase: that of ``frequency`` [Hz] wanders by ``wander`` [rad] a sample.
    """
    walk = np.cumsum(wander * rng.standard_normal(len(t)))
    phase = (2.0 * np.pi * frequency * t + walk)[:, None]
    return np.asarray(phase + rng.uniform(0.0, 2.0 * np.pi, 3))


def city_car(duration: float, seed: int, rest: float = 10.0) -> Motion:
    """Stand, then drive streets that cross at right angles, with stops."""
    return along_road(*streets(duration, seed, rest))


def streets(duration: float, seed: int, rest: float) -> tuple[Array, Array, Array]:
    """Return times [s], speed [m/s] and course [rad], each (N,), of a drive through a town."""
    t = time_grid(duration)
    rng = np.random.default_rng(seed)
    speed, course_rate = np.zeros_like(t), np.zeros_like(t)
    begin = rest + 2.5
    while begin < duration:
        cruise = rng.uniform(8.0, 15.0)
        leg = rng.uniform(6.0, 14.0)
        _set(speed, t, begin, leg, cruise)
        begin += leg
        if rng.random() < 0.25:
            begin += 2.5 + rng.uniform(4.0, 12.0)
            _set(speed, t, begin, 1.0, 5.0)
            begin += 1.0
            continue
        corner = rng.uniform(4.0, 5.5)
        _set(speed, t, begin, corner, rng.uniform(4.0, 6.0))
        turn = rng.uniform(2.0, 3.0)
        side = rng.choice([-1.0, 1.0])
        _set(course_rate, t, begin + 0.5 * (corner - turn), turn, side * 0.5 * np.pi / turn)
        begin += corner
    speed = smoothed(speed, 5.0)
    return t, speed, rng.uniform(-np.pi, np.pi) + integral(smoothed(course_rate, 1.0))


def motorway(duration: float, seed: int, rest: float = 10.0) -> Motion:
    """Stand, then drive fast through wide bends: hardly any change of velocity."""
    t = time_grid(duration)
    rng = np.random.default_rng(seed)
    speed, course_rate = np.zeros_like(t), np.zeros_like(t)
    begin = rest + 7.5
    while begin < duration:
        leg = rng.uniform(15.0, 40.0)
        _set(speed, t, begin, leg, rng.uniform(24.0, 34.0))
        _set(course_rate, t, begin + 10.0, leg, rng.choice([-1, 0, 1]) * rng.uniform(0.003, 0.02))
        begin += leg
    speed = smoothed(speed, 15.0)
    course = rng.uniform(-np.pi, np.pi) + integral(smoothed(course_rate, 4.0))
    return along_road(t, speed, course)


def along_road(t: Array, speed: Array, course: Array) -> Motion:
    """Return a car's motion over a gently rolling road, by speed [m/s] and course [rad], (N,)."""
    slope = slope_along(speed)
    velocity_n = velocity_of(speed, course, speed * np.tan(slope))
    roll = -0.01 * speed * np.gradient(course, t)  # the body leans out of the turn
    return motion_through(t, velocity_n, np.stack((roll, slope, course), axis=-1), START_LLA)


def slope_along(speed: Array) -> Array:
    """Return the slope [rad] of a gently rolling road, (N,), by the speed along it [m/s]."""
    return 0.03 * np.sin(2.0 * np.pi * integral(speed) / 400.0)


def fixed_wing(duration: float, seed: int, rest: float = 60.0, *, gust_std: float = 0.0) -> Motion:
    """
    Stand with the engine on, take off, then circles, straight legs and climbs, in wind.

    Gusts, of ``gust_std`` [m/s] in each component, carry the plane and do not turn it.
    """
    t = time_grid(duration)
    rng = np.random.default_rng(seed)
    cruise = rng.uniform(15.0, 22.0)
    speed = smoothed(np.where(t > rest + 3.0, cruise, 0.0), 6.0)
    climb = smoothed(np.where((t > rest + 8.0) & (t < rest + 25.0), 3.0, 0.0), 4.0)
    rate = np.zeros_like(t)
    begin = rest + 14.0
    while begin < duration:
        length = rng.uniform(4.0, 15.0)
        _set(rate, t, begin, length, rng.choice([-1.0, 0.0, 1.0]) * rng.uniform(0.15, 0.4))
        begin += length
    heading = rng.uniform(-np.pi, np.pi) + integral(smoothed(rate, 2.5))
    wind = smoothed(np.where(t > rest + 6.0, 1.0, 0.0), 4.0)[:, None] * rng.normal(0.0, 3.0, 2)
    velocity_n = velocity_of(speed, heading, climb)
    velocity_n[:, :2] += wind
    if gust_std:
        noise = np.random.default_rng([seed, 17]).standard_normal((2, len(t)))
        gusts = np.stack([smoothed(axis, 4.0) for axis in noise], axis=1)
        velocity_n[:, :2] += gust_std * gusts / gusts.std(axis=0) * (speed / cruise)[:, None]
    slope = np.arctan2(climb, np.maximum(speed, 1.0)) + 0.05

    def attitude(_: Array, acceleration_n: Array) -> Array:
        north, east, down = (acceleration_n - [0.0, 0.0, gravity_at(START_LLA)]).T
        forward, right = along_and_across(north, east, heading)
        bank = np.arctan2(right, -forward * np.sin(slope) - down * np.cos(slope))
        return np.stack((bank, slope, heading), axis=-1)

    return motion_through(t, velocity_n, attitude, START_LLA)


def slow_rover(duration: float, seed: int, rest: float = 10.0) -> Motion:
    """Drive straight at less than a metre a second, stop, turn on the spot, go on."""
    t = time_grid(duration)
    rng = np.random.default_rng(seed)
    speed, rate = np.zeros_like(t), np.zeros_like(t)
    begin = rest + 0.5
    while begin < duration:
        leg = rng.uniform(5.0, 15.0)
        _set(speed, t, begin, leg, rng.uniform(0.6, 1.0))
        begin += leg + 1.0
        turn = rng.uniform(2.0, 4.0)
        _set(rate, t, begin, turn, rng.choice([-1.0, 1.0]) * rng.uniform(0.5, 2.0) / turn)
        begin += turn + 1.0
    speed = smoothed(speed, 0.8)
    course = rng.uniform(-np.pi, np.pi) + integral(smoothed(rate, 0.8))
    rpy = np.stack((0.02 * np.sin(0.3 * t), 0.02 * np.sin(0.2 * t + 1.0), course), axis=-1)
    return motion_through(t, velocity_of(speed, course, 0.0 * t), rpy, START_LLA)


def boat(duration: float, seed: int, rest: float = 10.0) -> Motion:
    """Lie in waves, then run at a few metres a second, with gentle turns."""
    t = time_grid(duration)
    rng = np.random.default_rng(seed)
    speed = np.where(t > rest + 2.0, rng.uniform(4.0, 7.0), 0.0)
    rate = np.zeros_like(t)
    begin = rest + 8.0
    while begin < duration:
        length = rng.uniform(6.0, 15.0)
        _set(rate, t, begin, length, rng.choice([-1.0, 0.0, 1.0]) * rng.uniform(0.05, 0.2))
        _set(speed, t, begin, length, rng.uniform(3.0, 7.0))
        begin += length
    speed = smoothed(speed, 5.0)
    course = rng.uniform(-np.pi, np.pi) + integral(smoothed(rate, 3.0))
    phase = rng.uniform(0.0, 2.0 * np.pi, 4)
    wave = 2.0 * np.pi * np.array([0.31, 0.27, 0.23, 0.19])
    roll = 0.08 * np.sin(wave[0] * t + phase[0])
    pitch = 0.04 * np.sin(wave[1] * t + phase[1])
    yaw = course + 0.05 * np.sin(wave[3] * t + phase[3])
    heave = 0.3 * wave[2] * np.cos(wave[2] * t + phase[2])
    velocity_n = velocity_of(speed, course, heave)
    return motion_through(t, velocity_n, np.stack((roll, pitch, yaw), axis=-1), START_LLA)


def pedestrian(duration: float, seed: int, rest: float = 10.0) -> Motion:
    """Stand, then walk with turns; the body goes up and down with each step."""
    t = time_grid(duration)
    rng = np.random.default_rng(seed)
    walking, rate = np.zeros_like(t), np.zeros_like(t)
    begin = rest + 0.5
    while begin < duration:
        leg = rng.uniform(5.0, 20.0)
        _set(walking, t, begin, leg, rng.uniform(1.1, 1.6))
        turn = rng.uniform(1.0, 2.5)
        angle = rng.choice([-1.0, 1.0]) * rng.uniform(0.5, 2.8)
        _set(rate, t, begin + leg - turn, turn, angle / turn)
        begin += leg + (rng.uniform(3.0, 8.0) if rng.random() < 0.15 else 0.0)
    speed = smoothed(walking, 1.0)
    course = rng.uniform(-np.pi, np.pi) + integral(smoothed(rate, 0.6))
    step = 2.0 * np.pi * 1.9
    bounce = 0.015 * step * np.sin(step * t) * speed / 1.4
    roll = 0.03 * np.sin(0.5 * step * t) * speed / 1.4
    yaw = course + 0.05 * np.sin(0.5 * step * t + 1.0) * speed / 1.4
    rpy = np.stack((roll, 0.05 + 0.0 * t, yaw), axis=-1)
    return motion_through(t, velocity_of(speed, course, bounce), rpy, START_LLA)


def _set(values: Array, t: Array, begin: float, length: float, value: float) -> None:
    values[(t >= begin) & (t < begin + length)] = value


def _quadrotor(duration: float, seed: int, rest: float = 10.0) -> Motion:
    return quadrotor_flight(duration, seed, rest=rest)


MODEST = Receiver(5.0, (0.2, 0.2, 0.3), (0.8, 0.8, 1.5), 100.0, (1.0, 1.0, 2.0))
CONSUMER = Receiver(1.0, (1.0, 1.0, 2.0), (1.5, 1.5, 3.0), 60.0, (2.0, 2.0, 4.0))
ENGINE = Tone(31.0, 0.5, 0.02)
SHAKEN = ImuErrors(tones=(ENGINE, Tone(47.3, 0.3, 0.01)))
_FIXED_WING = Vehicle(
    "fixed wing 50 Hz",
    fixed_wing,
    replace(MODEST, offset=-0.2),
    ImuErrors(tones=(Tone(17.0, 2.0, 0.05), Tone(21.7, 1.5, 0.05))),
    50.0,
    60.0,
    engine_time=15.0,
)

VEHICLES: dict[str, Vehicle] = {
    vehicle.name: vehicle
    for vehicle in (
        Vehicle("car", city_car, Receiver(), SHAKEN, road_std=0.6),
        Vehicle("car, clock 50 ms", city_car, Receiver(offset=0.05), SHAKEN, road_std=0.6),
        Vehicle(
            "car, drift 300 ppm", city_car, Receiver(offset=0.02, drift=3e-4), SHAKEN, road_std=0.6
        ),
        Vehicle("car, clock -0.4 s", city_car, Receiver(offset=-0.4), SHAKEN, road_std=0.6),
        Vehicle("car, consumer", city_car, CONSUMER, SHAKEN, road_std=0.6),
        Vehicle(
            "car on a motorway, clock -0.1 s",
            motorway,
            Receiver(5.0, offset=-0.1),
            SHAKEN,
            road_std=0.6,
        ),
        _FIXED_WING,
        replace(
            _FIXED_WING,
            name="fixed wing, velocities 0.1 s old",
            receiver=replace(_FIXED_WING.receiver, velocity_std=0.1, velocity_age=0.1),
        ),
        Vehicle(
            "slow rover",
            slow_rover,
            Receiver(5.0, (0.1, 0.1, 0.2), (0.3, 0.3, 0.5), 60.0, (1.5, 1.5, 3.0)),
            ImuErrors(tones=(Tone(23.0, 0.2, 0.01),)),
            road_std=1.0,
        ),
        Vehicle(
            "boat",
            boat,
            Receiver(5.0, (0.2, 0.2, 0.3), (0.0, 0.0, 0.0), 100.0, (0.2, 0.2, 0.3)),
            SHAKEN,
            50.0,
        ),
        Vehicle(
            "pedestrian",
            pedestrian,
            Receiver(5.0, (0.02, 0.02, 0.03), claimed_std=(0.02, 0.02, 0.03), offset=0.1),
        ),
        Vehicle("quadrotor", _quadrotor, MODEST, SHAKEN, 200.0),
    )
}
