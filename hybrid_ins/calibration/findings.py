"""What a calibration finds: a value, its uncertainty and a verdict, and what follows from them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

SIGNIFICANT = 3.0  # standard deviations: a smaller difference may be chance
Verdict = Literal["identified", "weak", "not identifiable", "does not fit"]


@dataclass(frozen=True, slots=True)
class Finding:
    """
    One calibrated quantity as text, and the parameters that follow from it.

    Attributes
    ----------
    label, value, sigma : str
        What it is, its value, its uncertainty; empty: there is none.
    verdict : str
        How well the motion determines it.
    note : str
        Why that is so, or what else is to be known.
    values : mapping
        The parameters, by name.
    """

    label: str
    value: str
    sigma: str
    verdict: Verdict
    note: str = ""
    values: Mapping[str, Any] = field(default_factory=dict)

    @property
    def text(self) -> str:
        """Verdict, value and uncertainty in words."""
        spread = f" {self.sigma if self.sigma.startswith('×') else '± ' + self.sigma}"
        return f"{self.verdict}: {self.label} {self.value}{spread if self.sigma else ''}"


def kept_below(sigmas: float) -> str:
    """Return the note on a given value from which the best differs by fewer standard deviations."""
    return f"as given: less than {sigmas:g} σ from what fits best"


@dataclass
class Findings:
    """Findings, the parameters that follow from them, and the comments on these."""

    values: dict[str, Any]  # parameters, by name
    rows: list[Finding] = field(default_factory=list)
    notes: dict[str, str] = field(default_factory=dict)  # by name of the parameter

    def add(self, *findings: Finding) -> None:
        """Add findings; each is the comment on the parameters that follow from it."""
        for one in findings:
            self.rows.append(one)
            self.values.update(one.values)
            comment = one.text + (f"; {one.note}" if one.note else "")
            self.notes.update(dict.fromkeys(one.values, comment))

    def withdraw_verdicts(self) -> None:
        """Call nothing identified: the model is not that of the recordings."""
        self.rows = [
            replace(row, verdict="does not fit") if row.verdict == "identified" else row
            for row in self.rows
        ]
        self.notes = {
            name: text.replace("identified", "does not fit", 1)
            if text.startswith("identified")
            else text
            for name, text in self.notes.items()
        }
