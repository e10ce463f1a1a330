"""
What filters learn of the receiver and of the vehicle: it outlasts them.

A filter that begins after a restart, a search or another filter meets the same receiver and the
same antenna as the one before.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence

from hybrid_ins.core.filter.events import AntennaFound, ScatterInForce, ScatterShown
from hybrid_ins.core.filter.ins_filter import InsFilter
from hybrid_ins.core.imu.samples import ImuRing
from hybrid_ins.core.navigator.phases import Phase
from hybrid_ins.core.noise.fix_differences import FixDifferences
from hybrid_ins.core.noise.position_jumps import PositionJumps
from hybrid_ins.core.sensor_errors.lever_arm import LeverArmObserver
from hybrid_ins.core.update.measurements import Measurement, PositionFix


class KeptKnowledge:
    """
    Keeps what is known of the fixes and of the antenna's place for filters that begin later.

    Parameters
    ----------
    ring : ImuRing
        Recent IMU samples.
    """

    def __init__(self, ring: ImuRing) -> None:
        self._ring = ring
        self._differences = FixDifferences()
        self._jumps = PositionJumps()
        self._antenna: LeverArmObserver | None = None
        self._is_misled = False

    def observe(self, measurement: Measurement, phase: Phase) -> None:
        """Use a measurement that no filter has judged; tell those that search what is shown now."""
        if not isinstance(measurement, PositionFix):
            return
        self._differences.observe(measurement)
        if phase.bank is not None and self._differences.begins_to_show:
            self._tell_scatter(phase.bank.filters)

    def _tell_scatter(self, filters: Sequence[InsFilter]) -> None:
        shown = self._differences.shown(self._ring) if filters else None
        if shown is not None:
            for one in filters:
                one.submit(ScatterShown(one.t_ns, *shown))

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
        self._tell_scatter([begun for begun in filters if not begun.noise.has_begun])
        if self._antenna is not None:
            for begun in filters:
                if not begun.update.lever_arm.has_begun:
                    begun.submit(AntennaFound(begun.t_ns, self._antenna))
