"""
Write labelled IMU windows to a NumPy file, to train or judge a noise regressor elsewhere.

The file holds train_readings, test_readings (B, N) float32, one channel's window a row, oldest
sample first, in m/s² or rad/s; train_variance, test_variance (B,), the labels; train_group,
test_group (B,), the trajectory of each row; and trajectories, their names. The same options give
the same windows on every machine.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from hybrid_ins.cli import options, program
from hybrid_ins.errors import InputError
from tools.regressor import noise_data, noise_randomised
from tools.regressor.noise_data import Windows

SHARE = 0.8


def windows(args: argparse.Namespace) -> tuple[Windows, Windows]:
    """Return the (train, test) windows that the options ask for."""
    if not 50 <= args.window <= 10_000:
        raise InputError(f"--window {args.window}: give 50 to 10000 samples")
    if args.set == "randomised":
        if args.held_out is not None or args.variances is not None:
            raise InputError("--held-out and --variances are for --set paper")
        if args.count < 2:
            raise InputError(f"--count {args.count}: give at least 2")
        data = noise_randomised.randomised_set(args.seed, args.count, args.window)
        return noise_data.random_split(data, args.seed, SHARE)
    if args.window > round(args.duration * noise_data.PAPER_RATE_HZ):
        raise InputError(
            f"--duration {args.duration:g}: shorter than one window of {args.window} samples"
        )
    variances = noise_data.PAPER_VARIANCES if args.variances is None else args.variances
    data = noise_data.paper_set(args.seed, args.window, variances, duration_s=args.duration)
    if args.held_out is None:
        return noise_data.random_split(data, args.seed, SHARE)
    return noise_data.trajectory_split(data, noise_data.PAPER_TRAJECTORIES.index(args.held_out))


def make(args: argparse.Namespace) -> int:
    """Do what the command line asks for."""
    train, test = windows(args)
    columns = {
        f"{part}_{name}": column
        for part, data in (("train", train), ("test", test))
        for name, column in data._asdict().items()
    }
    with args.out.open("wb") as file:
        np.savez(file, **columns, trajectories=np.array(noise_data.PAPER_TRAJECTORIES))
    print(f"{args.out}: {len(train.variance)} windows to train on, {len(test.variance)} to test")
    return 0


def main(argv: Sequence[str] | None = None) -> int:
    """Run the program."""
    parser = program.parser(
        "make_noise_windows",
        __doc__ or "",
        "python -m tools.regressor.make_noise_windows --set paper --held-out agile --out agile.npz",
    )
    parser.add_argument(
        "--set",
        choices=("paper", "randomised"),
        required=True,
        help="the paper's six trajectories, or domain-randomised windows",
    )
    parser.add_argument("--out", type=Path, required=True, metavar="FILE.npz")
    parser.add_argument("--seed", type=options.count, default=1, help="[1]")
    parser.add_argument("--window", type=options.count, default=200, help="samples N [200]")
    parser.add_argument(
        "--count",
        type=options.count,
        default=100_000,
        help="windows of the randomised set [100000]",
    )
    parser.add_argument(
        "--held-out",
        choices=noise_data.PAPER_TRAJECTORIES,
        help="test on this whole trajectory, not on a random fifth",
    )
    parser.add_argument(
        "--variances",
        type=options.positive,
        nargs="+",
        metavar="Q",
        help="noise levels of the paper's set [the paper's 15]",
    )
    parser.add_argument(
        "--duration",
        type=options.positive,
        default=noise_data.PAPER_DURATION_S,
        help="of each trajectory, s [400]",
    )
    return program.run(make, parser.parse_args(argv))


if __name__ == "__main__":
    sys.exit(main())
