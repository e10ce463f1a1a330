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
import sys
import tempfile
import traceback
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from queue import SimpleQueue
from typing import cast

from hybrid_ins import parameters, progress, replay
from hybrid_ins.bags.reader import BagReader
from hybrid_ins.bags.writer import BagWriter
from hybrid_ins.calibration.findings import calibrate
from hybrid_ins.calibration.recording import read_recording
from hybrid_ins.cli import convert, simulate
from hybrid_ins.cli import program as shell
from hybrid_ins.errors import InputError
from hybrid_ins.parameters import parameter_file
from tools.processes import Processes, isolated_ros, program
from tools.robustness.campaign_results import (
    FAULTS,
    LIVE,
    RECOVERY,
    ResultFile,
    Row,
    over_draws,
    page,
    table,
    too_large,
)
from tools.robustness.disturbances import Flight
from tools.robustness.fault_output import Output, Trace, examine
from tools.robustness.faults import Fault
from tools.robustness.shared_start import AllForked, ForkingReader, HeldBack, has_same_start

ESTIMATE, DISTURBED = "estimate.mcap", "disturbed.mcap"
CHANGES_START = "the fault changes the beginning of the flight"
DRAWS = 5  # of noise, the same number for every fault
COVERED = 0.95  # share of the truth that must have an estimate by then
QUICK = ("imu_nan", "imu_frozen", "clock_back", "fix_zero", "fix_shift", "no_fixes_at_all")
LIVE_RATE = 4.0  # times real time, of a machine that has nothing else to do


@dataclass(frozen=True, eq=False)
class Case:
    """A flight to disturb, with one draw of the sensors' noise."""

    name: str
    bag: Path
    values: parameters.Values
    start: float  # s, of the faults
    draw: int = 0  # of noise


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
        return _row(fault, case, "; ".join(found), failures)
    end = case.start + fault.duration
    expected, _ = clean.after(end + RECOVERY)
    error, covered = output.trace.after(end + RECOVERY)
    if fault.silent:
        if output.odometry:
            failures.append(f"{output.odometry} odometry messages")
    else:
        if covered < COVERED:
            failures.append(f"odometry for {covered:.0%} of the time from {RECOVERY:g} s after")
        failures += too_large(error, expected)
    peak = output.trace.largest(case.start, end + RECOVERY)
    return _row(fault, case, "; ".join(found), failures, peak, expected, error)


def _row(
    fault: Fault,
    case: Case,
    said: str,
    failures: Sequence[str],
    peak: float = math.nan,
    clean: float = math.nan,
    error: float = math.nan,
) -> Row:
    return Row(fault.name, case.name, said, peak, clean, error, tuple(failures), case.draw)


class _LogLines(logging.Handler):
    """Collects lines in a list."""

    def __init__(self, lines: list[str]) -> None:
        super().__init__()
        self._lines = lines

    def emit(self, record: logging.LogRecord) -> None:
        """Add a line."""
        self._lines.append(record.getMessage())


@contextmanager
def _lines_logged() -> Iterator[list[str]]:
    """Within the block, collect what the package logs."""
    lines: list[str] = []
    handler, package = _LogLines(lines), logging.getLogger("hybrid_ins")
    package.addHandler(handler)
    try:
        yield lines
    finally:
        package.removeHandler(handler)


def replayed(case: Case, fault: Fault | None, folder: Path) -> Output:
    """Replay a flight, disturbed or not."""
    bag, estimate = case.bag, folder / ESTIMATE
    if fault is not None:
        bag = folder / DISTURBED
        inject(case, fault, bag)
    values = parameters.check_all({**case.values, **(fault.values if fault else {})})
    with (
        _lines_logged() as lines,
        BagReader(bag) as reader,
        BagWriter(estimate, overwrite=True) as out,
    ):
        replay.replay(reader, out, values, log=lambda level, text: lines.append(text))
    return _examined(case, fault, folder, lines)


def _examined(case: Case, fault: Fault | None, folder: Path, lines: Sequence[str]) -> Output:
    output = examine(
        folder / ESTIMATE,
        case.bag if fault is None else folder / DISTURBED,
        _origin(case),
        float(str(case.values["gnss.time_offset.value"])),
        fault.stamp_shift if fault else 0.0,
    )
    return replace(output, said=(*output.said, *lines))


def attempt_all(
    case: Case, faults: Sequence[Fault], clean: Trace, on_row: Callable[[Row], None]
) -> None:
    """Run faults; those that do not change the beginning of the flight share its replay."""
    from_ns = _origin(case) + round(case.start * 1e9)

    def on_result(index: int, result: Row | str | None) -> None:
        fault = faults[index]
        if result == CHANGES_START:
            on_row(attempt(case, fault.name, clean))
        elif isinstance(result, Row):
            on_row(result)
        else:
            on_row(_row(fault, case, "", ["crash: the process ended"]))

    with tempfile.TemporaryDirectory() as name, _lines_logged() as lines:
        folder = Path(name)
        out = HeldBack(folder)

        def disturb(fault: Fault) -> Path:
            inject(case, fault, folder / DISTURBED)
            if fault.values or not has_same_start(case.bag, folder / DISTURBED, from_ns):
                reader.answer(CHANGES_START)
            out.open(folder / ESTIMATE)
            return folder / DISTURBED

        others = [partial(disturb, fault) for fault in faults]
        with ForkingReader(case.bag, from_ns, others, on_result) as reader:
            try:
                log = lambda level, text: lines.append(text)  # noqa: E731
                replay.replay(reader, cast(BagWriter, out), case.values, log=log)
            except AllForked:
                return
            except Exception:
                if reader.index is None:
                    raise
                reader.answer(_crashed(faults[reader.index], case))
            assert reader.index is not None  # this is a child
            fault = faults[reader.index]
            try:
                out.close()
                row = judge(fault, case, _examined(case, fault, folder, lines), clean)
            except Exception:
                row = _crashed(fault, case)
            reader.answer(row)


def inject(case: Case, fault: Fault, bag: Path) -> None:
    """Write the disturbed flight."""
    flight = Flight.read(case.bag, case.start, fault.duration)
    fault.inject(flight)
    flight.write(bag)


def _origin(case: Case) -> int:
    with BagReader(case.bag) as bag:
        return bag.start_ns


def attempt(case: Case, name: str, clean: Trace) -> Row:
    """Run one fault, beside the undisturbed run; an exception is a result."""
    fault = next(fault for fault in FAULTS if fault.name == name)
    with tempfile.TemporaryDirectory() as folder:
        try:
            return judge(fault, case, replayed(case, fault, Path(folder)), clean)
        except Exception:  # whatever ends a run is what is looked for
            return _crashed(fault, case)


def _crashed(fault: Fault, case: Case) -> Row:
    last = traceback.format_exc().strip().splitlines()
    return _row(fault, case, "", (f"crash: {last[-1]}", *last[-5:-1]))


def attempt_live(
    case: Case, fault: Fault, clean: Trace, rate: float, domains: SimpleQueue[dict[str, str]]
) -> Row:
    """Play one fault into the node over DDS, at a multiple of real time, on a free domain."""
    domain = domains.get()
    try:
        with tempfile.TemporaryDirectory() as folder:
            return _play(case, fault, clean, rate, Path(folder), domain)
    finally:
        domains.put(domain)


def _play(
    case: Case, fault: Fault, clean: Trace, rate: float, folder: Path, domain: dict[str, str]
) -> Row:
    bag, estimate = folder / "disturbed.mcap", folder / "estimate.mcap"
    log, values_file = folder / "node.log", folder / "values.yaml"
    inject(case, fault, bag)
    values = parameters.check_all({**case.values, **fault.values})
    values_file.write_text(parameter_file.to_yaml(values, "Of the fault campaign."))
    with Processes() as processes, log.open("w") as output:
        node = processes.start(
            [program("ins_node"), "--ros-args", "--params-file", values_file], output, domain
        )
        player = processes.start(
            [
                program("ins_play"),
                bag,
                "--rate",
                str(rate),
                "--record",
                estimate,
                "--wait",
                "120",
                "--overwrite",
            ],
            output,
            domain,
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
    for row in _run_live([(case, fault, clean[case], rate) for case, fault in live], jobs):
        on_row(row)


def _run_live(plays: Sequence[tuple[Case, Fault, Trace, float]], jobs: int) -> Iterator[Row]:
    """Yield the results of live runs as they come, each beside others on domains of their own."""
    domains: SimpleQueue[dict[str, str]] = SimpleQueue()
    for _ in range(jobs):
        domains.put(isolated_ros())
    with ThreadPoolExecutor(jobs) as pool:
        futures = [pool.submit(attempt_live, *play, domains) for play in plays]
        try:
            for future in as_completed(futures):
                yield future.result()
        finally:
            pool.shutdown(cancel_futures=True)


if __name__ == "__main__":
    sys.exit(main())
