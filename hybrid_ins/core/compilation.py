"""
How the kernels are compiled, and where the machine code is kept.

Numba's own cache compares a kernel's file alone: a change of a function that the kernel takes from
another module would go unseen, also across an upgrade. And it gives up, at import, where neither
the package's directory nor the user's can be written. Here the machine code lies in a directory
named after the text of every module of ``core`` that numba sees, in the first place that can be
written.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from numba import config, njit

Function = Callable[..., Any]

CORE = Path(__file__).resolve().parent
COMPLETE = "complete"
KERNELS: list[Any] = []  # all there are, as numba's dispatchers
TEMPORARY = Path(tempfile.gettempdir()) / f"hybrid_ins-{os.getuid()}"


def kernel(**options: Any) -> Callable[[Function], Function]:
    """Return the decorator that compiles a function at its first call and keeps the result."""

    def decorate(function: Function) -> Function:
        dispatcher = njit(error_model="numpy", **options)(function)
        KERNELS.append(dispatcher)
        if CACHE is not None:
            given, config.CACHE_DIR = config.CACHE_DIR, str(CACHE)
            try:
                dispatcher.enable_caching()
            finally:
                config.CACHE_DIR = given
        return dispatcher  # type: ignore[no-any-return]

    return decorate


def is_compiled() -> bool:
    """Tell whether all kernels were compiled in an earlier run: if not, first calls take long."""
    return CACHE is not None and (CACHE / COMPLETE).exists()


def mark_compiled() -> None:
    """Note that the machine code of all kernels is kept."""
    if CACHE is not None:
        (CACHE / COMPLETE).touch()


def spare_blas() -> None:
    """
    Keep numba from loading SciPy's linear algebra, for programs.

    Numba looks for it when it starts, in case that a kernel multiplies matrices. Ours do not, and
    the search alone costs 0.3 s of the start and 40 MB.
    """
    name = "scipy.linalg.cython_blas"
    if name in sys.modules:
        return
    sys.modules[name] = None  # type: ignore[assignment]
    try:
        import numba.np.arraymath  # noqa: F401
    finally:
        del sys.modules[name]


def _cache() -> Path | None:
    """Return the directory for machine code of the present text; None if nothing is writable."""
    digest = hashlib.sha256()
    for source in sorted(CORE.glob("*.py")):
        text = source.read_bytes()
        if b"numba" in text or b"compilation" in text:
            digest.update(text)
    name = f"kernels-{digest.hexdigest()[:16]}"
    for base in _places():
        try:
            (base / name).mkdir(parents=True, exist_ok=True)
            tempfile.TemporaryFile(dir=base / name).close()
        except OSError:
            continue
        if base == TEMPORARY and base.stat().st_uid != os.getuid():
            continue  # others' machine code is not to be run
        if base.parent == CORE:
            for stale in base.glob("kernels-*"):
                if stale.name != name:
                    shutil.rmtree(stale, ignore_errors=True)
        return base / name
    return None


def _places() -> Iterator[Path]:
    """Yield where machine code may be kept: where numba is told to, here, or with the user."""
    if config.CACHE_DIR:
        yield Path(config.CACHE_DIR)
    yield CORE / "__pycache__"
    yield Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser() / "hybrid_ins"
    yield TEMPORARY


CACHE = _cache()
