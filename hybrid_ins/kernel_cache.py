"""
The directory that keeps the machine code of kernels between runs.

Numba's own cache compares a kernel's file alone: a change of a function that the kernel takes from
another module would go unnoticed, also across an upgrade. And it gives up where neither the
package's directory nor the user's is writable. Here the machine code is kept in a directory named
after the source text of all modules that it may depend on, in the first place that is writable:
``NUMBA_CACHE_DIR``, the package itself, the user's cache directory, the temporary directory.

Nothing happens before `enable` is called: the programs, the tools and the tests do so.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
import shutil
import stat
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any

from numba import config

from hybrid_ins.core import compilation

PACKAGE = Path(__file__).resolve().parent
LOCK = "lock"
PREFIX = "kernels-"
POLL = 0.2  # s, between two attempts to become the process that compiles


def enable() -> Path | None:
    """
    Keep the machine code of all kernels, and load what an earlier run has kept.

    Kernels that are compiled already are not kept: call this before the first use. Further calls
    do nothing.

    Returns
    -------
    Path or None
        The directory; None where no place is writable: every run compiles for itself then.
    """
    directory = _directory()
    if directory is not None and _keep not in compilation.on_registration:
        compilation.on_registration.append(_keep)
        for dispatcher in compilation.KERNELS:
            _keep(dispatcher)
    return directory


def is_complete(part: str) -> bool:
    """Return whether all kernels of a part are kept: if not, first calls take long."""
    directory = _directory()
    return directory is not None and (directory / f"complete-{part}").exists()


def mark_complete(part: str) -> None:
    """Note that all kernels of a part are kept; remove those of earlier source texts."""
    directory = _directory()
    if directory is None:
        return
    directory.mkdir(mode=0o700, parents=True, exist_ok=True)
    (directory / f"complete-{part}").touch()
    if directory.parent == _package_place():
        for other in directory.parent.glob(f"{PREFIX}*"):
            if other != directory:
                shutil.rmtree(other, ignore_errors=True)


@contextmanager
def exclusive(on_wait: Callable[[], None]) -> Iterator[None]:
    """
    Within the block, this process is the only one that fills the cache.

    Parameters
    ----------
    on_wait : callable
        Called once if another process does so now, before waiting for its end.
    """
    directory = _directory()
    if directory is None:
        yield
        return
    directory.mkdir(mode=0o700, parents=True, exist_ok=True)  # another version may remove it
    with (directory / LOCK).open("w") as file:
        waiting = False
        while True:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                if not waiting:
                    on_wait()
                waiting = True
                time.sleep(POLL)
            except OSError:  # a file system without locks: two processes may compile the same
                break
        yield


def _keep(dispatcher: Any) -> None:
    given, config.CACHE_DIR = config.CACHE_DIR, str(_directory())
    try:
        dispatcher.enable_caching()
    finally:
        config.CACHE_DIR = given


@cache
def _directory() -> Path | None:
    """Return the directory for machine code of the present source text; it exists."""
    name = f"{PREFIX}{_digest()}"
    for place in _places():
        directory = place / name
        try:
            if place == _temporary_place() and not _make_private(place):
                continue
            directory.mkdir(mode=0o700, parents=True, exist_ok=True)
            tempfile.TemporaryFile(dir=directory).close()
        except OSError:
            continue
        return directory
    return None


def _digest() -> str:
    """
    Return a name for the text of the core, in all its folders, and of other modules with kernels.

    Modules without kernels count, too: machine code contains the constants that kernels import.
    """
    digest = hashlib.sha256()
    for source in sorted(PACKAGE.rglob("*.py")):
        text = source.read_bytes()
        if source.is_relative_to(PACKAGE / "core") or b"core.compilation" in text:
            digest.update(text)
    return digest.hexdigest()[:16]


def _places() -> Iterator[Path]:
    """Yield where machine code may be kept, best first."""
    if config.CACHE_DIR:
        yield Path(config.CACHE_DIR)
    yield _package_place()
    with suppress(RuntimeError):  # neither HOME nor an entry in passwd
        yield Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser() / "hybrid_ins"
    yield _temporary_place()


def _package_place() -> Path:
    return PACKAGE / "__pycache__"


def _temporary_place() -> Path:
    return Path(tempfile.gettempdir()) / f"hybrid_ins-{os.getuid()}"


def _make_private(directory: Path) -> bool:
    """
    Make a directory for this user alone; False if it is not.

    Machine code is run: a directory, or a link, that another user has put there is not trusted.
    """
    with suppress(FileExistsError):
        directory.mkdir(mode=0o700)
    status = directory.lstat()
    return (
        stat.S_ISDIR(status.st_mode)
        and status.st_uid == os.getuid()
        and stat.S_IMODE(status.st_mode) & 0o077 == 0
    )
