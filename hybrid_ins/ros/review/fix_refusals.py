"""
Why fixes start no filter: the dominant reason among the recent ones, with its remedy.
"""

from __future__ import annotations

from collections import Counter, deque

from hybrid_ins.core.navigator.navigator import Navigator
from hybrid_ins.core.update.measurements import PositionFix
from hybrid_ins.ros.messages.conversions import Refused
from hybrid_ins.ros.reporting.clocks import ONE_CLOCK, describe_clocks
from hybrid_ins.ros.reporting.input_log import InputLog

OUTCOMES_KEPT = 100  # fixes
FEWEST_OUTCOMES = 5  # fixes that show anything
SHARE = 0.5  # of the fixes, from which a reason is the dominant one
ANOTHER_CLOCK = 2.0  # s, from the IMU: no receiver is so late, and alignment takes no older fix


class FixRefusals:
    """
    Collects what becomes of the fixes while no filter runs.

    Parameters
    ----------
    navigator : Navigator
    inputs : InputLog
        Warns once there is a dominant reason.
    """

    def __init__(self, navigator: Navigator, inputs: InputLog) -> None:
        self._navigator = navigator
        self._inputs = inputs
        self._outcomes: deque[str] = deque(maxlen=OUTCOMES_KEPT)
        self._texts: dict[str, str] = {}

    def note(self, fix: PositionFix | Refused) -> None:
        """Note a fix that has arrived, or why it is none."""
        if self._navigator.filter is not None:
            self._outcomes.clear()
            return
        refused = fix if isinstance(fix, Refused) else self._by_another_clock(fix)
        self._outcomes.append("" if refused is None else refused.name)
        if refused is not None:
            self._texts[refused.name] = refused.text
        if self.dominant:
            self._inputs.warn_once("gnss: no fix is of use", f"gnss/fix: {self.dominant}")

    def _by_another_clock(self, fix: PositionFix) -> Refused | None:
        imu_ns = self._navigator.last_ns
        ahead = (fix.t_ns - imu_ns) * 1e-9
        if imu_ns == 0 or abs(ahead) < ANOTHER_CLOCK:
            return None
        return Refused(
            "another clock",
            f"{describe_clocks(ahead)}: {ONE_CLOCK}",
        )

    @property
    def dominant(self) -> str:
        """The reason for which most fixes are of no use; empty where most are of use."""
        if len(self._outcomes) < FEWEST_OUTCOMES:
            return ""
        [(name, count)] = Counter(self._outcomes).most_common(1)
        if not name or count < SHARE * len(self._outcomes):
            return ""
        return f"{count} of the last {len(self._outcomes)} fixes are of no use: {self._texts[name]}"
