"""Wrong axes are named before anything is calibrated."""

import numpy as np
import pytest

from hybrid_ins.calibration.axes import axes_fault
from hybrid_ins.calibration.recording import Recording
from hybrid_ins.parameters import defaults
from hybrid_ins.ros.review.axes_monitor import describe
from hybrid_ins.simulation.motions import quadrotor_flight
from hybrid_ins.simulation.sensors import ImuErrors, corrupt, fixes, sample, sample_times


def recording(gyroscope: np.ndarray) -> Recording:
    rng = np.random.default_rng(5)
    motion = quadrotor_flight(50.0, 3)
    imu = corrupt(sample(motion, sample_times(50.0, 100.0)), ImuErrors(), rng)
    gnss = fixes(sample(motion, sample_times(50.0, 5.0)), rng)
    samples = np.hstack((imu.specific_force, imu.angular_rate @ gyroscope.T))
    count = len(gnss.t)
    kinds = np.zeros(count, np.int64)
    return Recording("r", imu.t, samples, gnss.t + 0.3, kinds, gnss.lla, np.empty((count, 3, 3)))


@pytest.mark.parametrize(
    ("gyroscope", "words"),
    [(np.eye(3), ""), (np.diag([1.0, 1.0, -1.0]), "z of angular_velocity reversed")],
)
def test_wrong_axes_are_named_and_right_ones_are_not(gyroscope: np.ndarray, words: str) -> None:
    fault = axes_fault(recording(gyroscope), defaults())

    assert (fault is not None) == bool(words)
    assert fault is None or words in describe(fault).text
