"""Output files that appear complete or not at all, and never in place of an input."""

from __future__ import annotations

import errno
import os
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from itertools import chain, count
from pathlib import Path
from typing import TypeGuard

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
        replaced; or its folder does not exist, or cannot be written.

    """
    target = resolved(path)
    for given in inputs:
        source = resolved(given)
        if target == source:
            name = "itself" if str(given) == str(path) else given
            raise InputError(f"{path}: is the input {name}: give the output another name")
        if source in target.parents:
            raise InputError(f"{path}: lies in the input {given}: choose another folder")
        if target in source.parents:
            raise InputError(f"{path}: contains the input {given}: choose another folder")
    try:
        if path.is_dir() and not folder:
            raise InputError(f"{path}: is a folder: choose another name")
        if path.exists() and not overwrite:
            raise InputError(f"{path}: exists: give --overwrite, or choose another name")
        if not folder and not target.parent.is_dir():
            raise InputError(f"{path}: no such folder")
        _check_folder(target)
    except OSError as error:
        raise cannot_be_written(path, error) from None


def resolved(path: Path) -> Path:
    """
    Return the absolute path that a path leads to, links followed.

    Raises
    ------
    InputError
        Its links lead in a circle.
    """
    try:
        return path.resolve()
    except RuntimeError:  # of Python before 3.13
        raise InputError(f"{path}: is a link that leads to itself: give another name") from None


def _check_folder(target: Path) -> None:
    """Raise `OSError` where no file can be made beside an output, or in the folder above it."""
    if _is_device(target):
        return
    folder = next((parent for parent in target.parents if parent.exists()), target)  # "/" has none
    with tempfile.TemporaryFile(dir=folder):
        pass


def _is_device(target: Path) -> bool:
    """Return whether there is a device or a pipe, which is written to, not replaced."""
    return os.access(target, os.F_OK) and not (target.is_file() or target.is_dir())


def is_full(error: BaseException | None) -> TypeGuard[OSError]:
    """Return whether an error says that there is no room for more of a file."""
    full = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
    return isinstance(error, OSError) and error.errno in full


def cannot_be_written(path: Path, error: OSError) -> InputError:
    """Return the error of an output that the system refuses, by the name that the user gave."""
    remedy = "choose a folder that can be written"
    if is_full(error):
        remedy = "make room, or choose another folder"
    return InputError(f"{path}: cannot be written ({error.strerror or error}): {remedy}")


def private_name(target: Path) -> Path:
    """Return a hidden name beside `target` for this process alone: there is nothing yet."""
    numbers = chain([""], (f".{number}" for number in count(2)))
    names = (f".{os.getpid()}{number}.{target.name}" for number in numbers)
    return next(path for path in map(target.with_name, names) if not os.path.lexists(path))


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """
    Give the path of a new file or folder that takes the place of `path` when it is complete.

    It is beside `path` until the block ends, and removed when the block fails: what was there
    before is then untouched. A device or pipe is written directly.
    """
    target = path.resolve()
    if _is_device(target):
        yield target
        return
    unfinished = private_name(target)
    try:
        yield unfinished
        if target.is_dir() and unfinished.is_dir():  # a file never takes a folder's place
            shutil.rmtree(target)
        unfinished.replace(target)
    except OSError as error:
        if error.filename not in (None, str(unfinished)):
            raise  # another file's
        raise cannot_be_written(path, error) from None
    finally:
        with suppress(OSError):  # there was none, or no folder to hold it
            if unfinished.is_dir():
                shutil.rmtree(unfinished, ignore_errors=True)
            else:
                unfinished.unlink()


def write_text(path: Path, text: str) -> None:
    """Write a text as UTF-8, complete or not at all."""
    with replacing(path) as unfinished:
        unfinished.write_text(text, encoding="utf-8")
