"""What is propagated beside the filter stays right for as long as the node runs."""

from __future__ import annotations

import numpy as np
import pytest
from support.endurance import assert_clock_is_within_three_sigma

from hybrid_ins.ros.estimator.estimator import Estimator
from hybrid_ins.ros.reporting.reports import Report
from tools.robustness import endurance

MINUTE = 60.0


@pytest.fixture(scope="module")
def smooth_drive() -> tuple[endurance.Day, list[float]]:
    """A quarter of an hour of smooth driving, and the speeds at which it was taken for standing."""
    duration = 15.0 * MINUTE
    motion = endurance.MOTIONS["smooth drive"](duration + 1.0, 0)
    speeds: list[float] = []

    class Watched(Estimator):
        def pop_reports(self) -> list[Report]:
            if self.navigator.monitor.standing:
                t = (self.navigator.last_ns - endurance.T0_NS) * 1e-9
                speeds.append(float(np.linalg.norm(motion.displacement(t, 1))))
            return super().pop_reports()

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(endurance, "Estimator", Watched)
        return endurance.live("smooth drive", duration, 0, 0.0, {}), speeds


@pytest.mark.slow
def test_smooth_driving_does_not_end_the_node(
    smooth_drive: tuple[endurance.Day, list[float]],
) -> None:
    """
    GIVEN a quarter of an hour of smooth driving with an ordinary receiver
    THEN the estimator goes on, every fix is used, and what it claims of clock and position holds.
    """
    day, _ = smooth_drive

    assert not day.failure
    assert day.t[-1] > 14.5 * MINUTE
    assert "opened" not in day.summary
    assert day.clock_excess < 3.0
    assert 1.5 < day.position_nees[3:].mean() < 4.5
    assert day.sensitivity.max() < 100.0


@pytest.mark.slow
def test_smooth_braking_is_not_standing(
    smooth_drive: tuple[endurance.Day, list[float]],
) -> None:
    """
    GIVEN a vehicle that brakes so steadily that its IMU seems to stand, and fixes that scatter by
    metres
    THEN no zero velocity is fused while it moves.
    """
    _, speeds = smooth_drive

    assert not [speed for speed in speeds if speed > 0.1]


@pytest.mark.slow
def test_zero_updates_correct_the_sensitivity_too() -> None:
    """
    GIVEN a vehicle that stands for 30 s of every 70, so that most corrections are zero updates
    THEN the sensitivity to the clock offset stays as large as motions are.

    Corrected by the fixes alone it was 10^3 after five minutes and 10^12 after fourteen, when the
    offset's variance had fallen to zero and the node ended.
    """
    day = endurance.live("stop and go", 6.0 * MINUTE, 1, 0.0, {})

    assert not day.failure
    assert day.clock_excess < 3.0
    assert day.sensitivity.max() < 100.0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "offset"), [("standing", 0.0), ("cruise", 0.2), ("smooth drive", -0.1)]
)
def test_clock_offset_stays_within_its_uncertainty(kind: str, offset: float) -> None:
    """
    GIVEN motion that shows little of the clock, and fixes stamped early or late
    THEN the true offset is within three sigma at all times, and sigma is no less than stamps allow.
    """
    assert_clock_is_within_three_sigma(kind, offset, seed=1, duration=120.0)
