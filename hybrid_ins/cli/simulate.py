"""The program ``ins_simulate``: a simulated drive or flight as a bag, with its truth."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from hybrid_ins.cli import options, program
from hybrid_ins.errors import InputError
from hybrid_ins.ros.messages.conversions import FLIP
from hybrid_ins.simulation.road_vehicles import ROAD_VEHICLES
from hybrid_ins.simulation.sensors import RTK_STD, ImuErrors
from hybrid_ins.simulation.simulate import MOTIONS, Scenario, simulate, simulate_vehicle
from hybrid_ins.simulation.vehicles import VEHICLES, Vehicle

ALL_VEHICLES = VEHICLES | ROAD_VEHICLES
BESIDE_VEHICLE = {"out", "vehicle", "duration", "truth_rate", "outage", "seed", "overwrite"}
SHORT = 60.0  # s


def main(argv: Sequence[str] | None = None) -> int:
    """Run the program."""
    parser = _parser()
    args = parser.parse_args(argv)
    if args.vehicle is not None:
        _check_unused(parser, args)
    return program.run(_run, args)


def _parser() -> argparse.ArgumentParser:
    p = program.parser(
        "ins_simulate",
        """Simulate a drive or flight with IMU, GNSS and truth, and write it as an MCAP bag.

The defaults are Table I of Or & Klein (2022): a 60 s quadrotor flight, an MPU-9250 at 1 kHz,
5 Hz GNSS with the variances 0.01, 0.01 and 0.02 m2, from 32.1 N 34.8 E. It stands still for 4 s.

The bag holds /imu/data, /gnss/fix, /gnss/velocity (on request), /truth/odometry in the map whose
origin is the first fix, that origin on /truth/datum, and what the filter estimates besides:
/truth/imu/bias, /truth/q/accelerometer, /truth/q/gyroscope.
Vectors are given in the bag's axes: forward, left, up.

With --vehicle it is a vehicle with what real ones have: vibration of its engine and of the road,
a receiver with slow errors and a claim that need not be right, a clock that is off or drifts. It
comes with IMU and receiver; --seed varies its way, too:
"""
        + "\n".join(f"  {name}" for name in ALL_VEHICLES),
        "ins_simulate flight --outage 30 10 --noise-schedule 0:1,20:5,40:1 --seed 3\n"
        "  ins_simulate drive --vehicle 'car, drift 300 ppm' --seed 2",
    )
    p.add_argument(
        "out", metavar="OUT", type=options.path, help="bag: a directory, or a file *.mcap"
    )
    motion = p.add_argument_group("motion")
    motion.add_argument("--trajectory", choices=MOTIONS, default="quadrotor", help="[%(default)s]")
    motion.add_argument(
        "--vehicle",
        choices=ALL_VEHICLES,
        metavar="NAME",
        help="one of those above, in place of a trajectory with the sensors described below",
    )
    motion.add_argument(
        "--variant",
        type=options.count,
        metavar="N",
        help="vary the manoeuvres by this number [the nominal motion]",
    )
    motion.add_argument(
        "--duration",
        type=options.positive,
        metavar="S",
        help=f"[{SHORT:g} s; of a vehicle {Vehicle.duration:g} s]",
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
        help="turn base_link's axes into the IMU's, in degrees; the parameter imu.mount_rpy holds "
        "the same in radians [0 0 0]",
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


def _check_unused(parser: argparse.ArgumentParser, args: argparse.Namespace) -> None:
    """End with an error where an option is given that a vehicle does not use."""
    for name, value in vars(args).items():
        if name not in BESIDE_VEHICLE and value is not parser.get_default(name):
            parser.error(
                f"--{name.replace('_', '-')}: --vehicle brings motion, IMU and receiver: leave one"
                " of the two out"
            )


def _run(args: argparse.Namespace) -> None:
    outages = options.outages(args.outage)
    if args.vehicle is not None:
        vehicle = ALL_VEHICLES[args.vehicle]
        if args.duration is not None:
            vehicle = replace(vehicle, duration=args.duration)
        line = simulate_vehicle(
            vehicle,
            args.out,
            seed=args.seed,
            truth_rate=args.truth_rate,
            outages=outages,
            overwrite=args.overwrite,
        )
        print(line)
        return
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
    scenario = Scenario(
        motion=args.trajectory,
        variant=args.variant,
        duration=args.duration or SHORT,
        start_lla=_start(args.start),
        heading=np.radians(args.heading),
        truth_rate=args.truth_rate,
        imu_rate=args.imu_rate,
        imu_errors=errors,
        orientation=args.orientation,
        gnss_rate=args.gnss_rate,
        gnss_noise=args.gnss_noise,
        velocity_std=args.gnss_velocity,
        outages=outages,
        lever_arm_b=args.lever_arm @ FLIP,
        time_offset=args.time_offset,
        seed=args.seed,
    )
    print(simulate(scenario, args.out, overwrite=args.overwrite))


def _start(given: Sequence[float] | None) -> tuple[float, float, float] | None:
    """Check ``--start``: degrees and metres to radians and metres."""
    if given is None:
        return None
    lat, lon, height = given
    if not (abs(lat) <= 89.0 and abs(lon) <= 360.0 and abs(height) <= 20_000.0):
        raise InputError(
            f"--start {lat:g} {lon:g} {height:g}: give latitude [deg, within 89], longitude"
            " [deg] and height [m, within 20000]"
        )
    return float(np.radians(lat)), float(np.radians(lon)), height


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
