"""
The smoother on the real flights of the field experiment, and on simulated ones with the true noise.

Writes ``docs/smoothing.md``, whose text is ``smoothing_text.md`` beside this file, and its figure.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hybrid_ins import parameters
from hybrid_ins.cli import options, program
from hybrid_ins.core.inertial.earth import curvature_scale
from hybrid_ins.core.inertial.rotations import quat_conjugate, quat_multiply, rotvec_from_quat
from hybrid_ins.core.inertial.state import DP, DV, EPS, LLA, QUAT, VELOCITY, covariance
from hybrid_ins.core.noise.process_noise import ProcessNoise
from hybrid_ins.core.smoothing.segments import SmootherStart, Update
from hybrid_ins.core.smoothing.smoother import Smoother
from hybrid_ins.evaluation.result import Errors, Result
from hybrid_ins.evaluation.statistics import nees
from hybrid_ins.plotting.style import BLUE, ORANGE
from tools.field.batch_least_squares import compare
from tools.field.cache import Cache, run_all
from tools.field.flights import SESSIONS, Flown, fixes, fly, load
from tools.field.tasks import OUTAGE, calibrate_task
from tools.paper import montecarlo
from tools.paper.figures import _axes, _save
from tools.paper.report import Bar, at_most, table
from tools.paper.runs import Scenario, draw

Array = np.ndarray[Any, np.dtype[np.float64]]
Row = dict[str, Any]

CONDITIONS: dict[str, tuple[float, str, float | None]] = {
    # Rate of the fixes [Hz], what is known of the calibration, error of the heading [rad].
    "1 Hz": (1.0, "all", 0.0),
    "5 Hz": (5.0, "all", 0.0),
    "outage of 10 s": (5.0, "all", 0.0),
    "5 Hz, heading not known": (5.0, "all", None),
    "5 Hz, only the lever arm known": (5.0, "lever arm", None),
    "5 Hz, nothing known": (5.0, "nothing", None),
}
NOTHING = {"gnss.time_offset.value": 0.0, "gnss.time_offset.estimate": True}
LEVER_ARM = "imu.position", "gnss.antenna_position"
FIRST_OUTAGE = 12.0  # s
HALF_PERIOD_NS = 50_000_000  # of the reference, whose epochs are compared


def fly_once(
    data: Path, condition: str, number: int, imu: int, seed: int, found: Row
) -> Flown | None:
    """Fly one flight in one condition; None where it is too short for an outage."""
    flight, (rate, known, heading) = load(data, number, imu), CONDITIONS[condition]
    outages = []
    if condition.startswith("outage"):
        spare = found["span"] - FIRST_OUTAGE - OUTAGE - 3.0
        if spare < 1.0:
            return None
        outages = [(FIRST_OUTAGE + 0.5 * seed * spare, OUTAGE)]
    calibrated = found["values"]
    lever_arm = {name: calibrated[name] for name in LEVER_ARM if name in calibrated}
    given = {"all": calibrated, "lever arm": {**NOTHING, **lever_arm}, "nothing": NOTHING}
    values = parameters.check_all(given[known])
    return fly(
        flight,
        fixes(flight, rate, seed, outages),
        values,
        offset=values["gnss.time_offset.value"],
        heading=heading,
        smooth=True,
        truth_offset=found["exact"],
    )


def flight_task(
    data: Path, condition: str, number: int, imu: int, seed: int, found: Row
) -> list[Row]:
    """Return the figures of one flight, filtered and smoothed."""
    flown = fly_once(data, condition, number, imu, seed, found)
    if flown is None:
        return []
    assert flown.smoothed is not None
    row: Row = {"condition": condition}
    for name, result in (("filter", flown.result), ("smoother", flown.smoothed)):
        row |= {f"{name} {figure}": value for figure, value in _figures(result).items()}
    return [row]


def _figures(result: Result) -> dict[str, float]:
    assert result.errors is not None and result.prmse is not None
    figures = {"prmse": result.prmse, "nees": _nees_against_reference(result.errors)}
    if result.outages:
        longest = max(result.outages, key=lambda outage: outage.duration)
        if longest.end_error is not None and longest.largest_error is not None:
            figures |= {"end": longest.end_error, "largest": longest.largest_error}
    return figures


def _nees_against_reference(errors: Errors) -> float:
    """NEES/3 of the position; the reference's own covariance counts, too."""
    own, reference = errors.estimate.position_cov, errors.truth.position_cov
    assert own is not None and reference is not None
    k = errors.scored
    return float(np.mean(nees(errors.position_enu[k], own[k] + reference[k]))) / 3.0


def simulation_task(seed: int) -> list[Row]:
    """Return the figures of one simulated flight: its noise is known, its truth exact."""
    scenario = Scenario("smoothing", outages=((60.0, OUTAGE),))
    run = draw(scenario, seed)
    process = ProcessNoise(run.bias_walk, 1.0 / scenario.rate)
    psd = process.psd(np.repeat((4e-4, 4e-6), 3))
    first = run.samples[0]
    start = SmootherStart(
        int(first["t_ns"]), np.concatenate((first["f"], first["w"])), run.start, psd
    )
    updates = [Update(fix.t_ns, psd, fix) for fix in run.fixes]
    smoother = Smoother(start, run.samples, updates, 0.01 - 1e-6, 40_000_000, {}, {})
    smoother.run()
    blocks = [rows for _, rows in smoother.states()]
    states = np.concatenate(blocks)[run.scored]
    filtered = montecarlo.fly(run, montecarlo.Method("filter", "constant"))
    errors = {
        "position": (run.lla - states[:, LLA]) * curvature_scale(run.lla[0]),
        "velocity": run.velocity_n - states[:, VELOCITY],
        "attitude": -rotvec_from_quat(
            quat_multiply(run.quat_xyzw, quat_conjugate(states[:, QUAT]))
        ),
    }
    P = np.array([covariance(row) for row in states])
    row: Row = {
        f"nees {name}": float(np.mean(nees(errors[name], P[:, block, block]))) / 3.0
        for name, block in (("position", DP), ("velocity", DV), ("attitude", EPS))
    }
    row["batch: smoother"], row["batch: solution"] = compare(seed)
    row["filter prmse"] = filtered.prmse
    row["smoother prmse"] = float(np.sqrt(np.mean(np.sum(errors["position"] ** 2, axis=1))))
    return [row]


def draw_separation(path: Path, flown: Flown) -> None:
    """
    Draw how far the filter and the smoother are apart on a flight, and their errors.

    The difference of the two has the covariance P - P_s: beyond three deviations of it, forward
    and backward information contradict each other.
    """
    assert flown.smoothed is not None
    before, after = flown.result.errors, flown.smoothed.errors
    assert before is not None and after is not None
    figure, axes = _axes(4, sharex=True)
    b = np.searchsorted(after.stamp_ns, before.stamp_ns - HALF_PERIOD_NS)
    a = np.flatnonzero(b < len(after.stamp_ns))
    a = a[np.abs(after.stamp_ns[b[a]] - before.stamp_ns[a]) < HALF_PERIOD_NS]
    b, t = b[a], (before.stamp_ns[a] - before.stamp_ns[a][0]) * 1e-9
    apart = before.position_enu[a] - after.position_enu[b]
    P, P_s = before.estimate.position_cov, after.estimate.position_cov
    assert P is not None and P_s is not None
    for i, (axis, name) in enumerate(zip(axes, ("east", "north", "up"), strict=False)):
        bound = 3.0 * np.sqrt(np.maximum(P[a, i, i] - P_s[b, i, i], 0.0))
        axis.fill_between(t, -bound, bound, color=BLUE, alpha=0.2, linewidth=0, label="± 3 σ")
        axis.plot(t, apart[:, i], color=BLUE, linewidth=1.0, label="difference")
        axis.set(xlabel="time [s]", ylabel=f"{name} [m]")
    axes[0].legend(loc="lower left", fontsize=7)
    for errors, rows, colour, label in (
        (before, a, ORANGE, "filter"),
        (after, b, BLUE, "smoother"),
    ):
        length = np.linalg.norm(errors.position_enu[rows], axis=1)
        axes[3].plot(t, length, color=colour, linewidth=1.0, label=label)
    axes[3].set(xlabel="time [s]", ylabel="error [m]", ylim=(0.0, None))
    axes[3].legend(loc="best")
    _save(figure, path)


def _mean(rows: Iterable[Row], figure: str) -> float:
    return float(np.mean([row[figure] for row in rows if figure in row]))


def _median(rows: Iterable[Row], figure: str) -> float:
    return float(np.median([row[figure] for row in rows if figure in row]))


def report(rows: Sequence[Row], simulated: Sequence[Row], command: str) -> str:
    """Return the document."""
    of = {name: [r for r in rows if r["condition"] == name] for name in CONDITIONS}
    one, outage = of["1 Hz"], of["outage of 10 s"]
    bars = [
        Bar(
            "1 Hz: PRMSE against the filter's",
            _mean(one, "smoother prmse") / _mean(one, "filter prmse"),
            *at_most(0.6, 0.4),
        ),
        Bar(
            "outages of 10 s: largest error inside against the filter's at the end, medians",
            _median(outage, "smoother largest") / _median(outage, "filter end"),
            *at_most(0.3, 0.2),
        ),
        *(
            Bar(
                f"{name}: NEES/3 of the position",
                _mean(r, "smoother nees"),
                (0.8, 1.3),
                (0.9, 1.15),
            )
            for name, r in of.items()
        ),
        *(
            Bar(
                f"simulated, true noise: NEES/3 of the {name}",
                _mean(simulated, f"nees {name}"),
                (0.8, 1.3),
                (0.9, 1.15),
            )
            for name in ("position", "velocity", "attitude")
        ),
        Bar(
            "simulated, true noise: PRMSE against the filter's",
            _mean(simulated, "smoother prmse") / _mean(simulated, "filter prmse"),
            *at_most(0.6, 0.4),
        ),
        Bar(
            "simulated, true noise, 12 s: RMSE against batch least squares",
            (_mean(simulated, "batch: smoother") / _mean(simulated, "batch: solution")) ** 0.5,
            *at_most(1.02, 1.005),
        ),
    ]
    flights = table(
        (
            "condition",
            "runs",
            "PRMSE [m]: filter",
            "smoother",
            "NEES/3: filter",
            "smoother",
            "outage, end [m]: filter",
            "largest inside: smoother",
        ),
        [
            (
                name,
                len(r),
                f"{_mean(r, 'filter prmse'):.3f}",
                f"{_mean(r, 'smoother prmse'):.3f}",
                f"{_mean(r, 'filter nees'):.2f}",
                f"{_mean(r, 'smoother nees'):.2f}",
                *(
                    (f"{_median(r, 'filter end'):.2f}", f"{_median(r, 'smoother largest'):.2f}")
                    if name.startswith("outage")
                    else ("–", "–")
                ),
            )
            for name, r in of.items()
        ],
    )
    text = Path(__file__).with_name("smoothing_text.md").read_text(encoding="utf-8")
    head, _, tail = text.partition("<!-- figures -->")
    results = table(("figure", "measured", "bar", "stretch", "met"), ())
    results += "\n" + "\n".join(bar.row() for bar in bars)
    return "\n\n".join(
        (
            head.strip(),
            f"## Figures\n\nMade by `{command}`; {len(simulated)} simulated flights.",
            results,
            flights,
            "![Separation](figures/smoothing_separation.png)",
            "*A flight with an outage of 10 s: smoothed minus filtered position with three "
            "standard deviations of that difference, and the errors of both.*",
            tail.strip(),
        )
    )


def _body(args: argparse.Namespace) -> int:
    cache = Cache(args.work or args.out / ".field")
    sessions = [(numbers, imu) for numbers in SESSIONS.values() for imu in range(1, args.imus + 1)]
    calibrations = run_all(
        cache, args.jobs, "calibration", calibrate_task, [(args.data, *s) for s in sessions]
    )
    found = {(int(r["flight"][1:]), r["imu"]): r for r in calibrations}
    tasks = [
        (args.data, condition, *key, seed, row)
        for condition in CONDITIONS
        for key, row in found.items()
        for seed in range(args.seeds)
    ]
    rows = run_all(cache, args.jobs, "flights", flight_task, tasks)
    simulated = run_all(
        cache, args.jobs, "simulations", simulation_task, [(k,) for k in range(args.simulations)]
    )
    key = next(key for key, row in found.items() if row["span"] > 35.0)
    flown = fly_once(args.data, "outage of 10 s", *key, 1, found[key])
    assert flown is not None
    (args.out / "figures").mkdir(parents=True, exist_ok=True)
    draw_separation(args.out / "figures" / "smoothing_separation.png", flown)
    command = (
        f"python -m tools.field.smoothing --data DIR --imus {args.imus} --seeds {args.seeds} "
        f"--simulations {args.simulations}"
    )
    target = args.out / "smoothing.md"
    target.write_text(report(rows, simulated, command) + "\n", encoding="utf-8")
    print(target)
    return 0


def main(argv: Sequence[str] | None = None) -> int:
    """Run the program."""
    parser = program.parser(
        "smoothing", __doc__ or "", "python -m tools.field.smoothing --data quadrotor --jobs 2"
    )
    parser.add_argument("--data", type=Path, required=True, metavar="DIR", help="the data set")
    parser.add_argument("--out", type=Path, default=Path("docs"), help="folder to write to [docs]")
    parser.add_argument("--work", type=Path, metavar="DIR", help="folder for finished parts")
    parser.add_argument(
        "--seeds", type=options.positive_count, default=2, help="draws of the fixes [2]"
    )
    parser.add_argument(
        "--imus", type=options.positive_count, default=2, help="how many of them [2]"
    )
    parser.add_argument(
        "--simulations", type=options.positive_count, default=20, help="flights [20]"
    )
    parser.add_argument("--jobs", type=options.positive_count, default=2, help="processes [2]")
    return program.run(_body, parser.parse_args(argv))


if __name__ == "__main__":
    sys.exit(main())
