"""
Words for stamps of fixes that do not go with those of the IMU: by how much, why, and the remedy.
"""

from __future__ import annotations

import math

from hybrid_ins import parameters

LEAP_SECONDS = (17.0, 19.0)  # s: GPS time is 18 s ahead of UTC, since 2017
LONGEST_QUEUE = 10.0  # s, of IMU messages that wait for a node which does not keep up
DAY, YEAR = 86_400.0, 31_557_600.0  # s
LONGEST_DELAY = parameters.find("gnss.max_delay").high  # s
ONE_CLOCK = "let both drivers stamp by one clock, or set use_receive_time: true"


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


def describe_wrong_stamp(age: float, count: int, imu_stopped: bool) -> str:
    """
    Return why fixes of that age [s] are not used, and the remedy.

    The age of a fix that is stamped ahead of the IMU is negative. ``imu_stopped`` says that no
    sample has come since the fix before: the clocks are not to blame then.
    """
    if imu_stopped and age < 0.0:
        return (
            f"gnss/fix: {count} fixes are of no use: the last IMU sample is {-age:.1f} s before "
            "this one: restart the driver of the IMU, check the cable"
        )
    needed = math.ceil(age) + 1
    if age >= 0.0 and needed <= LONGEST_DELAY:
        return (
            f"gnss/fix: {count} fixes came too late to be used, this one {age:.1f} s after its "
            f"stamp: raise gnss.max_delay to {needed}"
        )
    return f"gnss/fix: {count} fixes are of no use: {describe_clocks(-age)}: {ONE_CLOCK}"
