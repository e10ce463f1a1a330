"""
A limit on the rate of aiding measurements: each costs a filter update, or hundreds while searching.
"""

from __future__ import annotations

from collections import Counter

WINDOW_NS = 1_000_000_000
MOST = 100  # measurements of one topic in a window: receivers give up to 50 a second


class FloodGuard:
    """Admits at most ``MOST`` messages of a topic per second of the IMU's time."""

    def __init__(self) -> None:
        self._start_ns = 0
        self._counts: Counter[str] = Counter()

    def admits(self, topic: str, now_ns: int) -> bool:
        """Return whether one more message may be used; ``now_ns`` is the last IMU stamp [ns]."""
        if not 0 <= now_ns - self._start_ns < WINDOW_NS:
            self._start_ns = now_ns
            self._counts.clear()
        self._counts[topic] += 1
        return self._counts[topic] <= MOST
