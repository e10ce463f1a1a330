"""
Table of vehicles, real and simulated: how often standing is recognised, and motion taken for it.

Windows of a second, twice a second while the filter runs. The samples alone show a vehicle at rest;
their spectrum also one whose engine is on; zero velocity is fused where the filter's speed and the
fixes allow it, too.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from hybrid_ins import parameters
from hybrid_ins.core.earth import curvature_scale
from hybrid_ins.core.imu_monitor import PERIOD_NS, WINDOW_NS
from hybrid_ins.core.standstill import is_standing, is_standing_with_engine
from tools.vehicles.constraint import drives
from tools.vehicles.drives import Drive
from tools.vehicles.judge import Judged, run

RESTING, MOVING = 0.1, 0.5  # m/s, largest speed of what stands, smallest of what moves
HEADER = (
    "| drive | standing: windows | samples | spectrum | fused "
    "| moving: windows | samples | spectrum | fused |\n" + "|---" * 9 + "|"
)


class Watched(Judged):
    """Notes what each test finds of the last second."""

    def __init__(self) -> None:
        self.seen: list[tuple[int, bool, bool, bool]] = []
        super().__init__(parameters.defaults())

    def run_periodic(self) -> None:
        """See `Estimator`."""
        super().run_periodic()
        navigator = self.navigator
        if navigator.filter is not None and navigator.last_ns >= self._next_ns:
            self._next_ns = navigator.last_ns + PERIOD_NS
            samples = navigator.ring.after(navigator.last_ns - WINDOW_NS)
            at_rest = is_standing(samples)
            found = at_rest, at_rest or is_standing_with_engine(samples), navigator.monitor.standing
            self.seen.append((navigator.last_ns, *found))

    _next_ns = 0


def row(drive: Drive) -> str:
    """Return the row of a drive."""
    estimator = Watched()
    run(drive, {}, estimator=estimator)
    t_ns = np.array([seen[0] for seen in estimator.seen])
    found = np.array([seen[1:] for seen in estimator.seen], float).reshape(-1, 3)
    place = (drive.truth_lla - drive.truth_lla[0]) * curvature_scale(drive.truth_lla[0])
    at = [
        np.column_stack([np.interp(moment, drive.truth_ns, axis) for axis in place.T])
        for moment in (t_ns - WINDOW_NS, t_ns)
    ]
    speed = np.linalg.norm(at[1] - at[0], axis=1) / (WINDOW_NS * 1e-9)
    return f"| {drive.name} {_shares(found[speed < RESTING])} {_shares(found[speed > MOVING])} |"


def _shares(found: np.ndarray) -> str:
    """Return the cells of windows (N, 3)."""
    if not len(found):
        return "| 0 | - | - | -"
    return f"| {len(found)} | " + " | ".join(f"{share:.3f}" for share in found.mean(axis=0))


def main(argv: Sequence[str] | None = None) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME")
    parser.add_argument("--seeds", type=int, nargs="+", default=[2], metavar="N")
    parser.add_argument("--data", type=Path, metavar="DIR", help="folder of the real sets")
    args = parser.parse_args(argv)
    print(HEADER)
    for drive in drives(args.names, args.seeds, args.data):
        print(row(drive), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
