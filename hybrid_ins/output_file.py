"""Output files that appear complete or not at all, and never in place of an input."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from hybrid_ins.errors import InputError


def check_output(
    path: Path, inputs: Sequence[Path] = (), overwrite: bool = False, *, folder: bool = False
) -> None:
    """
    Check, before the work, that an output can be written.

    Parameters
    ----------
    path : Path
        The output.
    inputs : sequence of Path
        Files and bags that are read; links are followed.
    overwrite : bool
        Whether an existing output may be replaced.
    folder : bool
        Whether the output may be a folder, such as a bag; folders above it need not exist then.

    Raises
    ------
    InputError
        The output is one of the inputs, contains one or lies in one; it exists and may not be
        replaced; or its folder does not exist.

    """
    target = path.resolve()
    for given in inputs:
        source = given.resolve()
        if target == source or source in target.parents or target in source.parents:
            raise InputError(f"{path}: is the input {given}: choose another name")
    if path.is_dir() and not folder:
        raise InputError(f"{path}: is a folder: choose another name")
    if path.exists() and not overwrite:
        raise InputError(f"{path}: exists: give --overwrite, or choose another name")
    if not folder and not target.parent.is_dir():
        raise InputError(f"{path}: no such folder")


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """
    Give the path of a new file or folder that takes the place of `path` when it is complete.

    It is beside `path` until the block ends, and removed when the block fails: what was there
    before is then untouched. A device or pipe is written directly.
    """
    target = path.resolve()
    if target.exists() and not (target.is_file() or target.is_dir()):
        yield target
        return
    unfinished = target.with_name(f".{os.getpid()}.{target.name}")
    try:
        yield unfinished
        if target.is_dir() and unfinished.is_dir():  # a file never takes a folder's place
            shutil.rmtree(target)
        unfinished.replace(target)
    finally:
        if unfinished.is_dir():
            shutil.rmtree(unfinished, ignore_errors=True)
        else:
            unfinished.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write a text as UTF-8, complete or not at all."""
    with replacing(path) as unfinished:
        unfinished.write_text(text, encoding="utf-8")
