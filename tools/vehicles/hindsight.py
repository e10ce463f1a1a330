"""
Accuracy against the best constant noise in hindsight, of the same filter on the same drives.

The constants are the standard deviations of the accelerometer's and the gyroscope's noise per
sample and a factor on the standard deviations that fixes claim. They are searched for each drive by
coordinates, in steps of a factor of two from the best of a few, for the least RMSE in three
dimensions: no filter that runs while the vehicle moves can know them.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from hybrid_ins import parameters
from hybrid_ins.cli import program
from tools.vehicles.drives import Drive
from tools.vehicles.evaluate import drives, parser_of_drives
from tools.vehicles.judge import Score, score

Exponents = tuple[int, int, int]

ACCELEROMETER, GYROSCOPE = 0.5, 0.01  # m/s², rad/s per sample
STARTS: tuple[Exponents, ...] = (
    (-6, -4, 0),
    (-4, -3, 0),
    (-2, -2, 0),
    (0, 0, 0),
    (2, 0, -3),
    (2, 3, 0),
)
COVERED = 0.02  # share of the truth's epochs by which the constant may be ready later
HEADER = (
    "| drive | default [m] | best constant [m] | ratio | accelerometer [m/s²] | gyroscope [rad/s] "
    "| fixes | runs |\n" + "|---" * 8 + "|"
)


def error(found: Score) -> float:
    """Return the RMSE in three dimensions [m]."""
    return math.hypot(found.rmse, found.rmse_up)


def run_constant(drive: Drive, exponents: Exponents) -> Score:
    """Run with constants of 2 ** ``exponents`` times the first ones, and judge."""
    q_accelerometer, q_gyroscope, fixes = (2.0**k for k in exponents)
    values = parameters.defaults() | {
        "noise.mode": "constant",
        "noise.q_accelerometer": (ACCELEROMETER * q_accelerometer) ** 2,
        "noise.q_gyroscope": (GYROSCOPE * q_gyroscope) ** 2,
    }
    claimed = np.where(np.isnan(drive.fix_std), values["gnss.position_std_default"], drive.fix_std)
    return score(replace(drive, fix_std=claimed * fixes), values)


def search(
    drive: Drive, starts: Sequence[Exponents], covered: float
) -> tuple[Exponents, float, int]:
    """
    Return the best exponents, their RMSE [m] and the number of runs.

    ``covered`` is the share of the truth's epochs that must have an estimate.
    """
    known: dict[Exponents, float] = {}

    def cost(exponents: Exponents) -> float:
        if exponents not in known:
            found = run_constant(drive, exponents)
            whole = found.covered >= covered and math.isfinite(found.rmse)
            known[exponents] = error(found) if whole else math.inf
        return known[exponents]

    best = min(starts, key=cost)
    while True:
        before = best
        for axis in range(3):
            for step in (1, -1):
                while True:
                    moved = list(best)
                    moved[axis] += step
                    if cost((moved[0], moved[1], moved[2])) >= cost(best):
                        break
                    best = (moved[0], moved[1], moved[2])
        if best == before:
            return best, cost(best), len(known)


def main(argv: Sequence[str] | None = None) -> int:
    """Print the table."""
    return program.run(_body, parser_of_drives("hindsight", __doc__).parse_args(argv))


def _body(args: argparse.Namespace) -> int:
    chosen = drives(args.names, args.seeds, args.data, args.log)
    print(HEADER)
    starts = list(STARTS)
    for drive in chosen:
        ours = score(drive, parameters.defaults())
        if not math.isfinite(ours.rmse):
            print(f"| {drive.name} | never aligned |" + " |" * 6, flush=True)
            continue
        best, theirs, runs = search(drive, starts, ours.covered - COVERED)
        if math.isfinite(theirs):
            starts = [*STARTS, best]
        print(
            f"| {drive.name} | {error(ours):.3f} | {theirs:.3f} | {error(ours) / theirs:.2f} "
            f"| {ACCELEROMETER * 2.0 ** best[0]:.3g} | {GYROSCOPE * 2.0 ** best[1]:.3g} "
            f"| {2.0 ** best[2]:g} σ | {runs} |",
            flush=True,
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
