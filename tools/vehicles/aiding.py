"""Messages of aiding sensors on simulated drives: wheels, a compass, a barometer."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.bags.messages import new_message
from hybrid_ins.core.inertial.rotations import quat_from_rpy, rpy_from_quat
from hybrid_ins.ros.aids.aiding_sources import TOPICS
from hybrid_ins.ros.messages import conversions
from hybrid_ins.simulation.sensors import gauss_markov, to_body
from hybrid_ins.simulation.vehicles import Recording
from tools.vehicles.drives import EPOCH_NS

RATE = 10.0  # Hz


class Aiding(NamedTuple):
    """A message when it arrives [ns, IMU's time]."""

    arrival_ns: int
    topic: str
    message: Any


def wheels(recording: Recording, scale: float = 1.01, delay: float = 0.05) -> list[Aiding]:
    """Return speeds at the rear axle that read ``1 / scale`` of the truth, σ 0.05 m/s."""
    rng = np.random.default_rng([11, len(recording.fix_t)])
    truth = recording.truth
    axle_b = -np.array(getattr(getattr(recording.vehicle.motion, "ride", None), "imu_b", (0, 0, 0)))
    velocity_b = to_body(truth.C_nb, truth.velocity_n)
    velocity_b = velocity_b + np.cross(truth.angular_rate_eb_b, axle_b)
    found = []
    for k in _rows(recording):
        speed = velocity_b[k, 0] / scale + 0.05 * rng.standard_normal()
        message, t_ns = _message("aiding/velocity", truth.t[k])
        message.twist.twist.linear.x = float(speed)
        message.twist.covariance[0] = 0.05**2
        found.append(Aiding(t_ns + round(delay * 1e9), "aiding/velocity", message))
    return found


def compass(recording: Recording, error: float, std: float, delay: float = 0.02) -> list[Aiding]:
    """Return headings with a constant error and noise, which claim only the noise [rad]."""
    rng = np.random.default_rng([12, len(recording.fix_t)])
    truth = recording.truth
    rpy = rpy_from_quat(truth.quat_xyzw)
    found = []
    for k in _rows(recording):
        yaw_enu = 0.5 * np.pi - rpy[k, 2] - error + std * rng.standard_normal()
        message, t_ns = _message("aiding/heading", truth.t[k])
        q, quat = message.orientation, quat_from_rpy(rpy[k, 0], -rpy[k, 1], yaw_enu)
        q.x, q.y, q.z, q.w = quat.tolist()
        message.orientation_covariance[[0, 4, 8]] = std**2
        found.append(Aiding(t_ns + round(delay * 1e9), "aiding/heading", message))
    return found


def barometer(recording: Recording, delay: float = 0.05) -> list[Aiding]:
    """Return pressures whose height is off by tens of metres, and wanders by metres in minutes."""
    rng = np.random.default_rng([13, len(recording.fix_t)])
    truth = recording.truth
    rows = _rows(recording)
    wander = gauss_markov(1.0, float(np.exp(-1.0 / RATE / 300.0)), len(rows), rng)[:, 0]
    found = []
    for at, k in enumerate(rows):
        height = truth.lla[k, 2] + 30.0 + wander[at] + 0.15 * rng.standard_normal()
        message, t_ns = _message("aiding/pressure", truth.t[k])
        message.fluid_pressure = float(101325.0 * (1.0 - height / 44330.8) ** (1.0 / 0.190263))
        message.variance = 4.0
        found.append(Aiding(t_ns + round(delay * 1e9), "aiding/pressure", message))
    return found


def in_order(*streams: Sequence[Aiding]) -> list[Aiding]:
    """Return the messages of several sensors in the order of their arrival."""
    return sorted((one for stream in streams for one in stream), key=lambda one: one.arrival_ns)


def _rows(recording: Recording) -> NDArray[np.int64]:
    step = max(1, round(recording.vehicle.imu_rate / RATE))
    return np.arange(step, len(recording.truth.t), step)


def _message(topic: str, t: float) -> tuple[Any, int]:
    message = new_message(TOPICS[topic])
    t_ns = EPOCH_NS + round(float(t) * 1e9)
    conversions.set_stamp(message.header.stamp, t_ns)
    return message, t_ns
