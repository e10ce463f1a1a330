"""
Every named fault of `faults`, injected into a simulated and a recorded flight.

Each run has to end without an exception, publish no NaN and only positive definite covariances, say
what is wrong, and be as good as the undisturbed run 10 s after the fault, as RMS over several draws
of the sensors' noise.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

from hybrid_ins import parameters, progress
from hybrid_ins.calibration.calibrate import calibrate
from hybrid_ins.calibration.recording import read_recording
from hybrid_ins.cli import convert, simulate
from hybrid_ins.cli import program as shell
from hybrid_ins.errors import InputError
from tools.robustness.campaign_results import FAULTS, LIVE, ResultFile, Row, over_draws, page, table
from tools.robustness.fault_plays import run_live
from tools.robustness.fault_replays import Case, attempt_all, replayed
from tools.robustness.faults import Fault

DRAWS = 5  # of noise, the same number for every fault
QUICK = ("imu_nan", "imu_frozen", "clock_back", "fix_zero", "fix_shift", "no_fixes_at_all")
LIVE_RATE = 4.0  # times real time, of a machine that has nothing else to do


def make_simulated(folder: Path, draws: int) -> list[Case]:
    """Simulate a quadrotor flight with several draws of noise."""
    bags = [folder / f"simulated_{seed}.mcap" for seed in range(draws)]
    for seed, bag in enumerate(bags):
        simulate.main(
            [
                str(bag),
                "--imu-rate",
                "200",
                "--truth-rate",
                "20",
                "--variant",
                "3",
                "--seed",
                str(1 + seed),
                "--accelerometer-std",
                "0.3",
                "--gyroscope-std",
                "0.01",
                "--overwrite",
            ]
        )
    return [Case("simulated", bag, parameters.defaults(), 20.0, k) for k, bag in enumerate(bags)]


def make_recorded(
    folder: Path, flight: Path, imu: int, offset: float | None, draws: int
) -> list[Case]:
    """Convert a flight of the dataset, its clock offset given or calibrated."""
    bags = [folder / f"recorded_{seed}.mcap" for seed in range(draws)]
    for seed, bag in enumerate(bags):
        if convert.main(
            [str(flight), str(bag), "--imu", str(imu), "--seed", str(seed), "--overwrite"]
        ):
            raise InputError(f"{flight}: not converted")
    values = parameters.defaults()
    if offset is None:
        recording = read_recording(bags[0], values)
        offset = calibrate([recording], values).values["gnss.time_offset.value"]
        print(f"clock offset {offset:+.4f} s")
    values["gnss.time_offset.value"] = offset
    return [Case("recorded", bag, values, 12.0, k) for k, bag in enumerate(bags)]


def main(argv: Sequence[str] | None = None) -> int:
    """Run the campaign."""
    parser = shell.parser(
        "fault_campaign",
        __doc__ or "",
        "python -m tools.robustness.fault_campaign --live --flight quadrotor/Horizontal/path_4",
    )
    parser.add_argument(
        "--flight",
        type=Path,
        metavar="DIR",
        help="flight of the quadrotor dataset (without: simulated only)",
    )
    parser.add_argument("--imu", type=int, default=1, metavar="K", help="which IMU of it [1]")
    parser.add_argument(
        "--time-offset",
        type=float,
        metavar="S",
        help="of that flight [calibrated, which takes half a minute]",
    )
    parser.add_argument(
        "--only",
        nargs="+",
        metavar="FAULT",
        choices=[f.name for f in FAULTS],
        help="these faults only",
    )
    parser.add_argument("--quick", action="store_true", help="a few faults only")
    parser.add_argument(
        "--live", action="store_true", help="also play all of them into the node over DDS"
    )
    parser.add_argument(
        "--rate",
        type=float,
        default=LIVE_RATE,
        metavar="R",
        help="of that, times real time [%(default)g]",
    )
    parser.add_argument(
        "--no-replay", action="store_true", help="only what --live adds, and what FILE has"
    )
    parser.add_argument(
        "--results", type=Path, metavar="FILE", help="of every run; those that it has are kept"
    )
    parser.add_argument(
        "--draws", type=int, default=DRAWS, metavar="N", help="of noise, per fault [%(default)s]"
    )
    parser.add_argument(
        "--jobs", type=int, default=1, metavar="N", help="live runs at a time [%(default)s]"
    )
    parser.add_argument("--report", type=Path, metavar="FILE", help="Markdown page to write")
    args = parser.parse_args(argv)
    args.command = " ".join(
        ["python -m tools.robustness.fault_campaign", *(sys.argv[1:] if argv is None else argv)]
    )
    return shell.run(_body, args)


def _body(args: argparse.Namespace) -> int:
    names = args.only or (QUICK if args.quick else [fault.name for fault in FAULTS])
    faults = [fault for fault in FAULTS if fault.name in names]
    results = ResultFile(args.results)
    rows = results.rows()
    done = {(row.fault, row.case, row.draw) for row in rows}
    with tempfile.TemporaryDirectory() as folder:
        flights = [make_simulated(Path(folder), args.draws)]
        if args.flight:
            given = args.flight, args.imu, args.time_offset
            flights.append(make_recorded(Path(folder), *given, args.draws))
        runs = [  # a campaign that is ended has the first draws of all faults
            (draws[k], fault)
            for k in range(args.draws)
            for fault in faults
            for draws in flights
            if not args.no_replay and (fault.name, draws[k].name, k) not in done
        ]
        live = [
            (draws[0], fault)
            for fault in faults
            for draws in flights
            if args.live and (draws is flights[-1] or fault.unusable)
            if (fault.name, draws[0].name + LIVE, 0) not in done
        ]
        with progress.bar("faults", len(runs) + len(live), "run") as bar:

            def keep(row: Row) -> None:
                results.add(row)
                rows.append(row)
                bar.update()

            _run(runs, live, args.rate, args.jobs, Path(folder), keep)
    rows, draws = over_draws(rows)
    if args.report:
        text = page(rows, draws, args.command, results.revision)
        args.report.write_text(text, encoding="utf-8")
    print(table(rows))
    for row in rows:
        for failure in row.failures:
            print(f"FAIL {row.fault} ({row.case}): {failure}")
    failed = sum(bool(row.failures) for row in rows)
    print(f"{len(rows)} runs of {len(faults)} faults, {draws} draw(s) of noise, {failed} failed")
    return int(failed > 0)


def _run(
    runs: Sequence[tuple[Case, Fault]],
    live: Sequence[tuple[Case, Fault]],
    rate: float,
    jobs: int,
    folder: Path,
    on_row: Callable[[Row], None],
) -> None:
    """Make the replays and the live runs."""
    cases = dict.fromkeys(case for case, _ in (*runs, *live))
    clean = {case: replayed(case, None, folder).trace for case in cases}
    for case in cases:
        faults = [fault for other, fault in runs if other is case]
        if faults:
            attempt_all(case, faults, clean[case], on_row)
    for row in run_live([(case, fault, clean[case], rate) for case, fault in live], jobs):
        on_row(row)


if __name__ == "__main__":
    sys.exit(main())
