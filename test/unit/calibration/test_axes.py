"""Wrong axes and a tilted mount are named before anything is calibrated."""

import numpy as np
import pytest

from hybrid_ins.calibration.axes import axes_fault
from hybrid_ins.calibration.recording import Recording
from hybrid_ins.core.inertial.rotations import (
    matrix_from_quat,
    quat_from_matrix,
    quat_from_rpy,
    rpy_from_quat,
)
from hybrid_ins.parameters import defaults
from hybrid_ins.ros.messages.conversions import FLIP
from hybrid_ins.ros.review.axes_monitor import describe
from hybrid_ins.simulation.motions import Motion, quadrotor_flight
from hybrid_ins.simulation.sensors import ImuErrors, corrupt, fixes, sample, sample_times
from hybrid_ins.simulation.vehicles import city_car


def recording(motion: Motion, seconds: float, force: np.ndarray, rate: np.ndarray) -> Recording:
    rng = np.random.default_rng(5)
    imu = corrupt(sample(motion, sample_times(seconds, 100.0)), ImuErrors(), rng)
    gnss = fixes(sample(motion, sample_times(seconds, 5.0)), rng)
    samples = np.hstack((imu.specific_force @ force.T, imu.angular_rate @ rate.T))
    count = len(gnss.t)
    kinds = np.zeros(count, np.int64)
    return Recording("r", imu.t, samples, gnss.t + 0.3, kinds, gnss.lla, np.empty((count, 3, 3)))


@pytest.mark.parametrize(
    ("gyroscope", "words"),
    [(np.eye(3), ""), (np.diag([1.0, 1.0, -1.0]), "z of angular_velocity reversed")],
)
def test_wrong_axes_are_named_and_right_ones_are_not(gyroscope: np.ndarray, words: str) -> None:
    flight = recording(quadrotor_flight(50.0, 3), 50.0, np.eye(3), gyroscope)

    fault = axes_fault(flight, defaults())

    assert (fault is not None) == bool(words)
    assert fault is None or words in describe(fault).text


@pytest.mark.parametrize("roll", [0.0, 0.5])
def test_a_tilted_mount_is_named_and_a_right_one_is_not(roll: float) -> None:
    true = FLIP @ matrix_from_quat(quat_from_rpy(roll, 0.0, 0.0)) @ FLIP
    drive = recording(city_car(120.0, 1), 120.0, true.T, true.T)

    found = axes_fault(drive, defaults())

    assert (found is not None) == (roll > 0.0)
    if found is not None:
        rpy = rpy_from_quat(quat_from_matrix(FLIP @ found.mount))
        np.testing.assert_allclose(rpy, [roll, 0.0, 0.0], atol=0.06)
        assert "from base_frame's z axis: set imu.mount_rpy to [" in describe(found).text
