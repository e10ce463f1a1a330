"""Faults injected into a flight that is replayed, and what is demanded of each run."""

from __future__ import annotations

import logging
import math
import tempfile
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import cast

from hybrid_ins import parameters, replay
from hybrid_ins.bags.reader import BagReader
from hybrid_ins.bags.writer import BagWriter
from tools.robustness.campaign_results import FAULTS, RECOVERY, Row, too_large
from tools.robustness.disturbances import Flight
from tools.robustness.fault_output import Output, Trace, examine
from tools.robustness.faults import Fault
from tools.robustness.shared_start import AllForked, ForkingReader, HeldBack, has_same_start

ESTIMATE, DISTURBED = "estimate.mcap", "disturbed.mcap"
CHANGES_START = "the fault changes the beginning of the flight"
COVERED = 0.95  # share of the truth that must have an estimate by then


@dataclass(frozen=True, eq=False)
class Case:
    """A flight to disturb, with one draw of the sensors' noise."""

    name: str
    bag: Path
    values: parameters.Values
    start: float  # s, of the faults
    draw: int = 0  # of noise

    @property
    def origin_ns(self) -> int:
        """Log time of the first message [ns]."""
        with BagReader(self.bag) as bag:
            return bag.start_ns


def judge(fault: Fault, case: Case, output: Output, clean: Trace) -> Row:
    """Hold a run against what the fault demands."""
    failures = list(output.faults)
    found = []
    for sign in fault.signs:
        if sign.startswith("no "):
            unwanted = [text for text in output.said if sign[3:] in text]
            failures += [f"said {text!r}" for text in unwanted[:1]]
            found.append(sign)
            continue
        hits = [text for text in output.said for word in sign.split("|") if word in text]
        if hits:
            found.append(next(word for word in sign.split("|") if word in hits[0]))
        else:
            failures.append(f"nothing says {sign!r}")
    if fault.unusable:
        return _row(fault, case, "; ".join(found), failures)
    end = case.start + fault.duration
    expected, _ = clean.after(end + RECOVERY)
    error, covered = output.trace.after(end + RECOVERY)
    if fault.silent:
        if output.odometry:
            failures.append(f"{output.odometry} odometry messages")
    else:
        if covered < COVERED:
            failures.append(f"odometry for {covered:.0%} of the time from {RECOVERY:g} s after")
        failures += too_large(error, expected)
    peak = output.trace.largest(case.start, end + RECOVERY)
    return _row(fault, case, "; ".join(found), failures, peak, expected, error)


def _row(
    fault: Fault,
    case: Case,
    said: str,
    failures: Sequence[str],
    peak: float = math.nan,
    clean: float = math.nan,
    error: float = math.nan,
) -> Row:
    return Row(fault.name, case.name, said, peak, clean, error, tuple(failures), case.draw)


class _LogLines(logging.Handler):
    """Collects lines in a list."""

    def __init__(self, lines: list[str]) -> None:
        super().__init__()
        self._lines = lines

    def emit(self, record: logging.LogRecord) -> None:
        """Add a line."""
        self._lines.append(record.getMessage())


@contextmanager
def _lines_logged() -> Iterator[list[str]]:
    """Within the block, collect what the package logs."""
    lines: list[str] = []
    handler, package = _LogLines(lines), logging.getLogger("hybrid_ins")
    package.addHandler(handler)
    try:
        yield lines
    finally:
        package.removeHandler(handler)


def replayed(case: Case, fault: Fault | None, folder: Path) -> Output:
    """Replay a flight, disturbed or not."""
    bag, estimate = case.bag, folder / ESTIMATE
    if fault is not None:
        bag = folder / DISTURBED
        inject(case, fault, bag)
    values = parameters.check_all({**case.values, **(fault.values if fault else {})})
    with (
        _lines_logged() as lines,
        BagReader(bag) as reader,
        BagWriter(estimate, overwrite=True) as out,
    ):
        replay.replay(reader, out, values, log=lambda level, text: lines.append(text))
    return _examined(case, fault, folder, lines)


def _examined(case: Case, fault: Fault | None, folder: Path, lines: Sequence[str]) -> Output:
    output = examine(
        folder / ESTIMATE,
        case.bag if fault is None else folder / DISTURBED,
        case.origin_ns,
        float(str(case.values["gnss.time_offset.value"])),
        fault.stamp_shift if fault else 0.0,
    )
    return replace(output, said=(*output.said, *lines))


def attempt_all(
    case: Case, faults: Sequence[Fault], clean: Trace, on_row: Callable[[Row], None]
) -> None:
    """Run faults; those that do not change the beginning of the flight share its replay."""
    from_ns = case.origin_ns + round(case.start * 1e9)

    def on_result(index: int, result: Row | str | None) -> None:
        fault = faults[index]
        if result == CHANGES_START:
            on_row(attempt(case, fault.name, clean))
        elif isinstance(result, Row):
            on_row(result)
        else:
            on_row(_row(fault, case, "", ["crash: the process ended"]))

    with tempfile.TemporaryDirectory() as name, _lines_logged() as lines:
        folder = Path(name)
        out = HeldBack(folder)

        def disturb(fault: Fault) -> Path:
            inject(case, fault, folder / DISTURBED)
            if fault.values or not has_same_start(case.bag, folder / DISTURBED, from_ns):
                reader.answer(CHANGES_START)
            out.open(folder / ESTIMATE)
            return folder / DISTURBED

        others = [partial(disturb, fault) for fault in faults]
        with ForkingReader(case.bag, from_ns, others, on_result) as reader:
            try:
                log = lambda level, text: lines.append(text)  # noqa: E731
                replay.replay(reader, cast(BagWriter, out), case.values, log=log)
            except AllForked:
                return
            except Exception:
                if reader.index is None:
                    raise
                reader.answer(_crashed(faults[reader.index], case))
            assert reader.index is not None  # this is a child
            fault = faults[reader.index]
            try:
                out.close()
                row = judge(fault, case, _examined(case, fault, folder, lines), clean)
            except Exception:
                row = _crashed(fault, case)
            reader.answer(row)


def inject(case: Case, fault: Fault, bag: Path) -> None:
    """Write the disturbed flight."""
    flight = Flight.read(case.bag, case.start, fault.duration)
    fault.inject(flight)
    flight.write(bag)


def attempt(case: Case, name: str, clean: Trace) -> Row:
    """Run one fault, beside the undisturbed run; an exception is a result."""
    fault = next(fault for fault in FAULTS if fault.name == name)
    with tempfile.TemporaryDirectory() as folder:
        try:
            return judge(fault, case, replayed(case, fault, Path(folder)), clean)
        except Exception:  # whatever ends a run is what is looked for
            return _crashed(fault, case)


def _crashed(fault: Fault, case: Case) -> Row:
    last = traceback.format_exc().strip().splitlines()
    return _row(fault, case, "", (f"crash: {last[-1]}", *last[-5:-1]))
