"""Writes trajectories to files, in the format of the file's suffix."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from hybrid_ins.errors import InputError
from hybrid_ins.evaluation.run import Run
from hybrid_ins.evaluation.run_reader import read_run
from hybrid_ins.export.maps import geojson, gpx, kml
from hybrid_ins.export.tables import csv, tum
from hybrid_ins.output_file import check_output, replacing
from hybrid_ins.ros.messages.trajectory import Trajectory

FORMATS: dict[str, Callable[[Trajectory, str], Iterator[str]]] = {
    ".tum": tum,
    ".csv": csv,
    ".kml": kml,
    ".gpx": gpx,
    ".geojson": geojson,
}


def check_export(path: Path, inputs: Sequence[Path] = (), overwrite: bool = False) -> None:
    """
    Check, before the work, that a trajectory can be exported to `path`.

    Raises
    ------
    InputError
        Unknown suffix; for the rest see `output_file.check_output`.

    """
    if path.suffix.lower() not in FORMATS:
        raise InputError(f"{path}: the name of an export ends in one of {', '.join(FORMATS)}")
    check_output(path, inputs, overwrite)


def export(trajectory: Trajectory, name: str, path: Path) -> None:
    """
    Write a trajectory in the format that the suffix of `path` names.

    Raises
    ------
    InputError
        The trajectory lacks what the format needs: attitudes (TUM), a datum (maps).

    """
    lines = FORMATS[path.suffix.lower()](trajectory, name)
    with replacing(path) as unfinished, unfinished.open("w", encoding="utf-8") as file:
        file.writelines(lines)


def export_run(run: Run, path: Path) -> None:
    """
    Export the estimate of a run.

    Its positions before the heading is known are on maps and in tables, not in TUM files, which
    have poses and no uncertainty.

    Raises
    ------
    InputError
        See `export`.

    """
    positions = None if path.suffix.lower() == ".tum" else run.positions
    export(run.estimate if positions is None else positions, run.name, path)


def export_bag(bag: Path, path: Path) -> None:
    """
    Export the estimate in a bag.

    Raises
    ------
    InputError
        The bag has no estimate; or see `export`.

    """
    export_run(read_run(bag), path)
