"""
Drives whose receivers err by what they do not claim, and the same with right claims.

Slow errors, multipath waves, heights that scatter by more than the rest, and stamps that are those
of the fixes' arrival: how long the odometry is silently wrong, whether that is named, and how far
the published covariance holds. Odd seeds are for tuning, even ones judge.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hybrid_ins import parameters
from hybrid_ins.cli import options, program
from hybrid_ins.core.inertial import earth
from hybrid_ins.simulation.sensors import gauss_markov, in_outage
from hybrid_ins.simulation.vehicles import VEHICLES, Receiver, Recording, record
from tools.parallel import add_jobs, run_parallel
from tools.vehicles.drives import Drive, from_simulation
from tools.vehicles.evaluate import check_names
from tools.vehicles.judge import Score, score

Array = NDArray[np.float64]

MOTIONS = (
    "car",
    "car on a motorway, clock -0.1 s",
    "boat",
    "pedestrian",
    "slow rover",
    "quadrotor",
)
NAMED = "drift by", "stamps of fixes scatter", "scatter by more"  # in the log
LATEST = 0.3  # s, of a stamp
BETWEEN_LOSSES, LOSS = 40.0, (5.0, 25.0)  # s, of ambiguities: mean time between, shortest, longest


@dataclass(frozen=True)
class Claim:
    """What a receiver's errors are and what it claims: horizontal standard deviations [m]."""

    rate: float  # Hz
    white: float
    slow: float
    slow_time: float  # s
    claimed: float
    wave: float = 0.0  # m, amplitude of a multipath wave
    period: float = 60.0  # s, of that
    late: float = 0.0  # s, mean of the time by which stamps are late, exponentially distributed
    lost: float = 0.0  # m, what is claimed besides, and true, while the ambiguities are lost
    heights: float = 1.5  # times the horizontal errors
    claimed_heights: float = 1.5  # times the horizontal claim

    def errors(self, size: float) -> Array:
        """Return errors north, east, down of a horizontal size [m], (3,)."""
        return size * np.array([1.0, 1.0, self.heights])


RECEIVERS = {
    "0.7 m, 20 s, claims 0.1 m": Claim(1.0, 0.05, 0.7, 20.0, 0.1),
    "0.7 m, 60 s, claims 0.2 m": Claim(5.0, 0.1, 0.7, 60.0, 0.2),
    "1.0 m, 60 s, claims 0.3 m": Claim(1.0, 0.2, 1.0, 60.0, 0.3),
    "1.0 m, 120 s, claims 0.1 m": Claim(5.0, 0.08, 1.0, 120.0, 0.1),
    "1.5 m, 120 s, claims 0.2 m": Claim(1.0, 0.2, 1.5, 120.0, 0.2),
    "1.5 m, 40 s, claims 0.3 m": Claim(5.0, 0.3, 1.5, 40.0, 0.3),
    "wave of 1 m, 60 s, and 0.5 m, 300 s, claims 0.2 m": Claim(5.0, 0.1, 0.5, 300.0, 0.2, 1.0),
    "wave of 1.5 m, 90 s, and 0.5 m, 300 s, claims 0.15 m": Claim(
        1.0, 0.1, 0.5, 300.0, 0.15, 1.5, 90.0
    ),
    "0.3 m and heights 3 m, claims 1 m of both": Claim(
        1.0, 0.3, 0.0, 100.0, 1.0, heights=10.0, claimed_heights=1.0
    ),
    "0.02 m and heights 0.3 m, claims 0.02 m of both": Claim(
        5.0, 0.02, 0.0, 100.0, 0.02, heights=15.0, claimed_heights=1.0
    ),
    "stamps late by 0.02 s, 5 Hz": Claim(5.0, 0.01, 0.0, 100.0, 0.01, late=0.02),
    "stamps late by 0.02 s, 1 Hz": Claim(1.0, 0.01, 0.0, 100.0, 0.01, late=0.02),
    "stamps late by 0.05 s, 5 Hz": Claim(5.0, 0.01, 0.0, 100.0, 0.01, late=0.05),
    "stamps late by 0.05 s, 1 Hz": Claim(1.0, 0.01, 0.0, 100.0, 0.01, late=0.05),
}
RIGHT = {
    "right: 0.3 m and heights 3 m": Claim(
        1.0, 0.3, 0.0, 100.0, 0.3, heights=10.0, claimed_heights=10.0
    ),
    "right: 0.02 m and heights 0.3 m": Claim(
        5.0, 0.02, 0.0, 100.0, 0.02, heights=15.0, claimed_heights=15.0
    ),
    "right: 0.02 m": Claim(5.0, 0.02, 0.0, 100.0, 0.02),
    "right: 0.1 m": Claim(1.0, 0.1, 0.0, 100.0, 0.1),
    "right: 0.3 m": Claim(5.0, 0.3, 0.0, 100.0, 0.3),
    "right: 0.02 m, at times 0.4 m, 5 Hz": Claim(5.0, 0.02, 0.0, 30.0, 0.02, lost=0.4),
    "right: 0.02 m, at times 0.4 m, 1 Hz": Claim(1.0, 0.02, 0.0, 30.0, 0.02, lost=0.4),
}


def recorded(motion: str, claim: Claim, seed: int) -> Recording:
    """Return a recording of a motion with a receiver."""
    receiver = Receiver(
        rate=claim.rate,
        white_std=tuple(claim.errors(claim.white)),
        slow_std=tuple(claim.errors(claim.slow)),
        slow_time=claim.slow_time,
        claimed_std=(claim.claimed, claim.claimed, claim.claimed * claim.claimed_heights),
    )
    made = record(replace(VEHICLES[motion], receiver=receiver), seed)
    rng = np.random.default_rng([seed, 41])
    phase = rng.uniform(0.0, 2.0 * np.pi, 3)
    wave = claim.errors(claim.wave) * np.sin(
        2.0 * np.pi / claim.period * made.fix_t[:, None] + phase
    )
    scale = np.array([earth.curvature_scale(place) for place in made.fix_lla])
    late = np.minimum(rng.exponential(1.0, len(made.fix_t)) * claim.late, LATEST)
    return replace(made, fix_lla=made.fix_lla + wave / scale, fix_stamp=made.fix_stamp + late)


def losing_ambiguities(drive: Drive, claim: Claim, seed: int) -> Drive:
    """Return the drive with float solutions at times: a slow error, which is claimed."""
    rng, t = np.random.default_rng([seed, 43]), drive.fix_ns * 1e-9
    losses, at = [], t[0] + rng.exponential(BETWEEN_LOSSES)
    while at < t[-1]:
        losses.append((at, rng.uniform(*LOSS)))
        at += losses[-1][1] + rng.exponential(BETWEEN_LOSSES)
    decay = math.exp(-1.0 / (claim.rate * claim.slow_time))
    error = gauss_markov(1.0, decay, len(t), rng)
    std = claim.errors(claim.lost) * in_outage(t, losses)[:, None]
    scale = np.array([earth.curvature_scale(place) for place in drive.fix_lla])
    return replace(
        drive,
        fix_lla=drive.fix_lla + std * error / scale,
        fix_std=np.hypot(drive.fix_std, std[:, [1, 0, 2]]),
    )


def one(motion: str, name: str, seed: int) -> tuple[str, str, int, Score, int]:
    """Return a run's motion, receiver, seed, score, and how often its error was named."""
    named = 0

    def log(level: str, text: str) -> None:
        nonlocal named
        named += any(words in text for words in NAMED)

    claim = {**RECEIVERS, **RIGHT}[name]
    drive = from_simulation(recorded(motion, claim, seed), LATEST if claim.late else 0.0)
    if claim.lost:
        drive = losing_ambiguities(drive, claim, seed)
    found = score(drive, parameters.defaults(), log)
    return motion, name, seed, found, named


def main(argv: Sequence[str] | None = None) -> int:
    """Print a row for each run, and one for each receiver."""
    parser = program.parser("claims", __doc__ or "")
    parser.add_argument("receivers", nargs="*", metavar="NAME", help="parts of their names")
    parser.add_argument("--motions", nargs="+", default=MOTIONS, choices=MOTIONS, metavar="NAME")
    parser.add_argument("--seeds", type=options.count, nargs="+", default=[1], metavar="N")
    add_jobs(parser, 1)
    return program.run(_body, parser.parse_args(argv))


def _body(args: argparse.Namespace) -> int:
    check_names(args.receivers, [*RECEIVERS, *RIGHT])
    names = [
        name
        for name in (*RECEIVERS, *RIGHT)
        if not args.receivers or any(part in name for part in args.receivers)
    ]
    runs = [(m, name, seed) for name in names for m in args.motions for seed in args.seeds]
    rows = []
    print(
        "| receiver | motion | seed | silently wrong [s] | named | RMSE, up [m] | NEES/2 | NIS/m |"
    )
    for row in run_parallel(one, runs, args.jobs):
        rows.append(row)
        motion, name, seed, s, named = row
        print(
            f"| {name} | {motion} | {seed} | {s.silent:.0f} | {named} | {s.rmse:.3f}, "
            f"{s.rmse_up:.3f} | {s.nees:.2f} | {s.nis:.2f} |",
            flush=True,
        )
    print("| receiver | runs | silently wrong: runs, [s] | named | RMSE [m] | NEES/2, median |")
    for name in names:
        here = [row for row in rows if row[1] == name]
        silent = [row[3].silent for row in here]
        print(
            f"| {name} | {len(here)} | {sum(s > 0.0 for s in silent)}, {sum(silent):.0f} "
            f"| {sum(row[4] > 0 for row in here)} "
            f"| {np.sqrt(np.mean([row[3].rmse ** 2 for row in here])):.4f} "
            f"| {np.median([row[3].nees for row in here]):.2f} |"
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
