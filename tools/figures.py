"""
The measured figures that the documentation quotes, each read from the report that measured it.

The reports are written by the commands named beside the figures. `README.md` and `docs/figures.md`
are written from this list by `python -m tools.generate_docs`, so a figure stands in one place only:
its report.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
NUMBER = r"([-+]?\d+(?:\.\d+)?)"

BENCHMARK = "docs/benchmark.md"
CAMPAIGN = "docs/fault_campaign.md"
FIELD = "docs/field_experiment.md"
OUTAGES = "docs/outages.md"
PAPER = "docs/paper_evaluation.md"
ROBUSTNESS = "docs/robustness.md"
TUTORIAL = "docs/tutorial.md"


@dataclass(frozen=True, slots=True)
class Source:
    """
    Where a number stands in a report.

    Attributes
    ----------
    report : str
        Path of the report in the repository.
    after : tuple of str
        Texts that precede the number, in this order; the number is the first one after the last.
    cell : int
        Where the last text is the beginning of a table's row: how many columns to the right.
    """

    report: str
    after: tuple[str, ...]
    cell: int = 0

    def number(self) -> float:
        """Return the number, or raise `ValueError` where the report does not hold it."""
        text = _text(self.report)
        at = 0
        for part in self.after:
            found = text.find(part, at)
            if found < 0:
                raise ValueError(f"{self.report}: no {part!r} to read a figure after")
            at = found + len(part)
        if self.cell:
            row = text[at : text.index("\n", at)].split("|")
            number = re.search(NUMBER, row[self.cell])
        else:
            number = re.search(NUMBER, text[at:])
        if number is None:
            raise ValueError(f"{self.report}: no number after {' … '.join(self.after)!r}")
        return float(number[1])


@cache
def _text(report: str) -> str:
    return (ROOT / report).read_text(encoding="utf-8")


@dataclass(frozen=True, slots=True)
class Figure:
    """
    One line of the tables of figures.

    Attributes
    ----------
    what : str
        What was measured.
    text : str
        The result, with a `str.format` field for each of the sources.
    sources : tuple of Source
        Where its numbers stand.
    command : str
        What measures it, in Markdown.
    in_readme : bool
        It is among the most important ones.
    """

    what: str
    text: str
    sources: tuple[Source, ...]
    command: str
    in_readme: bool = False

    def result(self) -> str:
        """Return the result with its numbers, read from the reports."""
        return self.text.format(*(source.number() for source in self.sources))


def _tutorial(section: str, *labels: str) -> tuple[Source, ...]:
    return tuple(Source(TUTORIAL, (section, "\naccuracy", label)) for label in labels)


def _table(report: str, *rows: tuple[str, int]) -> tuple[Source, ...]:
    return tuple(Source(report, (f"\n| {label} |",), cell) for label, cell in rows)


def _field(table: str, *rows: tuple[str, int]) -> tuple[Source, ...]:
    return tuple(Source(FIELD, (table, f"\n| {label} |"), cell) for label, cell in rows)


BENCH = "`python -m tools.benchmark.run`"
ONLINE = "online 5 Hz, nor the heading known"

GROUPS: dict[str, tuple[Figure, ...]] = {
    "Accuracy": (
        Figure(
            "A real flight of 40 s, 5 Hz fixes with σ = 0.1 m, calibrated",
            "RMS position error {:.3f} m, NEES/3 {:.2f}, NIS/3 {:.2f}",
            _tutorial("## 4. ", "PRMSE", "position NEES", "position NIS"),
            "[tutorial, step 4](tutorial.md#4-compare-with-the-truth)",
            in_readme=True,
        ),
        Figure(
            "The same flight, 10 s without fixes",
            "{:.1f} m off at their end",
            (Source(TUTORIAL, ("## 6. ", "error at their ends: median")),),
            "[tutorial, step 6](tutorial.md#6-without-gnss)",
        ),
        Figure(
            "Twelve real flights with four IMUs each, calibrated, fixes at 5 Hz and at 1 Hz",
            "RMS position error {:.3f} m and {:.3f} m; with the best constant process noise of the "
            "flights' other session {:.3f} m and {:.3f} m; with the paper's best constant {:.3f} m "
            "and {:.3f} m",
            (
                *_field("5 Hz: PRMSE", ("HB-AEKF, ours", 0)),
                *_field("1 Hz: PRMSE", ("HB-AEKF, ours", 0)),
                *_field("5 Hz: PRMSE", ("tuned on the other session", 0)),
                *_field("1 Hz: PRMSE", ("tuned on the other session", 0)),
                *_field("5 Hz: PRMSE", ("MB-EKF-CQ3", 0)),
                *_field("1 Hz: PRMSE", ("MB-EKF-CQ3", 0)),
            ),
            "[field experiment](field_experiment.md)",
            in_readme=True,
        ),
        Figure(
            "The same flights, 10 s without fixes",
            "{:.2f} m off at their end (median); with the paper's best constant {:.1f} m, with its "
            "network {:.1f} m",
            _field(
                "## Outages of 10 s",
                ("HB-AEKF, ours", 0),
                ("MB-EKF-CQ3", 0),
                ("HB-AEKF, paper's network", 0),
            ),
            "[field experiment](field_experiment.md)",
            in_readme=True,
        ),
        Figure(
            "The same flights, nothing calibrated, clocks 0.1 s to 0.37 s apart, 5 Hz",
            "RMS position error {:.3f} m, NIS/3 {:.2f}",
            tuple(
                Source(FIELD, ("\n| published 5 Hz | HB-AEKF, ours |",), cell) for cell in (0, 3)
            ),
            "[field experiment](field_experiment.md)",
        ),
        Figure(
            "The same, with clock offset and heading estimated in flight",
            "after 20 s the clock offset is wrong by {:.0f} ms (median), {:.0f} ms (worst run)",
            _field("Clock offset in force", (ONLINE, 0), (ONLINE, 2)),
            "[field experiment](field_experiment.md)",
        ),
        Figure(
            "A real car in a town (KITTI), 30 s without fixes at about 9 m/s, never tuned on",
            "{:.1f} m off at their end (median), calibrated {:.1f} m; without the constraint of "
            "wheels {:.1f} m",
            tuple(
                Source(OUTAGES, (f"\n| 30 s, {parameters} |", "|"))
                for parameters in ("default", "calibrated", "no constraint")
            ),
            "[outages](outages.md#a-real-car)",
            in_readme=True,
        ),
    ),
    "Process noise from the IMU": (
        Figure(
            "The paper's test set, on which our model was not trained",
            "RMSE of q {:.5f}; the paper's network, rebuilt, {:.5f}; theoretical bound {:.5f}",
            (
                *_table(PAPER, ("ours, paper's set, never trained on it: q RMSE", 0)),
                *_table(PAPER, ("paper's network, paper's set, random split: q RMSE", 0)),
                Source(PAPER, ("Cramér–Rao bound of the set is",)),
            ),
            "`python -m tools.paper.evaluate`",
        ),
        Figure(
            "Simulated flights, noise that switches by a factor of up to 20, 200 Hz",
            "RMS position error {:.3f} times that of a filter that is given the true noise; "
            "{:.0f} % below the paper's best constant, {:.0f} % below its best innovation-based Q; "
            "NEES {:.1f} of 15",
            (
                *_table(PAPER, ("switching noise, 200 Hz: PRMSE, ours / oracle", 0)),
                Source(PAPER, ("200 Hz: better than CQ3 by", "|")),
                Source(PAPER, ("200 Hz: better than best stable AQ by", "|")),
                *_table(PAPER, ("switching noise, 200 Hz: NEES of ours", 0)),
            ),
            "`python -m tools.paper.evaluate`",
            in_readme=True,
        ),
        Figure(
            "The same with GNSS outages",
            "{:.3f} times; {:.0f} % and {:.0f} % below",
            (
                *_table(PAPER, ("switching noise, 200 Hz, outages: PRMSE, ours / oracle", 0)),
                Source(PAPER, ("200 Hz, outages: better than CQ3 by", "|")),
                Source(PAPER, ("200 Hz, outages: better than best stable AQ by", "|")),
            ),
            "`python -m tools.paper.evaluate`",
        ),
    ),
    "Robustness": (
        Figure(
            "Runs with named faults: NaN, wrong units, frozen and saturated sensors, lost and late "
            "data, clock jumps, wrong axes, false fixes; replayed and live",
            "{:.0f} runs, {:.0f} failed",
            (
                Source(CAMPAIGN, ("--report docs/fault_campaign.md\n",)),
                Source(CAMPAIGN, (" runs,",)),
            ),
            "[fault campaign](fault_campaign.md)",
            in_readme=True,
        ),
        Figure(
            "Heading from motion, from twelve initial headings, recorded and simulated",
            "{:.0f} runs: within 5° after 20 s of motion in {:.1f} %; in the others its σ "
            "shows the error",
            _table(ROBUSTNESS, ("all", 0), ("all", 1)),
            "[robustness](robustness.md#heading-from-motion)",
            in_readme=True,
        ),
        Figure(
            "Random messages and broken files",
            "100 000 messages and {:.0f} files: no exception, no NaN, no traceback",
            (Source(ROBUSTNESS, ("## Broken files",)),),
            "[robustness](robustness.md#random-messages)",
        ),
    ),
    "Speed, on two processors": (
        Figure(
            "One IMU sample through mechanisation and covariance",
            "{:.1f} µs live, {:.1f} µs in a batch; careful NumPy {:.0f} µs",
            _table(BENCHMARK, ("live step", 0), ("batch step", 0), ("careful NumPy", 0)),
            BENCH,
        ),
        Figure(
            "CPU of the node with IMU data at 200 Hz and 1 kHz, a clock offset being searched",
            "{:.0f} % and {:.0f} % of a core; an rclpy node that only publishes empty Odometry "
            "{:.0f} % and {:.0f} %",
            (
                Source(BENCHMARK, ("CPU at 200 Hz (naive", "|")),
                Source(BENCHMARK, ("CPU at 1000 Hz (naive", "|")),
                Source(BENCHMARK, ("CPU at 200 Hz (naive",)),
                Source(BENCHMARK, ("CPU at 1000 Hz (naive",)),
            ),
            BENCH,
            in_readme=True,
        ),
        Figure(
            "Latency from IMU stamp to odometry at 1 kHz, likewise",
            "{:.2f} ms (median), {:.2f} ms (99th percentile)",
            (
                Source(BENCHMARK, ("latency p50 at 1000 Hz", "|")),
                Source(BENCHMARK, ("latency p99 at 1000 Hz", "|")),
            ),
            BENCH,
            in_readme=True,
        ),
        Figure(
            "Highest IMU rate without a lost sample in a minute",
            "{:.0f} Hz",
            _table(BENCHMARK, ("IMU rate without loss", 0)),
            BENCH,
        ),
        Figure(
            "Replay at 200 Hz, bag to bag",
            "{:.0f} times real time",
            _table(
                BENCHMARK, ("ins_replay, bag to bag (the whole process, its start included)", 0)
            ),
            BENCH,
            in_readme=True,
        ),
        Figure(
            "Memory of the node",
            "{:.0f} MB",
            (Source(BENCHMARK, ("\n| memory (naive", "|")),),
            BENCH,
            in_readme=True,
        ),
    ),
}


PREAMBLE = """\
# Measured figures

Each figure with what measures it. This page is written by `python -m tools.generate_docs` from the
reports that the commands write; do not edit it. The reports hold the conditions and distributions.

NEES and NIS are the squared errors of the estimate and of the innovations in units of their own
covariances. Divided by their dimension they are 1 on average where the covariances are right.
"""


def short_table() -> str:
    """Return the README's table: the most important figures, links relative to the root."""
    rows = [
        f"| {figure.what} | {figure.result()} |"
        for figures in GROUPS.values()
        for figure in figures
        if figure.in_readme
    ]
    return "\n".join(["| what | result |", "|---|---|", *rows, ""])


def page() -> str:
    """Return `docs/figures.md`."""
    parts = [PREAMBLE]
    for title, figures in GROUPS.items():
        rows = [f"| {f.what} | {f.result()} | {f.command} |" for f in figures]
        parts.append(
            "\n".join([f"## {title}\n", "| what | result | from |", "|---|---|---|", *rows, ""])
        )
    return "\n".join(parts)
