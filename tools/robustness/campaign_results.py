"""Results of the fault campaign: kept in a file as they come, and the page that shows them."""

from __future__ import annotations

import datetime
import json
import math
import subprocess
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import hybrid_ins
from hybrid_ins.errors import InputError
from tools.robustness.faults import FAULTS as BRIEF
from tools.robustness.lasting_faults import LASTING

RECOVERY = 10.0  # s after the fault
WORSE = 1.2  # times the undisturbed run's error
FAULTS = (*BRIEF, *LASTING)
LIVE = ", live"  # behind the name of a flight that is played into the node


@dataclass(frozen=True)
class Row:
    """Result of one fault in one flight."""

    fault: str
    case: str
    said: str
    peak: float
    clean: float
    error: float
    failures: tuple[str, ...]
    draws: int = 1  # of noise


class ResultFile:
    """
    Rows in a file of JSON lines, so that a campaign that was ended goes on.

    Several processes may append to one file.

    Parameters
    ----------
    path : Path, optional
        None keeps nothing.
    draws : int
        Of noise, of each replayed row.

    Raises
    ------
    InputError
        The file holds rows of other code or with other draws.
    """

    def __init__(self, path: Path | None, draws: int) -> None:
        self._path = path
        self.revision = revision()
        for line in self._lines():
            if line["revision"] != self.revision:
                raise InputError(f"{path}: of {line['revision']}, this is {self.revision}")
            if not line["case"].endswith(LIVE) and line["draws"] != draws:
                raise InputError(f"{path}: has {line['draws']} draws of noise, not {draws}")

    def rows(self) -> list[Row]:
        """Return all rows, in the order of the faults."""
        order = {fault.name: k for k, fault in enumerate(FAULTS)}
        rows = []
        for line in self._lines():
            line.pop("revision")
            rows.append(Row(**{**line, "failures": tuple(line["failures"])}))
        return sorted(rows, key=lambda row: order[row.fault])

    def add(self, row: Row) -> None:
        """Append a row."""
        if self._path is not None:
            with self._path.open("a", encoding="utf-8") as file:
                file.write(json.dumps({**asdict(row), "revision": self.revision}) + "\n")

    def _lines(self) -> list[dict[str, object]]:
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


def page(rows: Sequence[Row], command: str, code: str) -> str:
    """Return the page for the documentation, of the runs so far."""
    failed = sum(bool(row.failures) for row in rows)
    draws = max((row.draws for row in rows), default=1)
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
