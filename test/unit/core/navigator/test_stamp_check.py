"""Stamps of IMU samples: what is a stray one, and what a gap."""

from __future__ import annotations

from hybrid_ins.core.navigator.stamp_check import JUMP_CONFIRMED, ImuStampCheck, StampFault

MS = 1_000_000  # ns


def test_a_stray_stamp_after_a_gap_is_no_confirmed_jump() -> None:
    """
    GIVEN a gap that samples have confirmed
    WHEN one stamp goes back to its end
    THEN it is stray, as it would be without the gap: the stamps ahead of it confirmed the gap.
    """
    stamps = ImuStampCheck(2.0)
    stamps.last_ns = 1_000 * MS
    behind = [stamps.check((2_000 + 10 * k) * MS) for k in range(JUMP_CONFIRMED)]
    assert behind == [StampFault.JUMP] * (JUMP_CONFIRMED - 1) + [None]
    stamps.last_ns = 3_000 * MS  # by steps that need no check

    assert stamps.check(2_100 * MS) is StampFault.JUMP
