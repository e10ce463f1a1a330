"""Figures that a benchmark measures: what repeated runs gave, and how it compares with its bar."""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

PACKAGES = ("numpy", "numba", "onnxruntime", "rosbags", "ros-jazzy-rclpy", "filterpy", "gtsam")


@dataclass
class Figure:
    """
    One line of the table.

    Attributes
    ----------
    name, unit : str
        What was measured.
    values : list of float
        One for each repetition.
    bar, stretch : float, optional
        What it has to reach, and what would be better still.
    higher : bool
        More is better.
    note : str
        What it depends on.
    """

    name: str
    unit: str
    values: list[float]
    bar: float | None = None
    stretch: float | None = None
    higher: bool = False
    note: str = ""

    @property
    def median(self) -> float:
        """Median of the repetitions; NaN without any."""
        return float(np.median(self.values)) if self.values else float("nan")

    @property
    def quartiles(self) -> tuple[float, float]:
        """Half of the repetitions lie between these."""
        if not self.values:
            return float("nan"), float("nan")
        low, high = np.quantile(self.values, [0.25, 0.75])
        return float(low), float(high)

    @property
    def verdict(self) -> str:
        """Whether the bar is met: stretch, yes, NO; empty without one."""
        if self.bar is None:
            return ""
        sign = -1.0 if self.higher else 1.0
        if self.stretch is not None and sign * self.median <= sign * self.stretch:
            return "stretch"
        return "yes" if sign * self.median <= sign * self.bar else "NO"

    def as_dict(self) -> dict[str, Any]:
        """For the JSON file."""
        return {
            **asdict(self),
            "median": self.median,
            "quartiles": self.quartiles,
            "verdict": self.verdict,
        }


@dataclass
class Section:
    """
    The figures of one part of the benchmark.

    Attributes
    ----------
    title : str
        Its heading.
    figures : list of Figure
        Its lines.
    remarks : list of str
        How it was measured, what was left out.
    tables : list of (str, list of list of str)
        Further tables: a caption, and rows, the first of them the heads.
    """

    title: str
    figures: list[Figure] = field(default_factory=list)
    remarks: list[str] = field(default_factory=list)
    tables: list[tuple[str, list[list[str]]]] = field(default_factory=list)

    def add(self, *args: Any, **kwargs: Any) -> Figure:
        """Append a figure, see `Figure`."""
        figure = Figure(*args, **kwargs)
        self.figures.append(figure)
        return figure

    def rows(self) -> list[list[str]]:
        """Return the table of the figures, heads first."""
        rows = [["", "median", "quartiles", "n", "bar", "stretch", "met"]]
        for f in self.figures:
            name = f.name + (f" ({f.note})" if f.note else "")
            rows.append(
                [
                    name,
                    f"{number(f.median)} {f.unit}".strip(),
                    "–".join(number(q) for q in f.quartiles),
                    str(len(f.values)),
                    _bound(f.bar, f.higher),
                    _bound(f.stretch, f.higher),
                    f.verdict,
                ]
            )
        return rows


def ratios(top: Iterable[float], bottom: Iterable[float]) -> list[float]:
    """Ratios of figures that were measured side by side, repetition by repetition."""
    return [a / b for a, b in zip(top, bottom, strict=False)]


def number(value: float) -> str:
    """Three significant digits."""
    if not np.isfinite(value):
        return "-"
    if abs(value) >= 1000.0:
        return f"{value:.0f}"
    text = f"{value:#.3g}".rstrip(".")
    return text if "e" not in text else f"{value:.1e}"


def _bound(value: float | None, higher: bool) -> str:
    return "" if value is None else ("≥ " if higher else "≤ ") + f"{value:g}"


def plain(rows: Sequence[Sequence[str]]) -> str:
    """Return a table for a terminal."""
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    return "\n".join(
        "  ".join(
            cell.ljust(w) if k == 0 else cell.rjust(w)
            for k, (cell, w) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    )


def markdown(rows: Sequence[Sequence[str]]) -> str:
    """Return a table for a document."""
    lines = ["| " + " | ".join(row) + " |" for row in rows]
    lines.insert(1, "|" + "|".join([" --- ", *([" ---: "] * (len(rows[0]) - 1))]) + "|")
    return "\n".join(lines)


def machine() -> dict[str, Any]:
    """Say on what it was measured, and how busy that was."""
    model = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.exists():
        names = [
            line.partition(":")[2].strip()
            for line in info.read_text().splitlines()
            if line.startswith("model name")
        ]
        model = names[0] if names else model
    versions = {}
    for name in PACKAGES:
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return {
        "processor": model,
        "processors": os.cpu_count(),
        "system": platform.platform(),
        "python": platform.python_version(),
        "packages": versions,
        "load": round(os.getloadavg()[0], 2),
        "time": time.strftime("%Y-%m-%d %H:%M:%S UTC", time.gmtime()),
    }
