"""
The field experiment: calibrate, replay and evaluate real flights, and say what came of it.

Reads the shared part of "Quadrotor Dead Reckoning with Multiple Inertial Sensors" (Hurwitz & Klein)
and does in one process what ins_convert, ins_calibrate, ins_replay and ins_evaluate do through
bags: the same functions, without the files. Finished parts are kept in a folder: run it again to
resume.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from hybrid_ins import parameters
from hybrid_ins.cli import options, program
from hybrid_ins.errors import InputError
from tools.field import figures
from tools.field.cache import Cache, run_all
from tools.field.flights import IMUS, SESSIONS, fixes, fly, load
from tools.field.groups import Group
from tools.field.methods import (
    GRID,
    HARDER,
    NO_BACKGROUND,
    NO_SCALE,
    NOISY_GRID,
    ONLINE,
    ORACLE,
    OTHERS,
    OURS,
    PAPER,
    PLAIN,
)
from tools.field.report import Findings, report
from tools.field.tasks import (
    MISFITS,
    OUTAGE,
    Row,
    Task,
    calibrate_task,
    fly_task,
    simulate_task,
)

OUTAGE_PLACES = 3  # in a flight: each draw of the fixes and each IMU has another


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
                            share = (seed + imu) % OUTAGE_PLACES / (OUTAGE_PLACES - 1)
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
        online = {OURS: {"gnss.time_offset.value": 0.0, "gnss.time_offset.std": 0.0}}
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
        folder = args.out / "figures"
        folder.mkdir(parents=True, exist_ok=True)
        shown, needed = self._draw(folder, five)
        minutes = (time.monotonic() - self.began) / 60.0
        count = sum(map(len, self.sessions.values()))
        draws = f"{len(self.seeds)} draws" if len(self.seeds) > 1 else "one draw"
        found = Findings(
            f"{count} flights × {len(self.imus)} IMUs × {draws} of the fixes, made "
            f"by `python -m tools.field.evaluate --data DIR --imus {len(self.imus)} "
            f"--seeds {len(self.seeds)}` (last run: {minutes:.0f} min with {args.jobs} processes, "
            "finished parts taken over).",
            args.quick,
            self.calibrations,
            simulated,
            groups,
            (chosen_5, chosen_1, chosen_noisy),
            shown,
            needed,
        )
        path = args.out / "field_experiment.md"
        path.write_text(report(found) + "\n", encoding="utf-8")
        return path

    def _draw(
        self, folder: Path, five: Group
    ) -> tuple[list[tuple[float, float]], tuple[float, float]]:
        """Draw the figures; returns the noise in the spectra, and the calibrated one."""
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
        needed = float(q_a), float(q_g)
        shown = figures.spectra(folder / "field_spectra.png", flights, needed)
        figures.distributions(
            folder / "field_fig10.png", {name: five.values(name, "prmse") for name in five.rows}
        )
        return shown, needed


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
