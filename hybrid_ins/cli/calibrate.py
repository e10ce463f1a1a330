"""``ins_calibrate``: clock offset, lever arm, mount, biases and noise from recordings."""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from functools import partial
from itertools import chain, repeat
from pathlib import Path
from typing import Any

from tqdm import tqdm

from hybrid_ins import kernels, progress
from hybrid_ins.calibration.axes import axes_fault
from hybrid_ins.calibration.calibrate import Calibration, calibrate
from hybrid_ins.calibration.placement import antenna_is_base, with_placement
from hybrid_ins.calibration.recording import Recording, read_recording
from hybrid_ins.calibration.report import innovation_line, parameter_file, table
from hybrid_ins.calibration.trial import Comparison, Trial, compare, run_trial
from hybrid_ins.cli import options, program
from hybrid_ins.errors import InputError
from hybrid_ins.output_file import check_output, resolved, write_text
from hybrid_ins.parameters.parameter_file import check_replaceable
from hybrid_ins.plotting import style
from hybrid_ins.plotting.calibration import figure
from hybrid_ins.replay import log_message
from hybrid_ins.ros.review.axes_monitor import WRONG_UNIT, describe
from hybrid_ins.worker_processes import worker_processes

DESCRIPTION = """\
Estimate from recordings of IMU and GNSS: the offset between their clocks, the lever arm of the
antenna, the IMU's mount, biases and noise levels, each with its uncertainty and whether the motion
made it observable. The noise may go with what noise.model reads in the samples. The random walk of
a bias is written as the root of its mean square over what the recordings allow, so that the
uncertainty stated in an outage holds. The recordings are then replayed with and without what was
found, some fixes withheld: parameters that do not fit, or are worse at these fixes, are not
written. Writes a parameter file for ins_node and ins_replay. Record half a minute or more with
curves, acceleration and braking."""

WORTH_A_PROCESS = 150.0
"""Seconds of recordings whose replay takes about as long as the start of a process."""

KILLED = (
    "a process that replayed a recording was killed, probably for want of memory: a smaller "
    "--longest needs less"
)

EXAMPLE = "ins_calibrate flight1.mcap flight2.mcap --out params.yaml --plot calibration.png"


def main(argv: Sequence[str] | None = None) -> int:
    """Run the program."""
    parser = program.parser("ins_calibrate", DESCRIPTION, EXAMPLE)
    parser.add_argument(
        "bags", metavar="BAG", nargs="+", type=options.path, help="recordings of one robot"
    )
    parser.add_argument(
        "--out", metavar="F", type=options.path, help="parameter file to write (YAML)"
    )
    parser.add_argument(
        "--plot", metavar="F", type=options.path,
        help="picture to write, .png or .svg: likelihood over offset, innovations before and after",
    )  # fmt: skip
    options.add_parameters(
        parser, "nominal parameters: mount, antenna, GNSS bounds; the search starts there"
    )
    parser.add_argument(
        "--offset-per-bag", action="store_true", help="each recording has its own clock offset"
    )
    parser.add_argument(
        "--search", type=options.positive, default=1.5, metavar="S",
        help="search clock offsets within ±S s (default: %(default)s)",
    )  # fmt: skip
    parser.add_argument(
        "--longest", type=options.positive, default=300.0, metavar="S",
        help="use at most S s of each recording, those in which its motion changes most (default: "
        "%(default)g)",
    )  # fmt: skip
    parser.add_argument(
        "--nose-first", action="store_true",
        help="the vehicle moves along its nose: estimate the IMU's yaw in it",
    )  # fmt: skip
    parser.add_argument(
        "--use-truth", action="store_true",
        help="use /truth/odometry for fixes and attitude (for comparison): it gives the "
        "IMU's position, and nothing of the antenna",
    )  # fmt: skip
    options.add_topics(parser)
    parser.add_argument("--overwrite", action="store_true", help="replace the output files")
    parser.add_argument(
        "--force", action="store_true",
        help="write the parameters even if the recordings do not fit, or are worse with them",
    )  # fmt: skip
    return program.run(_body, parser.parse_args(argv))


def _check_different(bags: Sequence[Path]) -> None:
    """Raise `InputError` where a recording is given twice, which would count as two."""
    known: dict[Path, Path] = {}
    for bag in bags:
        place = resolved(bag)
        if place in known:
            alias = "" if known[place] == bag else f", as {known[place]}"
            raise InputError(f"{bag}: is given twice{alias}: give each recording once")
        known[place] = bag


def _body(args: argparse.Namespace) -> int:
    values = options.parameter_values(args)
    _check_different(args.bags)
    inputs = [*args.bags, *([Path(args.params_file)] if args.params_file else [])]
    if args.out:
        check_output(args.out, inputs, args.overwrite)
        check_replaceable(args.out)
    if args.plot:
        style.check(args.plot, inputs, args.overwrite)
    given = values
    values = with_placement(args.bags, given, args.imu_topic, args.fix_topic)
    if values != given:
        log_message("info", f"/tf_static places IMU and antenna in '{values['base_frame']}'")
    recordings = [
        read_recording(
            path,
            values,
            **options.topics(args),
            use_truth=args.use_truth,
            longest=args.longest,
            search=args.search,
        )
        for path in args.bags
    ]
    for recording in recordings:
        if recording.begin > 0.0:
            log_message(
                "info",
                f"{recording.name}: {recording.t[-1]:.0f} s are used, from {recording.begin:.0f} s "
                "on, where the motion changes most: --longest sets how much",
            )
        fault = axes_fault(recording, values)
        if fault is not None:
            wrong = describe(fault)
            if wrong.name == WRONG_UNIT:  # nothing can be found with it
                raise InputError(f"{recording.name}: {args.imu_topic}: {wrong.text}")
            log_message("warn", f"{recording.name}: {wrong.text}")
    kernels.prepare(partial(log_message, "info"), kernels.OFFLINE)
    with _replays(args, recordings) as replay:
        before = () if args.use_truth else replay(values)  # while calibrating, by other processes
        of_base = args.use_truth or antenna_is_base(args.bags, values, args.fix_topic)
        with _Stages() as stages:
            found = calibrate(
                recordings,
                values,
                own_offsets=args.offset_per_bag and len(recordings) > 1,
                search=args.search,
                nose_first=args.nose_first,
                trust_fixes=args.use_truth,
                antenna_is_base=of_base,
                on_stage=stages.start,
                log=log_message,
            )
        comparison, objection = None, ""
        try:
            if not args.use_truth:
                comparison = _compare(chain(before, replay(found.values)), len(args.bags))
        except BrokenProcessPool:
            objection = f"not compared with the given parameters: {KILLED}"
    objection = _objection(found, comparison) or objection
    if args.out and (args.force or not objection):  # before the text: its reader may stop reading
        write_text(args.out, parameter_file(found))
    if args.plot:
        style.save(figure(found), args.plot)
    print(table(found.findings))
    print(innovation_line(found))
    if comparison is not None:
        print(comparison.text())
    if objection and args.out and not args.force:
        raise InputError(f"{objection}; {args.out} is not written: --force writes it all the same")
    if objection:
        log_message("warn", objection)
    if args.out:
        print(f"{args.out}: for ins_node --ros-args --params-file, ins_replay --params-file")
    return 0


@contextmanager
def _replays(
    args: argparse.Namespace, recordings: Sequence[Recording]
) -> Iterator[Callable[[Mapping[str, Any]], Iterable[Trial]]]:
    """
    Yield a function that runs the estimator over each recording with the parameters it is given.

    Other processes begin with that at once, where they are worth their start; otherwise it is done
    when the result is asked for.
    """
    trial = partial(run_trial, topics=options.topics(args))
    parts = [slice(recording.rows[0], recording.rows[-1] + 1) for recording in recordings]
    seconds = sum(recording.t[-1] - recording.t[0] for recording in recordings)
    processors = os.cpu_count() or 1
    workers = min(processors, 2 * len(args.bags), int(2.0 * seconds / WORTH_A_PROCESS))
    if processors == 1 or workers == 0:
        yield lambda values: (
            trial(path, values, rows=rows) for path, rows in zip(args.bags, parts, strict=True)
        )
        return
    with worker_processes(workers) as executor:
        run = partial(_run_elsewhere, trial)
        yield lambda values: executor.map(run, args.bags, repeat(values), parts)


def _compare(trials: Iterable[Trial], count: int) -> Comparison:
    """Compare the first trials, as many as there are recordings, with the others."""
    done = []
    with progress.bar("replay", 2 * count, "run", leave=False) as bar:
        for trial in trials:
            done.append(trial)
            bar.update()
    return compare(done[:count], done[count:])


def _run_elsewhere(
    trial: Callable[..., Trial], path: Path, values: Mapping[str, Any], rows: slice
) -> Trial:
    """Run a trial in a process that may have no kernels yet."""
    kernels.prepare()
    return trial(path, values, rows=rows)


def _objection(found: Calibration, comparison: Comparison | None) -> str:
    """Return why the parameters should not be used; empty if they may."""
    if found.misfits:
        return f"does not fit: check units, axes and mount: {'; '.join(found.misfits)}"
    return "" if comparison is None else comparison.objection


class _Stages:
    """Progress bars, one for each stage, that count passes of the filter."""

    def __init__(self) -> None:
        self._bar: tqdm[None] | None = None

    def __enter__(self) -> _Stages:
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.close()

    def start(self, name: str) -> Callable[[], None]:
        """Show the bar of a stage; returns what counts."""
        self.__exit__()
        bar = self._bar = progress.bar(name, 0, "pass", leave=False)

        def count() -> None:
            bar.update()

        return count


if __name__ == "__main__":
    raise SystemExit(main())
