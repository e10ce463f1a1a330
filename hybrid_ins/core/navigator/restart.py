"""
Restarts of a navigator: what makes one necessary, and what of the state outlasts it.
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.alignment.given_heading import HEADING_KEPT_STD
from hybrid_ins.core.filter.gap import turn_std
from hybrid_ins.core.filter.ins_filter import InsFilter
from hybrid_ins.core.inertial.rotations import heading_from_quat
from hybrid_ins.core.inertial.state import QUAT, total_std
from hybrid_ins.core.update.gate import Verdict
from hybrid_ins.core.update.measurements import Measurement, PositionFix

Array = NDArray[np.float64]

TURN_IN_GAP = 0.5  # rad/s, that a vehicle may have turned by in a gap
RESETS, RESETS_NS = 3, 30_000_000_000  # that many within that time: the heading is wrong
MOVING = 1.0  # m/s, at which a wrong heading makes fixes disagree


class ResetCount:
    """
    Counts the covariance resets of a filter: repeated ones prove its heading wrong.

    A jump of the fixes counts half: a receiver may jump a few times, a wrong heading causes a reset
    each time that the patience of the gate ends.
    """

    def __init__(self) -> None:
        self._resets: deque[tuple[int, float]] = deque(maxlen=2 * RESETS)  # stamps, and weights

    def add(self, verdict: Verdict, speed: float) -> bool:
        """Count a reset for a fix, at a speed [m/s]; return whether the heading is wrong."""
        t_ns = verdict.measurement.t_ns
        self._resets.append((t_ns, 0.5 if verdict.receiver_jumped else 1.0))
        recent = sum(weight for stamp, weight in self._resets if t_ns - stamp < RESETS_NS)
        return recent >= RESETS and speed > MOVING


class UnseenTurn:
    """
    A turn in a gap after which the heading has to be found anew, as soon as fixes can show it.

    Without fixes nothing is better than the state that goes on, as uncertain as it is.
    """

    def __init__(self) -> None:
        self._gap = 0.0  # s

    def observe(self, running: InsFilter | None, reading: Array, gap: float) -> None:
        """
        Use a gap.

        Parameters
        ----------
        running : InsFilter or None
            The filter before it; None: there was no heading yet.
        reading : ndarray, shape (6,)
            Sample behind the gap: specific force [m/s²] and angular rate [rad/s], b.
        gap : float
            Time without IMU samples [s].
        """
        if running is not None and turn_std(running.sample, reading, gap) >= HEADING_KEPT_STD:
            self._gap = gap

    def pop(self, measurement: Measurement, running: InsFilter | None) -> float:
        """Return at a fix how long the gap was [s] if nothing has shown the heading since; or 0."""
        if running is None or measurement.kind != PositionFix.kind or not self._gap:
            return 0.0
        gap, self._gap = self._gap, 0.0
        return gap if total_std(running.flat_state())[8] >= HEADING_KEPT_STD else 0.0


def heading_after(
    gap: float, running: InsFilter | None, standing: bool
) -> tuple[float, float] | None:
    """
    Return the heading [rad from north] after a gap, and its uncertainty.

    Parameters
    ----------
    gap : float
        Time without IMU samples [s].
    running : InsFilter or None
        The filter before it.
    standing : bool
        The vehicle stood.

    Returns
    -------
    (float, float) or None
        Heading and standard deviation [rad]; None where they are of no more use.
    """
    if running is None:
        return None
    nav = running.flat_state()
    rate = 0.1 * TURN_IN_GAP if standing else TURN_IN_GAP
    std = math.hypot(float(total_std(nav)[8]), rate * gap)
    return (heading_from_quat(nav[QUAT]), std) if std < HEADING_KEPT_STD else None
