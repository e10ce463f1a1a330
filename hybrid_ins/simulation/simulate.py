"""
A simulated drive or flight, its sensors and its truth, as a bag.

The sensors are those of a `Scenario`, or those that a `Vehicle` comes with. The bag holds what the
node subscribes to, the true motion, and what the filter estimates besides: the true biases and
noise variances.
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
from hybrid_ins.ros.messages.trajectory import Array, Stamps, Trajectory
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
    GnssData,
    ImuData,
    ImuErrors,
    Truth,
    corrupt,
    fixes,
    report_empty_outages,
    sample,
    sample_times,
)
from hybrid_ins.simulation.vehicles import Vehicle, record

ORIENTATION_STD = np.radians([1.0, 1.0, 3.0])  # roll, pitch, yaw of an AHRS's orientation
MOST_SAMPLES = 5_000_000  # about 4 GB of memory
STAMPS_END = 2.0**31  # s since 1970, the seconds of a stamp
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
    fastest = max(scenario.imu_rate, scenario.gnss_rate, scenario.truth_rate)
    _check_size(scenario.duration, fastest)
    _check_dates(scenario.duration, scenario.time_offset)
    motion = _motion(scenario)
    imu_rng, gnss_rng, orientation_rng = np.random.default_rng(scenario.seed).spawn(3)
    imu_truth = sample(motion, sample_times(scenario.duration, scenario.imu_rate))
    imu = corrupt(imu_truth, scenario.imu_errors, imu_rng)
    received = fixes(
        sample(motion, sample_times(scenario.duration, scenario.gnss_rate)),
        gnss_rng,
        scenario.gnss_noise,
        scenario.lever_arm_b,
        scenario.velocity_std,
    )
    wrote = _write(
        out,
        _imu_record(scenario, imu, imu_truth, orientation_rng),
        imu,
        _without(received, scenario.outages),
        sample(motion, sample_times(scenario.duration, scenario.truth_rate)),
        scenario.time_offset,
        overwrite=overwrite,
    )
    return f"{out}: {scenario.motion}, {wrote}"


def simulate_vehicle(
    vehicle: Vehicle,
    out: Path,
    *,
    seed: int = 0,
    truth_rate: float = 100.0,
    outages: Sequence[tuple[float, float]] = (),
    overwrite: bool = False,
) -> str:
    """
    Simulate a vehicle with the sensors that it comes with and write its bag.

    Parameters
    ----------
    vehicle : Vehicle
    out : Path
    seed : int
        Of its way and of all noise.
    truth_rate : float
        Hz; at most the IMU's.
    outages : sequence of (float, float)
        Start, duration [s].
    overwrite : bool
        See `hybrid_ins.bags.writer.BagWriter`.

    Returns
    -------
    str
        A line on what was written.

    Raises
    ------
    InputError
        See `simulate`.

    """
    receiver = vehicle.receiver
    _check_size(vehicle.duration, max(vehicle.imu_rate, receiver.rate))
    recording = record(vehicle, seed)
    imu, velocity_std = recording.imu, receiver.velocity_std
    received = GnssData(
        recording.fix_t,
        recording.fix_lla,
        np.asarray(receiver.claimed_std),
        recording.fix_velocity_n,
        None if velocity_std is None else np.full(3, velocity_std),
    )
    wrote = _write(
        out,
        ImuRecord(stamps(imu.t), imu.specific_force, imu.angular_rate),
        imu,
        _without(received, outages),
        recording.truth.every(max(1, round(vehicle.imu_rate / truth_rate))),
        receiver.offset,
        receiver.drift,
        overwrite=overwrite,
    )
    return f"{out}: {vehicle.name}, {wrote}"


def _check_size(duration: float, rate: float) -> None:
    samples = duration * rate
    if not 2.0 <= samples <= MOST_SAMPLES:
        raise InputError(
            f"--duration {duration:g} s makes {samples:.3g} samples: 2 to {MOST_SAMPLES:g} fit"
        )


def _check_dates(duration: float, offset: float) -> None:
    """Raise `InputError` where fixes or samples are dated before or after what a stamp can hold."""
    begin = flight_bag.EPOCH_NS * 1e-9
    if not (begin - offset >= 0.0 and begin + max(-offset, 0.0) + duration < STAMPS_END):
        raise InputError(
            f"--time-offset {offset:g} s, --duration {duration:g} s: stamps begin in 1970 and end "
            "in 2038, and a simulation begins in 2023: give smaller ones"
        )


def _write(
    out: Path,
    imu_record: ImuRecord,
    imu: ImuData,
    gnss: GnssData,
    truth: Truth,
    offset: float,
    drift: float = 0.0,
    *,
    overwrite: bool,
) -> str:
    """
    Write a bag and return what is in it.

    The IMU's clock is ``offset`` + ``drift`` t [s] ahead of the reference clock, which stamps fixes
    and truth. They are logged when they are true, or up to what the clock drifts later.
    """

    def reference_ns(t: Array) -> Stamps:
        return stamps(t - (offset + drift * t))

    received = GnssRecord(
        reference_ns(gnss.t), gnss.lla, gnss.position_std, gnss.velocity_n, gnss.velocity_std
    )
    trajectory = Trajectory.from_navigation(
        reference_ns(truth.t),
        truth.lla,
        truth.velocity_n,
        truth.quat_xyzw,
        datum_lla=flight_bag.first_datum(received),
    )
    flight_bag.write_flight(
        out,
        imu_record,
        received,
        TruthRecord(trajectory, truth.angular_rate_eb_b),
        log_offset_ns=round((offset + max(drift * float(imu.t[-1]), 0.0)) * 1e9),
        others=[_error_entries(imu)],
        overwrite=overwrite,
    )
    return (
        f"{imu.t[-1]:g} s; {imu.t.size} IMU samples, {gnss.t.size} fixes,"
        f" {truth.t.size} epochs of truth"
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


def _without(received: GnssData, outages: Sequence[tuple[float, float]]) -> GnssData:
    """Return the fixes outside of outages, and warn of outages in which no fix lies."""
    report_empty_outages(received.t, outages)
    return received.without(outages)


def _error_entries(imu: ImuData) -> Iterator[Entry]:
    """Yield messages of the true biases and noise variances, sensor axes (FLU)."""
    bias = new_message(ACCELERATION)
    noise = new_message(VECTOR)
    period = float(imu.t[1] - imu.t[0])
    for row in range(0, imu.t.size, max(round(1.0 / (MONITOR_RATE * period)), 1)):
        stamp_ns = int(stamps(imu.t[row]))
        flight_bag.stamp(bias, stamp_ns, "imu_link")
        flight_bag.set_vector(bias.accel.accel.linear, imu.accelerometer_bias[row] @ FLIP)
        flight_bag.set_vector(bias.accel.accel.angular, imu.gyroscope_bias[row] @ FLIP)
        yield stamp_ns, 4, "/truth/imu/bias", bias
        flight_bag.stamp(noise, stamp_ns, "imu_link")
        for name in ("accelerometer", "gyroscope"):
            flight_bag.set_vector(noise.vector, getattr(imu, f"{name}_std")[row] ** 2)
            yield stamp_ns, 5, f"/truth/q/{name}", noise
