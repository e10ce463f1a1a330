"""
Detection of a receiver or driver whose altitude is no measurement: it never changes.

A driver may leave the altitude at zero; a receiver without a 3-D fix holds it. Latitude and
longitude go on, and a filter that fuses the altitude is metres off with a covariance of
centimetres. No ground is level to the last bit of a number over a hundred metres, and no receiver
without noise. Altitudes that are rounded stay the same for longer on level ground, or on water: the
smallest change so far is taken for what they are rounded to. A simulator without noise on a plane
looks like such a receiver: its height drifts then, with a covariance that says so.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

from hybrid_ins.core.inertial.earth import displacement
from hybrid_ins.core.update.measurements import Measurement, PositionFix

FEWEST_FIXES = 30  # fixes of one altitude that show it
LEAST_WAY = 100.0  # m, horizontally, that they lie apart
PER_STD, PER_STEP = 100.0, 10_000.0  # of that way, by the claimed σ, by the rounding
COARSEST = 1.0  # m, that altitudes are rounded to; larger changes are no rounding
STEP, STEP_PER_STD = 20.0, 5.0  # m, of the way, and by σ: noise at rest is no way


@dataclass(frozen=True, slots=True)
class FrozenHeight:
    """Altitudes have been the same for so long that they are no measurements."""

    t_ns: int  # ns, of the fix that has shown it: it is the first that is used without
    height: float  # m
    count: int  # fixes
    way: float  # m, horizontally


class FrozenHeightCheck:
    """
    Takes the heights from positions as long as they are frozen.

    Parameters
    ----------
    tell : callable
        Called with a `FrozenHeight` each time that it begins.
    """

    def __init__(self, tell: Callable[[FrozenHeight], None]) -> None:
        self._tell = tell
        self._first: PositionFix | None = None  # of the same height, where the last step ended
        self._count, self._way = 0, 0.0  # fixes; m
        self._rounding = math.inf  # m, smallest change so far
        self._is_frozen = False

    def checked(self, measurement: Measurement) -> Measurement:
        """Return a measurement, or a position without its height."""
        if not isinstance(measurement, PositionFix) or not math.isfinite(measurement.lla[2]):
            return measurement
        self._follow(measurement)
        is_shown = self._count >= FEWEST_FIXES and self._way >= self._needed(measurement)
        if is_shown and not self._is_frozen:
            self._is_frozen = True
            height = float(measurement.lla[2])
            self._tell(FrozenHeight(measurement.t_ns, height, self._count, self._way))
        if not self._is_frozen:
            return measurement
        lla = measurement.lla.copy()
        lla[2] = math.nan
        return replace(measurement, lla=lla)

    def _follow(self, fix: PositionFix) -> None:
        """Add a fix to those of its height, or begin with it."""
        first = self._first
        change = math.inf if first is None else abs(float(fix.lla[2] - first.lla[2]))
        if first is None or change > 0.0:
            self._rounding = min(self._rounding, change)
            self._first, self._count, self._way, self._is_frozen = fix, 1, 0.0, False
            return
        self._count += 1
        north, east, _ = displacement(first.lla, fix.lla).tolist()
        step = math.hypot(north, east)
        if step >= max(STEP, STEP_PER_STD * math.sqrt(fix.covariance_n[:2, :2].max())):
            self._first, self._way = fix, self._way + step

    def _needed(self, fix: PositionFix) -> float:
        """Return the way over which no altitude as good as a fix claims stays the same [m]."""
        rounding = self._rounding if self._rounding <= COARSEST else 0.0
        std = math.sqrt(fix.covariance_n[2, 2])
        return max(LEAST_WAY, PER_STD * std, PER_STEP * rounding)
