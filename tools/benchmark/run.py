"""
Measure this package, and its peers beside it, in one run.

    python -m tools.benchmark.run                         all of it, a quarter of an hour
    python -m tools.benchmark.run --only kernel replay    some sections
    python -m tools.benchmark.run --report docs/benchmark.md --json benchmark.json

Contenders take turns, so that a busy machine is busy for all of them; every figure is the median
of its repetitions with their quartiles. Peers that are not installed are left out, and the table
says so: pip install -e '.[benchmark]' brings them.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
import traceback
from collections.abc import Callable, Sequence

from hybrid_ins import kernels
from hybrid_ins.cli import options, program
from hybrid_ins.output_file import check_output
from tools.benchmark import kernel, node, replay
from tools.benchmark.table import Section, machine, markdown, plain

SECTIONS: dict[str, Callable[[bool], Section]] = {
    "kernel": kernel.measure,
    "node": node.measure,
    "rate": node.measure_rate,
    "start": node.measure_start,
    "replay": replay.measure,
    "calibration": replay.measure_calibration,
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run the sections that are asked for, and write what they gave."""
    parser = program.parser("benchmark", __doc__ or "")
    parser.add_argument(
        "--only",
        nargs="+",
        choices=list(SECTIONS),
        default=list(SECTIONS),
        metavar="SECTION",
        help=f"of {', '.join(SECTIONS)} [all]",
    )
    parser.add_argument(
        "--quick",
        action="store_true",
        help="few and short repetitions: shows that it works, not how fast",
    )
    parser.add_argument("--json", type=options.path, metavar="FILE", help="write every repetition")
    parser.add_argument(
        "--report", type=options.path, metavar="FILE", help="write the tables as Markdown"
    )
    return program.run(_body, parser.parse_args(argv))


def _body(args: argparse.Namespace) -> int:
    for path in filter(None, (args.json, args.report)):
        check_output(path, overwrite=True)
    about = machine()
    print(f"{about['processor']}, {about['processors']} processors, load {about['load']}")
    kernels.prepare(print, kernels.OFFLINE)
    done: list[Section] = []
    start = time.monotonic()
    for name in args.only:
        try:
            section = SECTIONS[name](args.quick)
        except Exception as error:  # the other sections are worth having
            section = Section(name.capitalize(), remarks=[f"failed: {error}"])
            traceback.print_exc()
        done.append(section)
        print(f"\n{section.title}\n{plain(section.rows())}", flush=True)
        for caption, rows in section.tables:
            print(f"\n{caption}\n{plain(rows)}")
        for remark in section.remarks:
            print(f"- {remark}")
    about["minutes"] = round((time.monotonic() - start) / 60.0, 1)
    about["load_after"] = round(os.getloadavg()[0], 2)
    if args.json:
        args.json.write_text(
            json.dumps(
                {
                    "machine": about,
                    "sections": [
                        {
                            "title": s.title,
                            "figures": [f.as_dict() for f in s.figures],
                            "tables": s.tables,
                            "remarks": s.remarks,
                        }
                        for s in done
                    ],
                },
                indent=1,
            )
        )
    if args.report:
        args.report.write_text(report(about, done))
    missed = [f.name for s in done for f in s.figures if f.verdict == "NO"]
    print(
        f"\n{about['minutes']} minutes, load {about['load']} before and {about['load_after']} "
        f"after; bars missed: {', '.join(missed) or 'none'}"
    )
    return 0 if all(section.figures for section in done) else 1


def report(about: dict[str, object], sections: Sequence[Section]) -> str:
    """Return the document."""
    packages = about["packages"]
    assert isinstance(packages, dict)
    lines = [
        "# Benchmark",
        "",
        "Written by `python -m tools.benchmark.run --report docs/benchmark.md`; do not edit.",
        "",
        f"{about['time']}, {about['processor']} ({about['processors']} processors), Python "
        f"{about['python']}, {', '.join(f'{k} {v}' for k, v in packages.items())}. Load average "
        f"{about['load']} before and {about['load_after']} after the run of {about['minutes']} "
        "minutes; what the machine's noise does to a figure shows in its quartiles.",
        "",
    ]
    for section in sections:
        lines += [f"## {section.title}", "", markdown(section.rows()), ""]
        for caption, rows in section.tables:
            lines += [f"{caption}:", "", markdown(rows), ""]
        lines += [f"- {remark}" for remark in section.remarks] + [""]
    return "\n".join(lines).rstrip() + "\n"


if __name__ == "__main__":
    sys.exit(main())
