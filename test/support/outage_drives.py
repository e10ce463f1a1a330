"""Drives of the simulated vehicles at 50 Hz, and the values of a calibrated IMU for them."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

from hybrid_ins import parameters
from hybrid_ins.simulation.vehicles import Recording, record
from tools.vehicles.drives import Drive, from_simulation
from tools.vehicles.outages import every_vehicle

CALIBRATED: dict[str, Any] = {
    "gnss.time_offset.estimate": False,
    "imu.gyroscope_bias_std": [0.004],
    "imu.accelerometer_bias_std": [0.08],
    "noise.mode": "constant",
    "noise.q_accelerometer": 0.02,
    "noise.q_gyroscope": 1e-4,
}


def calibrated(**changes: Any) -> dict[str, Any]:
    """Return checked parameters; unchecked changes of them."""
    return {**parameters.check_all(CALIBRATED), **changes}


@cache
def recording(name: str, duration: float = 230.0, seed: int = 2) -> Recording:
    """Return a recording of a vehicle."""
    vehicle = replace(every_vehicle()[name], duration=duration, imu_rate=50.0)
    return record(vehicle, seed)


@cache
def drive(name: str, duration: float = 230.0, seed: int = 2) -> Drive:
    """Return the same, ready for the estimator."""
    return from_simulation(recording(name, duration, seed))
