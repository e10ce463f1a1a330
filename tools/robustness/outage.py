"""
A minute without fixes and the return: covariance and gate.

Many simulated flights with the noise that the regressor reads off the IMU. Scored are NEES at the
outage's end and after the return, NIS of the first fixes, and how many of them the gate refused.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence

import numpy as np

from hybrid_ins import progress
from hybrid_ins.cli import options, program
from hybrid_ins.core.inertial.state import N_ERROR
from hybrid_ins.core.update import chi_square
from hybrid_ins.core.update.gate import Gate
from hybrid_ins.evaluation.statistics import mean_band
from hybrid_ins.simulation.motions import car_drive, quadrotor_flight
from tools.paper import montecarlo
from tools.paper.montecarlo import Method
from tools.paper.runs import Scenario, draw
from tools.parallel import add_jobs, run_parallel

OUTAGE = (60.0, 60.0)  # s, start and duration
FIRST = 5  # fixes after the return
KINDS = {"quadrotor": quadrotor_flight, "car": car_drive}
AFTER = 5.0  # s after the return at which the state is looked at again


def fly(kind: str, mode: str, seed: int) -> tuple[list[float], list[float], int, float]:
    """Return NEES at the outage's end and after it, NIS of the first fixes, refusals, error [m]."""
    scenario = Scenario(
        kind, KINDS[kind], rate=100.0, duration=sum(OUTAGE) + AFTER + 1.0, outages=(OUTAGE,)
    )
    method = Method(mode, mode)  # type: ignore[arg-type]
    run = draw(scenario, seed)
    gate = Gate({m: chi_square.quantile(0.9999, m) for m in (1, 2, 3, 6)}, 3.0)
    flight = montecarlo.fly(run, method, gate)
    back = sum(OUTAGE)
    end, after = (int(np.searchsorted(run.t, t)) - 1 for t in (back - 0.05, back + AFTER))
    returned = flight.fix_t > back - 1e-6
    return (
        flight.nees[[end, after]].tolist(),
        flight.nis[returned][:FIRST].tolist(),
        int(np.sum(~flight.accepted[returned])),
        float(np.linalg.norm(flight.position_error[end])),
    )


def main(argv: Sequence[str] | None = None) -> int:
    """Run the experiment."""
    parser = program.parser("outage", __doc__ or "")
    parser.add_argument(
        "--runs", type=options.positive_count, default=200, metavar="N", help="[%(default)s]"
    )
    add_jobs(parser, os.cpu_count() or 1)
    parser.add_argument(
        "--modes",
        nargs="+",
        default=["learned"],
        choices=("learned", "scaled", "oracle"),
        help="[learned]",
    )
    return program.run(_body, parser.parse_args(argv))


def _body(args: argparse.Namespace) -> int:
    print(
        "| flight, mode | runs | error at the end, median | NEES/15 at the end | after "
        f"{AFTER:g} s | NIS/3 of the first fix | of the first {FIRST} | refused |"
    )
    print("|---|---|---|---|---|---|---|---|")
    good = True
    for kind in KINDS:
        for mode in args.modes:
            runs = [(kind, mode, 7000 + k) for k in range(args.runs)]
            flown = run_parallel(fly, runs, args.jobs)
            results = list(progress.track(flown, kind, args.runs, "run"))
            states = np.array([r[0] for r in results]).mean(axis=0)
            nis = np.array([r[1] for r in results])
            refused = sum(r[2] for r in results)
            cells, inside = [], []
            for mean, dof, count in (
                (states[0], N_ERROR, args.runs),
                (states[1], N_ERROR, args.runs),
                (nis[:, 0].mean(), 3, args.runs),
                (nis.mean(), 3, nis.size),
            ):
                low, high = mean_band(dof, count)
                inside.append(low <= mean <= high)
                cells.append(f"{mean / dof:.2f} ({low / dof:.2f}-{high / dof:.2f})")
            error = float(np.median([r[3] for r in results]))
            print(
                f"| {kind}, {mode} | {args.runs} | {error:.1f} m | "
                + " | ".join(cells)
                + f" | {refused} |"
            )
            good &= all(inside) and refused <= 0.01 * args.runs * FIRST * AFTER
    return int(not good)


if __name__ == "__main__":
    raise SystemExit(main())
