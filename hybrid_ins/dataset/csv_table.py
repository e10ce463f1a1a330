"""Columns of numbers from CSV files; rows that cannot be used are reported and left out."""

from __future__ import annotations

import csv
import logging
import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import chain, pairwise
from pathlib import Path
from typing import TextIO

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybrid_ins.errors import InputError
from hybrid_ins.ros.messages.trajectory import Array

SHOWN_PER_KIND = 5  # rows of one file with the same fault

_log = logging.getLogger(__name__)


class Faults:
    """Logs what is wrong with the rows of files, and what was done about it."""

    def __init__(self) -> None:
        self.counts: Counter[tuple[Path, str]] = Counter()
        self._reported: set[tuple[Path, int, str]] = set()

    def row(self, path: Path, line: int, kind: str, detail: str = "") -> None:
        """
        Report one row; once, even where two tables are read from one file.

        Parameters
        ----------
        path, line : Path, int
            Where it is.
        kind : str
            What is wrong and what was done; rows of one kind are counted together, and only the
            first few are shown.
        detail : str
            What is particular to this row.
        """
        if (path, line, kind) in self._reported:
            return
        self._reported.add((path, line, kind))
        self.counts[path, kind] += 1
        if self.counts[path, kind] <= SHOWN_PER_KIND:
            _log.warning(f"{path}:{line}: {kind}{detail and f' ({detail})'}")

    def file(self, path: Path, text: str) -> None:
        """Report what concerns a whole file."""
        _log.warning(f"{path}: {text}")

    def close(self) -> None:
        """Log how many rows were not shown."""
        for (path, kind), count in self.counts.items():
            if count > SHOWN_PER_KIND:
                _log.warning(f"{path}: {count - SHOWN_PER_KIND} more rows: {kind}")


@dataclass(frozen=True, eq=False)
class CsvFormat:
    """How a file is laid out."""

    delimiter: str = ","  # one character; a space stands for any run of blanks
    has_header: bool = True


@dataclass(frozen=True, eq=False)
class Table:
    """Numbers from a file, in its own units."""

    path: Path
    line: NDArray[np.int64]  # (N,) where each row stands in the file, from 1
    t: Array  # (N,) s, increasing strictly
    values: Array  # (N, number of columns)

    def rows(self, keep: NDArray[np.bool_]) -> Table:
        """Return the rows that `keep` selects."""
        return Table(self.path, self.line[keep], self.t[keep], self.values[keep])

    def drop(self, is_bad: ArrayLike, faults: Faults, kind: str) -> Table:
        """Leave out rows, reporting each."""
        bad = np.asarray(is_bad, bool)
        for line in self.line[bad]:
            faults.row(self.path, int(line), f"{kind}: row dropped")
        return self.rows(~bad)


def read_table(
    path: Path,
    layout: CsvFormat,
    time_column: str | int,
    seconds_per_unit: float,
    columns: Sequence[str | int],
    faults: Faults,
) -> Table:
    """
    Read some columns of a file.

    Rows with too few or too many fields, with text or NaN where a number belongs, with a time
    stamp that was there already or lies in the past are reported and left out; a skipped time
    stamp is reported.

    Parameters
    ----------
    path : Path
    layout : CsvFormat
    time_column, columns : str or int
        Names in the header, or positions from 1.
    seconds_per_unit : float
        Of the time column.
    faults : Faults
        Receives the reports.

    Returns
    -------
    Table

    Raises
    ------
    InputError
        No such file or column, or fewer than two good rows.

    """
    try:
        with path.open(encoding="utf-8-sig", errors="replace", newline="") as file:
            lines, numbers = _read_rows(path, file, layout, [time_column, *columns], faults)
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}") from None
    except csv.Error as error:
        raise InputError(f"{path}: not a CSV file: {error}") from None
    t = numbers[:, 0] * seconds_per_unit
    keep = _in_order(path, lines, t, faults)
    table = Table(path, lines[keep], t[keep], numbers[keep, 1:])
    if table.t.size < 2:
        raise InputError(f"{path}: {table.t.size} usable rows: too few")
    _report_gaps(table, faults)
    return table


def _read_rows(
    path: Path, file: TextIO, layout: CsvFormat, wanted: list[str | int], faults: Faults
) -> tuple[NDArray[np.int64], Array]:
    rows = _fields(file, layout.delimiter)
    first_line, first = next(rows, (1, []))
    if not layout.has_header:
        rows = chain([(first_line, first)], rows)
    names = [name.strip() for name in first] if layout.has_header else []
    index = [_position(path, names, name) for name in wanted]
    width = len(first)
    if max(index) >= width:
        raise InputError(
            f"{path}:{first_line}: no column {max(index) + 1}: the first line has {width} fields;"
            " check the map's columns and delimiter, and remove lines above the table"
        )
    lines: list[int] = []
    numbers: list[list[float]] = []
    for line, fields in rows:
        if len(fields) != width:
            faults.row(
                path, line, "wrong number of fields: row dropped", f"{len(fields)}, not {width}"
            )
            continue
        try:
            row = [float(fields[i]) for i in index]
        except ValueError:
            bad = next((fields[i] for i in index if not _is_number(fields[i])), "")
            faults.row(path, line, "not a number: row dropped", repr(bad[:40]))
            continue
        if not all(map(math.isfinite, row)):
            faults.row(path, line, "NaN or infinity: row dropped")
            continue
        lines.append(line)
        numbers.append(row)
    return np.array(lines, np.int64), np.array(numbers).reshape(-1, len(index))


def _fields(file: TextIO, delimiter: str) -> Iterator[tuple[int, list[str]]]:
    """Yield the line number and the fields of each line that is not blank."""
    if delimiter == " ":
        yield from ((n, text.split()) for n, text in enumerate(file, 1) if text.strip())
        return
    reader = csv.reader(file, delimiter=delimiter, skipinitialspace=True)
    yield from ((reader.line_num, fields) for fields in reader if any(fields))


def _position(path: Path, names: list[str], name: str | int) -> int:
    if isinstance(name, int):
        return name - 1
    if names.count(name) == 1:
        return names.index(name)
    if name in names:
        raise InputError(f"{path}: {names.count(name)} columns are called '{name}'")
    there = ", ".join(n[:30] for n in names[:40]) or "an empty first line"
    raise InputError(f"{path}: no column '{name}'; the header has {there}")


def _is_number(text: str) -> bool:
    try:
        return math.isfinite(float(text))
    except ValueError:
        return False


def _in_order(path: Path, lines: NDArray[np.int64], t: Array, faults: Faults) -> NDArray[np.bool_]:
    """Find the rows whose times increase; a single stamp that leaps ahead loses, not the rest."""
    keep = np.ones(t.size, bool)
    last = -math.inf
    for row, (time, after) in enumerate(pairwise([*t.tolist(), math.inf])):
        if time == last:
            problem = "repeated time stamp"
        elif time < last:
            problem = "time stamp goes back"
        elif last < after < time:
            problem = "time stamp leaps ahead"
        else:
            last = time
            continue
        faults.row(path, int(lines[row]), f"{problem}: row dropped", f"{time:.6f} s")
        keep[row] = False
    return keep


def _report_gaps(table: Table, faults: Faults) -> None:
    steps = np.diff(table.t)
    usual = np.median(steps)
    for row in np.flatnonzero(steps > 1.5 * usual):
        faults.row(
            table.path,
            int(table.line[row + 1]),
            "gap before this row: left open",
            f"{1e3 * steps[row]:.1f} ms instead of {1e3 * usual:.1f} ms",
        )
