"""Navigation with the levels of each method, on simulated flights."""

from __future__ import annotations

import argparse
import hashlib
import pickle
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from hybrid_ins import progress
from hybrid_ins.evaluation.statistics import Ratio, paired_ratio
from tools.paper import figures
from tools.paper.montecarlo import Flight, Method, fly_all
from tools.paper.report import Bar, at_least, at_most, interval, table
from tools.paper.runs import Scenario, draw
from tools.paper.scenarios import (
    AQ,
    AS_PRINTED,
    ASIDE,
    METHODS,
    ORACLE,
    PACES,
    ROUGH,
    SCENARIOS,
    SWITCHING,
    SWITCHING_OUTAGES,
    TABLE_ONE,
    WITH_PRINTED,
)

DEVELOPMENT_SEED = 500
FLIGHT_SEED = 90_000
ASIDE_SEED = 1_700_000
PAPER_TABLE = {  # PMAE and PRMSE [m] of the paper's flight
    "paper's network": (1.7, 1.2),
    "AQ1": (2.3, 1.6),
    "AQ2": (2.0, 1.4),
    "AQ3": (1.8, 1.3),
    "CQ1": (2.4, 1.8),
    "CQ2": (2.4, 1.7),
    "CQ3": (2.2, 1.6),
}


@dataclass(frozen=True)
class Result:
    """All flights of a scenario: one list for each method, in the order of the seeds."""

    scenario: Scenario
    flights: dict[str, list[Flight]]

    def ratio(self, name: str, against: str) -> Ratio | None:
        """Return the ratio of PRMSE, None where a filter diverged."""
        ours, theirs = ([f.prmse for f in self.flights[n]] for n in (name, against))
        if not np.all(np.isfinite((ours, theirs))):
            return None
        return paired_ratio(ours, theirs, range(len(ours)))

    def nees(self, name: str) -> float:
        """Return the mean NEES over runs and epochs; infinite where a filter diverged."""
        if any(f.diverged for f in self.flights[name]):
            return np.inf
        return float(np.mean([np.mean(f.nees) for f in self.flights[name]]))

    def best(self, methods: Sequence[Method]) -> str:
        """Return the name of the method with the least mean PRMSE."""
        return min(methods, key=lambda m: np.mean([f.prmse for f in self.flights[m.name]])).name


def flown(
    scenario: Scenario, methods: Sequence[Method], seeds: range, args: argparse.Namespace
) -> Result:
    """Fly every method on the runs of these seeds; what an interrupted run has kept is taken."""
    by_seed: dict[int, list[Flight]] = {}
    if args.keep:
        stated = [
            scenario.motion.__name__,
            methods,
            *(getattr(scenario, part.name) for part in fields(scenario) if part.name != "motion"),
        ]
        folder = args.keep / hashlib.sha256(repr(stated).encode()).hexdigest()[:16]
        folder.mkdir(parents=True, exist_ok=True)
        by_seed = {
            seed: pickle.loads((folder / str(seed)).read_bytes())
            for seed in seeds
            if (folder / str(seed)).is_file()
        }
    waiting = [seed for seed in seeds if seed not in by_seed]
    for seed, flights in progress.track(
        fly_all(scenario, methods, waiting, args.jobs), scenario.name, len(waiting), "run"
    ):
        by_seed[seed] = flights
        if args.keep:
            (folder / "part").write_bytes(pickle.dumps(flights))
            (folder / "part").rename(folder / str(seed))
    return Result(
        scenario, {m.name: [by_seed[seed][k] for seed in seeds] for k, m in enumerate(methods)}
    )


def tuned(scenario: Scenario, args: argparse.Namespace) -> Method:
    """Return the constant that is best for a scenario, by other seeds than it is judged on."""
    base = Method("tuned constant", "constant")
    seeds = range(DEVELOPMENT_SEED, DEVELOPMENT_SEED + 6)

    def best(candidates: Sequence[Method]) -> Method:
        named = [replace(m, name=str(k)) for k, m in enumerate(candidates)]
        flights = flown(scenario, named, seeds, args).flights
        errors = [np.sum(np.log([f.prmse for f in flights[m.name]])) for m in named]
        return candidates[int(np.argmin(errors))]

    def scaled(method: Method, accelerometer: float, gyroscope: float) -> Method:
        return replace(method, q=(method.q[0] * accelerometer, method.q[1] * gyroscope))

    if args.quick:
        return scaled(base, 10.0, 10.0)
    found = best([scaled(base, s, s) for s in (1.0, 3.0, 10.0, 30.0, 100.0, 300.0)])
    return best(
        [
            scaled(found, a, g)
            for a, g in ((1.0, 1.0), (1.0, 0.3), (1.0, 3.0), (0.3, 1.0), (3.0, 1.0))
        ]
    )


def wanted(scenario: Scenario, args: argparse.Namespace) -> bool:
    """Return whether a scenario is to be flown; the report needs Table I and 200 Hz."""
    return not any(words in scenario.name for words in args.without) or scenario in WITH_PRINTED


def all_methods(scenario: Scenario, args: argparse.Namespace) -> tuple[Method, ...]:
    """Return what is flown in a scenario."""
    methods = METHODS
    if scenario.rough is not None:
        methods = (*methods[:5], tuned(scenario, args), *methods[5:])
    if scenario.name in {s.name for s in WITH_PRINTED}:
        methods += AS_PRINTED
    return methods


def result_table(result: Result) -> str:
    """Return the table of a scenario."""
    beside_paper = result.scenario.name == TABLE_ONE.name
    rows = []
    for name, flights in result.flights.items():
        lost = sum(f.diverged for f in flights)
        ratio = result.ratio(name, "oracle")
        cells = [name]
        if lost:
            cells += [f"diverged in {lost} of {len(flights)}", "–", "–", "–"]
        else:
            cells += [
                f"{np.mean([f.prmse for f in flights]):.3f}",
                f"{np.mean([f.pmae for f in flights]):.3f}",
                str(ratio),
                f"{result.nees(name):.1f}",
            ]
        if beside_paper:
            pmae, prmse = PAPER_TABLE.get(name, ("–", "–"))
            cells.append(f"{prmse} / {pmae}")
        rows.append(cells)
    heads = ["method", "PRMSE [m]", "PMAE [m]", "PRMSE / oracle [95 %]", "NEES (15)"]
    if beside_paper:
        heads.append("paper's flight: PRMSE / PMAE [m]")
    return table(heads, rows)


def navigation(args: argparse.Namespace, bars: list[Bar]) -> list[str]:
    """Fly everything; return the report's part."""
    scenarios = tuple(s for s in SCENARIOS if wanted(s, args))
    if args.quick:
        scenarios = tuple(
            replace(s, duration=25.0, scored_from=10.0, outages=((12.0, 8.0),) * bool(s.outages))
            for s in SCENARIOS
            if s.rate == 200.0
        )
    seeds = range(FLIGHT_SEED, FLIGHT_SEED + args.runs)
    results = {s.name: flown(s, all_methods(s, args), seeds, args) for s in scenarios}
    paces = flown(SWITCHING[1] if not args.quick else scenarios[0], (ORACLE, *PACES), seeds, args)
    if wanted(ASIDE, args):
        car = ASIDE
        if args.quick:
            car = replace(ASIDE, duration=25.0, scored_from=10.0, outages=())
        fresh = range(ASIDE_SEED, ASIDE_SEED + args.runs)
        results[car.name] = flown(car, all_methods(car, args), fresh, args)
    switching = [results[s.name] for s in SWITCHING if s.name in results]
    with_outages = [results[s.name] for s in SWITCHING_OUTAGES if s.name in results]
    for group, limits in ((switching, at_most(1.02, 1.01)), (with_outages, at_most(1.05, 1.02))):
        for result in group:
            ratio = result.ratio("ours", "oracle")
            assert ratio is not None
            bars.append(
                Bar(
                    f"{result.scenario.name}: PRMSE, ours / oracle",
                    ratio.ratio,
                    *limits,
                    interval(ratio),
                )
            )
    for result in (*switching, *with_outages):
        rivals = (
            ("CQ3", "CQ3", at_least(20.0, 25.0)),
            ("best stable AQ", result.best(AQ), at_least(12.0, 18.0)),
        )
        for title, name, limits in rivals:
            ratio = result.ratio("ours", name)
            if ratio is None:
                continue
            gain = replace(
                ratio,
                ratio=100.0 * (1.0 - ratio.ratio),
                low=100.0 * (1.0 - ratio.high),
                high=100.0 * (1.0 - ratio.low),
            )
            best = result.ratio("oracle", name)
            assert best is not None
            bars.append(
                Bar(
                    f"{result.scenario.name}: better than {title} by [%] "
                    f"(the oracle: {100.0 * (1.0 - best.ratio):.1f})",
                    gain.ratio,
                    *limits,
                    interval(gain, 1),
                )
            )
    for result in (*switching, *with_outages):
        bars.append(
            Bar(
                f"{result.scenario.name}: NEES of ours",
                result.nees("ours"),
                (13.0, 18.0),
                (14.0, 16.0),
            )
        )

    example = results[SWITCHING[1].name]
    figures.levels_over_time(
        args.figures / "paper_fig9.png",
        draw(example.scenario, FLIGHT_SEED),
        {name: example.flights[name][0] for name in ("ours", "paper's network")},
    )
    figures.error_distributions(
        args.figures / "paper_fig10.png",
        {
            "without outages": example.flights,
            "with outages": results[SWITCHING_OUTAGES[1].name].flights,
        },
    )

    def part(result: Result) -> tuple[str, str]:
        name = result.scenario.name
        return f"### {name[0].upper()}{name[1:]}", result_table(result)

    first, *others = results.values()
    return [
        "## Navigation with their levels",
        NAVIGATION_TEXT.format(runs=args.runs, low=ROUGH[0], high=ROUGH[1]),
        PAPER_TABLE_TEXT,
        *part(first),
        "### Levels over time, the paper's Fig. 9",
        "![q over time](figures/paper_fig9.png)",
        "Levels in force on one flight at 200 Hz with switching noise, x axes. The paper shows one "
        "field flight, whose true levels are unknown.",
        "### Distribution of errors, the paper's Fig. 10",
        "![Distribution of position errors](figures/paper_fig10.png)",
        "Over all epochs of all flights, switching noise, 200 Hz: the summands of PRMSE and of "
        "PMAE.",
        "## Beyond the paper",
        *(text for result in others for text in part(result)),
        "### How often, and how smooth",
        "Switching noise, 200 Hz: ours with other refresh periods, with and without smoothing (a "
        "weighted mean of the logarithms of the last levels and the new).",
        result_table(paces),
    ]


PAPER_TABLE_TEXT = """\
The first table stands beside the paper's Table 2, which is one field flight, with errors of more
than a metre under RTK fixes of 0.1 m every 0.2 s. No choice of process noise explains that size:
following the fixes alone gives 0.2 m. So ranks and ratios may be compared, metres may not."""


NAVIGATION_TEXT = """\
{runs} paired flights for each table: every method flies the same flights with the same readings
and fixes. A quadrotor on figures of eight (Table I: 5 Hz RTK fixes of 0.1, 0.1, 0.14 m; noise of
0.02 m/s², 0.002 rad/s per sample), a seed for each flight; the filter starts with an error drawn
from its covariance, and is scored from 20 s on, midway between fixes. Bias random walks of
1e-3 m/s²/√s and 1e-4 rad/s/√s, which all methods know; Qc = q·Δt except where "as printed"
(Qc = q, ε = 0.001). No gate: no simulated fix is an outlier.

Switching noise: stretches of 4 to 15 s, in every second of which the standard deviation of all six
channels is higher by a factor of {low:g} to {high:g}, one factor for each flight. Outages: 10, 20
and 30 s. The oracle is given the true levels at every instant; the tuned constant is the best one
for that very scenario on six other flights, which a user does not have. AQ: eq. (16)–(18) with the
correction spread over the IMU steps of its interval; literal: at every IMU step, as printed, where
the levels run away to 10⁶ times the true ones and more and the filter only follows the fixes.

Ratios are geometric means over the pairs with a bootstrap interval of 95 %. NEES: mean over flights
and epochs, 15 for a right covariance, more for an overconfident filter."""
