"""A robot that spins before it drives, with an antenna that nobody has placed."""

from __future__ import annotations

import numpy as np
import pytest

from hybrid_ins import parameters
from hybrid_ins.simulation.motions import (
    START_LLA,
    Motion,
    integral,
    motion_through,
    smoothed,
    time_grid,
)
from hybrid_ins.simulation.sensors import ImuErrors
from hybrid_ins.simulation.vehicles import Receiver, Vehicle, record
from tools.vehicles import judge
from tools.vehicles.drives import Drive, from_simulation

SPINS = 60.0  # s
IMU_AHEAD = 0.25  # m, of the axle
ANTENNA_B = (-0.6, 0.0, -0.4)  # m, from the IMU


def spinning(duration: float, seed: int) -> Motion:
    """Spin to and fro on the spot, then drive legs that begin and end with a stop."""
    t, rng = time_grid(duration), np.random.default_rng(seed)
    spin = np.select([t < 10.0, t < SPINS - 5.0], [0.0, np.sign(np.sin(0.35 * t))]) * 0.8
    in_leg = np.mod(t - SPINS, 14.0)
    leg = ((t - SPINS) // 14.0).astype(int).clip(0)
    bends, speeds = rng.uniform(-0.25, 0.25, leg.max() + 1), rng.uniform(0.8, 1.4, leg.max() + 1)
    driving = (t > SPINS) & (in_leg < 11.0)
    speed = smoothed(np.where(driving, speeds[leg], 0.0), 1.5)
    rate = smoothed(spin + np.where(driving & (in_leg > 4.0), bends[leg], 0.0), 1.0)
    yaw = rng.uniform(-3.0, 3.0) + integral(rate)
    along, across = np.cos(yaw), np.sin(yaw)
    swing = IMU_AHEAD * rate
    velocity_n = np.stack(
        (speed * along - swing * across, speed * across + swing * along, 0.0 * t), axis=1
    )
    return motion_through(t, velocity_n, np.stack((0.0 * t, 0.0 * t, yaw), axis=1), START_LLA)


def drive(seed: int) -> Drive:
    receiver = Receiver(5.0, antenna_b=ANTENNA_B)
    return from_simulation(record(Vehicle("robot", spinning, receiver, ImuErrors()), seed))


@pytest.mark.parametrize("seed", [1, 3])
def test_the_heading_waits_for_the_drive_and_is_right(seed: int) -> None:
    lines: list[str] = []
    robot = drive(seed)
    _, t_ns, rows = judge.run(robot, parameters.defaults(), lambda _, text: lines.append(text))
    yaw_ns, off, std = judge._heading_errors(robot, t_ns, rows)
    seconds = (yaw_ns - robot.imu_ns[0]) * 1e-9
    known = std < np.radians(10.0)

    assert any("only turns on the spot" in line for line in lines)
    assert not known[seconds < SPINS].any()
    assert known[seconds > 160.0].mean() > 0.9
    assert np.all(off[known] < 3.0 * judge.FAR * std[known])
    assert np.degrees(off[known].max()) < 10.0
