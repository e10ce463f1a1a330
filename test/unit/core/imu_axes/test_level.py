"""A tilted mount is named by the mean specific force in motion; a right one is not."""

from __future__ import annotations

import numpy as np
import pytest

from hybrid_ins.core.imu.samples import SAMPLE_DTYPE
from hybrid_ins.core.imu_axes.faults import mount_as_shown
from hybrid_ins.core.imu_axes.level import LevelCheck
from hybrid_ins.core.imu_axes.monitor import ImuAxesCheck
from hybrid_ins.core.inertial.earth import STANDARD_GRAVITY, curvature_scale
from hybrid_ins.core.inertial.rotations import matrix_from_quat, quat_from_rpy

FRD = np.diag([1.0, -1.0, -1.0])  # of an IMU whose own axes are forward, left, up
START = np.array([0.8, 0.1, 400.0])  # rad, rad, m
UP = np.array([0.0, 0.0, 1.0])
CRUISE, REST = 10.0, 0.0  # m/s


def mount_of(roll: float, pitch: float, yaw: float = 0.0) -> np.ndarray:
    return FRD @ matrix_from_quat(quat_from_rpy(roll, pitch, yaw))


class Run:
    """Gives a check specific force, (3,) in the IMU's own axes, and fixes of a straight run."""

    def __init__(self, check: LevelCheck | ImuAxesCheck, given: np.ndarray = FRD) -> None:
        self.check, self._given = check, given
        self._t, self._north = 1000.0, 0.0
        self._noise = np.random.default_rng(1)

    def go(self, seconds: float, force: np.ndarray, speed: float) -> None:
        for _ in range(round(seconds)):
            samples = np.zeros(50, SAMPLE_DTYPE)
            samples["t_ns"] = np.round((self._t + np.arange(50) / 50.0) * 1e9)
            samples["f"] = self._given @ force
            samples["w"] = self._noise.normal(0.0, 1e-3, (50, 3))
            self._t += 1.0
            self._north += speed
            lla = START + np.array([self._north, 0.0, 0.0]) / curvature_scale(START)
            if isinstance(self.check, LevelCheck):
                self.check.add_fix(lla)
            else:
                self.check.add_fix(round(self._t * 1e9), lla)
            self.check.add_samples(samples)
            if isinstance(self.check, ImuAxesCheck):
                self.check.advance(round(self._t * 1e9))


def leaning(angle: float, about: int = 1) -> np.ndarray:
    """Return gravity's specific force in the axes of an IMU that is turned about x or y."""
    rpy = np.zeros(3)
    rpy[about] = angle
    return STANDARD_GRAVITY * matrix_from_quat(quat_from_rpy(*rpy)).T @ UP


@pytest.mark.parametrize("true", [(0.35, 0.0), (0.0, 0.96), (0.79, 0.61), (-0.5, -0.7)])
@pytest.mark.parametrize("yaw", [0.0, 1.2])
def test_a_tilt_is_measured_with_the_yaw_as_given(true: tuple[float, float], yaw: float) -> None:
    given, right = mount_of(0.0, 0.0, yaw), mount_of(*true, yaw)
    run = Run(LevelCheck(given), given)

    run.go(50.0, right.T @ [0.0, 0.0, -STANDARD_GRAVITY], CRUISE)
    assert run.check.tilt is None
    run.go(30.0, right.T @ [0.0, 0.0, -STANDARD_GRAVITY], CRUISE)

    tilt = run.check.tilt
    assert tilt is not None
    np.testing.assert_allclose(tilt.mount, right, atol=1e-6)
    assert tilt.angle == pytest.approx(np.arccos(-(given @ right.T)[2] @ [0.0, 0.0, -1.0]))


@pytest.mark.parametrize(
    ("force", "speed"),
    [
        (leaning(0.25), CRUISE),  # less than is called a tilt
        (leaning(0.6), REST),  # no motion: it may lie anyhow
        (np.array([0.0, 4.0, STANDARD_GRAVITY]), CRUISE),  # a car that circles
        (0.02 * leaning(0.6), CRUISE),  # a driver that removes gravity
    ],
)
def test_nothing_is_said_of_other_forces(force: np.ndarray, speed: float) -> None:
    run = Run(LevelCheck(FRD))

    run.go(200.0, force, speed)

    assert run.check.tilt is None


def test_more_than_gravity_is_a_tilt_where_no_acceleration_turns_it_as_far() -> None:
    run = Run(LevelCheck(FRD))

    run.go(80.0, 1.06 * leaning(0.6), CRUISE)  # a multirotor that circles

    assert run.check.tilt is not None


def test_a_lean_to_either_side_is_no_tilt() -> None:
    run = Run(LevelCheck(FRD))

    for side in (1.0, -1.0) * 10:
        run.go(11.0, leaning(0.6 * side, about=0), CRUISE)

    assert run.check.tilt is None


def test_a_climb_after_a_level_start_is_no_tilt() -> None:
    run = Run(LevelCheck(FRD))
    run.go(12.0, leaning(0.0), REST)

    run.go(180.0, leaning(-0.45), CRUISE)

    assert run.check.tilt is None


def test_level_motion_withdraws_a_tilt() -> None:
    run = Run(LevelCheck(FRD))
    run.go(300.0, leaning(-0.45), CRUISE)
    assert run.check.tilt is not None

    run.go(36.0, leaning(0.05), CRUISE)
    assert run.check.tilt is None
    run.go(100.0, leaning(-0.45), CRUISE)
    assert run.check.tilt is None


def test_what_a_hover_shows_is_withdrawn_by_level_motion_and_not_found_again() -> None:
    run = Run(ImuAxesCheck(FRD))
    run.go(60.0, leaning(-1.57), REST)
    fault = run.check.fault
    assert isinstance(run.check, ImuAxesCheck)
    assert fault is not None and fault.at_rest

    run.go(24.0, leaning(0.05), CRUISE)
    assert run.check.fault is None
    run.go(60.0, leaning(-1.57), REST)
    assert run.check.fault is None


@pytest.mark.parametrize(
    ("true", "is_square"),
    [((0.0, -1.57), True), ((3.05, 0.1), True), ((2.0, -0.9), False), ((-1.57, 0.5), False)],
)
def test_a_right_angle_is_named_where_it_fits(true: tuple[float, float], is_square: bool) -> None:
    up = mount_of(*true).T @ [0.0, 0.0, -1.0]

    found = mount_as_shown(FRD, up)

    np.testing.assert_allclose(found @ found.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(found) == pytest.approx(np.linalg.det(FRD))
    assert np.allclose(found, np.round(found)) == is_square
    if not is_square:
        np.testing.assert_allclose(found, mount_of(*true), atol=1e-9)
