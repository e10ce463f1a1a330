"""A clock of the IMU that is set back by less than makes a new time base."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import pytest
from support.scenes import make_navigator

from hybrid_ins.core.navigator.notices import GapBridged

MS = 1_000_000  # ns


class Stamps:
    """An IMU at 100 Hz that has given 1 s of samples, and what is found in those after them."""

    def __init__(self) -> None:
        self.navigator = make_navigator()
        self.rng = np.random.default_rng(0)
        self.readings: dict[int, np.ndarray] = {}
        self.give(range(1_000, 2_001, 10))

    def give(self, stamps_ms: Iterable[int], again: bool = False) -> None:
        """Give samples of these stamps [ms]."""
        for ms in stamps_ms:
            reading = self.readings[ms] if again else self.rng.normal(size=6)
            self.readings.setdefault(ms, reading)
            self.navigator.imu(ms * MS, *reading)

    def found(self) -> list[float]:
        """Times without stamps [s], since the last call."""
        notices = self.navigator.pop_notices()
        return [notice.seconds for notice in notices if isinstance(notice, GapBridged)]


@pytest.mark.parametrize("by", [83, 300])
def test_time_that_passes_while_the_stamps_catch_up_is_found_once(by: int) -> None:
    imu = Stamps()

    imu.give(range(2_010 - by, 3_000, 10))

    assert imu.found() == pytest.approx([by * 1e-3], abs=1e-3)
    imu.give(range(3_000 - by, 4_000, 10))
    assert imu.found() == pytest.approx([by * 1e-3], abs=0.011)


def test_a_block_that_is_sent_again_is_no_clock() -> None:
    imu = Stamps()

    imu.give(range(1_710, 2_001, 10), again=True)
    imu.give(range(2_010, 3_000, 10))

    assert not imu.found()


def test_a_block_that_others_have_overtaken_is_no_clock() -> None:
    imu = Stamps()

    imu.give([*range(2_110, 2_210, 10), *range(2_010, 2_110, 10), *range(2_210, 3_000, 10)])

    assert not imu.found()


def test_behind_a_stray_stamp_that_was_ahead_no_time_is_missing() -> None:
    imu = Stamps()

    imu.give([2_110, *range(2_020, 3_000, 10)])

    assert not imu.found()


def test_refused_samples_of_another_period_are_not_those_of_this_clock() -> None:
    imu = Stamps()

    imu.give([*range(1_700, 2_001, 30), *range(2_010, 3_000, 10)])

    assert not imu.found()
