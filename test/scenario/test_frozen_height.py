"""A receiver whose altitude is frozen: an honest height, the same track, and an end."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.runs import through_estimator

from hybrid_ins.core.filter.missing_height import UNKNOWN_HEIGHT_STD
from hybrid_ins.core.inertial.earth import displacement
from hybrid_ins.core.inertial.rotations import quat_conjugate, quat_multiply, rotvec_from_quat
from hybrid_ins.core.inertial.state import LLA, QUAT, total_std
from hybrid_ins.ros.estimator.estimator import Estimator
from hybrid_ins.simulation.motions import START_LLA, Motion, car_drive, motion_through, time_grid
from tools.paper.runs import Run, Scenario, draw


def with_heights(run: Run, height: float, until: float) -> Run:
    """Return a run whose fixes have one height until a time [s]."""
    end_ns = int(run.samples["t_ns"][0]) + round(min(until, 1e4) * 1e9)
    fixes = (
        replace(f, lla=np.array([*f.lla[:2], height])) if f.t_ns < end_ns else f for f in run.fixes
    )
    return replace(run, fixes=tuple(fixes))


def error_n(estimator: Estimator, run: Run) -> np.ndarray:
    """Return the error (3,) [m], NED, against the last fix."""
    assert estimator.navigator.filter is not None
    return displacement(run.fixes[-1].lla, estimator.navigator.filter.nav[LLA])


def sigma(estimator: Estimator) -> np.ndarray:
    assert estimator.navigator.filter is not None
    return total_std(estimator.navigator.filter.flat_state())


def attitude(estimator: Estimator) -> np.ndarray:
    assert estimator.navigator.filter is not None
    return estimator.navigator.filter.nav[QUAT]


@pytest.fixture(scope="module")
def drive() -> Run:
    return draw(Scenario("drive", car_drive, rate=100.0, duration=80.0), 2)


@pytest.mark.parametrize("off", [-3.0, -400.0])
def test_a_frozen_height_is_unknown_and_the_track_is_the_same(drive: Run, off: float) -> None:
    frozen = with_heights(drive, float(drive.fixes[0].lla[2]) + off, np.inf)
    estimator, whole = through_estimator(frozen), through_estimator(drive)

    assert sigma(estimator)[2] > UNKNOWN_HEIGHT_STD
    assert estimator.inputs.counts["gnss: altitude frozen"] == 1
    assert abs(error_n(estimator, drive)[2]) < 0.5 * UNKNOWN_HEIGHT_STD
    assert np.linalg.norm(error_n(estimator, drive)[:2]) < 0.3
    assert sigma(whole)[2] < 0.1 and not whole.inputs.counts["gnss: altitude frozen"]


def test_heights_that_come_back_are_taken_at_once(drive: Run) -> None:
    """GIVEN a height that was 80 m off THEN no fix is refused, and the attitude is the same."""
    back = with_heights(drive, float(drive.fixes[0].lla[2]) - 80.0, 70.0)
    estimator, whole = through_estimator(back), through_estimator(drive)

    refused = [name for name in estimator.inputs.counts if "gate" in name or "opened" in name]
    assert not refused
    assert np.abs(error_n(estimator, drive)).max() < 0.2
    assert sigma(estimator)[2] < 0.2
    turn = quat_multiply(attitude(estimator), quat_conjugate(attitude(whole)))
    assert np.degrees(np.linalg.norm(rotvec_from_quat(turn))) < 1.0


def level(duration: float, _: int) -> Motion:
    """Return a way on a plane."""
    t = time_grid(duration)
    speed, course = 8.0 * np.clip((t - 4.0) / 4.0, 0.0, 1.0), 0.5 * np.sin(0.2 * t)
    velocity_n = speed[:, None] * np.stack((np.cos(course), np.sin(course), 0.0 * t), axis=1)
    return motion_through(t, velocity_n, np.stack((0.0 * t, 0.0 * t, course), axis=1), START_LLA)


def test_a_false_alarm_on_a_plane_harms_nothing_but_the_height() -> None:
    """GIVEN a simulator whose height is right, and the same for ever."""
    run = draw(Scenario("plane", level, rate=100.0, duration=80.0), 1)
    run = with_heights(run, float(START_LLA[2]), np.inf)
    estimator = through_estimator(run)

    assert estimator.inputs.counts["gnss: altitude frozen"] == 1
    assert abs(error_n(estimator, run)[2]) < 50.0
    assert np.linalg.norm(error_n(estimator, run)[:2]) < 0.3
