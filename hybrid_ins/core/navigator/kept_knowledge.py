"""
What filters learn of the receiver and of the vehicle: it outlasts them.

A filter that begins after a restart, a search or another filter meets the same receiver and the
same antenna as the one before.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence

from hybrid_ins.core.filter.events import AntennaFound, ScatterInForce
from hybrid_ins.core.filter.ins_filter import InsFilter
from hybrid_ins.core.noise.position_jumps import PositionJumps
from hybrid_ins.core.sensor_errors.lever_arm import LeverArmObserver


class KeptKnowledge:
    """Keeps the jumps of the fixes and the antenna's place for filters that begin later."""

    def __init__(self) -> None:
        self._jumps = PositionJumps()
        self._antenna: LeverArmObserver | None = None
        self._is_misled = False

    def discard_antenna(self) -> None:
        """Discard its place: the filter that runs was wrong, or the sensors are elsewhere."""
        self._antenna, self._is_misled = None, True

    def keep_antenna(self, runs: InsFilter) -> None:
        """Keep what a filter that goes on has found of it so far, for those beside it."""
        self._antenna = copy.copy(runs.update.lever_arm)

    def on_restart(self, ended: InsFilter | None) -> None:
        """Keep what a filter, or None, has found of the antenna by its end."""
        if ended is not None and not self._is_misled:
            self._antenna = ended.update.lever_arm
        self._is_misled = False

    def hand_over(
        self, ended: InsFilter | None, runs: InsFilter | None, filters: Sequence[InsFilter]
    ) -> None:
        """
        Tell filters what is known.

        Parameters
        ----------
        ended, runs : InsFilter or None
            The filters before and after a change of the phase; they may be the same.
        filters : sequence of InsFilter
            All after it: those that just begin know nothing of the antenna.
        """
        if ended is not None:
            self._jumps = ended.noise.jumps
        if runs is not None and runs is not ended:
            runs.submit(ScatterInForce(runs.t_ns, self._jumps))
        if self._antenna is not None:
            for begun in filters:
                if not begun.update.lever_arm.has_begun:
                    begun.submit(AntennaFound(begun.t_ns, self._antenna))
