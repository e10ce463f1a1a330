"""
The field experiment: calibrate, replay and evaluate real flights, and say what came of it.

Reads the shared part of "Quadrotor Dead Reckoning with Multiple Inertial Sensors" (Hurwitz & Klein)
and does in one process what ins_convert, ins_calibrate, ins_replay and ins_evaluate do through
bags: the same functions, without the files. Finished parts are kept in a folder: run it again to
resume.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from hybrid_ins import parameters, progress
from hybrid_ins.calibration.derived import next_biases
from hybrid_ins.calibration.filter_pass import FilterPass
from hybrid_ins.calibration.findings import calibrate
from hybrid_ins.cli import options, program
from hybrid_ins.errors import InputError
from hybrid_ins.evaluation.statistics import Ratio, paired_ratio
from hybrid_ins.resources import share_path
from hybrid_ins.ros.conversions import FLIP
from hybrid_ins.simulation.sensors import ImuErrors
from tools.field import figures
from tools.field.flights import IMUS, SESSIONS, Fixes, Flight, as_recording, fixes, fly, load
from tools.paper import montecarlo
from tools.paper.evaluate import Bar, at_most, table
from tools.paper.montecarlo import Method, Scenario
from tools.parallel import run_parallel

OURS, TUNED, BEST = "HB-AEKF, ours", "tuned on the other session", "best constant in hindsight"
NO_BACKGROUND = {
    f"noise.background_{sensor}": [0.0, 0.0, 0.0] for sensor in ("accelerometer", "gyroscope")
}
OTHERS: dict[str, dict[str, Any]] = {
    "HB-AEKF, ours, without innovation scale": {"noise.innovation_scale": False},
    "HB-AEKF, ours, without background": NO_BACKGROUND,
    "HB-AEKF, paper's network": {
        "noise.model": "paper",
        "noise.innovation_scale": False,
        **NO_BACKGROUND,
    },
    "MB-EKF-AQ1 (ξ = 1)": {"noise.mode": "innovation", "noise.innovation_window": 1},
    "MB-EKF-AQ2 (ξ = 3)": {"noise.mode": "innovation", "noise.innovation_window": 3},
    "MB-EKF-AQ3 (ξ = 5)": {"noise.mode": "innovation", "noise.innovation_window": 5},
    "MB-EKF-CQ1": {"noise.mode": "cq1"},
    "MB-EKF-CQ2": {"noise.mode": "cq2"},
    "MB-EKF-CQ3": {"noise.mode": "cq3"},
    "MB-EKF-CQ3, Qc = q as printed": {"noise.mode": "cq3", "noise.units": "paper"},
}
NO_SCALE, PLAIN, PAPER, *_ = OTHERS
ORACLE = "HB-AEKF, told the injected levels"
ONLINE: dict[str, tuple[float, bool, float | None]] = {
    # Rate of the fixes [Hz], whether the rest is calibrated, error of the heading given [rad].
    "online 5 Hz": (5.0, False, 0.0),
    "online 5 Hz, the rest calibrated": (5.0, True, 0.0),
    "online 5 Hz, nor the heading known": (5.0, False, None),
    "online 1 Hz": (1.0, False, 0.0),
    "online 1 Hz, the rest calibrated": (1.0, True, 0.0),
}
HARDER = ("heading 30°", "heading unknown", "published 5 Hz", "published 1 Hz", *ONLINE)
PAPER_TABLE = {  # PMAE and PRMSE [m] of the paper's flight
    PAPER: (1.7, 1.2),
    "MB-EKF-AQ1 (ξ = 1)": (2.3, 1.6),
    "MB-EKF-AQ2 (ξ = 3)": (2.0, 1.4),
    "MB-EKF-AQ3 (ξ = 5)": (1.8, 1.3),
    "MB-EKF-CQ1": (2.4, 1.8),
    "MB-EKF-CQ2": (2.4, 1.7),
    "MB-EKF-CQ3": (2.2, 1.6),
}


def constant(accelerometer: float, gyroscope: float) -> tuple[str, dict[str, Any]]:
    """Return a constant's name and parameters."""
    return f"q {accelerometer:g}, {gyroscope:g}", {
        "noise.mode": "constant",
        "noise.q_accelerometer": accelerometer,
        "noise.q_gyroscope": gyroscope,
    }


GRID = dict(constant(a, g) for g in (1e-6, 1e-5, 1e-4) for a in (0.01, 0.03, 0.1, 0.3, 1.0))
NOISY_GRID = dict(constant(a, g) for g in (1e-4, 1e-3, 1e-2) for a in (0.3, 1.0, 3.0, 10.0))
INJECTED = (3.0, 0.1)  # m/s2, rad/s: standard deviation of the injected noise, per sample
BLOCK = 5.0  # s of quiet, then of injected noise
TRUTH = np.array([0.03, 0.03, 0.04])  # m, of the reference taken for fixes
OUTAGE = 10.0  # s
MISFITS = {
    "right model": ImuErrors(),
    "scale factors 1 %": ImuErrors(accelerometer_scale=0.01, gyroscope_scale=0.01),
    "mount 2°": ImuErrors(mount_rpy=np.radians([2.0, -2.0, 2.0])),
    "g-sensitivity 1e-3": ImuErrors(g_sensitivity=1e-3),
    "coloured noise": ImuErrors(
        accelerometer_coloured_std=0.3, gyroscope_coloured_std=0.02, coloured_time=0.5
    ),
}
HINDSIGHT = tuple(
    Method(f"{a:g}, {g:g}", "constant", (4e-4 * a, 4e-6 * g))
    for a, g in (
        (1, 1),
        (10, 1),
        (100, 1),
        (1e3, 1),
        (1e4, 1),
        (1, 10),
        (1, 100),
        (1, 1e3),
        (10, 10),
        (100, 10),
        (10, 100),
        (100, 100),
        (1e3, 100),
        (1e3, 1e3),
        (1e4, 1e2),
    )
)


@dataclass(frozen=True)
class Task:
    """One flight with one IMU and one draw of fixes, under some methods."""

    condition: str
    number: int
    imu: int
    seed: int
    rate: float
    values: dict[str, Any]  # calibrated parameters
    methods: dict[str, dict[str, Any]]
    outage: float | None = None  # s, start
    injected: bool = False
    heading: float | None = 0.0  # rad


Row = dict[str, Any]


def inject(flight: Flight, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the flight's readings with strong white noise in every second block."""
    rng = np.random.default_rng([seed, int(flight.name[1:]), flight.imu, 7])
    t = (flight.stamp_ns - flight.stamp_ns[0]) * 1e-9
    rough = ((t // BLOCK).astype(int) % 2 == 1)[:, None]
    force, rate = (
        readings + rough * std * rng.standard_normal(readings.shape)
        for readings, std in zip((flight.force, flight.rate), INJECTED, strict=True)
    )
    return force, rate


def injected_levels(flight: Flight, values: Mapping[str, Any]) -> Callable[[int], np.ndarray]:
    """Return what gives the true levels at a stamp [ns]: the calibrated ones, and the injected."""
    quiet = np.repeat([values["noise.q_accelerometer"], values["noise.q_gyroscope"]], 3)
    rough = quiet + np.repeat(np.square(INJECTED), 3)

    def levels(t_ns: int) -> np.ndarray:
        return rough if (t_ns - flight.stamp_ns[0]) * 1e-9 // BLOCK % 2 == 1 else quiet

    return levels


def fly_task(data: Path, task: Task) -> list[Row]:
    """Fly a task with all its methods."""
    flight = load(data, task.number, task.imu)
    outages = [] if task.outage is None else [(task.outage, OUTAGE)]
    aid = fixes(flight, task.rate, task.seed, outages)
    force, rate = inject(flight, task.seed) if task.injected else (None, None)
    rows = []
    for name, overrides in task.methods.items():
        values = parameters.check_all({**task.values, **overrides})
        row: Row = {
            "condition": task.condition,
            "rate": task.rate,
            "flight": flight.name,
            "session": flight.session,
            "imu": task.imu,
            "seed": task.seed,
            "method": name,
        }
        try:
            flown = fly(
                flight,
                aid,
                values,
                offset=values["gnss.time_offset.value"],
                heading=task.heading,
                force=force,
                rate=rate,
                told=injected_levels(flight, values) if name == ORACLE else None,
            )
        except InputError:
            rows.append(
                {
                    **row,
                    "prmse": np.inf,
                    "pmae": np.inf,
                    "nees": np.inf,
                    "nis": np.inf,
                    "end": np.inf,
                    "offset_20": np.nan,
                }
            )
            continue
        result = flown.result
        offsets = sorted((r[0], r[7]) for r in flown.estimator.rows)
        then = flight.stamp_ns[0] + 20_000_000_000
        before = [offset for stamp, offset in offsets if stamp <= then]
        assert result.nees_position is not None
        tested = result.nis_tested or result.nis_position
        rows.append(
            {
                **row,
                "prmse": result.prmse,
                "pmae": result.pmae,
                "nees": result.nees_position.per_dof,
                "nis": tested.per_dof if tested else np.nan,
                "end": result.outage_error(50) if task.outage is not None else None,
                "offset_20": before[-1] if before else np.nan,
            }
        )
    return rows


def calibrate_task(data: Path, numbers: Sequence[int], imu: int) -> list[Row]:
    """Calibrate a session's flights jointly, by noisy fixes and by the reference itself."""
    flights = [load(data, number, imu) for number in numbers]
    given = parameters.defaults()
    found = calibrate(
        [as_recording(f, fixes(f, 5.0, 0, ())) for f in flights],
        given,
        own_offsets=True,
        search=1.0,
        antenna_is_base=True,
    )
    exact = calibrate(
        [as_recording(f, Fixes(f.truth.stamp_ns, f.position.lla, TRUTH)) for f in flights],
        {**given, "gnss.time_offset.value": found.values["gnss.time_offset.value"]},
        own_offsets=True,
        search=0.3,
        antenna_is_base=True,
        trust_fixes=True,
    )
    chosen = {k: v for k, v in found.values.items() if v != given[k]}
    return [
        {
            "flight": flight.name,
            "session": flight.session,
            "imu": imu,
            "values": {
                **chosen,
                **_biases([p for j, p in enumerate(found.after) if j != k]),
                "gnss.time_offset.value": float(found.fitted.offset(k)),
            },
            "offset": found.fitted.offset(k),
            "sigma": found.fitted.sigma(f"offset_{k}"),
            "exact": exact.fitted.offset(k),
            "exact_sigma": exact.fitted.sigma(f"offset_{k}"),
            "imu_position": found.values["imu.position"],
            "exact_position": exact.values["imu.position"],
            "span": float(flight.position.t[-1] - flight.position.t[0]),
        }
        for k, flight in enumerate(flights)
    ]


def _biases(others: Sequence[FilterPass]) -> dict[str, Any]:
    """
    Biases at a flight's start, by the session's other flights.

    By the flight itself they would be told by fixes that an outage is to hide.
    """
    if not others:
        return {}
    (bias_a, std_a), (bias_g, std_g) = next_biases(others)
    return {
        "imu.accelerometer_bias": (FLIP @ bias_a).tolist(),
        "imu.accelerometer_bias_std": std_a.tolist(),
        "imu.gyroscope_bias": (FLIP @ bias_g).tolist(),
        "imu.gyroscope_bias_std": std_g.tolist(),
    }


def simulate_task(kind: str, seed: int, duration: float) -> list[Row]:
    """Fly a simulated flight whose IMU has an error that its noise does not show."""
    scenario = Scenario(kind, duration=duration, errors=MISFITS[kind])
    run = montecarlo.draw(scenario, seed)
    methods = (Method(OURS, "scaled"), Method(NO_SCALE, "learned"), *HINDSIGHT)
    rows = []
    for method in methods:
        flight = montecarlo.fly(run, method)
        rows.append(
            {
                "kind": kind,
                "seed": seed,
                "method": method.name,
                "prmse": flight.prmse,
                "nees": float(np.mean(flight.position_nees)) / 3.0,
            }
        )
    return rows


# --- Running it ----------------------------------------------------------------------------------


class Cache:
    """Results of finished parts, by what they depend on: their arguments and the package's code."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        folder.mkdir(parents=True, exist_ok=True)
        code = hashlib.sha256()
        package = Path(__file__).resolve().parents[2] / "hybrid_ins"
        for path in (
            *sorted(package.rglob("*.py")),
            share_path("models/plateau.onnx"),
            Path(__file__).with_name("flights.py"),
        ):
            code.update(Path(path).read_bytes())
        self._code = code.hexdigest()

    def run(self, function: Callable[..., list[Row]], arguments: tuple[Any, ...]) -> list[Row]:
        """Return a part's rows, from the folder where they are there."""
        key = json.dumps([self._code, function.__name__, arguments], default=_plain)
        path = self._folder / f"{hashlib.sha256(key.encode()).hexdigest()[:24]}.json"
        if path.exists():
            return list(json.loads(path.read_text(encoding="utf-8")))
        rows = function(*arguments)
        unfinished = path.with_suffix(f".{os.getpid()}")
        unfinished.write_text(json.dumps(rows), encoding="utf-8")
        unfinished.replace(path)
        return rows


def _plain(value: object) -> object:
    return asdict(value) if isinstance(value, Task) else str(value)


def run_all(
    cache: Cache,
    jobs: int,
    label: str,
    function: Callable[..., list[Row]],
    arguments: Sequence[tuple[Any, ...]],
) -> list[Row]:
    """Do all parts in some processes; returns their rows in order."""
    parts = run_parallel(cache.run, [(function, words) for words in arguments], jobs)
    return [row for part in progress.track(parts, label, len(arguments), "part") for row in part]


# --- What came of it -----------------------------------------------------------------------------


@dataclass(frozen=True)
class Group:
    """All rows of one condition, by method."""

    rows: dict[str, list[Row]]

    @classmethod
    def of(cls, rows: Iterable[Row], condition: str) -> Group:
        """Select a condition; every method's rows are in the same order."""
        by_method: dict[str, list[Row]] = {}
        for row in sorted(
            (r for r in rows if r["condition"] == condition),
            key=lambda r: (r["flight"], r["imu"], r["seed"]),
        ):
            by_method.setdefault(row["method"], []).append(row)
        return cls(by_method)

    def values(self, method: str, figure: str) -> np.ndarray:
        """Return a figure of every run."""
        return np.array([r[figure] for r in self.rows[method]], float)

    def ratio(self, method: str, against: str) -> Ratio | None:
        """Return the paired ratio of PRMSE with flights as clusters; None where one diverged."""
        a, b = self.values(method, "prmse"), self.values(against, "prmse")
        if not np.all(np.isfinite([a, b])):
            return None
        return paired_ratio(a, b, [r["flight"] for r in self.rows[method]], of="means")

    def with_constants(self, grid: Iterable[str]) -> tuple[Group, dict[str, str]]:
        """Put the tuned and the hindsight constant in the place of the grid of constants."""
        names = list(grid)
        prmse = np.array([self.values(name, "prmse") for name in names])
        first = self.rows[names[0]]
        session = np.array([r["session"] for r in first])
        flight = np.array([f"{r['flight']}/{r['imu']}" for r in first])
        chosen: dict[str, str] = {}
        tuned, best = [], []
        for own in dict.fromkeys(session):
            others = session != own if np.any(session != own) else session == own
            chosen[str(own)] = names[int(np.argmin(prmse[:, others].mean(axis=1)))]
        hindsight = {
            f: names[int(np.argmin(prmse[:, flight == f].mean(axis=1)))] for f in set(flight)
        }
        for k in range(len(first)):
            tuned.append(self.rows[chosen[str(session[k])]][k])
            best.append(self.rows[hindsight[str(flight[k])]][k])
        kept = {name: rows for name, rows in self.rows.items() if name not in names}
        return Group({**kept, TUNED: tuned, BEST: best}), chosen


def method_table(groups: Sequence[tuple[str, Group]]) -> str:
    """Return the form of the paper's Table 2: each method's errors, consistency, worst flight."""
    heads = ["method"]
    for label, _ in groups:
        heads += [
            f"{label}: PRMSE [m]",
            "PMAE [m]",
            "worst flight",
            "NEES/3",
            "NIS/3",
            "PRMSE / tuned [95 %]",
        ]
    rows = []
    for name in groups[0][1].rows:
        cells: list[object] = [name]
        for _, group in groups:
            prmse = group.values(name, "prmse")
            lost = int(np.sum(~np.isfinite(prmse) | (prmse > 100.0)))
            if lost:
                cells += [f"lost in {lost} of {len(prmse)}", "–", "–", "–", "–", "–"]
                continue
            flights = np.array([r["flight"] for r in group.rows[name]])
            worst = max(prmse[flights == f].mean() for f in set(flights))
            ratio = group.ratio(name, TUNED) if TUNED in group.rows else None
            cells += [
                f"{prmse.mean():.3f}",
                f"{group.values(name, 'pmae').mean():.3f}",
                f"{worst:.3f}",
                f"{group.values(name, 'nees').mean():.2f}",
                f"{group.values(name, 'nis').mean():.2f}",
                str(ratio or "–"),
            ]
        rows.append(cells)
    return table(heads, rows)


def _interval(ratio: Ratio | None) -> str:
    return "" if ratio is None else f" [{ratio.low:.3f}, {ratio.high:.3f}]"


class Experiment:
    """All parts of it, and the report."""

    def __init__(self, args: argparse.Namespace) -> None:
        self.args = args
        self.cache = Cache(args.work or args.out / ".field")
        numbers = {name: n[:1] if args.quick else n for name, n in SESSIONS.items()}
        self.sessions = {
            name: n
            for name, n in numbers.items()
            if all((args.data / "Horizontal" / f"path_{k}").is_dir() for k in n)
        }
        if not self.sessions:
            raise InputError(
                f"{args.data}: holds no Horizontal/path_2 and so on: is this the "
                "quadrotor data set?"
            )
        self.imus = IMUS[: 1 if args.quick else args.imus]
        self.seeds = range(1 if args.quick else args.seeds)
        self.began = time.monotonic()

    def run(
        self, label: str, function: Callable[..., list[Row]], arguments: Sequence[tuple[Any, ...]]
    ) -> list[Row]:
        """Do some parts with a progress bar."""
        return run_all(self.cache, self.args.jobs, label, function, arguments)

    def tasks(
        self,
        condition: str,
        rate: float,
        methods: dict[str, dict[str, Any]],
        seeds: Iterable[int],
        **options: Any,
    ) -> list[tuple[Path, Task]]:
        """Return a task for every flight, IMU and seed."""
        given = options.pop("values", None)
        made = []
        for numbers in self.sessions.values():
            for number in numbers:
                for imu in self.imus:
                    values = self.values[number, imu] if given is None else given
                    for seed in seeds:
                        task = Task(condition, number, imu, seed, rate, values, methods, **options)
                        if condition.startswith("outage"):
                            span = self.span[number]
                            if span < 26.0:
                                continue
                            first, last = 12.0, span - OUTAGE - 3.0
                            share = seed / max(len(self.seeds) - 1, 1)
                            task = replace(task, outage=first + share * max(last - first, 0.0))
                        made.append((self.args.data, task))
        return made

    def fly(self, label: str, tasks: Sequence[tuple[Path, Task]]) -> list[Row]:
        """Fly tasks."""
        return self.run(label, fly_task, tasks)

    def do(self) -> Path:
        """Run everything and write the report."""
        args = self.args
        self.calibrations = self.run(
            "calibration",
            calibrate_task,
            [(args.data, numbers, imu) for numbers in self.sessions.values() for imu in self.imus],
        )
        self.values = {(int(r["flight"][1:]), r["imu"]): r["values"] for r in self.calibrations}
        self.span = {int(r["flight"][1:]): r["span"] for r in self.calibrations}
        grid, noisy_grid, others = GRID, NOISY_GRID, OTHERS
        if args.quick:
            grid, noisy_grid = (dict(list(g.items())[:2]) for g in (GRID, NOISY_GRID))
            others = {name: OTHERS[name] for name in (NO_SCALE, PLAIN, PAPER)}
        ours: dict[str, dict[str, Any]] = {OURS: {}}
        rows = []
        for rate in (5.0, 1.0):
            rows += self.fly(
                f"{rate:g} Hz",
                self.tasks(f"{rate:g} Hz", rate, {**ours, **others, **grid}, self.seeds),
            )
        rows += self.fly(
            "injected noise",
            self.tasks(
                "injected",
                5.0,
                {
                    **ours,
                    ORACLE: {"noise.innovation_scale": False, **NO_BACKGROUND},
                    **{name: OTHERS[name] for name in (NO_SCALE, PLAIN, PAPER)},
                    "MB-EKF-CQ3": OTHERS["MB-EKF-CQ3"],
                    **noisy_grid,
                },
                self.seeds,
                injected=True,
            ),
        )
        outage_grid = {n: v for n, v in grid.items() if n.endswith(("1e-06", "1e-05"))}
        rows += self.fly(
            "outages", self.tasks("outage", 5.0, {**ours, **others, **outage_grid}, self.seeds)
        )
        rows += self.fly(
            "heading 30°",
            self.tasks("heading 30°", 5.0, ours, [0], heading=float(np.radians(30.0))),
        )
        rows += self.fly(
            "heading unknown", self.tasks("heading unknown", 5.0, ours, [0], heading=None)
        )
        for rate in (5.0, 1.0):
            rows += self.fly(
                f"as published, {rate:g} Hz",
                self.tasks(
                    f"published {rate:g} Hz",
                    rate,
                    {**ours, NO_SCALE: OTHERS[NO_SCALE]},
                    self.seeds,
                    values={},
                ),
            )
        online = {OURS: {"gnss.time_offset.value": 0.0, "gnss.time_offset.estimate": True}}
        for condition, (rate, calibrated, heading) in ONLINE.items():
            rows += self.fly(
                condition,
                self.tasks(
                    condition,
                    rate,
                    online,
                    self.seeds,
                    values=None if calibrated else {},
                    heading=heading,
                ),
            )
        simulated = self.run(
            "simulations",
            simulate_task,
            [
                (kind, seed, 20.5 if args.quick else 80.0)
                for kind in MISFITS
                for seed in range(1 if args.quick else 1 + len(self.seeds))
            ],
        )
        five, chosen_5 = Group.of(rows, "5 Hz").with_constants(grid)
        one, chosen_1 = Group.of(rows, "1 Hz").with_constants(grid)
        noisy, chosen_noisy = Group.of(rows, "injected").with_constants(noisy_grid)
        outage, _ = Group.of(rows, "outage").with_constants(outage_grid)
        groups = {"5 Hz": five, "1 Hz": one, "injected": noisy, "outage": outage}
        for name in HARDER:
            groups[name] = Group.of(rows, name)
        figures = args.out / "figures"
        figures.mkdir(parents=True, exist_ok=True)
        self._figures(figures, five)
        report = args.out / "field_experiment.md"
        report.write_text(
            self._report(groups, simulated, (chosen_5, chosen_1, chosen_noisy)) + "\n",
            encoding="utf-8",
        )
        return report

    def _figures(self, folder: Path, five: Group) -> None:
        number = next(iter(self.sessions.values()))[0]
        flight = load(self.args.data, number, 1)
        aid = fixes(flight, 5.0, 0, ())
        flown = {}
        for name in (OURS, PAPER):
            values = parameters.check_all({**self.values[number, 1], **OTHERS.get(name, {})})
            flown[name] = fly(flight, aid, values, offset=values["gnss.time_offset.value"])
        figures.path_and_levels(
            folder / "field_fig8.png", folder / "field_fig9.png", flight, aid, flown
        )
        flights = [load(self.args.data, n, 1) for s in self.sessions.values() for n in s]
        given = parameters.defaults()
        q_a, q_g = (
            np.median(
                [
                    {**given, **values}[f"noise.q_{sensor}"]
                    for (_, imu), values in self.values.items()
                    if imu == 1
                ]
            )
            for sensor in ("accelerometer", "gyroscope")
        )
        self.shown = figures.spectra(
            folder / "field_spectra.png", flights, (float(q_a), float(q_g))
        )
        self.needed = float(q_a), float(q_g)
        figures.distributions(
            folder / "field_fig10.png", {name: five.values(name, "prmse") for name in five.rows}
        )

    def _bars(self, groups: dict[str, Group], simulated: list[Row]) -> list[Bar]:
        five, one, noisy, outage = (groups[n] for n in ("5 Hz", "1 Hz", "injected", "outage"))
        away = np.array(
            [1e3 * abs(r["offset"] - r["exact"]) for r in self.calibrations if r["span"] >= 20.0]
        )
        online = self._online(groups)
        lever = {
            (r["session"], r["imu"]): 100.0
            * float(np.hypot(*np.subtract(r["imu_position"], r["exact_position"])[:2]))
            for r in self.calibrations
        }
        ends = outage.values(OURS, "end")

        def mean(group: Group, figure: str, name: str = OURS) -> float:
            return float(np.mean(group.values(name, figure)))

        bars = [
            Bar(
                "clock offset, worst flight [ms]",
                float(away.max()),
                *at_most(20.0, 10.0),
                f" (median {np.median(away):.0f})",
            ),
            *(
                Bar(
                    f"clock offset online after 20 s, {what} calibrated, worst of {len(off)} runs "
                    "[ms]",
                    float(off.max()),
                    *at_most(30.0, 15.0),
                    f" (median {np.median(off):.0f}, {np.sum(off <= 30.0)} within 30)",
                )
                for what, off in (
                    ("nothing", online["online 5 Hz"]),
                    ("the rest", online["online 5 Hz, the rest calibrated"]),
                )
            ),
            Bar(
                "lever arm, horizontally, worst IMU and session [cm]",
                max(lever.values()),
                *at_most(5.0, 2.0),
                f" (median {np.median(list(lever.values())):.1f})",
            ),
            Bar("PRMSE, 5 Hz [m]", mean(five, "prmse"), *at_most(0.145, 0.130)),
            Bar("PRMSE, 1 Hz [m]", mean(one, "prmse"), *at_most(0.26, 0.240)),
            Bar(
                "10 s outage end, median [m]",
                float(np.nanmedian(ends)),
                *at_most(2.3, 1.8),
                f" (p90 {np.nanpercentile(ends, 90):.1f})",
            ),
        ]
        for label, group, limits in (
            ("5 Hz", five, at_most(1.02, 1.0)),
            ("1 Hz", one, at_most(1.02, 1.0)),
            ("strong injected noise", noisy, at_most(0.95, 0.92)),
        ):
            ratio = group.ratio(OURS, TUNED)
            value = np.inf if ratio is None else ratio.ratio
            bars.append(
                Bar(
                    f"PRMSE against the constant tuned on the other session, {label}",
                    value,
                    *limits,
                    _interval(ratio),
                )
            )
        for label, group in (("5 Hz", five), ("1 Hz", one)):
            bars += [
                Bar(f"NIS/3, {label}", mean(group, "nis"), (0.85, 1.25), (0.9, 1.1)),
                Bar(f"NEES/3, {label}", mean(group, "nees"), (0.7, 1.7), (0.8, 1.3)),
            ]
        published = groups["published 5 Hz"]
        bars += [
            Bar(
                "clock as published: PRMSE, 5 Hz [m]",
                mean(published, "prmse"),
                *at_most(0.40, 0.30),
                f" (worst {published.values(OURS, 'prmse').max():.2f})",
            ),
            Bar("clock as published: NIS/3, 5 Hz", mean(published, "nis"), (0.5, 2.0)),
        ]
        for kind in MISFITS:
            by = _simulated(simulated, kind)
            best = min((v for n, v in by.items() if n not in (OURS, NO_SCALE)), key=lambda v: v[0])
            if kind == "right model":
                bars.append(
                    Bar(
                        "cost of the innovation scale, consistent simulations [%]",
                        100.0 * (by[OURS][0] / by[NO_SCALE][0] - 1.0),
                        *at_most(1.0, 0.3),
                    )
                )
                continue
            bars += [
                Bar(
                    f"simulated {kind}: PRMSE / hindsight constant",
                    by[OURS][0] / best[0],
                    *at_most(1.10, 1.05),
                ),
                Bar(f"simulated {kind}: NEES/3", by[OURS][1], *at_most(2.0, 1.5)),
            ]
        for label, group in (("5 Hz", five), ("1 Hz", one)):
            cost = mean(group, "prmse") / mean(group, "prmse", NO_SCALE) - 1.0
            bars.append(
                Bar(
                    f"cost of the innovation scale, calibrated flights, {label} [%]",
                    100.0 * cost,
                    *at_most(1.0, 0.3),
                )
            )
        return bars

    def _online(self, groups: dict[str, Group]) -> dict[str, np.ndarray]:
        """Return how far the offset found while flying is off after 20 s [ms], for each run."""
        exact = {(r["flight"], r["imu"]): r["exact"] for r in self.calibrations}
        return {
            condition: np.array(
                [
                    1e3 * abs(r["offset_20"] - exact[r["flight"], r["imu"]])
                    for r in groups[condition].rows[OURS]
                ]
            )
            for condition in ONLINE
        }

    def _report(
        self, groups: dict[str, Group], simulated: list[Row], chosen: Sequence[dict[str, str]]
    ) -> str:
        bars = self._bars(groups, simulated)
        five, one, noisy, outage = (groups[n] for n in ("5 Hz", "1 Hz", "injected", "outage"))
        ends = [
            (
                name,
                f"{np.nanmedian(outage.values(name, 'end')):.2f}",
                f"{np.nanpercentile(outage.values(name, 'end'), 90):.2f}",
            )
            for name in outage.rows
        ]
        others = []
        for label in HARDER:
            for name in groups[label].rows:
                group = groups[label]
                others.append(
                    (
                        label,
                        name,
                        *(
                            f"{group.values(name, f).mean():.3f}"
                            for f in ("prmse", "pmae", "nees", "nis")
                        ),
                        f"{group.values(name, 'prmse').max():.2f}",
                    )
                )
        calibration = [
            (
                r["flight"],
                r["imu"],
                f"{r['offset']:+.3f} ± {r['sigma']:.3f}",
                f"{r['exact']:+.3f} ± {r['exact_sigma']:.3f}",
                f"{1e3 * (r['offset'] - r['exact']):+.0f}",
                _centimetres(r["imu_position"]),
                _centimetres(r["exact_position"]),
            )
            for r in self.calibrations
        ]
        misfits = []
        for kind in MISFITS:
            by = _simulated(simulated, kind)
            best = min((n for n in by if n not in (OURS, NO_SCALE)), key=lambda n: by[n][0])
            misfits.append(
                (
                    kind,
                    f"{by[OURS][0]:.3f}",
                    f"{by[OURS][1]:.2f}",
                    f"{by[NO_SCALE][0]:.3f}",
                    f"{by[NO_SCALE][1]:.1f}",
                    f"{by[best][0]:.3f} (× {best})",
                    f"{by[best][1]:.2f}",
                )
            )
        minutes = (time.monotonic() - self.began) / 60.0
        count = sum(map(len, self.sessions.values()))
        quick = (
            [
                "**Quick mode: a few flights, to see that the program works. Its figures mean "
                "nothing.**"
            ]
            if self.args.quick
            else []
        )
        text = Path(__file__).with_name("text.md").read_text(encoding="utf-8")
        head, _, tail = text.partition("<!-- figures -->")
        return "\n\n".join(
            (
                "# The field experiment",
                *quick,
                f"{count} flights × {len(self.imus)} IMUs × {len(self.seeds)} draws of the fixes, "
                f"made by `python -m tools.field.evaluate --data DIR --imus {len(self.imus)} "
                f"--seeds {len(self.seeds)}` (last run: "
                f"{minutes:.0f} min with {self.args.jobs} processes, finished parts taken over).",
                "## Targets and results",
                table(("figure", "measured", "bar", "stretch", "met"), ())
                + "\n"
                + "\n".join(bar.row() for bar in bars),
                head.strip(),
                "## The paper's Table 2, on these flights",
                method_table([("5 Hz", five)]),
                method_table([("1 Hz", one)]),
                "Constants tuned on the other session: "
                + "; ".join(
                    f"{label} {', '.join(sorted(set(c.values())))}"
                    for label, c in zip(("5 Hz", "1 Hz", "injected noise"), chosen, strict=True)
                )
                + ".",
                "The paper's own flight, PRMSE / PMAE [m]: "
                + ", ".join(f"{name} {p[1]} / {p[0]}" for name, p in PAPER_TABLE.items())
                + ".",
                "![A flight](figures/field_fig8.png)",
                "*The paper's Fig. 8: one flight, reference, fixes and estimate.*",
                "![Levels](figures/field_fig9.png)",
                "*The paper's Fig. 9: levels in force on that flight.*",
                "![Distribution](figures/field_fig10.png)",
                "*The paper's Fig. 10: distribution of PRMSE over all runs at 5 Hz.*",
                "## IMU spectra and the noise that navigation needs",
                "![Spectra](figures/field_spectra.png)",
                "*Spectra of IMU 1 on all flights, as the variance per sample of white noise of "
                "that density, against the noise that `ins_calibrate` found.*",
                table(
                    ("", "calibrated noise", "quietest frequency, 5 % of windows", "its median"),
                    [
                        (sensor, f"{needed:.2g}", f"{low:.2g}", f"{middle:.2g}")
                        for sensor, needed, (low, middle) in zip(
                            ("accelerometer [(m/s²)²]", "gyroscope [(rad/s)²]"),
                            self.needed,
                            self.shown,
                            strict=True,
                        )
                    ],
                ),
                "## Outages of 10 s: error at their end",
                table(("method", "median [m]", "p90 [m]"), ends),
                f"## Strong noise injected every other {BLOCK:g} s",
                f"White, {INJECTED[0]:g} m/s² and {INJECTED[1]:g} rad/s per sample.",
                method_table([("5 Hz", noisy)]),
                "## Worse starts, nothing calibrated, clock found while flying",
                table(
                    (
                        "condition",
                        "method",
                        "PRMSE [m]",
                        "PMAE [m]",
                        "NEES/3",
                        "NIS/3",
                        "worst run [m]",
                    ),
                    others,
                ),
                "Clock offset in force 20 s after the first sample, against the one by the "
                "reference:",
                table(
                    ("condition", "median [ms]", "p90 [ms]", "worst [ms]", "within 30 ms"),
                    [
                        (
                            condition,
                            f"{np.median(off):.0f}",
                            f"{np.percentile(off, 90):.0f}",
                            f"{off.max():.0f}",
                            f"{np.sum(off <= 30.0)} of {len(off)}",
                        )
                        for condition, off in self._online(groups).items()
                    ],
                ),
                "## Errors that the IMU's noise does not show, simulated",
                table(
                    (
                        "error",
                        "ours: PRMSE [m]",
                        "NEES/3",
                        "without scale: PRMSE [m]",
                        "NEES/3",
                        "best constant: PRMSE [m]",
                        "NEES/3",
                    ),
                    misfits,
                ),
                "## Calibration, flight by flight",
                "Clock offset [s] from fixes of 5 Hz and from the reference itself, their "
                "difference [ms], IMU in base_link (forward, left, up) [cm] by both.",
                table(
                    (
                        "flight",
                        "IMU",
                        "offset",
                        "by the reference",
                        "difference",
                        "IMU position",
                        "by the reference",
                    ),
                    calibration,
                ),
                tail.strip(),
            )
        )


def _centimetres(position: Sequence[float]) -> str:
    return ", ".join(f"{100.0 * p:+.0f}" for p in position)


def _simulated(rows: Iterable[Row], kind: str) -> dict[str, tuple[float, float]]:
    """Mean PRMSE [m] and NEES/3 by method."""
    by: dict[str, list[tuple[float, float]]] = {}
    for row in rows:
        if row["kind"] == kind:
            by.setdefault(row["method"], []).append((row["prmse"], row["nees"]))
    return {name: tuple(np.mean(v, axis=0).tolist()) for name, v in by.items()}


def _body(args: argparse.Namespace) -> int:
    print(Experiment(args).do())
    return 0


def main(argv: Sequence[str] | None = None) -> int:
    """Run the program."""
    parser = program.parser(
        "evaluate_field", __doc__ or "", "python -m tools.field.evaluate --data quadrotor --jobs 2"
    )
    parser.add_argument(
        "--data",
        type=Path,
        required=True,
        metavar="DIR",
        help="the data set: holds Horizontal/path_2 and so on",
    )
    parser.add_argument("--out", type=Path, default=Path("docs"), help="folder to write to [docs]")
    parser.add_argument(
        "--work", type=Path, metavar="DIR", help="folder for finished parts [OUT/.field]"
    )
    parser.add_argument("--seeds", type=options.count, default=3, help="draws of the fixes [3]")
    parser.add_argument("--imus", type=options.count, default=4, help="how many of them [4]")
    parser.add_argument("--jobs", type=options.count, default=2, help="processes [2]")
    parser.add_argument("--quick", action="store_true", help="a minute, to see that it works")
    args = parser.parse_args(argv)
    if args.seeds < 1 or args.jobs < 1:
        parser.error("--seeds and --jobs: at least 1")
    return program.run(_body, args)


if __name__ == "__main__":
    sys.exit(main())
