"""
Heading found from motion alone: recorded flights and simulated runs, from twelve headings each.

A recorded flight is given another first heading by turning its IMU about its vertical axis. The
heading that counts is the reference's, plus what a filter with a given heading settles at against
it (how the IMU is mounted in yaw, which no reference tells).
"""

from __future__ import annotations

import argparse
import json
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybrid_ins import parameters, progress
from hybrid_ins.bags.messages import new_message
from hybrid_ins.calibration.calibrate import calibrate
from hybrid_ins.cli import options, program
from hybrid_ins.core.inertial.rotations import matrix_from_quat
from hybrid_ins.errors import InputError
from hybrid_ins.output_file import check_output
from hybrid_ins.ros.estimator.estimator import Estimator
from hybrid_ins.ros.estimator.imu_block import handle_imu_block
from hybrid_ins.ros.messages import conversions
from hybrid_ins.ros.messages.conversions import FLIP
from hybrid_ins.ros.messages.trajectory import Trajectory
from hybrid_ins.simulation.motions import Motion, car_drive, quadrotor_flight
from hybrid_ins.simulation.sensors import ImuErrors, corrupt, fixes, sample, sample_times
from tools.field import flights
from tools.parallel import add_jobs, run_parallel

Array = NDArray[np.float64]

HEADINGS = 12
MANOEUVRING = 20.0  # s
WITHIN = math.radians(5.0)
REFERENCE_STD = math.radians(2.0)  # of the reference's compass
COVERED = 3.3  # sigma
EPOCH_NS = 1_700_000_000_000_000_000
KINDS: dict[str, Any] = {"quadrotor": quadrotor_flight, "car": car_drive}


@dataclass(frozen=True, eq=False)
class Case:
    """A run's input in the IMU's clock, and its truth."""

    name: str
    stamp_ns: NDArray[np.int64]
    force: Array  # (N, 3) FLU
    rate: Array
    fix_ns: NDArray[np.int64]
    fix_lla: Array
    fix_std: Array  # (3,) north, east, down
    truth: Trajectory
    moving_ns: int  # since when it moves


@dataclass(frozen=True, eq=False)
class Found:
    """What an estimator said over a run."""

    stamp_ns: NDArray[np.int64]
    C: Array  # (K, 3, 3) base_link to map
    yaw_std: Array
    position: Array

    def at(self, stamp_ns: NDArray[np.int64]) -> NDArray[np.int64]:
        """Rows of the estimates at these stamps; -1 where there is none."""
        if not len(self.stamp_ns):
            return np.full(len(stamp_ns), -1)
        row = np.clip(np.searchsorted(self.stamp_ns, stamp_ns), 0, len(self.stamp_ns) - 1)
        return np.where(np.abs(self.stamp_ns[row] - stamp_ns) < 30_000_000, row, -1)


@dataclass(frozen=True)
class Row:
    """Result of one run."""

    case: str
    heading: float  # rad, by which the IMU was turned
    aligned_after: float  # s of motion; inf: never
    error: float  # rad, after `MANOEUVRING`
    std: float  # rad, what was said of it
    worst: float  # largest error over what was said, while aligned
    ratio: float  # position RMSE over that with the heading given


def about_z(angle: float) -> Array:
    """Rotation (3, 3) by an angle [rad] about the third axis."""
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def turned(case: Case, angle: float) -> Case:
    """Turn the IMU by an angle [rad] about its vertical axis."""
    return replace(case, force=case.force @ about_z(angle), rate=case.rate @ about_z(angle))


def estimate(case: Case, yaw: float | None) -> Found:
    """Run the node's estimator; the heading [rad, map] is given, or has to be found."""
    values = parameters.defaults()
    if yaw is not None:
        values.update({"alignment.heading_source": "parameter", "alignment.yaw": yaw})
    estimator = Estimator(values, lambda level, text: None)
    message = new_message("sensor_msgs/msg/NavSatFix")
    message.header.frame_id = str(values["base_frame"])
    message.position_covariance = np.diag(case.fix_std[[1, 0, 2]] ** 2).ravel()
    message.position_covariance_type = 2
    done, start = [], 0
    for k, fix_ns in enumerate(case.fix_ns.tolist()):
        stop = int(np.searchsorted(case.stamp_ns, fix_ns, side="right"))
        done += handle_imu_block(
            estimator, case.stamp_ns[start:stop], case.force[start:stop], case.rate[start:stop]
        )
        start = stop
        conversions.set_stamp(message.header.stamp, fix_ns)
        message.latitude, message.longitude = np.degrees(case.fix_lla[k, :2]).tolist()
        message.altitude = float(case.fix_lla[k, 2])
        estimator.handle_fix(message)
        estimator.pop_reports()
    if not done:
        return Found(np.empty(0, np.int64), np.empty((0, 3, 3)), np.empty(0), np.empty((0, 3)))
    stamps = np.concatenate([part[0] for part in done])
    rows = np.concatenate([part[1] for part in done])
    return Found(stamps, matrix_from_quat(rows[:, 3:7]), np.sqrt(rows[:, 7 + 35]), rows[:, :3])


def about_vertical(C: Array, C_true: Array) -> Array:
    """Turn about the vertical that leads from one attitude to another [rad]."""
    turn = C @ np.swapaxes(C_true, -1, -2)
    return np.arctan2(turn[:, 1, 0] - turn[:, 0, 1], turn[:, 0, 0] + turn[:, 1, 1])


def wrapped(angle: Array) -> Array:
    """Bring angles into (-pi, pi]."""
    return np.angle(np.exp(1j * angle))


def run(case: Case) -> list[Row]:
    """Give the heading once, then let it be found from all the others."""
    truth = case.truth
    assert truth.quat_xyzw is not None
    C = matrix_from_quat(truth.quat_xyzw)
    first = C[int(np.argmin(np.abs(truth.stamp_ns - case.stamp_ns[0])))]
    known = estimate(case, math.atan2(first[1, 0], first[0, 0]))
    rows = known.at(truth.stamp_ns)
    late = (rows >= 0) & (truth.stamp_ns > case.moving_ns + round(MANOEUVRING * 0.5e9))
    settled = float(np.median(about_vertical(known.C[rows[late]], C[late])))
    results = []
    for k in range(HEADINGS):
        angle = 2.0 * math.pi * (k + 0.37 * ((7 * k) % HEADINGS) / HEADINGS) / HEADINGS
        found = estimate(turned(case, angle), None)
        own = found.at(truth.stamp_ns)
        there = own >= 0
        error = np.full(len(own), math.nan)
        error[there] = wrapped(
            about_vertical(found.C[own[there]], C[there] @ about_z(angle)) - settled
        )
        std = np.full(len(own), math.nan)
        std[there] = found.yaw_std[own[there]]
        time = (truth.stamp_ns - case.moving_ns) * 1e-9
        at = int(np.argmin(np.abs(time - MANOEUVRING)))
        scored = there & (rows >= 0) & (time >= MANOEUVRING)
        miss = [
            np.linalg.norm(f.position[i[scored]] - truth.position_enu[scored], axis=1)
            for f, i in ((found, own), (known, rows))
        ]
        ratio = math.nan
        if scored.any():
            ratio = float(np.sqrt(np.mean(miss[0] ** 2) / np.mean(miss[1] ** 2)))
        with np.errstate(invalid="ignore"):
            worst = np.abs(error) / np.hypot(std, REFERENCE_STD)
        results.append(
            Row(
                case.name,
                angle,
                float(time[there][0]) if there.any() else math.inf,
                float(error[at]),
                float(std[at]),
                float(np.nanmax(worst)) if there.any() else math.nan,
                ratio,
            )
        )
    return results


def recorded(data: Path, number: int, imu: int, offset: float) -> Case:
    """Read a flight of the dataset."""
    flight = flights.load(data, number, imu)
    aid = flights.fixes(flight, 5.0, 0, ())
    shift = round(offset * 1e9)
    truth = replace(flight.truth.in_map_of(aid.lla[0]), stamp_ns=flight.truth.stamp_ns + shift)
    begin = max(int(flight.stamp_ns[0]), int(aid.stamp_ns[0]) + shift)
    return Case(
        f"{flight.name} IMU {imu}",
        flight.stamp_ns,
        flight.force,
        flight.rate,
        aid.stamp_ns + shift,
        aid.lla,
        aid.std,
        truth,
        begin,
    )


def calibrated(data: Path, number: int, imu: int) -> float:
    """Find the clock offset [s] of a flight."""
    flight = flights.load(data, number, imu)
    recording = flights.as_recording(flight, flights.fixes(flight, 5.0, 0, ()))
    found = calibrate([recording], parameters.defaults(), search=1.0).values
    return float(found["gnss.time_offset.value"])


def simulated(kind: str, seed: int) -> Case:
    """Simulate a run that vibrates, and starts to move after four seconds."""
    trajectory: Motion = KINDS[kind](60.0, seed, heading=0.5 * seed)
    rng = np.random.default_rng(seed)
    truth = sample(trajectory, sample_times(60.0, 100.0))
    imu = corrupt(truth, ImuErrors(accelerometer_std=0.1, gyroscope_std=0.005), rng)
    gnss = fixes(sample(trajectory, sample_times(60.0, 5.0)), rng)
    stamp_ns = EPOCH_NS + np.rint(truth.t * 1e9).astype(np.int64)
    track = Trajectory.from_navigation(
        stamp_ns, truth.lla, truth.velocity_n, truth.quat_xyzw, datum_lla=gnss.lla[0]
    )
    speed = np.linalg.norm(truth.velocity_n[:, :2], axis=1)
    return Case(
        f"{kind} {seed}",
        stamp_ns,
        imu.specific_force @ FLIP,
        imu.angular_rate @ FLIP,
        EPOCH_NS + np.rint(gnss.t * 1e9).astype(np.int64),
        gnss.lla,
        np.asarray(gnss.position_std),
        track.rows(slice(None, None, 10)),
        int(stamp_ns[int(np.argmax(speed > 1.0))]),
    )


def summary(group: str, rows: Sequence[Row]) -> tuple[str, bool]:
    """Return a line of the table, and whether it is as it should be."""
    error = np.array([abs(row.error) for row in rows])
    within = float(np.mean(error <= WITHIN))
    silent = sum(row.worst > COVERED and not abs(row.error) <= WITHIN for row in rows)
    ratio = np.array([row.ratio for row in rows if math.isfinite(row.ratio)])
    aligned = np.array([row.aligned_after for row in rows])
    worse = float(np.median(ratio)) if len(ratio) else math.nan
    pooled = float(np.sqrt(np.mean(ratio**2))) if len(ratio) else math.nan
    line = (
        f"| {group} | {len(rows)} | {within:.1%} | {np.degrees(np.nanmedian(error)):.2f}° "
        f"| {np.degrees(np.nanmax(error)):.1f}° | {silent} | {np.median(aligned):.1f} s "
        f"| {worse:.3f}, {pooled:.3f} |"
    )
    return line, within >= 0.95 and silent == 0 and pooled <= 1.05


def main(argv: Sequence[str] | None = None) -> int:
    """Run the experiment."""
    parser = program.parser("heading", __doc__ or "")
    parser.add_argument("--data", type=options.path, metavar="DIR", help="quadrotor dataset")
    parser.add_argument("--imus", type=options.count, nargs="+", default=[1, 3], metavar="K")
    parser.add_argument(
        "--simulated", type=options.count, default=6, metavar="N", help="runs of each kind"
    )
    parser.add_argument(
        "--offsets",
        type=options.path,
        metavar="FILE",
        help="JSON file that keeps the clock offsets that were found",
    )
    add_jobs(parser, os.cpu_count() or 1)
    parser.add_argument("--verbose", action="store_true", help="print every run")
    return program.run(_body, parser.parse_args(argv))


def _body(args: argparse.Namespace) -> int:
    if args.offsets is not None:
        check_output(args.offsets, overwrite=True)
    cases = [simulated(kind, seed) for kind in KINDS for seed in range(args.simulated)]
    if args.data:
        numbers = [n for session in flights.SESSIONS.values() for n in session]
        keys = [(n, imu) for n in numbers for imu in args.imus]
        kept = (
            json.loads(args.offsets.read_text()) if (args.offsets and args.offsets.exists()) else {}
        )
        missing = [key for key in keys if "{}/{}".format(*key) not in kept]
        found = run_parallel(calibrated, [(args.data, *key) for key in missing], args.jobs)
        for key, offset in zip(
            missing, progress.track(found, "offsets", len(missing), "flight"), strict=True
        ):
            kept["{}/{}".format(*key)] = offset
            if args.offsets:
                args.offsets.write_text(json.dumps(kept, indent=1))
        cases += [recorded(args.data, n, imu, kept[f"{n}/{imu}"]) for n, imu in keys]
    if not cases:
        raise InputError("nothing to run: give --simulated or --data")
    flown = run_parallel(run, [(case,) for case in cases], args.jobs)
    rows = [row for part in progress.track(flown, "runs", len(cases), "run") for row in part]
    print(
        "| runs | number | within 5° after 20 s | median | largest | silently wrong "
        "| aligned after | position RMSE ratio: median, RMS |\n|---|---|---|---|---|---|---|---|"
    )
    good = True
    for group in ("quadrotor", "car", "H"):
        mine = [row for row in rows if row.case.startswith(group)]
        if mine:
            line, fine = summary("recorded" if group == "H" else f"simulated {group}", mine)
            print(line)
            good &= fine
    for row in rows:
        if args.verbose or not abs(row.error) <= WITHIN or row.worst > COVERED:
            print(
                f"{row.case:12} turned {math.degrees(row.heading):4.0f}°: aligned after "
                f"{row.aligned_after:.1f} s, error {math.degrees(row.error):.1f}° "
                f"(σ {math.degrees(row.std):.1f}°), worst {row.worst:.1f} σ, "
                f"position ×{row.ratio:.3f}"
            )
    return int(not good)


if __name__ == "__main__":
    raise SystemExit(main())
