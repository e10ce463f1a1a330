"""Stamps of IMU samples: what is a stray one, and what a gap."""

from __future__ import annotations

import numpy as np
import pytest

from hybrid_ins.core.fix_checks.fix_speed import SpeedCheck
from hybrid_ins.core.navigator.stamp_check import (
    JUMP_CONFIRMED,
    ImuStampCheck,
    MeasurementCheck,
    StampFault,
)
from hybrid_ins.core.update.measurements import PositionFix, VelocityFix

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


def test_stray_stamps_among_good_ones_are_no_confirmed_jump() -> None:
    """GIVEN a driver that stamps one sample in a hundred 100 s early."""
    stamps = ImuStampCheck(2.0)
    for k in range(1, 10 * JUMP_CONFIRMED):
        stamps.last_ns = (200_000 + 500 * k) * MS // 10  # good ones, by steps that need no check

        assert stamps.check(stamps.last_ns - 10_000 * MS) is StampFault.JUMP


class HeldPositions:
    """A receiver that repeats one position at 5 Hz, and the checks of its fixes."""

    def __init__(self, std: float = 1.0) -> None:
        self.check = MeasurementCheck(SpeedCheck(100.0, 3.0))
        self.covariance = std**2 * np.eye(3)
        self.lla = np.array([0.8, 0.1, 100.0])
        self.t_ns = 1_000_000 * MS

    def refused(self, speed: float, lasting: float) -> int:
        """Return how many fixes of the next seconds are refused, at a speed [m/s]."""
        count = 0
        for _ in range(round(5.0 * lasting)):
            self.t_ns += 200 * MS
            fix = PositionFix(self.t_ns, self.lla, self.covariance, np.zeros(3))
            verdict = self.check.check(fix, ImuStampCheck(2.0), speed)
            count += verdict is not None and verdict.reason == "same position while moving"
        return count


def test_a_held_position_that_was_left_behind_is_refused_at_rest_until_it_changes() -> None:
    receiver = HeldPositions()

    assert receiver.refused(5.0, 4.0) == 19  # the first one is new
    assert receiver.refused(0.0, 60.0) == 300
    receiver.lla = receiver.lla + 1e-6
    assert receiver.refused(0.0, 60.0) == 0


def test_a_receiver_that_holds_its_position_when_the_vehicle_stops_is_believed_at_rest() -> None:
    """A filter that finds the stop late is no evidence against what it stopped at."""
    receiver = HeldPositions()

    assert receiver.refused(1.4, 2.0) == 9
    assert receiver.refused(0.0, 60.0) == 0


def test_a_position_that_claims_little_is_left_behind_later() -> None:
    receiver = HeldPositions(std=5.0)

    assert receiver.refused(5.0, 2.8) == 13
    assert receiver.refused(0.0, 10.0) == 0
    assert receiver.refused(5.0, 1.0) == 5
    assert receiver.refused(0.0, 10.0) == 50


class VelocitiesWithoutPositions:
    """A receiver at 5 Hz whose positions end, and the checks of its velocities."""

    def __init__(self) -> None:
        self.check = MeasurementCheck(SpeedCheck(100.0, 3.0))
        self.t_ns = 1_000_000 * MS
        for k in range(10):
            self.t_ns += 200 * MS
            lla = np.array([0.8 + 1e-7 * k, 0.1, 100.0])
            fix = PositionFix(self.t_ns, lla, np.eye(3), np.zeros(3))
            assert self.check.check(fix, ImuStampCheck(2.0), 5.0) is None
            assert self.refused([(3.0 + 0.01 * k, 4.0, 0.0)], 5.0) == 0

    def refused(self, velocities: list[tuple[float, float, float]], speed: float) -> int:
        """Return how many of the next are refused, at a speed [m/s] of the filter."""
        count = 0
        for velocity in velocities:
            self.t_ns += 200 * MS
            fix = VelocityFix(self.t_ns, np.array(velocity), 0.01 * np.eye(3), np.zeros(3))
            verdict = self.check.check(fix, ImuStampCheck(2.0), speed)
            count += verdict is not None and "while no position comes" in verdict.reason
        return count


@pytest.mark.parametrize("held", [(3.09, 4.0, 0.0), (0.0, 0.0, 0.0)], ids=["the last", "zero"])
def test_a_velocity_that_is_held_without_positions_is_refused(held: tuple[float, ...]) -> None:
    receiver = VelocitiesWithoutPositions()
    signs = [held, (held[0], held[1], -0.0)]

    assert receiver.refused(signs * 5, 5.0) in (0, 1)  # for 2 s
    assert receiver.refused(signs * 50, 5.0) == 100
    assert receiver.refused([held], 0.0) == 1  # until it changes
    assert receiver.refused([(3.0, 4.0, 0.1)], 5.0) == 0


def test_velocities_that_change_or_are_those_of_a_stand_are_used_without_positions() -> None:
    receiver = VelocitiesWithoutPositions()

    assert receiver.refused([(3.0, 4.0 + 0.01 * k, 0.0) for k in range(100)], 5.0) == 0
    assert receiver.refused([(0.0, 0.0, 0.0)] * 100, 0.05) == 0


def test_a_constant_velocity_is_used_beside_positions() -> None:
    receiver = VelocitiesWithoutPositions()

    for k in range(100):
        lla = np.array([0.8 + 1e-7 * k, 0.1, 100.0])
        fix = PositionFix(receiver.t_ns + MS, lla, np.eye(3), np.zeros(3))
        assert receiver.check.check(fix, ImuStampCheck(2.0), 5.0) is None
        assert receiver.refused([(3.0, 4.0, 0.0)], 5.0) == 0
