"""
The same drives with the default parameters and with what ``ins_calibrate`` finds.

The program calibrates a simulated vehicle from another of its drives, that of the next (odd) seed,
and a real one from the fixes that it is given of the same recording: there is no other. What it
declines to write is not used.
"""

from __future__ import annotations

import argparse
import heapq
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np

from hybrid_ins import parameters
from hybrid_ins.bags.flight_bag import UNKNOWN_VARIANCE, Entry, set_vector, stamp
from hybrid_ins.bags.messages import new_message
from hybrid_ins.bags.writer import BagWriter
from hybrid_ins.cli import options, program
from hybrid_ins.parameters import parameter_file
from hybrid_ins.ros.messages.conversions import DIAGONAL
from hybrid_ins.ros.messages.type_names import FIX, IMU, TWIST
from hybrid_ins.simulation.vehicles import VEHICLES, record
from tools.parallel import add_jobs, run_parallel
from tools.vehicles.drives import Drive, Log, from_log, from_simulation, load
from tools.vehicles.evaluate import FEEDS, check_names, parser_of_drives, real_sets
from tools.vehicles.judge import Score, score

HEADER = (
    "| drive | default: RMSE, up [m] | NEES/2 | calibrated: RMSE, up [m] | NEES/2 | ratio "
    "| silently wrong [s] | offset [s] | refused |\n" + "|---" * 9 + "|"
)


def write_bag(drive: Drive, path: Path) -> None:
    """Write what a drive's node would be given."""
    entries = heapq.merge(_imu(drive), _fixes(drive), _velocities(drive), key=itemgetter(0, 1))
    with BagWriter(path) as bag:
        for log_ns, _, topic, message in entries:
            bag.write(topic, message, log_ns)


def _imu(drive: Drive) -> Iterator[Entry]:
    message = new_message(IMU)
    message.orientation_covariance[0] = -1.0
    for t_ns, force, rate in zip(drive.imu_ns.tolist(), drive.force, drive.rate, strict=True):
        set_vector(message.linear_acceleration, force)
        set_vector(message.angular_velocity, rate)
        yield t_ns, 0, "/imu/data", stamp(message, t_ns, "imu_link")


def _fixes(drive: Drive) -> Iterator[Entry]:
    message = new_message(FIX)
    for k, stamp_ns in enumerate(drive.fix_ns.tolist()):
        std = drive.fix_std[k]
        message.position_covariance_type = DIAGONAL if np.all(np.isfinite(std)) else 0
        message.position_covariance[[0, 4, 8]] = np.nan_to_num(std) ** 2
        message.latitude, message.longitude = np.degrees(drive.fix_lla[k, :2]).tolist()
        message.altitude = float(drive.fix_lla[k, 2])
        yield int(drive.arrival_ns[k]), 1, "/gnss/fix", stamp(message, stamp_ns, "gnss_link")


def _velocities(drive: Drive) -> Iterator[Entry]:
    if drive.velocity_enu is None or drive.velocity_std is None:
        return
    message = new_message(TWIST)
    known = np.isfinite(drive.velocity_enu).all(axis=1)
    for k in np.flatnonzero(known).tolist():
        variance = [*np.nan_to_num(drive.velocity_std[k]) ** 2, *np.full(3, UNKNOWN_VARIANCE)]
        message.twist.covariance[:] = np.diag(variance).ravel()
        set_vector(message.twist.twist.linear, drive.velocity_enu[k])
        stamped = stamp(message, int(drive.fix_ns[k]), "gnss_link")
        yield int(drive.arrival_ns[k]), 2, "/gnss/velocity", stamped


def calibrated(drive: Drive, report: Path | None) -> tuple[dict[str, Any] | None, str]:
    """
    Return the parameters that the program writes for a drive, None if none, and why there is none.

    What it prints and writes is kept in the file ``report``.
    """
    with tempfile.TemporaryDirectory() as folder:
        bag, out = Path(folder, "drive.mcap"), Path(folder, "parameters.yaml")
        write_bag(drive, bag)
        command = [sys.executable, "-m", "hybrid_ins.cli.calibrate", str(bag), "--out", str(out)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        written = out.read_text(encoding="utf-8") if out.exists() else ""
        if report is not None:
            text = f"{done.stdout}\n{done.stderr}\n{written}"
            report.write_text(text, encoding="utf-8")
        errors = [line for line in done.stderr.splitlines() if "error: " in line]
        why = errors[-1].partition("error: ")[2].partition(f"; {out}")[0] if errors else ""
        return parameter_file.load(out) if written else None, why


def one(source: str | Path | Log, variant: int | str, keep: Path | None) -> str:
    """
    Return the row of one drive.

    ``source`` is a simulated vehicle, the folder of a real set, or a log; ``variant`` the seed of
    the first, the feed of the others.
    """
    if isinstance(variant, int):
        vehicle = VEHICLES[str(source)]
        judge, other = (from_simulation(record(vehicle, seed)) for seed in (variant, variant + 1))
    else:
        judge = other = (
            from_log(source, variant) if isinstance(source, tuple) else load(Path(source), variant)
        )
    default = score(judge, parameters.defaults())
    name = (source[0] if isinstance(source, tuple) else Path(source)).stem
    report = None if keep is None else keep / f"{name}, {variant}.txt"
    values, refused = calibrated(other, report)
    found = default if values is None else score(judge, values)
    return (
        f"| {judge.name} | {_accuracy(default)} | {_accuracy(found)} "
        f"| {_error(found) / _error(default):.2f} | {default.silent:.0f}, {found.silent:.0f} "
        f"| {found.offset:+.3f} | {refused} |"
    )


def _accuracy(found: Score) -> str:
    return f"{found.rmse:.3f}, {found.rmse_up:.3f} | {found.nees:.2f}"


def _error(found: Score) -> float:
    return float(np.hypot(found.rmse, found.rmse_up))


def main(argv: Sequence[str] | None = None) -> int:
    """Print the table."""
    parser = parser_of_drives("calibrated", __doc__)
    add_jobs(parser, 2)
    parser.add_argument(
        "--keep",
        type=options.path,
        metavar="DIR",
        help="folder for what ins_calibrate says and writes",
    )
    return program.run(_body, parser.parse_args(argv))


def _body(args: argparse.Namespace) -> int:
    if args.keep is not None:
        args.keep.mkdir(parents=True, exist_ok=True)
    wanted: list[tuple[str | Path, int | str]] = [
        (n, seed) for n in VEHICLES for seed in args.seeds
    ]
    if args.data is not None:
        real = (args.data / name for name in real_sets(args.data) if name != "car_circles")
        wanted += [(folder, feed) for folder in real for feed in FEEDS]
    check_names(args.names, [f"{Path(source).name}, {variant}" for source, variant in wanted])
    runs = [
        (source, variant, args.keep)
        for source, variant in wanted
        if not (args.names or args.log)
        or any(part in f"{Path(source).name}, {variant}" for part in args.names)
    ]
    runs += [(files, feed, args.keep) for files in args.log for feed in FEEDS]
    print(HEADER)
    for row in run_parallel(one, runs, args.jobs):
        print(row, flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
