"""Errors of an IMU's scale factors are not taken for another place of the antenna."""

from __future__ import annotations

import numpy as np
import pytest
from support.calibration_drives import recording_of

from hybrid_ins import parameters
from hybrid_ins.calibration.calibrate import calibrate
from hybrid_ins.calibration.filter_pass import Nominal
from hybrid_ins.calibration.likelihood import LEVER, SCALE, Likelihood
from hybrid_ins.simulation.motions import Motion
from hybrid_ins.simulation.sensors import ImuErrors
from hybrid_ins.simulation.vehicles import Receiver, Vehicle, fixed_wing, record

ARM_B = np.array([-0.3, -0.8, -0.15])  # m


def flight(duration: float, seed: int) -> Motion:
    """Fly a plane that has stood for 10 s."""
    return fixed_wing(duration, seed, 10.0)


@pytest.mark.parametrize("seed", [1, 3])
def test_the_antenna_of_a_plane_is_found_beside_scale_errors(seed: int) -> None:
    """
    GIVEN scale factors that are wrong by 0.6 % (σ), and turns of 2 g
    THEN the antenna is as far off as is said: its height was 3.4 and 4.3 σ off.
    """
    rng = np.random.default_rng(seed)
    scale_a, scale_g = 0.006 * rng.standard_normal((2, 3))
    errors = ImuErrors(accelerometer_scale=scale_a, gyroscope_scale=scale_g)
    receiver = Receiver(5.0, antenna_b=tuple(ARM_B))
    drive = record(Vehicle("plane", flight, receiver, errors, 100.0, duration=120.0), seed)

    found = calibrate([recording_of(drive)], parameters.defaults()).fitted

    away = [abs(found.value(n) - x) / found.sigma(n) for n, x in zip(LEVER, ARM_B, strict=True)]
    assert max(away) < 2.5
    assert found.sigma(LEVER[2]) < 0.015
    assert not any(found.value(name) for name in SCALE)


def test_a_scale_error_is_taken_out_of_the_samples() -> None:
    """GIVEN readings with a scale error and the same in x, the likelihood is that of right ones."""
    errors = ImuErrors(accelerometer_std=0.0, gyroscope_std=0.0)
    vehicle = Vehicle("plane", flight, Receiver(5.0), errors, 100.0, duration=60.0)
    right = recording_of(record(vehicle, 2))
    none, std = np.zeros(3), np.full(3, 0.1)
    nominal = Nominal(0.0, none, 1e-4, 1e-7, 1e-3, 1e-5, none, std, none, std, 0.005)
    x = np.array([prior.mean for prior in Likelihood([right], nominal, False).prior])
    M = np.zeros((6, 6))
    M[2, 1], M[5, 5] = 0.004, 0.01
    wrong = recording_of(record(vehicle, 2))
    wrong.samples[:] = np.linalg.solve(np.eye(6) - M, right.samples.T).T
    beside = Likelihood([wrong], nominal, False)
    there = x.copy()
    there[beside.names.index("scale_a_zy")], there[beside.names.index("scale_g_zz")] = 0.004, 0.01

    late = slice(150, None)  # the state at the start is by the samples as they are
    expected = Likelihood([right], nominal, False).run(0, x).z[late]
    np.testing.assert_allclose(beside.run(0, there).z[late], expected, atol=2e-4)
    assert np.abs(beside.run(0, x).z[late] - expected).max() > 0.01
