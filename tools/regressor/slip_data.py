"""
Windows of IMU samples of simulated cars, with the slip at their end.

What of it follows from the motion, `ConstraintObserver` estimates: the place of the point without
slip, which tyres that slip out of turns displace, and how the body pitches with the acceleration.
The slip is what the best values of these for a drive leave.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from hybrid_ins.ros.messages.trajectory import Array
from hybrid_ins.simulation.sensors import to_body
from hybrid_ins.simulation.vehicles import Recording
from tools.vehicles.roads import changing_road, random_road

RATES_HZ = (100.0, 50.0, 200.0)
DURATION = 200.0  # s, of a drive
BETWEEN = 0.5  # s, between two windows
SETTLED = 20.0  # s, before the first one


class Drive(NamedTuple):
    """The windows of one drive."""

    readings: Array  # (B, 6, N) m/s², rad/s: forward, right, down; one second each
    slip: Array  # (B, 2) m/s, to the right and down, at the end


def drives(seeds: Sequence[int], changing: Sequence[int]) -> Iterator[Drive]:
    """Yield drives on random roads, and on roads that change, by their seeds."""
    roads = [(random_road, seed) for seed in seeds] + [(changing_road, seed) for seed in changing]
    for k, (road, seed) in enumerate(roads):
        yield windows(road(seed, DURATION, RATES_HZ[k % len(RATES_HZ)]))


def slip_of(recording: Recording) -> Array:
    """Return the velocity (N, 3) of the point of a car that follows the road, body axes."""
    truth = recording.truth
    axle_b = -np.array(recording.vehicle.motion.ride.imu_b)  # type: ignore[attr-defined]
    return to_body(truth.C_nb, truth.velocity_n) + np.cross(truth.angular_rate_eb_b, axle_b)


def unexplained(recording: Recording) -> Array:
    """Return the slip (N, 2), right and down, that no place of its point and no squat explain."""
    axle, truth = slip_of(recording), recording.truth
    speed, rate = axle[:, 0], truth.angular_rate_eb_b[:, 2]
    squat = speed * np.gradient(speed, truth.t)
    left = np.empty((len(axle), 2))
    for i, explained in enumerate(((speed, rate), (speed, squat))):
        by = np.stack(explained, axis=1)
        left[:, i] = axle[:, 1 + i] - by @ np.linalg.lstsq(by, axle[:, 1 + i], rcond=None)[0]
    return left


def windows(recording: Recording) -> Drive:
    """Return the windows of a drive."""
    size = round(recording.vehicle.imu_rate)
    ends = np.arange(round(SETTLED * size), len(recording.truth.t), round(BETWEEN * size))
    samples = np.hstack((recording.imu.specific_force, recording.imu.angular_rate))
    readings = np.stack([samples[end - size + 1 : end + 1].T for end in ends])
    return Drive(readings, unexplained(recording)[ends])
