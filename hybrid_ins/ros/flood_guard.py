"""
A limit on the rate of aiding measurements: each costs a filter update, or hundreds while searching.
"""

from __future__ import annotations

from collections import Counter

from hybrid_ins.ros.conversions import Refused

WINDOW_NS = 1_000_000_000
MOST = 100  # measurements of one topic in a window: receivers give up to 50 a second

TOO_MANY = Refused(
    "gnss: too many messages", f"more than {MOST} in a second: are there several publishers?"
)


class FloodGuard:
    """Refuses messages of a topic beyond ``MOST`` per second of the IMU's time."""

    def __init__(self) -> None:
        self._start_ns = 0
        self._counts: Counter[str] = Counter()

    def check(self, topic: str, now_ns: int) -> Refused | None:
        """Return why one more message is refused, or None; ``now_ns`` is the IMU's stamp [ns]."""
        if not 0 <= now_ns - self._start_ns < WINDOW_NS:
            self._start_ns = now_ns
            self._counts.clear()
        self._counts[topic] += 1
        return TOO_MANY if self._counts[topic] > MOST else None
