"""
What is claimed of position, velocity and heading, in one word each.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import Enum
from typing import Any

from hybrid_ins.core.inertial.state import total_std
from hybrid_ins.core.navigator.fix_watch import FixWatch
from hybrid_ins.core.navigator.navigator import Navigator
from hybrid_ins.ros.reporting.diagnostics import status
from hybrid_ins.ros.reporting.reports import Status

PARTS = ("position", "velocity", "heading")


class Validity(Enum):
    """How far an estimate can be relied on; the value is the word for it."""

    GOOD = "good"  # fixes come, and σ is within its limit
    COASTING = "coasting"  # no fixes; σ is within its limit
    WAITING = "waiting"  # there is no estimate yet
    LOST = "lost"  # σ is beyond its limit, or there is no estimate any more, or no IMU sample


LEVELS = {Validity.GOOD: 0, Validity.COASTING: 1, Validity.WAITING: 1, Validity.LOST: 2}


class ValidityMonitor:
    """
    Judges the estimate by its standard deviations and by whether fixes come.

    Parameters
    ----------
    values : mapping
        Checked parameters.
    navigator : Navigator
    fixes : FixWatch
    """

    def __init__(self, values: Mapping[str, Any], navigator: Navigator, fixes: FixWatch) -> None:
        self._limits = [values[f"validity.{part}_std_max"] for part in PARTS]
        self._navigator = navigator
        self._fixes = fixes
        self._reported: tuple[Validity, ...] = ()
        self._had_estimate = False

    def judge(self, t_ns: int, is_silent: bool = False) -> tuple[tuple[Validity, ...], list[float]]:
        """
        Return the validity of position, velocity and heading at a stamp [ns], and any σ.

        Where the IMU is silent nothing propagates the state: what there was is lost.
        """
        phase = self._navigator.phase
        self._had_estimate |= phase.filter is not None
        missing = Validity.LOST if self._had_estimate else Validity.WAITING
        nav = phase.nav
        if nav is None:
            return (missing,) * 3, []
        sigma = total_std(nav)  # that of the odometry
        found = [float(sigma[:2].max()), float(sigma[3:5].max()), float(sigma[8])]
        held = Validity.COASTING if self._fixes.outage(t_ns) else Validity.GOOD
        judged = [
            held if s <= limit else missing for s, limit in zip(found, self._limits, strict=True)
        ]
        if phase.filter is None:
            judged[2] = missing  # the filters do not agree yet
        if is_silent:
            held_no_more = [one if one is Validity.WAITING else Validity.LOST for one in judged]
            return tuple(held_no_more), []
        return tuple(judged), found

    def status(self, t_ns: int, is_silent: bool = False) -> Status:
        """Return the status at a stamp [ns]; see `judge`."""
        judged, sigma = self.judge(t_ns, is_silent)
        words = {part: one.value for part, one in zip(PARTS, judged, strict=True)}
        return status(
            "validity",
            max(LEVELS[one] for one in judged),
            ", ".join(f"{part} {word}" for part, word in words.items()),
            {
                **words,
                **{f"sigma_{part}": value for part, value in zip(PARTS, sigma, strict=False)},
            },
        )

    def changed(self, t_ns: int, is_silent: bool = False) -> Status | None:
        """Return the status at a stamp [ns] if it differs from the one last returned."""
        judged, _ = self.judge(t_ns, is_silent)
        if judged == self._reported:
            return None
        self._reported = judged
        return self.status(t_ns, is_silent)
