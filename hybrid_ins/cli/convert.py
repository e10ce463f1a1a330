"""The program ``ins_convert``: a flight in CSV files as a bag on the node's topics."""

from __future__ import annotations

import argparse
from collections.abc import Sequence

import numpy as np

from hybrid_ins.cli import options, program
from hybrid_ins.dataset.column_map import load_map
from hybrid_ins.dataset.convert import DEFAULT_MAP, Conversion, convert
from hybrid_ins.dataset.convert_logs import convert_logs
from hybrid_ins.errors import InputError
from hybrid_ins.resources import share_path
from hybrid_ins.ros.messages.conversions import place_of
from hybrid_ins.simulation.sensors import RTK_STD

OF_FOLDERS = "imu", "gnss_rate", "gnss_noise", "seed", "outage", "map"  # options


def main(argv: Sequence[str] | None = None) -> int:
    """Run the program."""
    return program.run(_run, _parser().parse_intermixed_args(argv))


def _parser() -> argparse.ArgumentParser:
    p = program.parser(
        "ins_convert",
        """Convert logs, or a flight in CSV files, to an MCAP bag on the node's topics.

Logs of a receiver and of an IMU are recognised by their content: RTKLIB solutions (.pos), NMEA
(needs pynmeagps), UBX with NAV-PVT (needs pyubx2), PX4 logs (needs pyulog), ArduPilot logs (needs
pymavlink), tables of fixes with a line of names, and tables of time, accelerations and angular
rates (m/s2, g or mg; rad/s or deg/s; axes FLU), with or without a header; docs/logs.md. Fixes
keep the receiver's own covariance, status and velocity. Where the two have clocks of their own
the offset between them is found by the turns that both see.

Made for the dataset "Quadrotor Dead Reckoning with Multiple Inertial Sensors" (Hurwitz & Klein);
for others copy config/datasets/quadrotor.yaml, change it, and give it with --map.

/imu/data        the IMU at its own stamps (FLU), with the orientation that it gave; where the
                 zero of its yaw is arbitrary, the yaw's variance says so (pi^2 / 3)
/gnss/fix        the reference's positions at the GNSS rate, with noise
/truth/odometry  the reference at all its epochs, in the map whose origin is the first fix: its
                 positions and attitudes as they are; velocity and angular rate are derivatives
                 (of a cubic over 0.8 s; the reference's own speed column is filtered)
/truth/datum     that origin

IMU and reference have clocks of their own in this dataset, up to 0.7 s apart: see --time-offset.
Rows that cannot be used are reported on stderr and left out.""",
        "ins_convert imu.csv solution.pos walk.mcap\n"
        "  ins_convert Horizontal/path_4 flight --imu 2 --gnss-rate 1 --outage 15 10",
    )
    p.add_argument(
        "input",
        metavar="IN",
        nargs="+",
        type=options.path,
        help="logs of an IMU and a receiver, or the directory of a flight's CSV files",
    )
    p.add_argument(
        "out", metavar="OUT", type=options.path, help="bag: a directory, or a file *.mcap"
    )
    p.add_argument("--imu", type=options.count, default=1, metavar="K", help="which IMU [1]")
    p.add_argument(
        "--gnss-rate",
        type=options.positive,
        default=5.0,
        metavar="HZ",
        help="of the fixes; where it divides the reference's, the epochs between are not used [5]",
    )
    options.add_gnss_noise(p, RTK_STD)
    p.add_argument("--seed", type=options.count, default=0, metavar="N", help="of that noise [0]")
    options.add_outage(p)
    p.add_argument(
        "--time-offset",
        type=options.number,
        metavar="S",
        help="added to the reference's times to bring them to the IMU's clock [0: as published]; "
        "of logs, to the IMU's to bring them to the receiver's [found]",
    )
    p.add_argument(
        "--origin",
        type=options.number,
        nargs=3,
        metavar=("LAT", "LON", "H"),
        help="of a table of fixes with local coordinates, deg deg m",
    )
    p.add_argument(
        "--map", type=options.path, metavar="FILE", help="column map (YAML) of the dataset"
    )
    p.add_argument("--overwrite", action="store_true", help="replace OUT where it exists")
    return p


def _run(args: argparse.Namespace) -> None:
    if len(args.input) > 1 or args.input[0].is_file():
        for name in OF_FOLDERS:
            if getattr(args, name) != _parser().get_default(name):
                option = "--" + name.replace("_", "-")
                raise InputError(f"{option} is for a folder of CSV files, not for logs")
        origin = None
        if args.origin is not None:
            if not (abs(args.origin[0]) < 90.0 and abs(args.origin[1]) <= 180.0):
                raise InputError(
                    f"--origin: {place_of(*args.origin[:2])} is no place on Earth [deg]"
                )
            origin = np.array([*np.radians(args.origin[:2]), args.origin[2]])
        offset, overwrite = args.time_offset, args.overwrite
        print(convert_logs(args.input, args.out, offset, origin, overwrite=overwrite))
        return
    [flight] = args.input
    conversion = Conversion(
        imu=args.imu,
        time_offset=args.time_offset or 0.0,
        gnss_rate=args.gnss_rate,
        gnss_noise=args.gnss_noise,
        outages=options.outages(args.outage),
        seed=args.seed,
    )
    layout = load_map(args.map or share_path(DEFAULT_MAP))
    print(convert(flight, args.out, layout, conversion, overwrite=args.overwrite))


if __name__ == "__main__":
    raise SystemExit(main())
