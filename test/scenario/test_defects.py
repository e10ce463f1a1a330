"""What random drives may have of real recordings: each defect does what it says, and no more."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hybrid_ins.core.inertial import earth
from hybrid_ins.simulation.vehicles import VEHICLES, Recording, record
from tools.vehicles.defects import DEFECTS, draw


@pytest.fixture(scope="module")
def drive() -> Recording:
    return record(replace(VEHICLES["car"], duration=40.0), 3)


def rng() -> np.random.Generator:
    return np.random.default_rng(5)


def errors_of_fixes(drive: Recording) -> np.ndarray:
    """Return the errors (M, 3) [m] against the truth at their times."""
    truth = drive.truth
    lla = np.stack([np.interp(drive.fix_t, truth.t, axis) for axis in truth.lla.T], axis=1)
    return (drive.fix_lla - lla) * earth.curvature_scale(truth.lla[0])


@pytest.mark.parametrize("name", DEFECTS)
def test_a_defect_changes_the_recording_and_keeps_it_whole(drive: Recording, name: str) -> None:
    before = errors_of_fixes(drive)
    found = DEFECTS[name](drive, rng())

    assert np.all(np.diff(found.imu.t) > 0.0)
    assert found.imu.specific_force.shape == found.imu.angular_rate.shape == (len(found.imu.t), 3)
    assert found.fix_lla.shape == (len(found.fix_t), 3) and len(found.fix_stamp) == len(found.fix_t)
    same = (
        np.array_equal(found.imu.t, drive.imu.t)
        and np.array_equal(found.imu.specific_force, drive.imu.specific_force)
        and np.array_equal(found.fix_lla, drive.fix_lla)
        and np.array_equal(found.fix_stamp, drive.fix_stamp)
    )
    assert not same
    np.testing.assert_array_equal(errors_of_fixes(drive), before)


def test_an_imu_that_is_turned_feels_the_same_force(drive: Recording) -> None:
    turned = DEFECTS["turned_imu"](drive, rng())

    def force_n(run: Recording) -> np.ndarray:
        return np.asarray((run.truth.C_nb @ run.imu.specific_force[..., None])[..., 0])

    np.testing.assert_allclose(force_n(turned), force_n(drive), atol=1e-9)
    assert np.abs(turned.imu.specific_force - drive.imu.specific_force).max() > 1.0


def test_the_position_of_the_antenna_is_judged(drive: Recording) -> None:
    moved = DEFECTS["unknown_lever_arm"](drive, rng())

    away = np.linalg.norm(
        (moved.truth.lla - drive.truth.lla) * earth.curvature_scale(drive.truth.lla[0]), axis=1
    )
    assert away.min() > 0.05 and np.ptp(away) < 1e-3
    np.testing.assert_allclose(errors_of_fixes(moved), errors_of_fixes(drive), atol=0.02)


def test_repeated_rows_are_old_readings(drive: Recording) -> None:
    rows = DEFECTS["repeated_rows"](drive, rng()).imu.specific_force

    repeated = np.all(rows[1:] == rows[:-1], axis=1)
    assert 0.04 < repeated.mean() < 0.36


def test_none_and_all_can_be_drawn(drive: Recording) -> None:
    assert draw(drive, rng(), 0.0) == (drive, [])
    assert draw(drive, rng(), 1.0)[1] == list(DEFECTS)
