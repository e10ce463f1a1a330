"""
A limit on the rate of aiding measurements: each costs a filter update, or hundreds while searching.
"""

from __future__ import annotations

from collections import Counter

from hybrid_ins.ros.messages.conversions import Refused

WINDOW_NS = 1_000_000_000
MOST = 100  # measurements of one topic in a window: receivers give up to 50 a second

TOO_MANY = Refused(
    "gnss: too many messages", f"more than {MOST} in a second: are there several publishers?"
)


class FloodGuard:
    """
    Refuses messages of a topic beyond ``MOST`` per second of the IMU's time.

    While that stands still, since no sample comes or is usable, the messages' own stamps count.
    """

    def __init__(self) -> None:
        self._start_ns = 0
        self._now_ns = self._stamp_ns = 0  # the IMU's last stamp, and the first message's there
        self._counts: Counter[str] = Counter()

    def check(self, topic: str, now_ns: int, stamp_ns: int) -> Refused | None:
        """Return why one more message is refused, or None; stamps of IMU and message [ns]."""
        if now_ns != self._now_ns:
            self._now_ns, self._stamp_ns = now_ns, stamp_ns
        since_ns = now_ns - self._start_ns
        if not 0 <= since_ns < WINDOW_NS or abs(stamp_ns - self._stamp_ns) >= WINDOW_NS:
            self._start_ns, self._stamp_ns = now_ns, stamp_ns
            self._counts.clear()
        self._counts[topic] += 1
        return TOO_MANY if self._counts[topic] > MOST else None
