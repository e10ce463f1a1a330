"""Progress bars on stderr, shown where that is a terminal."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from threading import RLock
from typing import Any, TypeVar

from tqdm import tqdm

T = TypeVar("T")
_hidden = False


def hide() -> None:
    """Show no bars in this process: it is one of many that work side by side."""
    global _hidden
    _hidden = True
    tqdm.set_lock(RLock())  # its own is a semaphore, which a killed process leaves behind


def track(
    items: Iterable[T], label: str, total: int | None = None, unit: str = "msg"
) -> Iterator[T]:
    """Yield the items while a bar counts them."""
    return iter(
        tqdm(items, desc=label, total=total, unit=unit, unit_scale=True, disable=_disabled())
    )


def bar(label: str, total: float, unit: str, **options: Any) -> tqdm[None]:
    """Return a bar for a ``with`` statement; its ``update(n)`` counts."""
    return tqdm(total=total, desc=label, unit=unit, disable=_disabled(), **options)


def _disabled() -> bool | None:
    return True if _hidden else None  # None leaves it to whether stderr is a terminal
