"""
How kernels are compiled: by numba, at their first call, unless a cache of machine code is enabled.

Decorating a kernel registers it here and does nothing else. Whoever runs the package decides where
machine code is kept, see `hybrid_ins.kernel_cache`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from numba import njit

Function = Callable[..., Any]

KERNELS: list[Any] = []  # all there are, as numba's dispatchers
on_registration: list[Callable[[Any], None]] = []  # called with every kernel decorated from now on


def kernel(allocates: bool = True, **options: Any) -> Callable[[Function], Function]:
    """
    Return the decorator that compiles a function by numba.

    Parameters
    ----------
    allocates : bool
        The function makes arrays. If neither it nor what it calls does, references to the views
        that it takes of its arguments are not counted: that is an eighth of a filter step.
    **options
        Those of ``njit``.
    """

    def decorate(function: Function) -> Function:
        dispatcher = njit(error_model="numpy", _nrt=allocates, **options)(function)
        KERNELS.append(dispatcher)
        for observe in on_registration:
            observe(dispatcher)
        return dispatcher  # type: ignore[no-any-return]

    return decorate
