"""The tilt of a levelled attitude and the accelerometers' bias: one error until the body turns."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hybrid_ins.core.alignment.levelling import levelled as level_by
from hybrid_ins.core.alignment.levelling import roll_pitch, tilt_by_bias
from hybrid_ins.core.imu.samples import SAMPLE_DTYPE
from hybrid_ins.core.inertial.earth import STANDARD_GRAVITY
from hybrid_ins.core.inertial.rotations import matrix_from_quat, quat_from_rpy, skew

GRAVITY_N = np.array([0.0, 0.0, STANDARD_GRAVITY])
SMALL = st.floats(-0.2, 0.2)


@given(
    roll=st.floats(-0.5, 0.5),
    pitch=st.floats(-0.5, 0.5),
    yaw=st.floats(-3.1, 3.1),
    bias=st.tuples(SMALL, SMALL, SMALL),
)
def test_the_tilt_of_a_level_is_that_which_its_bias_makes(roll, pitch, yaw, bias):
    C_nb = matrix_from_quat(quat_from_rpy(roll, pitch, yaw))
    samples = np.zeros(20, SAMPLE_DTYPE)
    samples["t_ns"] = np.arange(20) * 10_000_000
    samples["f"] = -C_nb.T @ GRAVITY_N + bias  # the bias is unknown, estimated as zero
    down_b = level_by(samples, 0, np.zeros(3), np.zeros(3)).down_b
    levelled = matrix_from_quat(quat_from_rpy(*roll_pitch(down_b), yaw))
    error = tilt_by_bias(levelled) @ bias
    truth = (np.eye(3) - skew(error)) @ levelled
    tilt = np.cross(truth.T @ [0.0, 0.0, 1.0], C_nb.T @ [0.0, 0.0, 1.0])
    assert np.linalg.norm(tilt) < 4.0 * (np.linalg.norm(bias) / STANDARD_GRAVITY) ** 2 + 1e-9


def test_with_that_bias_and_tilt_no_horizontal_force_is_left():
    levelled = matrix_from_quat(quat_from_rpy(0.2, -0.1, 1.0))
    bias = np.array([0.05, -0.08, 0.02])
    felt = -levelled.T @ GRAVITY_N  # what was levelled by
    truth = (np.eye(3) - skew(tilt_by_bias(levelled) @ bias)) @ levelled
    assert (truth @ (felt - bias))[:2] == pytest.approx(0.0, abs=1e-3)
