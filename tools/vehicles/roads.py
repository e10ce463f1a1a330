"""Simulated roads besides the named ones: of any roughness, and of one that changes on the way."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from hybrid_ins.ros.messages.trajectory import Array
from hybrid_ins.simulation.motions import GRID_STEP, Motion, smoothed
from hybrid_ins.simulation.road_vehicles import MEASURED, MEMS, Ride, RoadCar
from hybrid_ins.simulation.sensors import gauss_markov
from hybrid_ins.simulation.vehicles import Recording, Vehicle, record, streets

CHANGING = "road car, changing"
ROUGHNESS = (0.25, 4.0)  # of that of `Ride`
STRETCH = (10.0, 40.0)  # s, of one surface
ROAD_STD, ROAD_TIME = 0.1, 0.01  # m/s² at 10 m/s, s: vibration of an ordinary road
RATE_SHARE = 0.03  # rad/s per m/s² of vibration


def random_road(seed: int, duration: float, imu_rate: float = 100.0) -> Recording:
    """Return a drive on a road of any roughness, in a car of its own."""
    rng = np.random.default_rng([seed, 79])

    def about(value: float, spread: float) -> float:
        return value * float(np.exp(spread * rng.standard_normal()))

    rough = float(np.exp(rng.uniform(*np.log(ROUGHNESS))))
    ride = Ride(
        imu_b=(float(rng.uniform(-0.5, 2.0)), float(rng.uniform(-0.5, 0.5)), -0.3),
        slip=float(np.exp(rng.uniform(np.log(0.002), np.log(0.012)))),
        wander_std=about(0.02 * rough, 0.3),
        heave_std=about(0.04 * rough, 0.3),
        pitch_std=about(0.003 * rough, 0.3),
        bank_std=float(rng.uniform(0.005, 0.03)),
    )
    road_std, share = about(ROAD_STD * rough, 0.5), float(rng.uniform(0.0, 2.0))
    tones = tuple(
        replace(
            tone,
            frequency=about(tone.frequency, 0.3),
            accelerometer=share * np.asarray(tone.accelerometer),
            gyroscope=share * np.asarray(tone.gyroscope),
        )
        for tone in MEMS.tones
    )
    errors = replace(MEMS, tones=tones)
    car = Vehicle(
        "road car, random", RoadCar(ride), MEASURED, errors, imu_rate, 10.0, 0.0, road_std, duration
    )
    return record(car, seed)


@dataclass(frozen=True)
class ChangingCar:
    """The motion of a car on a road whose surface changes, see `Vehicle.motion`."""

    ride: Ride = field(default_factory=Ride)
    rest: float = 10.0  # s

    def __call__(self, duration: float, seed: int) -> Motion:
        """Return the motion for a duration [s] and a seed."""
        t, speed, course = streets(duration, seed, self.rest)
        rough = roughness(t, seed)
        ride = self.ride
        changing = replace(
            ride,
            wander_std=ride.wander_std * rough,
            heave_std=ride.heave_std * rough,
            pitch_std=ride.pitch_std * rough,
        )
        return RoadCar(changing).along(t, speed, course, seed, np.zeros((len(t), 3)))


def changing_road(seed: int, duration: float, imu_rate: float = 100.0) -> Recording:
    """Return a drive on a road whose surface and vibration change every 10 to 40 s."""
    smooth = ROUGHNESS[0] * ROAD_STD
    car = Vehicle(CHANGING, ChangingCar(), MEASURED, MEMS, imu_rate, 10.0, 0.0, smooth, duration)
    drive = record(car, seed)
    t, rng = drive.truth.t, np.random.default_rng([seed, 78])
    decay = float(np.exp(-1.0 / imu_rate / ROAD_TIME))
    added = np.sqrt(np.maximum((roughness(t, seed) * ROAD_STD) ** 2 - smooth**2, 0.0))
    added = added * 0.1 * np.linalg.norm(drive.truth.velocity_n, axis=1)
    shaking = [gauss_markov(1.0, decay, len(t), rng) * added[:, None] for _ in range(2)]
    imu = replace(
        drive.imu,
        specific_force=drive.imu.specific_force + shaking[0],
        angular_rate=drive.imu.angular_rate + RATE_SHARE * shaking[1],
    )
    return replace(drive, imu=imu)


def roughness(t: Array, seed: int) -> Array:
    """Return the roughness (N,) at times (N,) [s] of a road that changes."""
    rng = np.random.default_rng([seed, 77])
    count = 2 + int(t[-1] / STRETCH[0])
    edges = np.cumsum(rng.uniform(*STRETCH, count))
    level = np.exp(rng.uniform(*np.log(ROUGHNESS), count + 1))
    fine = np.arange(0.0, t[-1] + GRID_STEP, GRID_STEP)
    return np.interp(t, fine, smoothed(level[np.searchsorted(edges, fine)], 2.0))
