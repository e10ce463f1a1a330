"""A vehicle that spins shows the place of its antenna to a fraction of a millimetre."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from support.calibration_drives import recording_of

from hybrid_ins import parameters
from hybrid_ins.calibration.calibrate import calibrate
from hybrid_ins.calibration.filter_pass import Nominal
from hybrid_ins.calibration.fit import kept_within
from hybrid_ins.calibration.likelihood import LEVER, Likelihood
from hybrid_ins.calibration.recording import Recording
from hybrid_ins.core.inertial.rotations import rpy_from_quat
from hybrid_ins.simulation.motions import (
    START_LLA,
    Motion,
    gravity_at,
    integral,
    motion_through,
    smoothed,
    thrust_attitude,
    time_grid,
)
from hybrid_ins.simulation.sensors import ImuErrors, Tone
from hybrid_ins.simulation.vehicles import Receiver, Vehicle, record

Array = NDArray[np.float64]
ARM_B = np.array([0.03, 0.0, -0.03])  # m
OFFSET = -0.02  # s
STD_A, STD_G = 0.03, 0.002  # of a reading


def spinning_flight(duration: float, seed: int) -> Motion:
    """Fly at other velocities every 6 s, and spin at 10 rad/s."""
    t = time_grid(duration)
    draws = np.random.default_rng(seed).uniform(-3.0, 3.0, (2, int(duration / 6.0) + 1))
    north, east = (smoothed(drawn[(t // 6.0).astype(int)], 3.0) for drawn in draws)
    yaw = integral(10.0 * np.clip((t - 3.0) / 3.0, 0.0, 1.0))

    def attitude(velocity_n: Array, acceleration_n: Array) -> Array:
        return thrust_attitude(velocity_n, acceleration_n, yaw, gravity_at(START_LLA))

    return motion_through(t, np.stack((north, east, 0.0 * t), axis=-1), attitude, START_LLA)


def spinner() -> tuple[Recording, float]:
    """Return a recording with fixes that scatter by a centimetre, and the heading at its start."""
    errors = ImuErrors(STD_A, STD_G, tones=(Tone(60.0, 2.0, 0.1),))
    receiver = Receiver(10.0, antenna_b=tuple(ARM_B), offset=OFFSET)
    drive = record(Vehicle("spinner", spinning_flight, receiver, errors, 200.0, duration=60.0), 2)
    return recording_of(drive), float(rpy_from_quat(drive.truth.quat_xyzw[0])[2])


def test_the_slope_by_the_place_of_its_antenna_is_that_of_the_likelihood() -> None:
    """
    GIVEN an antenna whose σ is a fraction of the steps of the finite differences
    THEN the slopes are those over a tenth of a millimetre: they were 2 σ off.
    """
    recording, yaw = spinner()
    none, std, period = np.zeros(3), np.full(3, 0.1), recording.period
    noise = STD_A**2 * period, STD_G**2 * period, 1e-3, 1e-4
    nominal = Nominal(OFFSET, ARM_B, *noise, none, std, none, std)
    likelihood = Likelihood([kept_within(recording, OFFSET, 0.2)], nominal, False)
    likelihood.yaws = [yaw]
    x = np.array([prior.mean for prior in likelihood.prior])
    _, slopes = likelihood.scores(x)
    found = likelihood.gradient(slopes, x)

    for name in LEVER[:2]:
        i = likelihood.names.index(name)
        step = 1e-4 * np.eye(len(x))[i]
        slope = (likelihood.value_at(x + step) - likelihood.value_at(x - step)) / 2e-4
        sigma = np.sum(slopes[0][:, i] ** 2) ** -0.5
        assert sigma < 0.1 * likelihood.prior[i].step
        assert abs(found[i] - slope) * sigma < 0.8


def test_its_antenna_and_clock_are_found() -> None:
    """
    GIVEN the place of its antenna, rightly, and not that its clock is 20 ms off
    THEN it stays there: it was turned, and the clock was off by as much as it takes to turn so.
    """
    values = {**parameters.defaults(), "gnss.antenna_position": [0.03, 0.0, 0.03]}

    found = calibrate([spinner()[0]], values)

    sigma = found.fitted.sigma("offset")
    assert set(LEVER) <= found.fitted.frozen
    assert sigma < 0.005
    assert abs(found.fitted.value("offset") - OFFSET) < 3.0 * sigma
