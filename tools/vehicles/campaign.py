"""
Many short drives with everything drawn at random: which are silently wrong, which align soon.

Vehicle, receiver, claim, clock offset and drift, IMU rate and noise, and what is known of the
heading are drawn for each run, on request also where the antenna is, which is given or not, and
the defects of real recordings (`defects`); all other parameters are the defaults.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from hybrid_ins import parameters, progress
from hybrid_ins.cli import options, program
from hybrid_ins.output_file import check_output
from hybrid_ins.simulation.sensors import ImuErrors
from hybrid_ins.simulation.vehicles import VEHICLES, Receiver, Vehicle, record
from tools.parallel import add_jobs, run_parallel
from tools.vehicles import defects
from tools.vehicles.drives import Drive, from_simulation
from tools.vehicles.judge import score

MOTIONS = (
    "car",
    "car on a motorway, clock -0.1 s",
    "fixed wing 50 Hz",
    "slow rover",
    "boat",
    "pedestrian",
    "quadrotor",
)
RECEIVERS = {  # rate [Hz], white, slow [m, horizontal]
    "RTK": ((1.0, 4.0, 5.0, 10.0), (0.008, 0.03), (0.0, 0.0)),
    "modest": ((1.0, 5.0), (0.1, 0.3), (0.0, 1.0)),
    "consumer": ((1.0, 5.0), (0.5, 2.0), (0.0, 2.0)),
}
MAX_OFFSET = 0.7  # s, of the clock
CLOCK_STD = 0.005  # s, of an offset that is given
IN_MOTION = 75.0  # s
SOON = 20.0  # s of motion, to align


def draw(seed: int) -> tuple[dict[str, Any], Vehicle]:
    """Return what was drawn, for the table, and the vehicle."""
    rng = np.random.default_rng([seed, 31])
    motion, kind = str(rng.choice(MOTIONS)), str(rng.choice(list(RECEIVERS)))
    rates, white, slow = RECEIVERS[kind]
    shape = np.array([1.0, 1.0, 1.5])
    white_std = math.exp(rng.uniform(*np.log(white))) * shape
    slow_std = rng.uniform(*slow) * shape
    claimed_std = np.hypot(white_std, slow_std) * math.exp(rng.uniform(math.log(0.7), math.log(2)))
    receiver = Receiver(
        rate=float(rng.choice(rates)),
        white_std=tuple(white_std),
        slow_std=tuple(slow_std),
        claimed_std=tuple(claimed_std),
        offset=float(rng.choice([0.0, rng.uniform(-MAX_OFFSET, MAX_OFFSET)])),
        drift=float(rng.uniform(-1e-4, 1e-4)),
        velocity_std=float(rng.uniform(0.03, 0.3)) if rng.random() < 0.5 else None,
        velocity_age=float(rng.choice([0.0, rng.uniform(0.0, 0.15)])),
    )
    known = VEHICLES[motion]
    noise = math.exp(rng.uniform(math.log(0.3), math.log(3.0)))
    rest = float(rng.uniform(3.0, 15.0))
    errors = replace(
        known.errors,
        accelerometer_std=noise * ImuErrors.accelerometer_std,
        gyroscope_std=noise * ImuErrors.gyroscope_std,
    )
    vehicle = replace(
        known,
        motion=partial(known.motion, rest=rest),
        receiver=receiver,
        errors=errors,
        imu_rate=float(rng.choice([50.0, 100.0, 200.0])),
        rest=rest,
        engine_time=min(known.engine_time, rest),
        road_std=known.road_std * float(rng.uniform(0.3, 1.5)),
        duration=rest + IN_MOTION,
    )
    row = {
        "seed": seed,
        "motion": motion.partition(",")[0],
        "receiver": kind,
        "rate": receiver.rate,
        "imu_rate": vehicle.imu_rate,
        "true_offset": receiver.offset,
        "velocity": receiver.velocity_std is not None,
        "given": str(rng.choice(["nothing", "nothing", "right", "wrong"])),
    }
    return row, vehicle


def with_antenna(vehicle: Vehicle, seed: int) -> Vehicle:
    """Return a vehicle whose antenna is up to three metres from its IMU."""
    rng = np.random.default_rng([seed, 33])
    away = math.exp(rng.uniform(*np.log((0.1, 3.0))))
    direction = rng.standard_normal(3) * [1.0, 0.5, 0.5]
    antenna_b = away * direction / np.linalg.norm(direction)
    return replace(vehicle, receiver=replace(vehicle.receiver, antenna_b=tuple(antenna_b)))


def one(
    seed: int,
    defective: bool = False,
    clock_given: bool = False,
    antenna: bool = False,
    unplaced: bool = False,
) -> dict[str, Any]:
    """
    Return the row of one run.

    It has the defects of real recordings if ``defective``; ``clock_given`` gives its clock offset;
    with ``antenna`` that is away from the IMU, where the parameters say; with ``unplaced``, too,
    and nothing says where.
    """
    row, vehicle = draw(seed)
    if antenna:
        vehicle = with_antenna(vehicle, seed)
    recording = record(vehicle, seed)
    if unplaced:
        recording = defects.unknown_lever_arm(recording, np.random.default_rng([seed, 34]))
    if defective:
        recording, names = defects.draw(recording, np.random.default_rng([seed, 32]))
        row["defects"] = names
    drive = from_simulation(recording, defects.DELAY if defective else 0.0)
    values = {**parameters.defaults(), **_heading(row["given"], drive)}
    if clock_given:
        values["gnss.time_offset.value"] = row["true_offset"]
        values["gnss.time_offset.std"] = CLOCK_STD
    forward, right, down = vehicle.receiver.antenna_b
    values["gnss.antenna_position"] = [forward, -right, -down]
    if row["given"] == "wrong":
        drive = _later(drive, drive.motion_ns + round(SOON * 1e9))
    found = score(drive, values)
    return row | {
        "aligned": found.aligned,
        "silent": found.silent,
        "rmse": found.rmse,
        "nees": found.nees,
        "offset": found.offset,
        "heading": found.heading,
    }


def _heading(given: str, drive: Drive) -> dict[str, Any]:
    """Return the parameters of a heading that is given at the start."""
    if given == "nothing":
        return {}
    east_to_nose = 0.5 * math.pi - float(drive.truth_yaw[0])
    yaw = east_to_nose + (math.pi if given == "wrong" else 0.0)
    return {
        "alignment.heading_source": "parameter",
        "alignment.yaw": math.remainder(yaw, 2.0 * math.pi),
    }


def _later(drive: Drive, since_ns: int) -> Drive:
    """Return a drive that is judged from a stamp [ns] on: no motion shows before what is wrong."""
    judged, judged_yaw = drive.truth_ns >= since_ns, drive.truth_yaw_ns >= since_ns
    return replace(
        drive,
        truth_ns=drive.truth_ns[judged],
        truth_lla=drive.truth_lla[judged],
        truth_yaw_ns=drive.truth_yaw_ns[judged_yaw],
        truth_yaw=drive.truth_yaw[judged_yaw],
    )


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Return the summary by vehicle and by receiver."""
    lines = [
        "| runs of | number | silently wrong | aligned within 20 s of motion | never | NEES/2 |",
        "|---|---|---|---|---|---|",
    ]
    groups = [("all", rows)]
    for key in ("motion", "receiver", "given"):
        for value in sorted({row[key] for row in rows}):
            name = f"heading given: {value}" if key == "given" else value
            groups.append((name, [row for row in rows if row[key] == value]))
    for name in defects.DEFECTS:
        group = [row for row in rows if name in row.get("defects", ())]
        if group:
            groups.append((name.replace("_", " "), group))
    for name, group in groups:
        aligned = np.array([row["aligned"] for row in group])
        nees = [row["nees"] for row in group if math.isfinite(row["nees"])]
        lines.append(
            f"| {name} | {len(group)} | {sum(row['silent'] > 0.0 for row in group)} "
            f"| {100.0 * np.mean(aligned <= SOON):.1f} % | {np.count_nonzero(np.isnan(aligned))} "
            f"| {np.mean(nees) if nees else math.nan:.2f} |"
        )
    return "\n".join(lines)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the campaign; print a line for each run that is silently wrong, and the table."""
    parser = program.parser("campaign", __doc__ or "")
    parser.add_argument("--runs", type=options.positive_count, default=100, metavar="N")
    parser.add_argument(
        "--first", type=options.count, default=0, metavar="SEED", help="[%(default)s]"
    )
    add_jobs(parser, 2)
    parser.add_argument(
        "--defects", action="store_true", help="with what real recordings have besides noise"
    )
    parser.add_argument(
        "--clock-given",
        action="store_true",
        help="give the true clock offset: shows what finding it costs",
    )
    parser.add_argument(
        "--antenna", action="store_true", help="up to 3 m from the IMU, and where is given"
    )
    parser.add_argument(
        "--unplaced", action="store_true", help="some decimetres from the IMU, and nothing says so"
    )
    parser.add_argument(
        "--results", type=options.path, metavar="FILE", help="also write all rows, JSON"
    )
    return program.run(_body, parser.parse_args(argv))


def _body(args: argparse.Namespace) -> int:
    if args.results is not None:
        check_output(args.results, overwrite=True)
    rows = []
    runs = [
        (seed, args.defects, args.clock_given, args.antenna, args.unplaced)
        for seed in range(args.first, args.first + args.runs)
    ]
    for row in progress.track(run_parallel(one, runs, args.jobs), "drives", total=args.runs):
        rows.append(row)
        if row["silent"] > 0.0:
            print({k: round(v, 3) if isinstance(v, float) else v for k, v in row.items()})
    if args.results is not None:
        args.results.write_text(json.dumps(rows, indent=1), encoding="utf-8")
    print(table(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
