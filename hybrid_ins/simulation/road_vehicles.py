"""
Cars whose axle slips, whose springs travel, and which are carried: for constraints on motion.

The point that follows the road is the centre of the rear axle; the IMU is elsewhere in the car.
That point slips out of a turn in proportion to the side force of the tyres, [1]_, wanders in ruts
and wind, and heaves over bumps; the body squats and dives.

References
----------
.. [1] T. Gillespie, *Fundamentals of Vehicle Dynamics*, 1992, sections 4 and 6 (squat, cornering).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hybrid_ins.core.inertial.rotations import matrix_from_quat, quat_from_rpy
from hybrid_ins.ros.messages.trajectory import Array
from hybrid_ins.simulation.motions import (
    START_LLA,
    Motion,
    motion_through,
    smoothed,
    time_grid,
    velocity_of,
)
from hybrid_ins.simulation.sensors import ImuErrors
from hybrid_ins.simulation.vehicles import (
    CONSUMER,
    SHAKEN,
    Receiver,
    Vehicle,
    slope_along,
    streets,
)


@dataclass(frozen=True)
class Ride:
    """How a car follows its road; speeds and rates are those at 10 m/s, and grow with speed."""

    imu_b: tuple[float, float, float] = (1.2, 0.1, -0.3)  # m, from the rear axle's centre, FRD
    slip: float = 0.006  # rad per m/s² of lateral acceleration
    wander_std: float = 0.02  # m/s, across the road, over a second
    heave_std: float = 0.04  # m/s, of the axle over bumps, over 0.4 s
    squat: float = 0.003  # rad of pitch per m/s² of acceleration
    pitch_std: float = 0.003  # rad, over bumps, over 0.4 s
    bank_std: float = 0.02  # rad, of the road, over 5 s


SMOOTH = Ride(slip=0.003, wander_std=0.01, heave_std=0.01, pitch_std=0.001, bank_std=0.01)
ROUGH = Ride(slip=0.009, wander_std=0.06, heave_std=0.15, pitch_std=0.01, bank_std=0.03)
ICE = Ride(slip=0.12, wander_std=0.6)


@dataclass(frozen=True)
class RoadCar:
    """The motion of a car through streets, see `Vehicle.motion`; ``ride`` None: of any kind."""

    ride: Ride = Ride()
    rest: float = 10.0  # s
    ice_from: float = np.inf  # s, from which on the road is `ICE`

    def __call__(self, duration: float, seed: int) -> Motion:
        """Return the motion for a duration [s] and a seed."""
        t, speed, course = streets(duration, seed, self.rest)
        return self.along(t, speed, course, seed, np.zeros((len(t), 3)))

    def along(self, t: Array, speed: Array, course: Array, seed: int, carried_n: Array) -> Motion:
        """Return the motion for a speed [m/s], a course [rad], and what carries the car (N, 3)."""
        from scipy.interpolate import make_interp_spline  # here: it takes long to load

        ride, rng = self.ride, np.random.default_rng([seed, 15])
        icy = np.where(t >= self.ice_from, 1.0, 0.0)
        slope = slope_along(speed)
        acceleration = np.gradient(speed, t)
        side_force = speed * np.gradient(course, t)
        slip = ride.slip + (ICE.slip - ride.slip) * icy
        wander_std = ride.wander_std + (ICE.wander_std - ride.wander_std) * icy
        faster = 0.1 * speed
        wander = wander_std * faster * _rough(t, 1.0, rng)
        heave = ride.heave_std * faster * _rough(t, 0.4, rng)
        pitch = slope + ride.squat * acceleration
        pitch += ride.pitch_std * np.minimum(faster, 1.0) * _rough(t, 0.4, rng)
        roll = -0.01 * side_force + ride.bank_std * np.minimum(faster, 1.0) * _rough(t, 5.0, rng)
        yaw = course + slip * side_force
        across = np.stack((-np.sin(course), np.cos(course), np.zeros_like(t)), axis=-1)
        axle_n = velocity_of(speed, course, speed * np.tan(slope) - heave)
        axle_n += across * wander[:, None] + carried_n
        rpy = np.stack((roll, pitch, yaw), axis=-1)
        arm_n = matrix_from_quat(quat_from_rpy(*rpy.T)) @ np.array(ride.imu_b)
        swing_n = make_interp_spline(t, arm_n, k=5).derivative()(t)
        return motion_through(t, axle_n + swing_n, rpy, START_LLA)


@dataclass(frozen=True)
class Ferry:
    """A car that drives, stands, and is carried across its nose, see `Vehicle.motion`."""

    boarding: float = 150.0  # s, from which on the car stands
    angle: float = 1.0  # rad, of the ferry's course to the right of the car's nose

    def __call__(self, duration: float, seed: int) -> Motion:
        """Return the motion for a duration [s] and a seed."""
        t, speed, course = streets(duration, seed, 10.0)
        stop = smoothed(np.where(t < self.boarding, 1.0, 0.0), 8.0)
        rate = np.gradient(course, t) * stop
        rng = np.random.default_rng([seed, 16])
        afloat = smoothed(np.where(t > self.boarding + 25.0, 1.0, 0.0), 15.0)
        rate += afloat * 0.02 * np.sin(0.03 * t + rng.uniform(0.0, 6.0))
        yaw = course[0] + np.concatenate(([0.0], np.cumsum(0.5 * (rate[1:] + rate[:-1]) * t[1])))
        sailing = velocity_of(6.0 * afloat, yaw + self.angle, 0.0 * t)
        return RoadCar().along(t, speed * stop, yaw, seed, sailing)


def _rough(t: Array, width: float, rng: np.random.Generator) -> Array:
    """Return noise of unit variance (N,), smoothed over a width [s]."""
    noise = smoothed(rng.standard_normal(len(time_grid(float(t[-1])))), width)
    return np.asarray(noise / np.std(noise))


MEMS = ImuErrors(tones=SHAKEN.tones)
MEASURED = Receiver(rate=1.0)
ROAD_VEHICLES: dict[str, Vehicle] = {
    vehicle.name: vehicle
    for vehicle in (
        Vehicle("road car", RoadCar(), MEASURED, MEMS, road_std=0.1),
        Vehicle("road car, smooth", RoadCar(SMOOTH), MEASURED, MEMS, road_std=0.05),
        Vehicle("road car, rough", RoadCar(ROUGH), MEASURED, MEMS, road_std=0.3),
        Vehicle("road car, consumer", RoadCar(), CONSUMER, MEMS, road_std=0.1),
        Vehicle("car on ice", RoadCar(ICE), MEASURED, MEMS, road_std=0.1),
        Vehicle("car, later on ice", RoadCar(ice_from=150.0), MEASURED, MEMS, road_std=0.1),
        Vehicle("car, then on a ferry", Ferry(), MEASURED, MEMS, road_std=0.1),
    )
}
