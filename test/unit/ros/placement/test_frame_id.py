"""Which messages change a frame_id."""

from __future__ import annotations

import pytest

from hybrid_ins.ros.placement.frame_id import CONFIRMED, FrameId

SECOND = 1_000_000_000


def known(name: str) -> FrameId:
    frame = FrameId()
    frame.set(name)
    return frame


def test_the_first_is_settled_once_it_is_set() -> None:
    frame = FrameId()

    assert frame.in_force is None and not frame.is_settled("")
    frame.set("")
    assert frame.is_settled("") and not frame.is_settled("imu")


@pytest.mark.parametrize(("period", "needed"), [(0.01, 101), (0.25, 5), (1.0, CONFIRMED)])
def test_another_has_to_last_in_messages_and_in_time(period: float, needed: int) -> None:
    frame = known("imu")

    confirmed = [frame.is_confirmed("other", round(k * period * SECOND)) for k in range(needed)]

    assert confirmed == [False] * (needed - 1) + [True]


@pytest.mark.parametrize("between", ["imu", "third"])
def test_one_of_another_name_between_them_begins_the_count_anew(between: str) -> None:
    frame = known("imu")

    for k in range(50):
        assert not frame.is_confirmed("other", k * SECOND)
        if k % 4 == 3:
            assert frame.is_confirmed(between, k * SECOND) is (between == "imu")


def test_stamps_that_go_back_begin_it_anew() -> None:
    frame = known("imu")
    for k in range(CONFIRMED):
        assert not frame.is_confirmed("other", 100 * SECOND - k * SECOND)


def test_a_message_of_the_frame_in_force_settles_it_again() -> None:
    frame = known("imu")
    frame.is_confirmed("other", 0)
    assert not frame.is_settled("imu")

    assert frame.is_confirmed("imu", 1)

    assert frame.is_settled("imu")
