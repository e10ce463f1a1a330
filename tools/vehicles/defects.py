"""What real recordings have besides noise, done to a simulated one; each is drawn at random."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from hybrid_ins.core.inertial import earth
from hybrid_ins.core.inertial.rotations import matrix_from_quat, quat_from_matrix, quat_from_rpy
from hybrid_ins.ros.messages.trajectory import Array
from hybrid_ins.simulation.sensors import in_outage
from hybrid_ins.simulation.vehicles import Recording, engine_phases

PROBABILITY = 0.2  # of each
DELAY = 0.1  # s, of the fixes' arrival
Defect = Callable[[Recording, np.random.Generator], Recording]


def draw(
    recording: Recording, rng: np.random.Generator, probability: float = PROBABILITY
) -> tuple[Recording, list[str]]:
    """Return the recording with some of the defects, and their names."""
    names = [name for name in DEFECTS if rng.random() < probability]
    for name in names:
        recording = DEFECTS[name](recording, rng)
    return recording, names


def repeated_rows(recording: Recording, rng: np.random.Generator) -> Recording:
    """Let the IMU's log hold old readings again, as one that is read faster than it measures."""
    imu = recording.imu
    fresh = rng.random(len(imu.t)) >= rng.uniform(0.05, 0.35)
    fresh[0] = True
    row = np.maximum.accumulate(np.where(fresh, np.arange(len(imu.t)), 0))
    return _with_readings(recording, imu.specific_force[row], imu.angular_rate[row])


def irregular_stamps(recording: Recording, rng: np.random.Generator) -> Recording:
    """Stamp the IMU's samples with a jitter of up to a third of the period."""
    imu = recording.imu
    jitter = rng.uniform(0.1, 1.0 / 3.0) * rng.uniform(-1.0, 1.0, len(imu.t))
    return replace(recording, imu=replace(imu, t=imu.t + jitter / recording.vehicle.imu_rate))


def imu_gap(recording: Recording, rng: np.random.Generator) -> Recording:
    """Lose the IMU's samples once while it moves."""
    imu = recording.imu
    lost = _in_motion(recording, rng), math.exp(rng.uniform(*np.log((0.05, 1.5))))
    kept = ~in_outage(imu.t, [lost])
    fields = ("t", "specific_force", "angular_rate")
    return replace(recording, imu=replace(imu, **{n: getattr(imu, n)[kept] for n in fields}))


def scale_and_axes(recording: Recording, rng: np.random.Generator) -> Recording:
    """Give the sensors scale errors, and axes that are not at right angles."""

    def distort(values: Array) -> Array:
        errors = np.diag(0.01 * rng.standard_normal(3)) + 0.006 * rng.standard_normal((3, 3))
        return values + values @ errors.T

    imu = recording.imu
    return _with_readings(recording, distort(imu.specific_force), distort(imu.angular_rate))


def warming_up(recording: Recording, rng: np.random.Generator) -> Recording:
    """Let the biases drift as the IMU warms up."""
    imu = recording.imu
    share = 1.0 - np.exp(-imu.t / rng.uniform(30.0, 200.0))[:, None]
    return _with_readings(
        recording,
        imu.specific_force + share * 0.15 * rng.standard_normal(3),
        imu.angular_rate + share * 0.005 * rng.standard_normal(3),
    )


def strong_vibration(recording: Recording, rng: np.random.Generator) -> Recording:
    """Shake the IMU with an engine's tone of any frequency, seen through the sampling."""
    imu = recording.imu
    on = (imu.t > rng.uniform(0.0, recording.vehicle.rest))[:, None]
    phases = engine_phases(imu.t, rng.uniform(20.0, 200.0), rng.uniform(0.02, 0.3), rng)
    return _with_readings(
        recording,
        imu.specific_force + on * rng.uniform(0.5, 5.0, 3) * np.sin(phases),
        imu.angular_rate + on * rng.uniform(0.01, 0.1, 3) * np.cos(phases),
    )


def turned_imu(recording: Recording, rng: np.random.Generator) -> Recording:
    """Mount the IMU at any angle about the vertical and up to 15 degrees tilted."""
    tilt = np.radians(rng.uniform(-15.0, 15.0, 2))
    C_bs = matrix_from_quat(quat_from_rpy(*tilt, rng.uniform(-np.pi, np.pi)))
    truth, imu = recording.truth, recording.imu
    turned = replace(truth, quat_xyzw=quat_from_matrix(truth.C_nb @ C_bs))
    recording = replace(recording, truth=turned)
    return _with_readings(recording, imu.specific_force @ C_bs, imu.angular_rate @ C_bs)


def unknown_lever_arm(recording: Recording, rng: np.random.Generator) -> Recording:
    """Put the antenna, of which the position is judged, some decimetres from the IMU."""
    lever_arm_b = rng.uniform(-0.4, 0.4, 3)
    truth = recording.truth
    arm_n = truth.C_nb @ lever_arm_b
    arm_rate = np.gradient(arm_n, truth.t, axis=0)
    scale = earth.curvature_scale(truth.lla[0])
    velocity_n = recording.fix_velocity_n
    if velocity_n is not None:
        age = recording.vehicle.receiver.velocity_age
        velocity_n = velocity_n + _interpolated(recording.fix_t - age, truth.t, arm_rate)
    return replace(
        recording,
        truth=replace(truth, lla=truth.lla + arm_n / scale),
        fix_lla=recording.fix_lla + _interpolated(recording.fix_t, truth.t, arm_n) / scale,
        fix_velocity_n=velocity_n,
    )


def stamped_on_arrival(recording: Recording, rng: np.random.Generator) -> Recording:
    """Stamp the fixes when the driver reads them: late, by an amount that varies."""
    late = rng.exponential(rng.uniform(0.003, 0.03), len(recording.fix_t))
    return replace(recording, fix_stamp=recording.fix_stamp + np.minimum(late, 0.09))


def quantised(recording: Recording, rng: np.random.Generator) -> Recording:
    """Round latitude and longitude to 1e-6 or 1e-7 degrees, the height by its claim at most."""
    degrees = float(rng.choice([1e-7, 1e-6]))
    height = min(float(rng.choice([0.1, 1.0])), recording.vehicle.receiver.claimed_std[2])
    steps = np.array([math.radians(degrees), math.radians(degrees), height])
    return replace(recording, fix_lla=np.round(recording.fix_lla / steps) * steps)


def reflections(recording: Recording, rng: np.random.Generator) -> Recording:
    """Move some fixes in a row by several times their claim, smoothly, once or twice."""
    lla = recording.fix_lla.copy()
    claim = np.asarray(recording.vehicle.receiver.claimed_std)
    for _ in range(rng.integers(1, 3)):
        length = rng.uniform(3.0, 10.0)
        since = (recording.fix_t - _in_motion(recording, rng)) / length
        shape = np.where((since > 0.0) & (since < 1.0), np.sin(np.pi * since), 0.0)
        size = rng.uniform(2.0, 8.0) * claim * rng.standard_normal(3)
        lla += shape[:, None] * size / earth.curvature_scale(lla[0])
    return replace(recording, fix_lla=lla)


def outliers(recording: Recording, rng: np.random.Generator) -> Recording:
    """Throw single fixes off by metres or tens of metres."""
    hit = (rng.random(len(recording.fix_t)) < rng.uniform(0.01, 0.08))[:, None]
    error = hit * rng.uniform(3.0, 30.0) * rng.standard_normal((len(hit), 3))
    lla = recording.fix_lla + error / earth.curvature_scale(recording.fix_lla[0])
    return replace(recording, fix_lla=lla)


def outage(recording: Recording, rng: np.random.Generator) -> Recording:
    """Lose the fixes for 5 to 20 seconds while it moves."""
    lost = _in_motion(recording, rng), rng.uniform(5.0, 20.0)
    kept, velocity_n = ~in_outage(recording.fix_t, [lost]), recording.fix_velocity_n
    return replace(
        recording,
        fix_t=recording.fix_t[kept],
        fix_stamp=recording.fix_stamp[kept],
        fix_lla=recording.fix_lla[kept],
        fix_velocity_n=None if velocity_n is None else velocity_n[kept],
    )


DEFECTS: dict[str, Defect] = {
    function.__name__: function
    for function in (
        repeated_rows,
        scale_and_axes,
        warming_up,
        strong_vibration,
        turned_imu,
        unknown_lever_arm,
        irregular_stamps,
        imu_gap,
        stamped_on_arrival,
        reflections,
        outliers,
        quantised,
        outage,
    )
}


def _in_motion(recording: Recording, rng: np.random.Generator) -> float:
    """Return a time [s] while it moves."""
    return float(rng.uniform(recording.vehicle.rest + 5.0, recording.vehicle.duration - 20.0))


def _with_readings(recording: Recording, force: Array, rate: Array) -> Recording:
    return replace(recording, imu=replace(recording.imu, specific_force=force, angular_rate=rate))


def _interpolated(t: Array, known_t: Array, values: Array) -> Array:
    return np.stack([np.interp(t, known_t, axis) for axis in values.T], axis=1)
