"""The program ``ins_replay``: recorded runs through the node's estimator."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from hybrid_ins import batch, kernels
from hybrid_ins.bags.reader import InputTopics
from hybrid_ins.cli import options, program
from hybrid_ins.errors import InputError
from hybrid_ins.export.writer import check_export, export_bag
from hybrid_ins.parameters import Values
from hybrid_ins.plotting import style
from hybrid_ins.plotting.overview import plot_bag
from hybrid_ins.replay import log_message, replay_bag


def main(argv: Sequence[str] | None = None) -> int:
    """Run the program."""
    return program.run(_run, _parser().parse_intermixed_args(argv))


def _parser() -> argparse.ArgumentParser:
    parser = program.parser(
        "ins_replay",
        "Estimate a recorded run: IMU and GNSS from a bag (rosbag2 MCAP or SQLite, ROS 1) through\n"
        "the node's own estimator, without middleware, faster than real time and repeatably.\n"
        "The output bag holds the node's topics, the fixes and any truth: ready for ins_evaluate.",
        "ins_replay flight.mcap estimate.mcap --params-file params.yaml\n"
        "  ins_replay flights/ estimates/     all bags in a folder; again to resume",
    )
    parser.add_argument(
        "input",
        metavar="IN",
        nargs="+",
        type=options.path,
        help="bag with sensor_msgs/Imu and NavSatFix; several, or a folder of bags",
    )
    parser.add_argument(
        "output",
        metavar="OUT",
        type=options.path,
        help="bag to write (directory, or *.mcap file); the folder for several",
    )
    options.add_parameters(parser, "parameter file, the same as the node's")
    options.add_topics(parser)
    parser.add_argument(
        "--smooth",
        action="store_true",
        help="write smoothed states: each uses the measurements after it, too",
    )
    parser.add_argument(
        "--overwrite", action="store_true", help="replace OUT, and the FILEs written"
    )
    parser.add_argument(
        "--plot",
        metavar="FILE",
        type=options.path,
        help="draw the run, with errors where IN holds truth: .png or .svg",
    )
    parser.add_argument(
        "--export",
        metavar="FILE",
        type=options.path,
        action="append",
        default=[],
        help="write the track for other tools, by suffix: .tum, .csv, .kml, .gpx or .geojson; "
        "may be repeated",
    )
    options.add_batch(parser)
    return parser


def _run(args: argparse.Namespace) -> int:
    values, topics = options.parameter_values(args), options.topics(args)
    if len(args.input) > 1 or not batch.is_bag(args.input[0]):
        if args.plot is not None or args.export:
            raise InputError("--plot and --export are for one bag at a time")
        jobs = batch.find_jobs(args.input, args.output)
        kernels.prepare(partial(log_message, "info"), (kernels.SMOOTHING,) if args.smooth else ())
        used = {name: value for name, value in values.items() if name != "state_file"}
        settings = {"parameter": used, "topic": topics, "smooth": args.smooth}
        replay = partial(_replay_one, values, topics, args.smooth)
        return batch.run(
            jobs,
            replay if args.overwrite else partial(_replay_new, replay, settings),
            settings,
            output=_target,
            redo=args.overwrite,
            workers=args.jobs,
            cluster=args.dask,
        )
    read = [*args.input, args.output, *([Path(args.params_file)] if args.params_file else [])]
    if args.plot is not None:
        style.check(args.plot, read, args.overwrite)
    for path in args.export:
        check_export(path, read, args.overwrite)
    [source] = args.input
    replayed = replay_bag(
        source, args.output, values, topics, overwrite=args.overwrite, smooth=args.smooth
    )
    print(replayed.estimator.status.summary())
    if args.plot is not None:
        plot_bag(args.output, args.plot)
        print(f"picture: {args.plot}")
    for path in args.export:
        export_bag(args.output, path)
        print(f"trajectory: {path}")
    return 0


def _target(job: batch.Job) -> Path:
    assert job.record is not None
    return job.record.with_suffix(".mcap")


def _replay_new(
    replay: Callable[[batch.Job], batch.Row], settings: Mapping[str, Any], job: batch.Job
) -> batch.Row:
    """Replay one bag of many, unless there is an output already, which is another's."""
    target = _target(job)
    if target.exists():
        assert job.record is not None
        if not job.record.exists():
            raise InputError(
                f"{target} exists, but no record of its making: --overwrite to replace it"
            )
        raise InputError(
            f"{target} was made otherwise ({batch.changes(job, settings)}): --overwrite to replace "
            "it, or choose another folder"
        )
    return replay(job)


def _replay_one(values: Values, topics: InputTopics, smooth: bool, job: batch.Job) -> batch.Row:
    """Replay one bag of many; its output appears under its name once it is complete."""
    target = _target(job)
    levels: list[str] = []
    replayed = replay_bag(
        job.source,
        target,
        values,
        topics,
        overwrite=True,
        keep_partial=False,
        smooth=smooth,
        log=lambda level, text: levels.append(level),
    )
    return {
        "duration [s]": replayed.duration,
        "fixes fused": replayed.estimator.reporter.fixes_fused,
        "refused or remarkable": sum(replayed.estimator.inputs.counts.values()),
        "warnings": levels.count("warn"),
    }


if __name__ == "__main__":
    raise SystemExit(main())
