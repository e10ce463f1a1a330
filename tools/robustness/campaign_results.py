"""Results of the fault campaign: kept in a file as they come, and the page that shows them."""

from __future__ import annotations

import datetime
import json
import math
import subprocess
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

import hybrid_ins
from hybrid_ins.errors import InputError
from tools.robustness.faults import FAULTS as BRIEF
from tools.robustness.lasting_faults import LASTING

RECOVERY = 10.0  # s after the fault
WORSE = 1.2  # times the undisturbed run's error
FAULTS = (*BRIEF, *LASTING)
TOO_LARGE = "error"  # begins what is wrong with a run that is not good enough
LIVE = ", live"  # behind the name of a flight that is played into the node


@dataclass(frozen=True)
class Row:
    """Result of one fault in one flight, with one draw of noise or over all of them."""

    fault: str
    case: str
    said: str
    peak: float
    clean: float
    error: float
    failures: tuple[str, ...]
    draw: int = 0  # of the sensors' noise


class ResultFile:
    """
    Rows in a file of JSON lines, so that a campaign that was ended goes on.

    Several processes may append to one file.

    Parameters
    ----------
    path : Path, optional
        None keeps nothing.

    Attributes
    ----------
    revision : str
        See `revision`.

    Raises
    ------
    InputError
        The file holds rows of other code.
    """

    def __init__(self, path: Path | None) -> None:
        self._path = path
        self.revision = revision()
        for line in self._lines():
            if line["revision"] != self.revision:
                raise InputError(f"{path}: of {line['revision']}, this is {self.revision}")

    def rows(self) -> list[Row]:
        """Return all rows."""
        names = Row.__dataclass_fields__
        lines = [{name: line[name] for name in names} for line in self._lines()]
        return [Row(**{**line, "failures": tuple(line["failures"])}) for line in lines]

    def add(self, row: Row) -> None:
        """Append a row."""
        if self._path is not None:
            with self._path.open("a", encoding="utf-8") as file:
                file.write(json.dumps({**asdict(row), "revision": self.revision}) + "\n")

    def _lines(self) -> list[dict[str, Any]]:
        if self._path is None or not self._path.exists():
            return []
        return [json.loads(line) for line in self._path.read_text(encoding="utf-8").splitlines()]


def revision() -> str:
    """Return the last commit that changed the package; empty where there is no git."""
    package = Path(hybrid_ins.__file__).resolve().parent
    command = ["git", "log", "-1", "--format=%h", "--", "."]
    try:
        found = subprocess.run(command, cwd=package, capture_output=True, text=True, check=False)
    except OSError:
        return ""
    return found.stdout.strip()


def over_draws(rows: Sequence[Row]) -> tuple[list[Row], int]:
    """
    Combine the draws of each fault and flight: the errors of one flight are few independent.

    Returns the rows in the order of the faults, and the number of draws, the same for all that was
    replayed; live runs have one. The errors are RMS over the draws, and judged as such.
    """
    groups: dict[tuple[str, str], list[Row]] = {}
    for row in sorted(rows, key=lambda row: row.draw):
        groups.setdefault((row.fault, row.case), []).append(row)
    draws = min((len(g) for (_, case), g in groups.items() if not case.endswith(LIVE)), default=1)
    order = {fault.name: k for k, fault in enumerate(FAULTS)}
    return sorted(
        (_combined(group[:draws]) for group in groups.values()), key=lambda row: order[row.fault]
    ), draws


def _combined(rows: Sequence[Row]) -> Row:
    clean, error = (
        float(np.sqrt(np.mean([getattr(row, name) ** 2 for row in rows])))
        for name in ("clean", "error")
    )
    failures = [text for row in rows for text in row.failures if not text.startswith(TOO_LARGE)]
    if any(text.startswith(TOO_LARGE) for row in rows for text in row.failures):
        failures += too_large(error, clean)
    return replace(
        rows[0],
        clean=clean,
        error=error,
        peak=max(row.peak for row in rows),
        failures=tuple(dict.fromkeys(failures)),
    )


def too_large(error: float, clean: float) -> list[str]:
    """Return what is wrong with an error [m], beside that of the undisturbed flight."""
    if error <= WORSE * clean:
        return []
    return [f"{TOO_LARGE} {error:.3f} m, undisturbed {clean:.3f} m"]


def table(rows: Sequence[Row]) -> str:
    """Return the results as a Markdown table."""
    texts = {fault.name: fault.text for fault in FAULTS}
    cases = sorted({row.case for row in rows}, key=lambda case: (case.endswith(LIVE), case[::-1]))
    lines = [
        "| fault | what happens | said | "
        + " | ".join(f"{case}: peak, after (clean) [m]" for case in cases)
        + " | |",
        "|---|---|---|" + "---|" * len(cases) + "---|",
    ]
    for name in dict.fromkeys(row.fault for row in rows):
        mine = {row.case: row for row in rows if row.fault == name}
        said = next((row.said for row in mine.values() if row.said), "")
        verdict = "pass" if not any(row.failures for row in mine.values()) else "**FAIL**"
        cells = [name, texts[name], said, *(_cell(mine.get(case)) for case in cases), verdict]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _cell(row: Row | None) -> str:
    if row is None:
        return ""
    if math.isnan(row.error):
        return "no odometry"
    return f"{row.peak:.2f}, {row.error:.3f} ({row.clean:.3f})"


def page(rows: Sequence[Row], draws: int, command: str, code: str) -> str:
    """Return the page for the documentation, of the runs so far; ``code`` is their `revision`."""
    failed = sum(bool(row.failures) for row in rows)
    failures = [f"- {row.fault} ({row.case}): {text}" for row in rows for text in row.failures]
    return f"""# Fault campaign

Named faults, each injected into a simulated flight (60 s, a quadrotor with vibration of 0.3 m/s²
and 0.01 rad/s, 200 Hz, fixes at 5 Hz) and into a recorded one. Both are replayed by the node's
estimator with the default parameters and no heading given, with {draws} draw(s) of the sensors'
noise each; with `--live` all are also played into the live node over DDS, in the recorded flight;
wrong axes, units and clocks from the start in the simulated one, too. Every run must

- end without an exception,
- publish no NaN, and positive definite covariances only,
- report what is wrong: a counter or text of `/diagnostics`, or a reason in `gnss/verdict`,
- from {RECOVERY:g} s after the fault to the flight's end, have an RMS position error of at most
  {WORSE:g} times that of the undisturbed runs over the same time, as RMS over all draws. A run with
  wrong axes or clocks from the start only has to name them.

`peak` is the largest position error from the fault's beginning to {RECOVERY:g} s after its end.

    {command}

{len(rows)} runs, {failed} failed, on {datetime.date.today()}. All with the code of commit {code}.

{table(rows)}
""" + "".join(f"{line}\n" for line in ("", *failures) if failures)
