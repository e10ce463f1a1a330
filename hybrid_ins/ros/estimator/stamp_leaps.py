"""
Leaps of the receiver's clock by whole seconds, seen where its messages arrive.

A receiver that learns the leap seconds of UTC minutes after its start, or a driver that takes the
second of a solution from another message, stamps from then on by whole seconds earlier or later.
Its messages still arrive when they did: compared with the stamps of the IMU samples between which
they arrive, their stamps leap. A delay on the way changes by any fraction of a second, and that of
messages which were held up and arrive together becomes smaller with each. A computer that falls
behind with the IMU's samples does so by and by: a leap comes at once. Where the IMU's samples stay
away, the stamps of the messages go on as before. A driver that is one message of a receiver at 1 Hz
late from then on looks the same: the positions of a vehicle that moves tell.
"""

from __future__ import annotations

from collections import deque

import numpy as np

SECOND_NS = 1_000_000_000
LARGEST = 20  # s: GPS time is 18 s ahead of UTC
TOLERANCE_NS = 150_000_000  # by which a leap may differ from whole seconds: delays on the way vary
USUAL, FEWEST = 20, 5  # messages that show the usual difference; at least
CONFIRMED, CONFIRMED_NS = 5, 3_000_000_000  # messages in a row that make a leap, and how long


class StampLeaps:
    """
    Compares the stamps of one topic's messages with the IMU's at their arrival.

    Attributes
    ----------
    confirmed : bool
        The last message was one of enough in a row after the same leap.
    evidence : float
        For a leap and against another delay, which those who know the motion add up from the first
        of these messages on.
    """

    def __init__(self) -> None:
        self.confirmed, self.evidence = False, 0.0
        self._usual: deque[int] = deque(maxlen=USUAL)  # ns, stamp less that of the last IMU sample
        self._is_usual = False  # so was the difference of the last message without a leap
        self._steps: deque[int] = deque(maxlen=USUAL)  # ns, from stamp to stamp without a leap
        self._last_ns = 0  # stamp of the last message
        self._leap = self._count = 0  # s, of the last message; messages in a row after it
        self._since_ns = 0  # stamp of the IMU at the first of them

    def observe(self, stamp_ns: int, imu_ns: int) -> int:
        """
        Return by how many whole seconds a message's stamp has leapt ahead; 0: it has not.

        Parameters
        ----------
        stamp_ns, imu_ns : int
            Stamp of the message, without the leaps before, and of the last IMU sample [ns].
        """
        self.confirmed = False
        ahead_ns = stamp_ns - imu_ns
        leap, excess_ns = self._leap_of(ahead_ns)
        step_ns, self._last_ns = stamp_ns - self._last_ns, stamp_ns
        if leap != 0 and self._leap == 0 and abs(step_ns - np.median(self._steps)) < TOLERANCE_NS:
            leap = 0
        if leap == 0:
            self._steps.append(step_ns)
            self._usual.append(ahead_ns)
            self._is_usual = abs(excess_ns) < TOLERANCE_NS
            self._leap = 0
            return 0
        if leap != self._leap:
            self._leap, self._count, self._since_ns, self.evidence = leap, 0, imu_ns, 0.0
        self._count += 1
        self.confirmed = self._count >= CONFIRMED and imu_ns - self._since_ns >= CONFIRMED_NS
        return leap

    def _leap_of(self, ahead_ns: int) -> tuple[int, float]:
        """Return the leap [s] that a difference [ns] shows, 0 for none, and its excess [ns]."""
        if len(self._usual) < FEWEST:
            return 0, 0.0
        excess_ns = ahead_ns - float(np.median(self._usual))
        leap = round(excess_ns / SECOND_NS)
        is_whole = abs(excess_ns - leap * SECOND_NS) < TOLERANCE_NS
        shown = self._is_usual and is_whole and abs(leap) <= LARGEST
        return leap if shown else 0, excess_ns
