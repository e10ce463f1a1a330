"""
Outages of GNSS cut into the flights of autopilots' logs: error at their ends, consistency.

The fixes that an outage leaves out are its truth, at their stamps plus the clock offset in force.
Outages begin 90 s after the motion, 25 s after the last one ended, where the vehicle is faster than
5 m/s. With a constant noise the standard deviations per sample are those given.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from hybrid_ins import parameters
from hybrid_ins.cli import options, program
from hybrid_ins.core.inertial.earth import LocalFrame
from hybrid_ins.ros.messages.conversions import SWAP
from hybrid_ins.ros.messages.trajectory import Array
from tools.parallel import add_jobs, run_parallel
from tools.vehicles.drives import Drive, from_log
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
HEADER = "| flight | noise | outages | median, 90 % [m] | rms [m] | NEES/3 |\n" + "|---" * 6 + "|"


def begins(drive: Drive, length: float) -> Array:
    """Return when outages of a ``length`` [s] begin [s after the first sample]."""
    assert drive.velocity_enu is not None
    speed = np.linalg.norm(drive.velocity_enu[:, :2], axis=1)
    t = (drive.fix_ns - drive.imu_ns[0]) * 1e-9
    first = (drive.motion_ns - drive.imu_ns[0]) * 1e-9 + SETTLED
    starts = np.arange(first, t[-1] - length - 5.0, length + BETWEEN)

    def is_fast(start: float) -> bool:
        inside = (t > start) & (t < start + length)
        return bool(np.any(inside)) and float(np.median(speed[inside])) > LEAST_SPEED

    return np.array([start for start in starts if is_fast(start)])


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


def one(path: Path, variant: str, length: float) -> str:
    """Return the row of one flight."""
    errors, nees = ends(from_log(path, "all"), parameters.defaults() | VARIANTS[variant], length)
    median, most = np.quantile(errors, (0.5, 0.9))
    rms = float(np.sqrt(np.mean(errors**2)))
    return (
        f"| {path.stem} | {variant} | {len(errors)} | {median:.1f}, {most:.1f} | {rms:.1f} "
        f"| {np.nanmean(nees):.2f} |"
    )


def main(argv: Sequence[str] | None = None) -> int:
    """Print the table."""
    parser = program.parser("log_outages", __doc__ or "")
    parser.add_argument("logs", type=options.path, nargs="+", metavar="FILE")
    parser.add_argument(
        "--length", type=options.positive, default=10.0, metavar="S", help="[%(default)s]"
    )
    add_jobs(parser, 2)
    return program.run(_body, parser.parse_args(argv))


def _body(args: argparse.Namespace) -> int:
    tasks = [(path, variant, args.length) for path in args.logs for variant in VARIANTS]
    for k, line in enumerate(run_parallel(one, tasks, args.jobs)):
        print(line if k else f"{HEADER}\n{line}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
