"""
A simulated drive or flight, its sensors and its truth, as a bag.

The bag holds what the node subscribes to, the true motion, and what the filter estimates besides:
the true biases and noise variances.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from hybrid_ins.bags import flight_bag
from hybrid_ins.bags.flight_bag import Entry, GnssRecord, ImuRecord, TruthRecord, stamps
from hybrid_ins.bags.messages import new_message
from hybrid_ins.core.inertial.rotations import quat_from_rpy, quat_multiply
from hybrid_ins.errors import InputError
from hybrid_ins.ros.messages.conversions import FLIP
from hybrid_ins.ros.messages.trajectory import Trajectory
from hybrid_ins.ros.messages.type_names import ACCELERATION, VECTOR
from hybrid_ins.simulation.motions import (
    Motion,
    aircraft_flight,
    car_drive,
    quadrotor_flight,
    random_motion,
    static,
)
from hybrid_ins.simulation.sensors import (
    RTK_STD,
    ImuData,
    ImuErrors,
    Truth,
    corrupt,
    fixes,
    report_empty_outages,
    sample,
    sample_times,
)

ORIENTATION_STD = np.radians([1.0, 1.0, 3.0])  # roll, pitch, yaw of an AHRS's orientation
MOST_SAMPLES = 5_000_000  # about 4 GB of memory
MONITOR_RATE = 10.0  # Hz, of the true biases and noise variances in the bag

MOTIONS: dict[str, Callable[..., Motion]] = {
    "quadrotor": quadrotor_flight,
    "car": car_drive,
    "aircraft": aircraft_flight,
    "random": random_motion,
    "static": static,
}


@dataclass(frozen=True)
class Scenario:
    """A motion and the sensors that follow it; vectors in FRD."""

    motion: str = "quadrotor"  # a key of MOTIONS
    variant: int | None = None  # seed of the manoeuvres; None: the nominal ones
    duration: float = 60.0  # s
    start_lla: ArrayLike | None = None  # rad, rad, m; None: the motion's own
    heading: float = 0.0  # rad, from north, clockwise
    truth_rate: float = 100.0  # Hz
    imu_rate: float = 1000.0  # Hz
    imu_errors: ImuErrors = field(default_factory=ImuErrors)
    orientation: bool = False  # the IMU is an AHRS
    gnss_rate: float = 5.0  # Hz
    gnss_noise: ArrayLike = RTK_STD  # m: north, east, down
    velocity_std: float | None = None  # m/s; None: the receiver reports no velocity
    outages: Sequence[tuple[float, float]] = ()  # start, duration [s]
    lever_arm_b: ArrayLike = (0.0, 0.0, 0.0)  # m, from the IMU to the antenna
    time_offset: float = 0.0  # s, IMU clock minus reference clock
    seed: int = 0  # of all noise


def simulate(scenario: Scenario, out: Path, *, overwrite: bool = False) -> str:
    """
    Simulate a scenario and write its bag.

    Parameters
    ----------
    scenario : Scenario
    out : Path
    overwrite : bool
        See `hybrid_ins.bags.writer.BagWriter`.

    Returns
    -------
    str
        A line on what was written.

    Raises
    ------
    InputError
        There are too few or too many samples, no fix is left, or the bag cannot be written.

    """
    samples = scenario.duration * max(scenario.imu_rate, scenario.gnss_rate, scenario.truth_rate)
    if not 2.0 <= samples <= MOST_SAMPLES:
        raise InputError(
            f"--duration {scenario.duration:g} s makes {samples:.3g} samples:"
            f" 2 to {MOST_SAMPLES:g} fit"
        )
    motion = _motion(scenario)
    imu_rng, gnss_rng, orientation_rng = np.random.default_rng(scenario.seed).spawn(3)
    imu_truth = sample(motion, sample_times(scenario.duration, scenario.imu_rate))
    imu = corrupt(imu_truth, scenario.imu_errors, imu_rng)
    offset_ns = round(scenario.time_offset * 1e9)
    gnss = _gnss_record(scenario, motion, gnss_rng, offset_ns)
    truth = sample(motion, sample_times(scenario.duration, scenario.truth_rate))
    trajectory = Trajectory.from_navigation(
        stamps(truth.t) - offset_ns,
        truth.lla,
        truth.velocity_n,
        truth.quat_xyzw,
        datum_lla=flight_bag.first_datum(gnss),
    )
    flight_bag.write_flight(
        out,
        _imu_record(scenario, imu, imu_truth, orientation_rng),
        gnss,
        TruthRecord(trajectory, truth.angular_rate_eb_b),
        log_offset_ns=offset_ns,
        others=[_error_entries(imu, scenario.imu_rate)],
        overwrite=overwrite,
    )
    return (
        f"{out}: {scenario.motion}, {scenario.duration:g} s;"
        f" {imu.t.size} IMU samples at {scenario.imu_rate:g} Hz,"
        f" {gnss.stamp_ns.size} fixes at {scenario.gnss_rate:g} Hz,"
        f" {truth.t.size} epochs of truth at {scenario.truth_rate:g} Hz"
    )


def _motion(scenario: Scenario) -> Motion:
    options: dict[str, object] = {"heading": scenario.heading}
    if scenario.start_lla is not None:
        options["start_lla"] = scenario.start_lla
    if scenario.motion != "static":
        options["seed"] = scenario.variant
    return MOTIONS[scenario.motion](scenario.duration, **options)


def _imu_record(
    scenario: Scenario, imu: ImuData, truth: Truth, rng: np.random.Generator
) -> ImuRecord:
    record = ImuRecord(stamps(imu.t), imu.specific_force, imu.angular_rate)
    if not scenario.orientation:
        return record
    error = quat_from_rpy(*(ORIENTATION_STD * rng.standard_normal(3)))
    mount = quat_from_rpy(*np.asarray(scenario.imu_errors.mount_rpy))
    return replace(
        record,
        quat_xyzw=quat_multiply(truth.quat_xyzw, quat_multiply(error, mount)),
        attitude_std=ORIENTATION_STD,
    )


def _gnss_record(
    scenario: Scenario, motion: Motion, rng: np.random.Generator, offset_ns: int
) -> GnssRecord:
    received = fixes(
        sample(motion, sample_times(scenario.duration, scenario.gnss_rate)),
        rng,
        scenario.gnss_noise,
        scenario.lever_arm_b,
        scenario.velocity_std,
    )
    report_empty_outages(received.t, scenario.outages)
    gnss = received.without(scenario.outages)
    return GnssRecord(
        stamps(gnss.t) - offset_ns,
        gnss.lla,
        gnss.position_std,
        gnss.velocity_n,
        gnss.velocity_std,
    )


def _error_entries(imu: ImuData, imu_rate: float) -> Iterator[Entry]:
    """Yield messages of the true biases and noise variances, sensor axes (FLU)."""
    bias = new_message(ACCELERATION)
    noise = new_message(VECTOR)
    for row in range(0, imu.t.size, max(round(imu_rate / MONITOR_RATE), 1)):
        stamp_ns = int(stamps(imu.t[row]))
        flight_bag.stamp(bias, stamp_ns, "imu_link")
        flight_bag.set_vector(bias.accel.accel.linear, imu.accelerometer_bias[row] @ FLIP)
        flight_bag.set_vector(bias.accel.accel.angular, imu.gyroscope_bias[row] @ FLIP)
        yield stamp_ns, 4, "/truth/imu/bias", bias
        flight_bag.stamp(noise, stamp_ns, "imu_link")
        for name in ("accelerometer", "gyroscope"):
            flight_bag.set_vector(noise.vector, getattr(imu, f"{name}_std")[row] ** 2)
            yield stamp_ns, 5, f"/truth/q/{name}", noise
