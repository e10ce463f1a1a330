"""Finished parts of an experiment, kept in a folder."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from hybrid_ins import progress
from hybrid_ins.resources import share_path
from tools.field.tasks import (
    Row,
    Task,
)
from tools.parallel import run_parallel


class Cache:
    """Results of finished parts, by what they depend on: their arguments and the package's code."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        folder.mkdir(parents=True, exist_ok=True)
        code = hashlib.sha256()
        package = Path(__file__).resolve().parents[2] / "hybrid_ins"
        for path in (
            *sorted(package.rglob("*.py")),
            share_path("models/plateau.onnx"),
            *(Path(__file__).with_name(name) for name in ("flights.py", "tasks.py")),
        ):
            code.update(Path(path).read_bytes())
        self._code = code.hexdigest()

    def run(self, function: Callable[..., list[Row]], arguments: tuple[Any, ...]) -> list[Row]:
        """Return a part's rows, from the folder where they are there."""
        key = json.dumps([self._code, function.__name__, arguments], default=_plain)
        path = self._folder / f"{hashlib.sha256(key.encode()).hexdigest()[:24]}.json"
        if path.exists():
            return list(json.loads(path.read_text(encoding="utf-8")))
        rows = function(*arguments)
        unfinished = path.with_suffix(f".{os.getpid()}")
        unfinished.write_text(json.dumps(rows), encoding="utf-8")
        unfinished.replace(path)
        return rows


def _plain(value: object) -> object:
    return asdict(value) if isinstance(value, Task) else str(value)


def run_all(
    cache: Cache,
    jobs: int,
    label: str,
    function: Callable[..., list[Row]],
    arguments: Sequence[tuple[Any, ...]],
) -> list[Row]:
    """Do all parts in some processes; returns their rows in order."""
    parts = run_parallel(cache.run, [(function, words) for words in arguments], jobs)
    return [row for part in progress.track(parts, label, len(arguments), "part") for row in part]
