"""
Motions to simulate: smooth, repeatable, and exact to the last derivative.

Every motion is drawn as a programme (speed, course, climb, attitude over a grid of epochs), which
is smoothed and then interpolated by quintic splines. From there on the splines *are* the motion:
what `simulation.sensors.sample` derives from them is exact, whatever the programme was.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybrid_ins.core.inertial import earth

if TYPE_CHECKING:
    from scipy.interpolate import BSpline

Array = NDArray[np.float64]

START_LLA: Array = np.array([np.radians(32.1), np.radians(34.8), 0.0])  # the paper's Table I
GRID_STEP = 0.02  # s, between the knots of the splines
QUADROTOR_DRAG = 0.25  # 1/s, rotor drag: horizontal deceleration per m/s of speed


@dataclass(frozen=True)
class Motion:
    """
    A smooth motion over the WGS-84 Earth, as functions of the time [s] in [0, duration].

    ``displacement`` gives north, east and down [m] from the start, scaled to latitude and
    longitude with the start's radii of curvature; ``rpy`` roll, pitch and (unwrapped) yaw [rad] of
    the FRD body in the local NED. Position has five, attitude four continuous derivatives.
    """

    start_lla: Array  # (3,) rad, rad, m
    duration: float  # s
    displacement: BSpline
    rpy: BSpline


def static(
    duration: float = 60.0,
    *,
    start_lla: ArrayLike = START_LLA,
    heading: float = 0.0,
    roll: float = 0.0,
    pitch: float = 0.0,
) -> Motion:
    """Stand still with the given attitude [rad]."""
    times = time_grid(duration)
    rpy = np.broadcast_to([roll, pitch, heading], (times.size, 3))
    return motion_through(times, np.zeros((times.size, 3)), rpy, start_lla)


def quadrotor_flight(
    duration: float = 60.0,
    seed: int | None = None,
    *,
    start_lla: ArrayLike = START_LLA,
    heading: float = 0.0,
    rest: float = 4.0,
) -> Motion:
    """
    Stand, climb, fly off straight, then fly figures of eight with straight diagonals.

    The attitude follows from the motion: the rotors push along the body's z axis and make up for
    drag, so the accelerometer feels no side force but drag's. The nose sways about the course.

    Parameters
    ----------
    duration : float
        [s]
    seed : int, optional
        Varies speed, radius, height, sway and the side of the first turn; None flies the nominal
        ones (7 m/s, 10 m, 15 m).
    start_lla : array_like, shape (3,)
        Latitude, longitude [rad], height [m].
    heading : float
        Yaw while standing, and course of the first leg [rad, clockwise from north].
    rest : float
        Time standing before the climb [s].
    """
    factors, phase, side = np.ones(4), 0.0, 1.0
    if seed is not None:
        rng = np.random.default_rng(seed)
        factors, phase = rng.uniform(0.8, 1.25, 4), rng.uniform(-np.pi, np.pi)
        side = float(rng.choice([-1.0, 1.0]))
    speed, radius, height, sway = factors * [7.0, 10.0, 15.0, 0.3]

    t = time_grid(duration)
    moving = np.where(t >= rest + 1.5, 1.0, 0.0)  # the climb spreads its onset over three seconds
    flying = np.where(t >= rest + 6.5, 1.0, 0.0)
    # Two circles joined by crossing tangents: twice the radius, then three quarters of a circle.
    leg, turn = 2.0 * radius / speed, 1.5 * np.pi * radius / speed
    rate = side * speed / radius
    in_laps = t - (rest + 11.5)
    in_lap = np.where(in_laps < 0.0, 0.0, np.mod(in_laps, 2.0 * (leg + turn)))
    course_rate = np.select(
        [in_lap < leg, in_lap < leg + turn, in_lap < 2.0 * leg + turn], [0.0, rate, 0.0], -rate
    )
    swing = 2.0 * np.pi * (t - rest)
    climb = smoothed((moving - flying) * height / 5.0, 3.0)
    climb += smoothed(0.7 * flying * np.sin(swing / 11.0 + phase), 3.0)
    ground_speed = smoothed(flying * speed * (1.0 + 0.1 * np.sin(swing / 17.0 + phase)), 3.0)
    course = heading + integral(smoothed(course_rate, 1.2))
    yaw = course + smoothed(flying * sway * np.sin(swing / 14.0 + phase), 3.0)
    velocity_n = velocity_of(ground_speed, course, climb)

    def attitude(velocity_n: Array, acceleration_n: Array) -> Array:
        return thrust_attitude(velocity_n, acceleration_n, yaw, gravity_at(start_lla))

    return motion_through(t, velocity_n, attitude, start_lla)


def car_drive(
    duration: float = 60.0,
    seed: int | None = None,
    *,
    start_lla: ArrayLike = START_LLA,
    heading: float = 0.0,
    rest: float = 4.0,
) -> Motion:
    """
    Stand, then drive through a town: legs, bends and stops on a gently rolling road.

    The nose points along the velocity (pitch included) and the road is level across.
    Arguments as for `quadrotor_flight`; without a seed the town is always the same.
    """
    t = time_grid(duration)
    speed, course_rate = np.zeros_like(t), np.zeros_like(t)
    rng = np.random.default_rng(0 if seed is None else seed)
    first = begin = rest + 3.5  # the speed spreads its steps over seven seconds
    while begin < duration:
        kind = rng.choice(["leg", "bend", "stop"], p=[0.5, 0.38, 0.12]) if begin > first else "leg"
        if kind == "leg":
            length, pace, angle = rng.uniform(5.0, 12.0), rng.uniform(9.0, 16.0), 0.0
        elif kind == "bend":
            length, pace = rng.uniform(4.0, 7.0), rng.uniform(5.0, 8.0)
            angle = rng.choice([-1.0, 1.0]) * rng.uniform(0.5, 1.7)
        else:
            length, pace, angle = rng.uniform(9.0, 15.0), 0.0, 0.0
        span = (t >= begin) & (t < begin + length)
        speed[span], course_rate[span] = pace, angle / length
        begin += length
    speed = smoothed(speed, 7.0)
    slope = 0.03 * np.sin(2.0 * np.pi * integral(speed) / 500.0)
    course = heading + integral(smoothed(course_rate, 2.0))
    velocity_n = velocity_of(speed, course, speed * np.tan(slope))
    rpy = np.stack((np.zeros_like(t), slope, course), axis=-1)
    return motion_through(t, velocity_n, rpy, start_lla)


def aircraft_flight(
    duration: float = 60.0,
    seed: int | None = None,
    *,
    start_lla: ArrayLike = (*START_LLA[:2], 1000.0),
    heading: float = 0.0,
) -> Motion:
    """
    Cruise at 60 m/s with coordinated turns and climbs; starts in the air.

    The nose points along the velocity, and the bank keeps the side force at zero.
    Arguments as for `quadrotor_flight`; without a seed the flight is always the same.
    """
    t = time_grid(duration)
    rng = np.random.default_rng(0 if seed is None else seed)
    speed = 60.0 + smoothed(_steps(t, rng, 15.0, 6.0), 10.0)
    climb = smoothed(_steps(t, rng, 20.0, 2.5), 10.0)
    course_rate = smoothed(_steps(t, rng, 12.0, 0.06), 4.0)
    course = heading + integral(course_rate)
    slope = np.arctan2(climb, speed)

    def attitude(_: Array, acceleration_n: Array) -> Array:
        # Roll turns the body's y axis out of the specific force.
        north, east, down = (acceleration_n - [0.0, 0.0, gravity_at(start_lla)]).T
        forward, right = along_and_across(north, east, course)
        bank = np.arctan2(right, -forward * np.sin(slope) - down * np.cos(slope))
        return np.stack((bank, slope, course), axis=-1)

    return motion_through(t, velocity_of(speed, course, climb), attitude, start_lla)


def random_motion(
    duration: float = 60.0,
    seed: int | None = None,
    *,
    start_lla: ArrayLike = START_LLA,
    heading: float = 0.0,
    rest: float = 0.0,
    speed_std: float = 5.0,
    tilt_std: float = 0.2,
    period: float = 3.0,
) -> Motion:
    """
    Wander: velocity and attitude are independent smoothed random steps.

    Parameters
    ----------
    duration, seed, start_lla, heading, rest
        As for `quadrotor_flight`; without a seed the motion is always the same.
    speed_std : float
        Spread of each velocity component's steps [m/s].
    tilt_std : float
        Spread of roll's and pitch's steps [rad]; yaw walks by five times as much per step.
    period : float
        Length of the steps [s]; accelerations are about ``speed_std / period``.
    """
    t = time_grid(duration)
    rng = np.random.default_rng(0 if seed is None else seed)
    moving = np.where(t >= rest + 0.5 * period, 1.0, 0.0)
    steps = [
        moving * _steps(t, rng, period, std)
        for std in (speed_std, speed_std, 0.4 * speed_std, tilt_std, tilt_std)
    ]
    north, east, down, roll, pitch = (smoothed(step, period) for step in steps)
    turn_rate = moving * _steps(t, rng, period, 5.0 * tilt_std / period)
    yaw = heading + integral(smoothed(turn_rate, period))
    rpy = np.stack((roll, pitch, yaw), axis=-1)
    return motion_through(t, np.stack((north, east, down), axis=-1), rpy, start_lla)


def time_grid(duration: float) -> Array:
    """Return the knots of the splines [s], shape (N,)."""
    count = max(int(np.ceil(duration / GRID_STEP)), 12)
    return np.linspace(0.0, duration, count + 1)


def smoothed(values: Array, width: float) -> Array:
    """Spread every step over `width` seconds, half of them before it (Hann window)."""
    taps = np.hanning(2 * round(0.5 * width / GRID_STEP) + 3)
    padded = np.pad(values, taps.size // 2, mode="edge")
    smooth: Array = np.convolve(padded, taps / taps.sum(), mode="valid")
    return smooth


def integral(rate: Array) -> Array:
    """Return the integral from the first knot on, by the trapezoidal rule."""
    steps = 0.5 * (rate[1:] + rate[:-1]) * GRID_STEP
    return np.concatenate(([0.0], np.cumsum(steps)))


def _steps(times: Array, rng: np.random.Generator, period: float, std: float) -> Array:
    """Draw a new value every `period` seconds."""
    index = np.floor(times / period).astype(int)
    values: Array = rng.normal(0.0, std, index[-1] + 1)[index]
    return values


def velocity_of(speed: Array, course: Array, climb: Array) -> Array:
    """Return the NED velocity (N, 3) of a horizontal speed, a course and a climb."""
    return np.stack((speed * np.cos(course), speed * np.sin(course), -climb), axis=-1)


def gravity_at(lla: ArrayLike) -> float:
    """Return the normal gravity down [m/s²] at a place (3,)."""
    lat, _, height = np.asarray(lla, float)
    return float(earth.normal_gravity(lat, height)[1])


def thrust_attitude(velocity_n: Array, acceleration_n: Array, yaw: Array, gravity: float) -> Array:
    """Return roll, pitch and yaw (N, 3) [rad] of a quadrotor that moves so, (N, 3), with drag."""
    thrust_n = acceleration_n + QUADROTOR_DRAG * velocity_n * [1.0, 1.0, 0.0]
    thrust_n[:, 2] -= gravity
    forward, right = along_and_across(thrust_n[:, 0], thrust_n[:, 1], yaw)
    roll = np.arcsin(right / np.linalg.norm(thrust_n, axis=-1))
    pitch = np.arctan2(-forward, -thrust_n[:, 2])
    return np.stack((roll, pitch, yaw), axis=-1)


def along_and_across(north: Array, east: Array, yaw: Array) -> tuple[Array, Array]:
    """Return the components along a heading [rad] and to its right."""
    along = np.cos(yaw) * north + np.sin(yaw) * east
    across = np.cos(yaw) * east - np.sin(yaw) * north
    return along, across


def motion_through(
    times: Array,
    velocity_n: Array,
    rpy: Array | Callable[[Array, Array], Array],
    start_lla: ArrayLike,
) -> Motion:
    """Make the splines; `rpy` may be a function of velocity and acceleration on the grid."""
    from scipy.interpolate import make_interp_spline  # here: it takes long to load

    velocity = make_interp_spline(times, velocity_n, k=5)
    if callable(rpy):
        rpy = rpy(velocity_n, velocity.derivative()(times))
    return Motion(
        start_lla=np.asarray(start_lla, float),
        duration=float(times[-1]),
        displacement=velocity.antiderivative(),
        rpy=make_interp_spline(times, rpy, k=5),
    )
