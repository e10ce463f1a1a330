"""
Put the paper's tables and figures beside ours: noise estimators, then navigation with their levels.

Or & Klein, "A hybrid model and learning-based adaptive navigation filter", IEEE TIM 2022. One
command draws every data set and every flight from fixed seeds, and writes a report in Markdown
with its figures.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from hybrid_ins.cli import options, program
from hybrid_ins.plotting import style
from tools.paper.estimators import estimators
from tools.paper.navigation import navigation
from tools.paper.report import Bar, table

FIGURES = ("paper_fig4", "paper_fig6", "paper_fig9", "paper_fig10")
ORACLE_TEXT = """\
Where the target for the gain over another method is missed, compare with the oracle's own gain in
brackets: the oracle is given the true noise at every instant, and ours does as well. Between fixes
of 0.1 m every 0.2 s these flights do not allow a larger gain; in outages they do."""


def evaluate(args: argparse.Namespace) -> int:
    """Do it all and write the report."""
    args.figures = args.out / "figures"
    args.figures.mkdir(parents=True, exist_ok=True)
    for name in FIGURES:
        style.check(args.figures / f"{name}.png", overwrite=True)
    if args.quick:
        args.runs = 2
    bars: list[Bar] = []
    parts = [*estimators(args, bars), *navigation(args, bars)]
    quick = (
        [
            "**Quick mode: a few windows and flights, to see that the program works. "
            "Its figures mean nothing.**"
        ]
        if args.quick
        else []
    )
    head = [
        "# The paper's evaluation, with ours",
        'Or & Klein, "A hybrid model and learning-based adaptive navigation filter", IEEE TIM '
        "2022.",
        *quick,
        f"Made by `python -m tools.paper.evaluate --runs {args.runs}"
        f"{' --quick' if args.quick else ''}{' --by-window FOLDER' if args.by_window else ''}"
        f"{''.join(f' --without {words!r}' for words in args.without)}`.",
        "## Targets and results",
        table(("figure", "measured [95 %]", "bar", "stretch", "met"), ()),
    ]
    head[-1] += "\n" + "\n".join(bar.row() for bar in bars)
    if any("(the oracle:" in row and "**no**" in row for row in head[-1].splitlines()):
        head.append(ORACLE_TEXT)
    report = args.out / "paper_evaluation.md"
    report.write_text("\n\n".join((*head, *parts)) + "\n", encoding="utf-8")
    print(report)
    return 0


def main(argv: Sequence[str] | None = None) -> int:
    """Run the program."""
    parser = program.parser(
        "evaluate_paper", __doc__ or "", "python -m tools.paper.evaluate --jobs 2"
    )
    parser.add_argument("--out", type=Path, default=Path("docs"), help="folder to write to [docs]")
    parser.add_argument("--runs", type=options.count, default=24, help="flights per table [24]")
    parser.add_argument("--jobs", type=options.count, default=1, help="processes [1]")
    parser.add_argument(
        "--by-window",
        type=Path,
        metavar="FOLDER",
        help="holds paper_N.onnx, plateau_N.onnx for Fig. 4's windows N",
    )
    parser.add_argument(
        "--without",
        action="append",
        default=[],
        metavar="WORDS",
        help="leave out scenarios with these words in their name; may be repeated",
    )
    parser.add_argument(
        "--keep",
        type=Path,
        metavar="FOLDER",
        help="keep flights here, and take those that an interrupted run kept",
    )
    parser.add_argument("--quick", action="store_true", help="a minute, to see that it works")
    args = parser.parse_args(argv)
    if args.runs < 2:
        parser.error("--runs: at least 2")
    return program.run(evaluate, args)


if __name__ == "__main__":
    sys.exit(main())
