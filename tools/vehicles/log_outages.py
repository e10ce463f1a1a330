"""
Outages of GNSS cut into recorded logs: error at their ends, consistency.

The fixes that an outage leaves out are its truth, at their stamps plus the clock offset in force.
Outages begin 90 s after the motion, 25 s after the last one ended, where the vehicle is faster than
5 m/s. With a constant noise the standard deviations per sample are those given. With
``--params-file`` its parameters are compared with the defaults, with and without a constraint.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from hybrid_ins import parameters
from hybrid_ins.cli import options, program
from hybrid_ins.core.inertial.earth import LocalFrame
from hybrid_ins.parameters import parameter_file
from hybrid_ins.ros.messages.conversions import SWAP
from hybrid_ins.ros.messages.trajectory import Array
from tools.parallel import add_jobs, run_parallel
from tools.vehicles.drives import Drive, Log, from_log, log
from tools.vehicles.judge import at_offset_in_force, run

SETTLED, BETWEEN, LEAST_SPEED = 90.0, 25.0, 5.0  # s, s, m/s
VARIANTS: dict[str, dict[str, Any]] = {
    "default": {},
    **{
        f"constant, {force:g} m/s², {rate:g} rad/s": {
            "noise.mode": "constant",
            "noise.q_accelerometer": force**2,
            "noise.q_gyroscope": rate**2,
        }
        for force, rate in ((0.5, 0.01), (1.0, 0.01), (2.0, 0.01), (1.0, 0.003), (1.0, 0.03))
    },
}
CONSTRAINTS: dict[str, dict[str, Any]] = {
    "no constraint": {"vehicle.kind": "other"},
    "default": {},
}
HEADER = (
    "| recording | parameters | outages, without odometry at the end | median, 90 % [m] | rms [m] "
    "| NEES/3 |\n" + "|---" * 6 + "|"
)


def begins(drive: Drive, length: float) -> Array:
    """Return when outages of a ``length`` [s] begin [s after the first sample]."""
    t = (drive.fix_ns - drive.imu_ns[0]) * 1e-9
    speed = _speed(drive, t)
    first = (drive.motion_ns - drive.imu_ns[0]) * 1e-9 + SETTLED
    starts = np.arange(first, t[-1] - length - 5.0, length + BETWEEN)

    def is_fast(start: float) -> bool:
        inside = (t > start) & (t < start + length)
        return bool(np.any(inside)) and float(np.median(speed[inside])) > LEAST_SPEED

    return np.array([start for start in starts if is_fast(start)])


def _speed(drive: Drive, t: Array) -> Array:
    """Return the horizontal speed [m/s] at the fixes, by the positions where none is measured."""
    if drive.velocity_enu is not None:
        return np.asarray(np.linalg.norm(drive.velocity_enu[:, :2], axis=1))
    frame = LocalFrame(drive.fix_lla[0])
    track = np.array([frame.position(lla)[:2] for lla in drive.fix_lla])
    return np.asarray(np.linalg.norm(np.gradient(track, t, axis=0), axis=1))


def ends(drive: Drive, values: Mapping[str, Any], length: float) -> tuple[Array, Array]:
    """Return the errors [m] at the ends of outages, (K,), and their NEES over 3."""
    starts = begins(drive, length)
    t = (drive.fix_ns - drive.imu_ns[0]) * 1e-9
    out = np.any([(t > start) & (t < start + length) for start in starts], axis=0)
    estimator, t_ns, rows = run(drive.thinned(~out), values)
    assert estimator.odometry.map is not None
    frame = LocalFrame(estimator.odometry.map.datum_lla)
    every = replace(drive, truth_ns=drive.fix_ns + round(drive.offset * 1e9))
    true_ns = at_offset_in_force(every, estimator.offsets)
    errors, nees = [], []
    for start in starts:
        k = int(np.searchsorted(t, start + length)) - 1
        at = int(np.searchsorted(t_ns, true_ns[k]))
        if not 0 < at < len(t_ns) or t_ns[at] - t_ns[at - 1] > 500_000_000:
            errors.append(np.inf)  # it claims nothing there
            nees.append(np.nan)
            continue
        share = (true_ns[k] - t_ns[at - 1]) / (t_ns[at] - t_ns[at - 1])
        position = rows[at - 1, :3] + share * (rows[at, :3] - rows[at - 1, :3])
        error = position - frame.position(drive.fix_lla[k]) @ SWAP
        P = rows[at, 7:43].reshape(6, 6)[:3, :3]
        errors.append(float(np.linalg.norm(error)))
        nees.append(float(error @ np.linalg.solve(P, error)) / 3.0)
    return np.array(errors), np.array(nees)


def one(files: Log, name: str, values: Mapping[str, Any], length: float) -> str:
    """Return the row of one recording; ``name`` is that of the parameters' ``values``."""
    errors, nees = ends(from_log(files, "all"), parameters.defaults() | values, length)
    claimed = errors[np.isfinite(errors)]
    median, most = np.quantile(claimed, (0.5, 0.9)) if len(claimed) else (np.nan, np.nan)
    rms = float(np.sqrt(np.mean(claimed**2)))
    return (
        f"| {files[0].stem} | {name} | {len(errors)}, {len(errors) - len(claimed)} "
        f"| {median:.1f}, {most:.1f} | {rms:.1f} | {np.nanmean(nees):.2f} |"
    )


def main(argv: Sequence[str] | None = None) -> int:
    """Print the table."""
    parser = program.parser("log_outages", __doc__ or "")
    parser.add_argument("logs", type=log, nargs="+", metavar="FILE", help="or IMU,GNSS")
    parser.add_argument("--params-file", type=options.path, metavar="FILE", help="of ins_calibrate")
    parser.add_argument(
        "--length", type=options.positive, default=10.0, metavar="S", help="[%(default)s]"
    )
    add_jobs(parser, 2)
    return program.run(_body, parser.parse_args(argv))


def _body(args: argparse.Namespace) -> int:
    variants = VARIANTS
    if args.params_file is not None:
        variants = {**CONSTRAINTS, args.params_file.name: parameter_file.load(args.params_file)}
    tasks = [(files, *variant, args.length) for files in args.logs for variant in variants.items()]
    for k, line in enumerate(run_parallel(one, tasks, args.jobs)):
        print(line if k else f"{HEADER}\n{line}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
