"""
Checkpoints of a filter: a late measurement is fused at its own stamp by going back to one.

The filter restores the youngest checkpoint before the measurement and repeats the IMU samples and
events since, with the measurement among them, so that the result is that of an in-order run.
"""

from __future__ import annotations

import bisect
import copy
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.filter.events import Event
from hybrid_ins.core.filter.measurement_update import MeasurementUpdate

Array = NDArray[np.float64]

MIN_SPACING_NS = 50_000_000
SPACINGS = 4  # checkpoints per horizon without events


@dataclass(frozen=True, slots=True)
class Checkpoint:
    """All that changes in a filter, copied."""

    t_ns: int
    nav: Array  # (N_NAV,)
    update: MeasurementUpdate


class History:
    """
    Checkpoints over a time span, and the events applied since the oldest of them.

    Parameters
    ----------
    horizon : float
        Length of the time span [s].

    Attributes
    ----------
    horizon_ns : int
        The same [ns].
    """

    def __init__(self, horizon: float) -> None:
        self.horizon_ns = int(horizon * 1e9)
        self._spacing_ns = max(self.horizon_ns // SPACINGS, MIN_SPACING_NS)
        self._checkpoints: list[Checkpoint] = []
        self._counts: list[int] = []  # of events that were applied before each checkpoint
        self._events: list[Event] = []  # the last ones
        self._count = 0  # of all events ever applied

    def __copy__(self) -> History:
        twin = object.__new__(History)
        twin.__dict__.update(self.__dict__)
        twin._checkpoints = [replace(p, update=copy.copy(p.update)) for p in self._checkpoints]
        twin._counts, twin._events = [*self._counts], [*self._events]
        return twin

    @property
    def due_ns(self) -> int:
        """Stamp at which the next checkpoint is due."""
        return self._checkpoints[-1].t_ns + self._spacing_ns

    @property
    def last_event(self) -> Event | None:
        """The event that was applied last."""
        return self._events[-1] if self._events else None

    @property
    def count(self) -> int:
        """Number of events that are applied."""
        return self._count

    def add_event(self, event: Event) -> None:
        """Append an event that is applied now."""
        self._events.append(event)
        self._count += 1

    def add_checkpoint(self, checkpoint: Checkpoint) -> None:
        """Append a checkpoint, and drop those that no measurement within the span can need."""
        self._checkpoints.append(checkpoint)
        self._counts.append(self._count)
        oldest_ns = checkpoint.t_ns - self.horizon_ns
        while len(self._checkpoints) > 1 and self._checkpoints[1].t_ns < oldest_ns:
            del self._checkpoints[0], self._counts[0]
        # All since the oldest checkpoint, and the last one in any case.
        del self._events[: len(self._events) - max(self._count - self._counts[0], 1)]

    def before(self, t_ns: int) -> Checkpoint | None:
        """Return the youngest checkpoint before a stamp [ns]; None where there is none."""
        at = self._index(t_ns)
        return self._checkpoints[at] if at >= 0 else None

    def rewind(self, t_ns: int) -> list[Event]:
        """Drop that checkpoint and all later ones; return the events since, to be repeated."""
        at = self._index(t_ns)
        keep = len(self._events) - (self._count - self._counts[at])
        events = self._events[keep:]
        self._count = self._counts[at]
        del self._checkpoints[at:], self._counts[at:], self._events[keep:]
        return events

    def _index(self, t_ns: int) -> int:
        return bisect.bisect_left(self._checkpoints, t_ns, key=lambda point: point.t_ns) - 1
