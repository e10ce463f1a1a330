"""
Outages of GNSS cut into drives of simulated and real vehicles: error at their ends, consistency.

Each outage lasts 60 s and is judged after 30 s and at its end. A vehicle is calibrated by what
``ins_calibrate`` finds in two drives of odd seeds; drives of even seeds judge. Variants of the
parameters are compared on the same drives. The IMUs have errors of their scale factors and axes.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from hybrid_ins import parameters
from hybrid_ins.calibration.calibrate import calibrate
from hybrid_ins.calibration.innovations import POSITION
from hybrid_ins.calibration.recording import Recording as Calibrating
from hybrid_ins.cli import options, program
from hybrid_ins.core.inertial.earth import LocalFrame
from hybrid_ins.core.sensor_errors.scale_errors import N_SCALE, SHARES
from hybrid_ins.ros.messages.conversions import SWAP
from hybrid_ins.ros.messages.trajectory import Array
from hybrid_ins.simulation.road_vehicles import ROAD_VEHICLES
from hybrid_ins.simulation.vehicles import VEHICLES, Recording, Vehicle, fixed_wing, record
from tools.vehicles.aiding import Aiding, wheels
from tools.vehicles.drives import Drive, from_simulation
from tools.vehicles.judge import run
from tools.vehicles.roads import CHANGING, changing_road

SETTLED, BETWEEN, LENGTH = 120.0, 60.0, 60.0  # s before the first outage, between two, of each
JUDGED = (30.0, 60.0)  # s after an outage begins
SHORTEST = 30.0  # m: less distance says nothing per distance
CALIBRATION_SEEDS = (101, 103)
GUSTY, GUST_STD = "fixed wing, gusts", 1.5  # m/s
SCALE_STD = 0.005  # of an IMU's scale factors
VARIANTS: dict[str, dict[str, Any]] = {  # those that begin with wheels: with their messages
    "none": {"vehicle.kind": "other"},
    "auto": {"vehicle.kind": "auto"},
    "constant 0.1, 0.1": {"vehicle.slip_model": ""},
    "constant 0.05, 0.05": {"vehicle.slip_model": "", "vehicle.slip_std": [0.05, 0.05]},
    "constant 0.05, 0.1": {"vehicle.slip_model": "", "vehicle.slip_std": [0.05, 0.1]},
    "ground": {"vehicle.kind": "ground"},
    "fixed wing": {"vehicle.kind": "fixed_wing"},
    "none, scale errors ignored": {"vehicle.kind": "other", "imu.scale_std": 0.0},
    "auto, scale errors ignored": {"vehicle.kind": "auto", "imu.scale_std": 0.0},
    "fixed wing, scale errors ignored": {"vehicle.kind": "fixed_wing", "imu.scale_std": 0.0},
    "wheels": {"vehicle.kind": "auto"},
    "wheels alone": {"vehicle.kind": "other"},
}


@dataclass(frozen=True)
class End:
    """The error of position a time [s] into an outage."""

    after: float  # s
    error: float  # m, three-dimensional
    distance: float  # m, travelled since the outage began
    nees: float  # of the position, over 3


def every_vehicle() -> dict[str, Vehicle]:
    """Return all simulated vehicles by name."""
    return {**VEHICLES, **ROAD_VEHICLES}


def gusty() -> Vehicle:
    """Return the fixed wing in gusts."""
    motion = partial(fixed_wing, gust_std=GUST_STD)
    return replace(VEHICLES["fixed wing 50 Hz"], name=GUSTY, motion=motion)


def driven(
    name: str, seed: int, duration: float | None = None, scale_std: float = SCALE_STD
) -> Recording:
    """
    Return a drive of a vehicle by its name, of a car on a road that changes, or in gusts.

    Errors of the IMU's scale factors have the standard deviation ``scale_std``.
    """
    if name == CHANGING:
        made = changing_road(seed, duration or every_vehicle()["road car"].duration)
    else:
        vehicle = gusty() if name == GUSTY else every_vehicle()[name]
        made = record(replace(vehicle, duration=duration or vehicle.duration), seed)
    return with_scale_errors(made, seed, scale_std)


def with_scale_errors(made: Recording, seed: int, std: float) -> Recording:
    """Return a recording whose IMU reads f + M_a f and ω + M_g ω; ``std`` of scale factors."""
    m = std * SHARES * np.random.default_rng([seed, 91]).standard_normal(N_SCALE)
    M_a, M_g = m.reshape(2, 3, 3)
    force, rate = made.imu.specific_force, made.imu.angular_rate
    imu = replace(made.imu, specific_force=force + force @ M_a.T, angular_rate=rate + rate @ M_g.T)
    return replace(made, imu=imu)


def calibrated(name: str, scale_std: float = SCALE_STD) -> dict[str, Any]:
    """Return what ``ins_calibrate`` finds in drives of a vehicle, but for its nose and axle."""
    drives = [as_recording(driven(name, seed, None, scale_std)) for seed in CALIBRATION_SEEDS]
    given = parameters.defaults()
    found = calibrate(drives, given).values
    return {**found, **{name: given[name] for name in given if name.startswith("vehicle.")}}


def as_recording(drive: Recording) -> Calibrating:
    """Return a simulated drive as a recording to calibrate with."""
    count = len(drive.fix_stamp)
    samples = np.hstack((drive.imu.specific_force, drive.imu.angular_rate))
    R = np.diag(np.asarray(drive.vehicle.receiver.claimed_std) ** 2)
    return Calibrating(
        drive.vehicle.name,
        drive.imu.t,
        np.ascontiguousarray(samples),
        drive.fix_stamp,
        np.full(count, POSITION, np.int64),
        drive.fix_lla,
        np.tile(R, (count, 1, 1)),
    )


def begins(drive: Drive) -> Array:
    """Return when outages begin [s after the first sample]."""
    first = (drive.motion_ns - drive.imu_ns[0]) * 1e-9 + SETTLED
    last = (drive.imu_ns[-1] - drive.imu_ns[0]) * 1e-9 - LENGTH - 5.0
    return np.arange(first, last, LENGTH + BETWEEN)


def ends(
    drive: Drive,
    values: Mapping[str, Any],
    log: Any = lambda *_: None,
    aiding: Sequence[Aiding] = (),
    starts: Array | None = None,
) -> list[End]:
    """
    Return the errors in the outages of one drive.

    ``aiding`` as for `judge.run`; ``starts`` of the outages [s after the first sample], instead of
    `begins`.
    """
    t = (drive.arrival_ns - drive.imu_ns[0]) * 1e-9
    starts = begins(drive) if starts is None else starts
    out = np.any([(t > start) & (t < start + LENGTH) for start in starts], axis=0)
    estimator, t_ns, rows = run(drive.thinned(~out), values, log, aiding)
    if len(t_ns) < 2 or estimator.odometry.map is None:
        return []
    truth = LocalFrame(estimator.odometry.map.datum_lla).position(drive.truth_lla) @ SWAP
    found = []
    truth_t = (drive.truth_ns - drive.imu_ns[0]) * 1e-9
    for start in starts:
        for after in JUDGED:
            stop = int(np.searchsorted(truth_t, start + after))
            begin = int(np.searchsorted(truth_t, start))
            at = int(np.searchsorted(t_ns, drive.truth_ns[stop]))
            if at >= len(t_ns) or abs(t_ns[at] - drive.truth_ns[stop]) > 20_000_000:
                continue
            error = rows[at, :3] - truth[stop]
            P = rows[at, 7:43].reshape(6, 6)[:3, :3]
            steps = np.diff(truth[begin : stop + 1], axis=0)
            found.append(
                End(
                    after,
                    float(np.linalg.norm(error)),
                    float(np.sum(np.linalg.norm(steps, axis=1))),
                    float(error @ np.linalg.solve(P, error)) / 3.0,
                )
            )
    return found


def row(name: str, variant: str, found: Sequence[End], after: float) -> str:
    """Return the row of a table for the errors a time [s] into outages."""
    here = [end for end in found if end.after == after]
    if not here:
        return f"| {name} | {variant} | {after:.0f} s | 0 | - | - | - | - |"
    error = np.array([end.error for end in here])
    median, most = np.quantile(error, (0.5, 0.9))
    share = [100.0 * end.error / end.distance for end in here if end.distance > SHORTEST]
    nees = np.mean([end.nees for end in here])
    return (
        f"| {name} | {variant} | {after:.0f} s | {len(here)} | {median:.1f}, {most:.1f} "
        f"| {np.sqrt(np.mean(error**2)):.1f} | {np.median(share):.2f} %, "
        f"{np.exp(np.mean(np.log(share))):.2f} % | {nees:.2f} |"
    )


HEADER = (
    "| vehicle | variant | after | outages | median, 90 % [m] | rms [m] "
    "| of distance: median, geometric mean | NEES/3 |\n"
)
HEADER += "|---" * 8 + "|"


def table(
    names: Sequence[str],
    seeds: Sequence[int],
    variants: Sequence[str],
    duration: float,
    scale_std: float,
) -> Iterator[str]:
    """
    Yield the rows of vehicles, and of all of them where there are several.

    Errors of the IMUs' scale factors have the standard deviation ``scale_std``.
    """
    every: dict[str, list[End]] = {variant: [] for variant in variants}
    for name in names:
        base = calibrated(name, scale_std)
        recordings = [driven(name, seed, duration, scale_std) for seed in seeds]
        for variant in variants:
            found: list[End] = []
            for recording in recordings:
                aiding = wheels(recording) if variant.startswith("wheels") else []
                values = {**base, **VARIANTS[variant]}
                found += ends(from_simulation(recording), values, aiding=aiding)
            every[variant] += found
            yield from (row(name, variant, found, after) for after in JUDGED)
    if len(names) > 1:
        for variant, found in every.items():
            yield from (row("all", variant, found, after) for after in JUDGED)


def main(argv: Sequence[str] | None = None) -> int:
    """Print the table."""
    parser = program.parser("outages", __doc__ or "")
    names = [*every_vehicle(), CHANGING, GUSTY]
    parser.add_argument(
        "names", nargs="*", default=["road car"], choices=names, metavar="NAME", help="[road car]"
    )
    parser.add_argument("--seeds", type=options.count, nargs="+", default=[2, 4, 6, 8], metavar="N")
    parser.add_argument("--variants", nargs="+", default=list(VARIANTS), choices=VARIANTS)
    parser.add_argument("--duration", type=options.positive, default=600.0, metavar="S")
    parser.add_argument(
        "--scale-errors",
        type=options.not_negative,
        default=SCALE_STD,
        metavar="STD",
        help="standard deviation of errors of the IMU's scale factors, twice that of its axes'"
        " directions [%(default)s]",
    )
    return program.run(_body, parser.parse_args(argv))


def _body(args: argparse.Namespace) -> int:
    print(HEADER)
    for line in table(args.names, args.seeds, args.variants, args.duration, args.scale_errors):
        print(line, flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
