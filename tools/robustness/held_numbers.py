"""
Every number that an object holds, and which of them grow for as long as it lives.

A program that runs for days must not hold a variance, a sum or a list without a bound, and nobody
remembers all of them. So this walks through an object's attributes, whatever their names.
"""

from __future__ import annotations

import types
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

GROWTH = 1.5  # of the last quarter of the time over the second one; twice is linear in time
STAMP = 0.9e9  # per second: what grows so is a time in nanoseconds
_OPAQUE = (str, bytes, type, types.ModuleType, types.FunctionType, types.BuiltinFunctionType)


def held_numbers(holder: object) -> dict[str, tuple[float, float, bool]]:
    """
    Return smallest and largest finite number, and whether all are, by where they are held.

    A place is a class and its attribute, such as ``ClockOffsetObserver.values``; how many elements
    a list, a dictionary or a queue has counts as a number of ``len(place)``.
    """
    found: dict[str, list[tuple[float, float, bool]]] = {}
    for place, values in _walk(holder, type(holder).__name__, set()):
        if values.size:
            finite = values[np.isfinite(values)]
            ends = float(finite.min(initial=np.inf)), float(finite.max(initial=-np.inf))
            found.setdefault(place, []).append((*ends, finite.size == values.size))
    return {
        place: (min(p[0] for p in parts), max(p[1] for p in parts), all(p[2] for p in parts))
        for place, parts in found.items()
    }


def growing(t: Array, history: Mapping[str, Array]) -> dict[str, tuple[float, float]]:
    """
    Return the largest magnitude in the second and in the last quarter of time, of what grows.

    ``history`` holds magnitudes (K,) at times ``t`` [s], (K,), for each place; 0 where there was
    none. Stamps in nanoseconds are left out.
    """
    span = t[-1] - t[0]
    early = (t - t[0] > 0.25 * span) & (t - t[0] <= 0.5 * span)
    late = t - t[0] > 0.75 * span
    if not np.any(early):
        return {}
    pairs = {place: (float(m[early].max()), float(m[late].max())) for place, m in history.items()}
    return {
        place: pair for place, pair in pairs.items() if GROWTH * pair[0] < pair[1] < STAMP * t[-1]
    }


def _walk(value: Any, place: str, seen: set[int]) -> Iterator[tuple[str, Array]]:
    if isinstance(value, (bool, int, float, np.number)):
        yield place, np.array([float(value)])
        return
    if value is None or isinstance(value, _OPAQUE) or id(value) in seen:
        return
    seen.add(id(value))
    if isinstance(value, np.ndarray):
        for part in [value[name] for name in value.dtype.names or ()] or [value]:
            if part.dtype.kind in "iuf":
                yield place, part.astype(float).ravel()
        return
    if isinstance(value, Mapping):
        yield f"len({place})", np.array([float(len(value))])
        for element in list(value.values()):
            yield from _walk(element, place, seen)
        return
    if hasattr(value, "__len__") and hasattr(value, "__iter__"):
        yield f"len({place})", np.array([float(len(value))])
        for element in list(value):
            yield from _walk(element, place, seen)
        return
    for name, attribute in _attributes(value):
        yield from _walk(attribute, f"{type(value).__name__}.{name}", seen)


def _attributes(value: Any) -> Iterator[tuple[str, Any]]:
    if isinstance(value, types.MethodType):
        yield "__self__", value.__self__
        return
    names = dict(getattr(value, "__dict__", {}))
    for cls in type(value).__mro__:
        slots = getattr(cls, "__slots__", ())
        for name in (slots,) if isinstance(slots, str) else slots:
            if name not in ("__dict__", "__weakref__") and hasattr(value, name):
                names[name] = getattr(value, name)
    yield from names.items()
