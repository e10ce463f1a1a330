"""
Why fixes start no filter: the dominant reason among the recent ones, with its remedy.
"""

from __future__ import annotations

from collections import Counter, deque

from hybrid_ins.core.navigator.navigator import Navigator
from hybrid_ins.core.update.measurements import PositionFix
from hybrid_ins.ros.messages.conversions import Refused
from hybrid_ins.ros.reporting.input_log import InputLog

OUTCOMES_KEPT = 100  # fixes
FEWEST_OUTCOMES = 5  # fixes that show anything
SHARE = 0.5  # of the fixes, from which a reason is the dominant one
ANOTHER_CLOCK = 2.0  # s, from the IMU: no receiver is so late, and alignment takes no older fix
LEAP_SECONDS = (17.0, 19.0)  # s: GPS time is 18 s ahead of UTC, since 2017
LONGEST_QUEUE = 10.0  # s, of IMU messages that wait for a node which does not keep up
DAY, YEAR = 86_400.0, 31_557_600.0  # s


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
            f"{describe_clocks(ahead)}: let both drivers stamp by one clock, or set "
            "use_receive_time: true",
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


def describe_clocks(ahead: float) -> str:
    """Return how far the fixes are stamped ahead of the IMU [s], and why."""
    size = abs(ahead)
    if size < 1000.0:
        text = f"{size:.1f} s"
    elif size < YEAR:
        text = f"{size / DAY:.1f} days"
    else:
        text = f"{size / YEAR:.1f} years"
    side = "ahead of" if ahead > 0.0 else "behind"
    cause = "two clocks that were set differently"
    if 0.0 < ahead < LONGEST_QUEUE:
        cause = "two clocks that were set differently, or a computer too slow for the IMU's rate"
    elif LEAP_SECONDS[0] < size < LEAP_SECONDS[1]:
        cause = "one driver stamps in GPS time, the other in UTC: 18 s"
    elif size > YEAR:
        cause = "one clock counts from its start, or was never set"
    return f"their stamps are {text} {side} the IMU's ({cause})"
