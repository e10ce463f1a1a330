"""What a report is made of: tables in Markdown, and figures beside what they have to reach."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from hybrid_ins.evaluation.statistics import Ratio


class Bar(NamedTuple):
    """What is to be reached: a figure, its limits (a value within both is sound) and stretch."""

    name: str
    value: float
    bar: tuple[float, float]
    stretch: tuple[float, float] | None = None
    interval: str = ""

    def row(self) -> str:
        """Return a line of a Markdown table."""

        def text(limits: tuple[float, float] | None) -> str:
            if limits is None:
                return "–"
            low, high = limits
            if low == -np.inf:
                return f"≤ {high:g}"
            return f"≥ {low:g}" if high == np.inf else f"{low:g} – {high:g}"

        def met(limits: tuple[float, float] | None) -> bool:
            return limits is not None and limits[0] <= self.value <= limits[1]

        verdict = "stretch" if met(self.stretch) else "yes" if met(self.bar) else "**no**"
        return (
            f"| {self.name} | {self.value:.4g}{self.interval} | {text(self.bar)} | "
            f"{text(self.stretch)} | {verdict} |"
        )


def at_most(bar: float, stretch: float) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return two limits from above."""
    return (-np.inf, bar), (-np.inf, stretch)


def at_least(bar: float, stretch: float) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return two limits from below."""
    return (bar, np.inf), (stretch, np.inf)


def table(heads: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Return a Markdown table."""
    lines = ["| " + " | ".join(heads) + " |", "|---" * len(heads) + "|"]
    lines += ["| " + " | ".join(map(str, row)) + " |" for row in rows]
    return "\n".join(lines)


def interval(ratio: Ratio | None, digits: int = 3) -> str:
    """Return the interval of a ratio, to stand behind its value; nothing without one."""
    if ratio is None:
        return ""
    return f" [{ratio.low:.{digits}f}, {ratio.high:.{digits}f}]"
