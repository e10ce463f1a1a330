"""
Table of vehicles, real and simulated: for how much of the time the motion shows wheels.

With the default, ``vehicle.kind: auto``, and with fixes all the time: the constraint is fused in
outages only, and what is found while fixes come is what an outage begins with.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from itertools import chain
from pathlib import Path

import numpy as np

from hybrid_ins import parameters
from hybrid_ins.cli import options, program
from hybrid_ins.ros.aids.vehicle_input import PERIOD_NS
from hybrid_ins.simulation.vehicles import record
from tools.vehicles.drives import Drive, from_simulation, load
from tools.vehicles.evaluate import check_names, real_sets
from tools.vehicles.judge import Judged, run
from tools.vehicles.outages import every_vehicle

HEADER = "| drive | held | longest [s] | first [s] | evidence at the end |\n" + "|---" * 5 + "|"


def drives(names: Sequence[str], seeds: Sequence[int], data: Path | None) -> Iterator[Drive]:
    """
    Return a generator of the drives of the named vehicles, all without a name, and the real sets.

    Raises
    ------
    InputError
        There is no vehicle of such a name, or no real set in the folder ``data``.
    """
    sets = [] if data is None else real_sets(data)
    check_names(names, [*every_vehicle(), *sets])
    vehicles = [v for name, v in every_vehicle().items() if not names or name in names]
    return chain(
        (from_simulation(record(vehicle, seed)) for vehicle in vehicles for seed in seeds),
        (load(Path(data or "", name), "all") for name in sets if not names or name in names),
    )


class Watched(Judged):
    """Notes twice a second whether the constraint holds."""

    def __init__(self) -> None:
        self.seen: list[tuple[int, bool]] = []
        super().__init__(parameters.defaults())

    def run_periodic(self) -> None:
        """See `Estimator`."""
        super().run_periodic()
        observer = self.aids.vehicle.observer
        if observer is not None and self.navigator.last_ns >= self._next_ns:
            self._next_ns = self.navigator.last_ns + PERIOD_NS
            self.seen.append((self.navigator.last_ns, observer.holds))

    _next_ns = 0


def row(drive: Drive) -> str:
    """Return the row of a drive."""
    estimator = Watched()
    run(drive, {}, estimator=estimator)
    t = np.array([t_ns - drive.imu_ns[0] for t_ns, _ in estimator.seen]) * 1e-9
    holds = np.array([held for _, held in estimator.seen], bool)
    edges = np.flatnonzero(np.diff(np.concatenate(([False], holds, [False])).astype(np.int8)))
    spans = [float(t[end - 1] - t[begin]) for begin, end in edges.reshape(-1, 2)]
    first = f"{t[edges[0]]:.0f}" if len(edges) else "-"
    observer = estimator.aids.vehicle.observer
    assert observer is not None
    return (
        f"| {drive.name} | {100.0 * holds.mean():.0f} % | {max(spans, default=0.0):.0f} | {first} "
        f"| {observer.evidence:+.0f} |"
    )


def main(argv: Sequence[str] | None = None) -> int:
    """Print the table."""
    parser = program.parser("constraint", __doc__ or "")
    parser.add_argument("names", nargs="*", metavar="NAME")
    parser.add_argument("--seeds", type=options.count, nargs="+", default=[2], metavar="N")
    parser.add_argument("--data", type=options.path, metavar="DIR", help="folder of the real sets")
    return program.run(_body, parser.parse_args(argv))


def _body(args: argparse.Namespace) -> int:
    chosen = drives(args.names, args.seeds, args.data)
    print(HEADER)
    for drive in chosen:
        print(row(drive), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
