"""Runs of measurements above the threshold of the gate, and whose error they are."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

MAX_ACCELERATION_ERROR = 10.0  # m/s², of an INS: its tilt is unknown altogether
ORDINARY_ACCELERATION_ERROR = 2.0  # m/s², of an INS that agreed with the fixes
SETTLED_CHANGE = 0.2  # of an innovation, at most: an error of an INS grows
SETTLED_SHARE = 1.0 / 3.0  # of a run; one that grows linearly is unsettled for its first 80 %
ABSENCE = 2.0  # times the usual spacing of measurements: longer, and a run has ended


@dataclass(frozen=True, slots=True)
class Rejections:
    """A run of measurements above the threshold, one after the other."""

    first_ns: int
    last_ns: int
    first_interval: float  # s, between the first and the correction before it
    consistent_ns: int  # since when they are consistent with each other
    settled_ns: int  # since when they hardly change
    settled_z: Array  # innovation at that stamp
    z: Array  # innovation of the last
    count: int
    certain: bool  # none had a NIS below `gate.CERTAIN`, and the innovations before were ordinary
    jump: bool  # the first was one, or one after it
    began_with_jump: bool

    def has_ended(self, t_ns: int, patience_ns: int) -> bool:
        """Return whether no measurement of the kind has come for long, at a stamp [ns]."""
        absence_ns = max(patience_ns, ABSENCE * self.first_interval * 1e9)
        return t_ns - self.last_ns > absence_ns


class Innovation(NamedTuple):
    """An innovation, and what it is compared with."""

    z: Array
    R: Array
    claimed: Array  # covariance that the measurement claims
    interval: float  # s, since the last correction
    is_pause: bool


def has_jumped(first: Array, second: Array, R: Array, interval: float) -> bool:
    """Return whether two innovations of positions are alike, and larger than those of an INS."""
    m, tolerance = min(len(first), len(second)), 4.0 * float(np.sqrt(np.trace(R)))
    size = float(np.linalg.norm(first[:m]))
    change = float(np.linalg.norm(second[:m] - first[:m]))
    grown = 0.5 * ORDINARY_ACCELERATION_ERROR * interval**2
    return size > grown + tolerance and change <= max(SETTLED_CHANGE * size, tolerance)


def is_of_receiver(last: Rejections, seen: Innovation, t_ns: int) -> bool:
    """
    Return whether a run of innovations of positions, up to a stamp [ns], is the receiver's error.

    It began with a jump; or it glided within seconds to what would have been one, and stayed there,
    where an error of an INS would have grown.
    """
    if last.began_with_jump:
        return True
    expected = max(float(np.trace(seen.R)), float(np.trace(seen.claimed)))
    settled_ns, _ = settled(last, seen.z, t_ns)
    has_settled = t_ns - settled_ns > SETTLED_SHARE * (t_ns - last.first_ns)
    return has_settled and is_jump("position", seen.z, expected, last.first_interval)


def settled(last: Rejections | None, z: Array, t_ns: int) -> tuple[int, Array]:
    """Return since when [ns] innovations hardly change, and the one at that stamp."""
    if last is None:
        return t_ns, z
    m = min(len(last.settled_z), len(z))
    change = float(np.linalg.norm(z[:m] - last.settled_z[:m]))
    stays = change <= SETTLED_CHANGE * float(np.linalg.norm(z[:m]))
    return (last.settled_ns, last.settled_z) if stays else (t_ns, z)


def is_jump(kind: str, z: Array, expected: float, interval: float) -> bool:
    """
    Return whether no acceleration error can have made an innovation so large.

    ``expected`` is the mean square of the measurement's error.
    """
    grown = MAX_ACCELERATION_ERROR * interval * (0.5 * interval if kind == "position" else 1.0)
    return float(np.linalg.norm(z)) > grown + 5.0 * math.sqrt(expected)


def are_consistent(last: Array, z: Array, R: Array) -> bool:
    """Return whether two innovations show one error of the state: constant, or growing."""
    m = min(len(last), len(z))
    change = float(np.linalg.norm(z[:m] - last[:m]))
    return change <= max(0.5 * float(np.linalg.norm(z)), 4.0 * float(np.sqrt(np.trace(R))))
