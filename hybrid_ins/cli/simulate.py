"""The program ``ins_simulate``: a simulated drive or flight as a bag, with its truth."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from hybrid_ins.bags import flight_bag
from hybrid_ins.bags.flight_bag import Entry, GnssRecord, ImuRecord, TruthRecord, stamps
from hybrid_ins.bags.messages import new_message
from hybrid_ins.cli import options, program
from hybrid_ins.core.rotations import quat_from_rpy, quat_multiply
from hybrid_ins.errors import InputError
from hybrid_ins.ros.conversions import FLIP
from hybrid_ins.ros.trajectory import Trajectory
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
    corrupt,
    fixes,
    sample,
    sample_times,
)

ORIENTATION_STD = np.radians([1.0, 1.0, 3.0])  # roll, pitch, yaw of an AHRS's orientation
MOST_SAMPLES = 5_000_000  # about 4 GB of memory
MONITOR_RATE = 10.0  # Hz, of the true biases and noise variances in the bag

TRAJECTORIES: dict[str, Callable[..., Motion]] = {
    "quadrotor": quadrotor_flight,
    "car": car_drive,
    "aircraft": aircraft_flight,
    "random": random_motion,
    "static": static,
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run ``ins_simulate``."""
    return program.run(_simulate, _parser().parse_args(argv))


def _parser() -> argparse.ArgumentParser:
    p = program.parser(
        "ins_simulate",
        """Simulate a drive or flight with IMU, GNSS and truth, and write it as an MCAP bag.

The defaults are Table I of Or & Klein (2022): a 60 s quadrotor flight, an MPU-9250 at 1 kHz,
5 Hz GNSS with the variances 0.01, 0.01 and 0.02 m2, from 32.1 N 34.8 E. It stands still for 4 s.

The bag holds /imu/data, /gnss/fix, /gnss/velocity (on request), /truth/odometry in the map whose
origin is the first fix, that origin on /truth/datum, and what the filter estimates besides:
/truth/imu/bias, /truth/q/accelerometer, /truth/q/gyroscope.
Vectors are given in the bag's axes: forward, left, up.""",
        "ins_simulate flight --outage 30 10 --noise-schedule 0:1,20:5,40:1 --seed 3",
    )
    p.add_argument("out", metavar="OUT", type=Path, help="bag: a directory, or a file *.mcap")
    motion = p.add_argument_group("motion")
    motion.add_argument(
        "--trajectory", choices=TRAJECTORIES, default="quadrotor", help="[%(default)s]"
    )
    motion.add_argument(
        "--variant",
        type=options.count,
        metavar="N",
        help="vary the manoeuvres by this number [the nominal motion]",
    )
    motion.add_argument(
        "--duration", type=options.positive, default=60.0, metavar="S", help="[%(default)g s]"
    )
    motion.add_argument(
        "--start",
        type=options.number,
        nargs=3,
        metavar=("LAT", "LON", "H"),
        help="first position [32.1 deg, 34.8 deg, 0 m; aircraft 1000 m]",
    )
    motion.add_argument(
        "--heading",
        type=options.number,
        default=0.0,
        metavar="DEG",
        help="of the nose at the start, clockwise from north [%(default)g]",
    )
    motion.add_argument(
        "--truth-rate", type=options.positive, default=100.0, metavar="HZ", help="[%(default)g]"
    )
    sensor = p.add_argument_group("IMU")
    nominal = ImuErrors()
    sensor.add_argument(
        "--imu-rate", type=options.positive, default=1000.0, metavar="HZ", help="[%(default)g]"
    )
    for quantity, unit in (("accelerometer", "m/s2"), ("gyroscope", "rad/s")):
        sensor.add_argument(
            f"--{quantity}-std",
            type=options.not_negative,
            default=getattr(nominal, f"{quantity}_std"),
            metavar="STD",
            help=f"white noise of a sample, {unit} [%(default)g]",
        )
        bias = getattr(nominal, f"{quantity}_bias")
        sensor.add_argument(
            f"--{quantity}-bias",
            type=options.number,
            nargs=3,
            default=bias,
            metavar=("X", "Y", "Z"),
            help=f"at the start, {unit} [{' '.join(map(str, bias))}]",
        )
        sensor.add_argument(
            f"--{quantity}-bias-walk",
            type=options.not_negative,
            default=getattr(nominal, f"{quantity}_bias_walk"),
            metavar="STD",
            help=f"random walk of the bias, {unit} per sqrt(s) [%(default)g]",
        )
    sensor.add_argument(
        "--noise-schedule",
        type=_schedule,
        default=(),
        metavar="S:FACTOR,...",
        help="from each time on, multiply the white noise's STD by the factor",
    )
    sensor.add_argument(
        "--mount-rpy",
        type=options.number,
        nargs=3,
        default=(0.0, 0.0, 0.0),
        metavar=("R", "P", "Y"),
        help="degrees that turn base_link's axes into the IMU's (imu.mount_rpy) [0 0 0]",
    )
    sensor.add_argument(
        "--orientation",
        action="store_true",
        help="fill the orientation like an AHRS: off by a constant of 1, 1, 3 degrees (1 sigma)",
    )
    receiver = p.add_argument_group("GNSS")
    receiver.add_argument(
        "--gnss-rate", type=options.positive, default=5.0, metavar="HZ", help="[%(default)g]"
    )
    options.add_gnss_noise(receiver, RTK_STD)
    receiver.add_argument(
        "--gnss-velocity",
        type=options.positive,
        nargs="?",
        const=0.05,
        metavar="STD",
        help="write /gnss/velocity, too, with this noise, m/s [0.05]",
    )
    options.add_outage(receiver)
    receiver.add_argument(
        "--lever-arm",
        type=options.number,
        nargs=3,
        default=(0.0, 0.0, 0.0),
        metavar=("X", "Y", "Z"),
        help="antenna in base_link (gnss.antenna_position), m [0 0 0]",
    )
    receiver.add_argument(
        "--time-offset",
        type=options.number,
        default=0.0,
        metavar="S",
        help="IMU clock minus reference clock, which stamps fixes and truth [%(default)g]",
    )
    p.add_argument("--seed", type=options.count, default=0, metavar="N", help="of all noise [0]")
    p.add_argument("--overwrite", action="store_true", help="replace OUT where it exists")
    return p


def _simulate(args: argparse.Namespace) -> None:
    outages = options.outages(args.outage)
    samples = args.duration * max(args.imu_rate, args.gnss_rate, args.truth_rate)
    if not 2.0 <= samples <= MOST_SAMPLES:
        raise InputError(
            f"--duration {args.duration:g} s makes {samples:.3g} samples: 2 to {MOST_SAMPLES:g} fit"
        )
    trajectory = _trajectory(args)
    errors = ImuErrors(
        accelerometer_std=args.accelerometer_std,
        gyroscope_std=args.gyroscope_std,
        accelerometer_bias=args.accelerometer_bias @ FLIP,
        gyroscope_bias=args.gyroscope_bias @ FLIP,
        accelerometer_bias_walk=args.accelerometer_bias_walk,
        gyroscope_bias_walk=args.gyroscope_bias_walk,
        noise_schedule=args.noise_schedule,
        mount_rpy=np.radians(args.mount_rpy) @ FLIP,
    )
    imu_rng, gnss_rng, orientation_rng = np.random.default_rng(args.seed).spawn(3)
    motion = sample(trajectory, sample_times(args.duration, args.imu_rate))
    imu = corrupt(motion, errors, imu_rng)
    gnss = fixes(
        sample(trajectory, sample_times(args.duration, args.gnss_rate)),
        gnss_rng,
        args.gnss_noise,
        args.lever_arm @ FLIP,
        args.gnss_velocity,
    ).without(outages)

    offset_ns = round(args.time_offset * 1e9)
    gnss_record = GnssRecord(
        stamps(gnss.t) - offset_ns,
        gnss.lla,
        gnss.position_std,
        gnss.velocity_n,
        gnss.velocity_std,
    )
    truth = sample(trajectory, sample_times(args.duration, args.truth_rate))
    track = Trajectory.from_navigation(
        stamps(truth.t) - offset_ns,
        truth.lla,
        truth.velocity_n,
        truth.quat_xyzw,
        datum_lla=flight_bag.first_datum(gnss_record),
    )
    imu_record = ImuRecord(stamps(imu.t), imu.specific_force, imu.angular_rate)
    if args.orientation:
        error = quat_from_rpy(*(ORIENTATION_STD * orientation_rng.standard_normal(3)))
        mount = quat_from_rpy(*np.asarray(errors.mount_rpy))
        imu_record = replace(
            imu_record,
            quat_xyzw=quat_multiply(motion.quat_xyzw, quat_multiply(error, mount)),
            attitude_std=ORIENTATION_STD,
        )
    flight_bag.write_flight(
        args.out,
        imu_record,
        gnss_record,
        TruthRecord(track, truth.angular_rate_eb_b),
        log_offset_ns=offset_ns,
        others=[_hidden_entries(imu, args.imu_rate)],
        overwrite=args.overwrite,
    )
    print(
        f"{args.out}: {args.trajectory}, {args.duration:g} s;"
        f" {imu.t.size} IMU samples at {args.imu_rate:g} Hz,"
        f" {gnss.t.size} fixes at {args.gnss_rate:g} Hz,"
        f" {truth.t.size} epochs of truth at {args.truth_rate:g} Hz"
    )


def _trajectory(args: argparse.Namespace) -> Motion:
    motion: dict[str, object] = {"heading": np.radians(args.heading)}
    if args.start is not None:
        lat, lon, height = args.start
        if not (abs(lat) <= 89.0 and abs(lon) <= 360.0 and abs(height) <= 20_000.0):
            raise InputError(
                f"--start {lat:g} {lon:g} {height:g}: give latitude [deg, within 89], longitude"
                " [deg] and height [m, within 20000]"
            )
        motion["start_lla"] = np.array([np.radians(lat), np.radians(lon), height])
    if args.trajectory != "static":
        motion["seed"] = args.variant
    return TRAJECTORIES[args.trajectory](args.duration, **motion)


def _hidden_entries(imu: ImuData, imu_rate: float) -> Iterator[Entry]:
    """Messages of what no sensor tells: the true biases and noise variances, sensor axes (FLU)."""
    bias = new_message("geometry_msgs/msg/AccelWithCovarianceStamped")
    noise = new_message("geometry_msgs/msg/Vector3Stamped")
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


def _schedule(text: str) -> tuple[tuple[float, float], ...]:
    try:
        pairs = [tuple(map(float, pair.split(":"))) for pair in text.split(",")]
        if all(len(p) == 2 and np.isfinite(p).all() and p[1] >= 0.0 for p in pairs):
            return tuple((start, factor) for start, factor in pairs)
    except ValueError:
        pass
    raise argparse.ArgumentTypeError(
        f"{text!r}: write START:FACTOR,START:FACTOR,... as in 0:1,20:5"
    )


if __name__ == "__main__":
    raise SystemExit(main())
