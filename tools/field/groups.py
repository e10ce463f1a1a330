"""The results of one condition, method by method."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from hybrid_ins.evaluation.statistics import Ratio, paired_ratio
from tools.field.methods import (
    BEST,
    TUNED,
)
from tools.field.tasks import (
    Row,
)
from tools.paper.report import table


@dataclass(frozen=True)
class Group:
    """All rows of one condition, by method."""

    rows: dict[str, list[Row]]

    @classmethod
    def of(cls, rows: Iterable[Row], condition: str) -> Group:
        """Select a condition; every method's rows are in the same order."""
        by_method: dict[str, list[Row]] = {}
        for row in sorted(
            (r for r in rows if r["condition"] == condition),
            key=lambda r: (r["flight"], r["imu"], r["seed"]),
        ):
            by_method.setdefault(row["method"], []).append(row)
        return cls(by_method)

    def values(self, method: str, figure: str) -> np.ndarray:
        """Return a figure of every run."""
        return np.array([r[figure] for r in self.rows[method]], float)

    def ratio(self, method: str, against: str) -> Ratio | None:
        """Return the paired ratio of PRMSE with flights as clusters; None where one diverged."""
        a, b = self.values(method, "prmse"), self.values(against, "prmse")
        if not np.all(np.isfinite([a, b])):
            return None
        return paired_ratio(a, b, [r["flight"] for r in self.rows[method]], of="means")

    def with_constants(self, grid: Iterable[str]) -> tuple[Group, dict[str, str]]:
        """Put the tuned and the hindsight constant in the place of the grid of constants."""
        names = list(grid)
        prmse = np.array([self.values(name, "prmse") for name in names])
        first = self.rows[names[0]]
        session = np.array([r["session"] for r in first])
        flight = np.array([f"{r['flight']}/{r['imu']}" for r in first])
        chosen: dict[str, str] = {}
        tuned, best = [], []
        for own in dict.fromkeys(session):
            others = session != own if np.any(session != own) else session == own
            chosen[str(own)] = names[int(np.argmin(prmse[:, others].mean(axis=1)))]
        hindsight = {
            f: names[int(np.argmin(prmse[:, flight == f].mean(axis=1)))] for f in set(flight)
        }
        for k in range(len(first)):
            tuned.append(self.rows[chosen[str(session[k])]][k])
            best.append(self.rows[hindsight[str(flight[k])]][k])
        kept = {name: rows for name, rows in self.rows.items() if name not in names}
        return Group({**kept, TUNED: tuned, BEST: best}), chosen


def method_table(groups: Sequence[tuple[str, Group]]) -> str:
    """Return the form of the paper's Table 2: each method's errors, consistency, worst flight."""
    heads = ["method"]
    for label, _ in groups:
        heads += [
            f"{label}: PRMSE [m]",
            "PMAE [m]",
            "worst flight",
            "NEES/3",
            "NIS/3",
            "PRMSE / tuned [95 %]",
        ]
    rows = []
    for name in groups[0][1].rows:
        cells: list[object] = [name]
        for _, group in groups:
            prmse = group.values(name, "prmse")
            lost = int(np.sum(~np.isfinite(prmse) | (prmse > 100.0)))
            if lost:
                cells += [f"lost in {lost} of {len(prmse)}", "–", "–", "–", "–", "–"]
                continue
            flights = np.array([r["flight"] for r in group.rows[name]])
            worst = max(prmse[flights == f].mean() for f in set(flights))
            ratio = group.ratio(name, TUNED) if TUNED in group.rows else None
            cells += [
                f"{prmse.mean():.3f}",
                f"{group.values(name, 'pmae').mean():.3f}",
                f"{worst:.3f}",
                f"{group.values(name, 'nees').mean():.2f}",
                f"{group.values(name, 'nis').mean():.2f}",
                str(ratio or "–"),
            ]
        rows.append(cells)
    return table(heads, rows)
