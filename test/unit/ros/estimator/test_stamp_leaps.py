"""A receiver's clock that leaps by whole seconds is told from messages that are late."""

from __future__ import annotations

import pytest

from hybrid_ins.ros.estimator.stamp_leaps import CONFIRMED, SECOND_NS, StampLeaps

PERIOD_NS, DELAY_NS = SECOND_NS // 5, 80_000_000


def settled(period_ns: int = PERIOD_NS) -> tuple[StampLeaps, int]:
    """Return the check after ten messages of a receiver, and the IMU's time [ns]."""
    leaps = StampLeaps()
    for k in range(1, 11):
        assert leaps.observe(k * period_ns - DELAY_NS, k * period_ns) == 0
    return leaps, 10 * period_ns


@pytest.mark.parametrize("seconds", [1, -1, 3, -18])
def test_a_leap_is_confirmed_once_the_stamps_stay_there(seconds: int) -> None:
    leaps, now_ns = settled()
    confirmed = []
    for k in range(1, 20):
        jitter_ns = 40_000_000 * (k % 3)
        imu_ns = now_ns + k * PERIOD_NS + jitter_ns
        stamp_ns = now_ns + k * PERIOD_NS - DELAY_NS + seconds * SECOND_NS
        assert leaps.observe(stamp_ns, imu_ns) == seconds
        confirmed.append(leaps.confirmed)
    assert not any(confirmed[: CONFIRMED - 1])
    assert confirmed[-1]


def test_messages_that_were_held_up_and_arrive_together_are_late() -> None:
    leaps, now_ns = settled()
    arrival_ns = now_ns + 3 * SECOND_NS
    for k in range(1, 15):
        leaps.observe(now_ns + k * PERIOD_NS - DELAY_NS, arrival_ns + k)
        assert not leaps.confirmed


@pytest.mark.parametrize("by_ns", [300_000_000, -500_000_000, 25 * SECOND_NS])
def test_another_delay_is_no_leap(by_ns: int) -> None:
    leaps, now_ns = settled()
    for k in range(1, 20):
        imu_ns = now_ns + k * PERIOD_NS
        assert leaps.observe(imu_ns - DELAY_NS + by_ns, imu_ns) == 0


@pytest.mark.parametrize("period_ns", [PERIOD_NS, SECOND_NS])
def test_fixes_that_run_ahead_of_an_imu_that_has_stopped_are_no_leap(period_ns: int) -> None:
    leaps, now_ns = settled(period_ns)
    for k in range(1, 40):
        assert leaps.observe(now_ns + k * period_ns - DELAY_NS, now_ns) == 0


def test_a_computer_that_falls_behind_with_the_imu_is_no_leap() -> None:
    leaps, now_ns = settled()
    for k in range(1, 60):
        behind_ns = min(k * SECOND_NS // 20, SECOND_NS)
        stamp_ns = now_ns + k * SECOND_NS - DELAY_NS
        assert leaps.observe(stamp_ns, now_ns + k * SECOND_NS - behind_ns) == 0
