"""The likelihood is of the same measurements wherever it is taken."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import pytest
from support.calibration_drives import recording_of

from hybrid_ins.calibration.filter_pass import Nominal
from hybrid_ins.calibration.fit import kept_within
from hybrid_ins.calibration.innovations import POSITION, VELOCITY
from hybrid_ins.calibration.likelihood import LEVER, VELOCITY_AGE, VELOCITY_AGES, Likelihood
from hybrid_ins.calibration.recording import Recording
from hybrid_ins.core.inertial.rotations import rpy_from_quat
from hybrid_ins.simulation.motions import START_LLA, Motion, integral, motion_through, time_grid
from hybrid_ins.simulation.sensors import ImuErrors
from hybrid_ins.simulation.vehicles import Receiver, Vehicle, city_car, record

MARGIN = 0.2  # s


def standing() -> Recording:
    """Return positions and velocities with common stamps, some of them those of samples."""
    t, fix_t = np.arange(0.0, 20.0, 0.02), np.repeat(np.arange(0.1, 19.9, 0.2), 2)
    kinds = np.tile([POSITION, VELOCITY], len(fix_t) // 2)
    measured = np.where(kinds[:, None] == POSITION, [0.5, 1.0, 100.0], np.zeros(3))
    samples = np.tile([0.0, 0.0, -9.8, 0.0, 0.0, 0.0], (len(t), 1))
    return Recording(
        "standing", t, samples, fix_t, kinds, measured, np.tile(np.eye(3), (len(fix_t), 1, 1))
    )


def used(likelihood: Likelihood) -> Iterator[tuple[int, ...]]:
    """Yield the measurements that are used at clock offsets and velocity ages of a search."""
    x = np.array([prior.mean for prior in likelihood.prior])
    for offset in (-0.15, -0.01, 0.0, 0.013, 0.15):
        for age in (*VELOCITY_AGES, -0.001, 0.001):
            x[likelihood.names.index("offset")] = offset
            x[likelihood.names.index(VELOCITY_AGE)] = age
            yield tuple(np.flatnonzero(np.isfinite(likelihood.run(0, x).nis)))


@pytest.mark.parametrize("shift", [0.0, 0.007])
def test_it_is_of_the_same_measurements_at_any_offset_and_velocity_age(shift: float) -> None:
    """A velocity that was used at one age and not at the next made a step of its own."""
    whole, none, std = standing(), np.zeros(3), np.full(3, 0.1)
    whole.aid_t[:] += shift
    nominal = Nominal(0.0, none, 1e-4, 1e-8, 1e-3, 1e-5, none, std, none, std)

    (found,) = set(used(Likelihood([kept_within(whole, 0.0, MARGIN)], nominal, False)))

    assert len(found) > 0.9 * len(whole.aid_t)


def on_a_turntable(duration: float, seed: int) -> Motion:
    """Turn to and fro about the IMU."""
    t = time_grid(duration)
    yaw = seed + integral(0.4 * np.sin(0.15 * t))
    return motion_through(
        t, np.zeros((len(t), 3)), np.stack((0.0 * t, 0.0 * t, yaw), axis=1), START_LLA
    )


@pytest.mark.parametrize(("motion", "known"), [(on_a_turntable, False), (city_car, True)])
def test_the_direction_of_an_arm_is_known_by_motion_and_not_by_turns_on_the_spot(
    motion: Callable[[float, int], Motion], known: bool
) -> None:
    arm_b = np.array([2.0, 0.0, -1.0])
    receiver = Receiver(5.0, antenna_b=tuple(arm_b))
    drive = record(Vehicle("one", motion, receiver, ImuErrors(), duration=90.0), 1)
    none, std = np.zeros(3), np.full(3, 0.1)
    nominal = Nominal(0.0, arm_b, 1e-4, 1e-7, 1e-3, 1e-4, none, std, none, std)
    likelihood = Likelihood([kept_within(recording_of(drive), 0.0, MARGIN)], nominal, False)
    likelihood.yaws = [float(rpy_from_quat(drive.truth.quat_xyzw[0])[2])]
    x = np.array([prior.mean for prior in likelihood.prior])

    found = likelihood.azimuth_std(x)

    assert [likelihood.value(x, name) for name in LEVER] == arm_b.tolist()
    assert found < 0.01 if known else found > 0.05
