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
from hybrid_ins.core import chi_square
from hybrid_ins.core.gate import Gate
from hybrid_ins.core.ins_filter import FilterSettings, InsFilter
from hybrid_ins.core.samples import ImuRing
from hybrid_ins.core.state import N_ERROR
from hybrid_ins.evaluation.statistics import mean_band, nees
from hybrid_ins.simulation.motions import car_drive, quadrotor_flight
from tools.paper import montecarlo
from tools.paper.montecarlo import T0_NS, Method, Scenario
from tools.parallel import run_parallel

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
    run = montecarlo.draw(scenario, seed)
    samples = run.samples
    stamps = samples["t_ns"]
    ring = ImuRing()
    ring.extend(samples[:1])
    ins = InsFilter(
        run.start,
        int(stamps[0]),
        np.concatenate((samples["f"][0], samples["w"][0])),
        montecarlo.noise_of(method, run),
        Gate({m: chi_square.quantile(0.9999, m) for m in (1, 2, 3, 6)}, 3.0),
        ring,
        FilterSettings(max_delay=0.2),
    )
    back = sum(OUTAGE)
    wanted = [int(np.searchsorted(run.t, t)) - 1 for t in (back - 0.05, back + AFTER)]
    found: list[float] = []
    error = 0.0
    at = 0
    for t_ns, _, act in sorted(montecarlo._events(run, method, ins), key=lambda e: e[:2]):
        stop = int(np.searchsorted(stamps, t_ns, side="right"))
        if stop > at + 1:
            ring.extend(samples[at + 1 : stop])
            ins.predict_block(samples[at + 1 : stop])
            at = stop - 1
        if not isinstance(act, int):
            act()
        elif act in wanted:
            state = ins.state
            e = montecarlo.state_error(run, act, state)
            found.append(float(nees(e[None], state.P[None])[0]))
            if act == wanted[0]:
                error = float(np.linalg.norm(e[:3]))
    returned = [v for v in ins.verdicts if v.measurement.t_ns >= T0_NS + round(back * 1e9) - 1]
    return (found, [v.nis for v in returned[:FIRST]], sum(not v.accepted for v in returned), error)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the experiment."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=200, metavar="N", help="[%(default)s]")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, metavar="N")
    parser.add_argument(
        "--modes",
        nargs="+",
        default=["learned"],
        metavar="MODE",
        help="learned, scaled, oracle [%(default)s]",
    )
    args = parser.parse_args(argv)
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
