"""
Every named fault of `faults`, injected into a simulated and a recorded flight.

Each run has to end without an exception, publish no NaN and only positive definite covariances, say
what is wrong, and be as good as the undisturbed run 10 s after the fault, as RMS over several draws
of the sensors' noise.
"""

from __future__ import annotations

import argparse
import logging
import math
import os
import sys
import tempfile
import traceback
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from hybrid_ins import parameters, progress, replay
from hybrid_ins.bags.reader import BagReader
from hybrid_ins.bags.writer import BagWriter
from hybrid_ins.calibration.findings import calibrate
from hybrid_ins.calibration.recording import read_recording
from hybrid_ins.cli import convert, simulate
from hybrid_ins.cli import program as shell
from hybrid_ins.errors import InputError
from hybrid_ins.parameters import parameter_file
from tools.parallel import run_parallel
from tools.processes import Processes, isolated_ros, program
from tools.robustness.campaign_results import (
    FAULTS,
    LIVE,
    RECOVERY,
    WORSE,
    ResultFile,
    Row,
    page,
    table,
)
from tools.robustness.disturbances import Flight
from tools.robustness.fault_output import Output, Trace, examine
from tools.robustness.faults import Fault

DRAWS = 5  # of noise, the same number for every fault
COVERED = 0.95  # share of the truth that must have an estimate by then
QUICK = ("imu_nan", "imu_frozen", "clock_back", "fix_zero", "fix_shift", "no_fixes_at_all")
LIVE_RATE = 4.0  # times real time


@dataclass(frozen=True)
class Case:
    """A flight to disturb, and the same with other noise."""

    name: str
    bag: Path
    values: parameters.Values
    start: float  # s, of the faults
    others: tuple[Path, ...] = ()

    @property
    def draws(self) -> list[Case]:
        """The flight with each draw of noise."""
        return [replace(self, bag=bag, others=()) for bag in (self.bag, *self.others)]


def judge(fault: Fault, case: Case, output: Output, clean: Trace) -> Row:
    """Hold a run against what the fault demands."""
    failures = list(output.faults)
    found = []
    for sign in fault.signs:
        if sign.startswith("no "):
            unwanted = [text for text in output.said if sign[3:] in text]
            failures += [f"said {text!r}" for text in unwanted[:1]]
            found.append(sign)
            continue
        hits = [text for text in output.said for word in sign.split("|") if word in text]
        if hits:
            found.append(next(word for word in sign.split("|") if word in hits[0]))
        else:
            failures.append(f"nothing says {sign!r}")
    if fault.unusable:
        nan = math.nan
        return Row(fault.name, case.name, "; ".join(found), nan, nan, nan, tuple(failures))
    end = case.start + fault.duration
    expected, _ = clean.after(end + RECOVERY)
    error, covered = output.trace.after(end + RECOVERY)
    if fault.silent:
        if output.odometry:
            failures.append(f"{output.odometry} odometry messages")
    else:
        if covered < COVERED:
            failures.append(f"odometry for {covered:.0%} of the time from {RECOVERY:g} s after")
        if not error <= WORSE * expected:
            failures.append(_too_large(error, expected))
    peak = output.trace.largest(case.start, end + RECOVERY)
    return Row(fault.name, case.name, "; ".join(found), peak, expected, error, tuple(failures))


class _LogLines(logging.Handler):
    """Collects lines in a list."""

    def __init__(self, lines: list[str]) -> None:
        super().__init__()
        self._lines = lines

    def emit(self, record: logging.LogRecord) -> None:
        """Add a line."""
        self._lines.append(record.getMessage())


def replayed(case: Case, fault: Fault | None, folder: Path) -> Output:
    """Replay a flight, disturbed or not."""
    bag, estimate = case.bag, folder / f"{case.name}_estimate.mcap"
    if fault is not None:
        bag = folder / f"{case.name}_disturbed.mcap"
        inject(case, fault, bag)
    values = parameters.check_all({**case.values, **(fault.values if fault else {})})
    log: list[str] = []
    of_reader = _LogLines(log)
    logging.getLogger("hybrid_ins").addHandler(of_reader)
    try:
        with BagReader(bag) as reader, BagWriter(estimate, overwrite=True) as out:
            replay.replay(reader, out, values, log=lambda level, text: log.append(text))
    finally:
        logging.getLogger("hybrid_ins").removeHandler(of_reader)
    output = examine(
        estimate,
        bag,
        _origin(case),
        float(values["gnss.time_offset.value"]),
        fault.stamp_shift if fault else 0.0,
    )
    return replace(output, said=(*output.said, *log))


def inject(case: Case, fault: Fault, bag: Path) -> None:
    """Write the disturbed flight."""
    flight = Flight.read(case.bag, case.start, fault.duration)
    fault.inject(flight)
    flight.write(bag)


def _origin(case: Case) -> int:
    with BagReader(case.bag) as bag:
        return bag.start_ns


def attempt(case: Case, name: str, clean: Sequence[Trace]) -> Row:
    """Run one fault, with the undisturbed run of each draw; an exception is a result."""
    fault = next(fault for fault in FAULTS if fault.name == name)
    with tempfile.TemporaryDirectory() as folder:
        try:
            rows = [
                judge(fault, draw, replayed(draw, fault, Path(folder)), undisturbed)
                for draw, undisturbed in zip(case.draws, clean, strict=True)
            ]
        except Exception:  # whatever ends a run is what is looked for
            return _crashed(fault, case)
    return _over_draws(rows, fault)


def _over_draws(rows: Sequence[Row], fault: Fault) -> Row:
    """Take the RMS over the draws of noise: the errors of one flight are few independent."""
    clean, error = (
        float(np.sqrt(np.mean([getattr(r, name) ** 2 for r in rows])))
        for name in ("clean", "error")
    )
    failures = [f for r in rows for f in r.failures if not f.startswith("error ")]
    if not (fault.silent or fault.unusable) and not error <= WORSE * clean:
        failures.append(_too_large(error, clean) + f", RMS of {len(rows)} draws of noise")
    return replace(
        rows[0],
        clean=clean,
        error=error,
        peak=max(r.peak for r in rows),
        failures=tuple(dict.fromkeys(failures)),
        draws=len(rows),
    )


def _too_large(error: float, clean: float) -> str:
    return f"error {error:.3f} m, undisturbed {clean:.3f} m"


def _crashed(fault: Fault, case: Case) -> Row:
    last = traceback.format_exc().strip().splitlines()
    return Row(
        fault.name,
        case.name,
        "",
        math.nan,
        math.nan,
        math.nan,
        (f"crash: {last[-1]}", *last[-5:-1]),
        len(case.draws),
    )


def attempt_live(case: Case, fault: Fault, clean: Trace, folder: Path) -> Row:
    """Play one fault into the node over DDS."""
    bag, estimate = folder / "disturbed.mcap", folder / "estimate.mcap"
    log, values_file = folder / "node.log", folder / "values.yaml"
    inject(case, fault, bag)
    values = parameters.check_all({**case.values, **fault.values})
    values_file.write_text(parameter_file.to_yaml(values, "Of the fault campaign."))
    with Processes() as processes, log.open("w") as output:
        node = processes.start(
            [program("ins_node"), "--ros-args", "--params-file", values_file], output
        )
        player = processes.start(
            [
                program("ins_play"),
                bag,
                "--rate",
                str(LIVE_RATE),
                "--record",
                estimate,
                "--wait",
                "120",
                "--overwrite",
            ],
            output,
        )
        player.wait(600.0)
        ended_early = node.poll() is not None
        status = processes.stop(node)
    words = log.read_text(errors="replace")
    row = judge(
        fault,
        case,
        examine(
            estimate, bag, _origin(case), float(values["gnss.time_offset.value"]), fault.stamp_shift
        ),
        clean,
    )
    failures = [*row.failures]
    if player.returncode or status or ended_early:
        failures.append(f"exit status: player {player.returncode}, node {status}")
    if "Traceback" in words:
        failures.append("traceback: " + words.strip().splitlines()[-1])
    return replace(row, case=case.name + LIVE, failures=tuple(failures))


def make_simulated(folder: Path, draws: int) -> Case:
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
    return Case("simulated", bags[0], parameters.defaults(), 20.0, tuple(bags[1:]))


def make_recorded(folder: Path, flight: Path, imu: int, offset: float | None, draws: int) -> Case:
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
    return Case("recorded", bags[0], values, 12.0, tuple(bags[1:]))


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
        "--no-replay", action="store_true", help="only what --live adds, and what FILE has"
    )
    parser.add_argument(
        "--results", type=Path, metavar="FILE", help="of every run; those that it has are kept"
    )
    parser.add_argument(
        "--draws", type=int, default=DRAWS, metavar="N", help="of noise, per fault [%(default)s]"
    )
    parser.add_argument(
        "--jobs", type=int, default=os.cpu_count() or 1, metavar="N", help="at a time [%(default)s]"
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
    results = ResultFile(args.results, args.draws)
    rows = results.rows()
    done = {(row.fault, row.case) for row in rows}
    with tempfile.TemporaryDirectory() as folder:
        cases = [make_simulated(Path(folder), args.draws)]
        if args.flight:
            given = args.flight, args.imu, args.time_offset
            cases.append(make_recorded(Path(folder), *given, args.draws))
        runs = [
            (case, fault.name)
            for fault in faults
            for case in cases
            if not args.no_replay and (fault.name, case.name) not in done
        ]
        live = [
            (case, fault)
            for fault in faults
            for case in cases
            if args.live and (case is cases[-1] or fault.unusable)
            if (fault.name, case.name + LIVE) not in done
        ]
        found = _run(cases, runs, live, args.jobs, Path(folder))
        for row in progress.track(found, "faults", len(runs) + len(live), "run"):
            results.add(row)
            rows.append(row)
    rows = results.rows() or rows
    if args.report:
        args.report.write_text(page(rows, args.command, results.revision), encoding="utf-8")
    print(table(rows))
    for row in rows:
        for failure in row.failures:
            print(f"FAIL {row.fault} ({row.case}): {failure}")
    failed = sum(bool(row.failures) for row in rows)
    print(f"{len(rows)} runs of {len(faults)} faults, {failed} failed")
    return int(failed > 0)


def _run(
    cases: Sequence[Case],
    runs: Sequence[tuple[Case, str]],
    live: Sequence[tuple[Case, Fault]],
    jobs: int,
    folder: Path,
) -> Iterator[Row]:
    """Yield the results of replayed and of live runs."""
    clean: dict[str, list[Trace]] = {}
    for case in cases:
        if any(run[0] is case for run in runs):
            clean[case.name] = [replayed(draw, None, folder).trace for draw in case.draws]
        elif any(run[0] is case for run in live):
            clean[case.name] = [replayed(case, None, folder).trace]
    yield from run_parallel(attempt, [(case, name, clean[case.name]) for case, name in runs], jobs)
    if live:
        os.environ.update(isolated_ros())
    for case, fault in live:
        yield attempt_live(case, fault, clean[case.name][0], folder)


if __name__ == "__main__":
    sys.exit(main())
