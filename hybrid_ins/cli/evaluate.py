"""``ins_evaluate``: accuracy and consistency of an estimate."""

from __future__ import annotations

import argparse
import io
import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from hybrid_ins import batch
from hybrid_ins.cli import options, program
from hybrid_ins.errors import InputError
from hybrid_ins.evaluation import report
from hybrid_ins.evaluation.evaluate import evaluate_run
from hybrid_ins.evaluation.result import GNSS_CLOCK, IMU_CLOCK, Result, Scoring
from hybrid_ins.evaluation.run import Run, Topics
from hybrid_ins.evaluation.run_reader import read_run
from hybrid_ins.evaluation.table import summary, table
from hybrid_ins.export.writer import check_export, export_run
from hybrid_ins.output_file import write_text
from hybrid_ins.plotting import style
from hybrid_ins.plotting.comparison import MOST_RUNS, comparison
from hybrid_ins.plotting.overview import overview
from hybrid_ins.resources import printable

DESCRIPTION = """\
Compare an estimate with the truth: PRMSE and PMAE, velocity and attitude RMSE, consistency of the
covariances (NEES, NIS with 95 % bands), and the error at the end of outages.

The estimate is interpolated to the epochs of the truth. Truth epochs at the stamp of a fix are not
scored: the filter was given these positions. Truth and GNSS share a clock, unless --truth-clock
says otherwise; its offset to the IMU clock is read from gnss/verdict. The datums of the bags may
differ. Without --skip, scoring begins with the first estimate whose heading is known."""

EXAMPLE = "ins_evaluate flight_estimate --truth flight.mcap --plot flight.png"


def main(argv: Sequence[str] | None = None) -> int:
    """Run the program ``ins_evaluate``."""
    parser = program.parser("ins_evaluate", DESCRIPTION, EXAMPLE)
    parser.add_argument(
        "estimate", metavar="EST", type=options.path, nargs="+",
        help="bag with the filter's output; several, or a folder of bags",
    )  # fmt: skip
    parser.add_argument(
        "--truth", metavar="BAG", type=options.path, help="bag with truth (default EST)"
    )
    parser.add_argument("--no-truth", action="store_true", help="evaluate NIS and fixes only")
    parser.add_argument("--json", action="store_true", help="print JSON instead of the table")
    parser.add_argument(
        "--plot", metavar="FILE", type=options.path,
        help="write a picture, .png or .svg; of several bags, an overlay of their runs",
    )  # fmt: skip
    parser.add_argument(
        "--export", metavar="FILE", type=options.path, action="append", default=[],
        help="write the estimate for other tools, by suffix: .tum, .csv, .kml, .gpx or .geojson; "
        "may be repeated",
    )  # fmt: skip
    parser.add_argument(
        "--report", metavar="FILE", type=options.path,
        help="write an HTML report with questions and answers, picture and table",
    )  # fmt: skip
    parser.add_argument(
        "--overwrite", action="store_true", help="replace FILE of --plot, --export and --report"
    )

    defaults = Scoring()
    scoring = parser.add_argument_group("scoring")
    scoring.add_argument(
        "--skip", metavar="S", type=options.not_negative, default=defaults.skip,
        help="do not score the first S seconds with an estimate (default %(default)s)",
    )  # fmt: skip
    scoring.add_argument(
        "--start", metavar="S", type=options.not_negative,
        help="begin S seconds after the first truth epoch",
    )  # fmt: skip
    scoring.add_argument(
        "--end", metavar="S", type=options.not_negative,
        help="end S seconds after the first truth epoch",
    )  # fmt: skip
    scoring.add_argument(
        "--include-fed", action="store_true", help="also score truth epochs at fix stamps"
    )
    scoring.add_argument(
        "--time-offset", metavar="S", type=options.number,
        help="seconds to add to stamps of the fixes' clock (default: from gnss/verdict, else 0)",
    )  # fmt: skip
    scoring.add_argument(
        "--truth-clock", choices=(GNSS_CLOCK, IMU_CLOCK), default=defaults.truth_clock,
        help="whose clock the truth has: that of the fixes, or, as the estimate of another "
        "program, that of the IMU (default %(default)s)",
    )  # fmt: skip
    scoring.add_argument(
        "--max-gap", metavar="S", type=options.not_negative, default=defaults.max_gap,
        help="longest gap between estimates to interpolate (default %(default)s)",
    )  # fmt: skip
    scoring.add_argument(
        "--outage-gap", metavar="S", type=options.not_negative, default=defaults.outage_gap,
        help="shortest time without an accepted fix that is an outage (default %(default)s)",
    )  # fmt: skip

    options.add_batch(parser).add_argument(
        "--results", metavar="DIR", type=options.path,
        help="keep the result of each bag there; the same command again evaluates only new bags",
    )  # fmt: skip

    names = parser.add_argument_group("topics")
    topics = Topics()
    for option, default in (
        ("--odometry", topics.odometry),
        ("--truth-topic", topics.truth),
        ("--fix", topics.fix),
        ("--verdict", topics.verdict),
    ):
        names.add_argument(option, metavar="TOPIC", default=default, help="default %(default)s")
    return program.run(_run, parser.parse_args(argv))


def _run(args: argparse.Namespace) -> int:
    inputs = [*args.estimate, *filter(None, [args.truth])]
    if args.plot is not None:
        style.check(args.plot, inputs, args.overwrite)
    if args.report is not None:
        report.check(args.report, inputs, args.overwrite)
        style.require_matplotlib()
    for path in args.export:
        check_export(path, inputs, args.overwrite)
    if args.no_truth and args.truth is not None:
        raise InputError("--truth and --no-truth exclude each other")
    topics = Topics(
        odometry=args.odometry,
        truth=args.truth_topic,
        truth_datum=f"{args.truth_topic.rpartition('/')[0]}/datum",
        fix=args.fix,
        verdict=args.verdict,
    )
    scoring = Scoring(
        args.skip,
        args.start,
        args.end,
        args.time_offset,
        args.include_fed,
        args.max_gap,
        args.outage_gap,
        args.truth_clock,
    )
    if len(args.estimate) > 1 or not batch.is_bag(args.estimate[0]):
        if args.json or args.report or args.export:
            raise InputError("--json, --report and --export are for one bag at a time")
        return _evaluate_many(args, topics, scoring)
    if args.results:
        raise InputError("--results is for several bags, or a folder of bags")
    [path] = args.estimate
    run = _read(path, truth=args.truth, topics=topics, no_truth=args.no_truth)
    result = evaluate_run(run, scoring)
    written = _write_files(args, run, result)
    if args.json:
        bags = {"estimate": str(path), "truth": str(args.truth or path)}
        print(json.dumps({**bags, **result.as_dict()}, indent=2, allow_nan=False))
    else:
        print(table(result))
        for kind, file in written:
            print(f"{kind}: {file}")
    return 0


def _write_files(args: argparse.Namespace, run: Run, result: Result) -> list[tuple[str, Path]]:
    """Write picture, report and trajectories; return the kind and path of each."""
    written: list[tuple[str, Path]] = []
    if args.plot is not None:
        style.save(overview(run, result), args.plot)
        written.append(("picture", args.plot))
    if args.report is not None:
        picture = io.BytesIO()
        style.write(overview(run, result), picture, "png")
        write_text(args.report, report.page(run, result, picture.getvalue()))
        written.append(("report", args.report))
    for path in args.export:
        export_run(run, path)
        written.append(("trajectory", path))
    return written


def _evaluate_many(args: argparse.Namespace, topics: Topics, scoring: Scoring) -> int:
    read = partial(_read, truth=args.truth, topics=topics, no_truth=args.no_truth)
    settings = {
        "topic": vars(topics),
        "scoring": vars(scoring),
        "truth": args.truth,
        "no_truth": args.no_truth,
    }
    jobs = batch.find_jobs(args.estimate, args.results)
    if args.plot is not None and len(jobs) > MOST_RUNS:
        raise InputError(f"--plot overlays at most {MOST_RUNS} runs, not {len(jobs)}")
    work = partial(_evaluate_one, read, scoring)
    status = batch.run(jobs, work, settings, workers=args.jobs, cluster=args.dask)
    if args.plot is not None:
        runs = [(printable(job.name), read(job.source)) for job in jobs]
        evaluated = [(name, run, evaluate_run(run, scoring)) for name, run in runs]
        style.save(comparison(evaluated), args.plot)
        print(f"picture: {args.plot}")
    return status


def _read(path: Path, *, truth: Path | None, topics: Topics, no_truth: bool) -> Run:
    run = read_run(path, truth, topics)
    if no_truth:
        return replace(run, truth=None)
    if run.truth is None:
        raise InputError(
            f"{path}: no truth on {topics.truth}: give its bag with --truth, or evaluate without "
            "truth with --no-truth"
        )
    return run


def _evaluate_one(
    read: Callable[[Path], Run], scoring: Scoring, job: batch.Job
) -> dict[str, float | int | None]:
    """Evaluate one bag of many."""
    return summary(evaluate_run(read(job.source), scoring))


if __name__ == "__main__":
    raise SystemExit(main())
