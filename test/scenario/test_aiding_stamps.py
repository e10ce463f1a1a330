"""Stamps of an aiding sensor that jump, alone or with all others."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from support.drive import KNOWN, Drive

from hybrid_ins.bags.messages import new_message
from hybrid_ins.core.inertial.rotations import matrix_from_quat
from hybrid_ins.ros.messages.conversions import FLIP, set_stamp

PERIOD = 0.2  # s, of the readings


class Aided(Drive):
    """A flight with a velocity in the vehicle's axes."""

    def fly(self, start: float, stop: float) -> None:
        for k in range(round((stop - start) / PERIOD)):
            t = start + PERIOD * (k + 1)
            self.play(t - PERIOD, t)
            self.read(t - 0.02)

    def read(self, t: float, ahead: float = 0.0, measured: float | None = None) -> None:
        i = int(np.searchsorted(self.truth.t, t if measured is None else measured))
        velocity_b = matrix_from_quat(self.truth.quat_xyzw[i]).T @ self.truth.velocity_n[i]
        message = new_message("geometry_msgs/msg/TwistWithCovarianceStamped")
        set_stamp(message.header.stamp, self.stamp(t + ahead))
        v = message.twist.twist.linear
        v.x, v.y, v.z = (FLIP @ velocity_b).tolist()
        message.twist.covariance = np.diag([0.04] * 6).ravel()
        self.estimator.aids.sources.handle("aiding/velocity", message)

    @property
    def state(self) -> Any:
        return dict(self.status("aiding").values)["velocity"]

    @property
    def aiding_warnings(self) -> list[str]:
        return [line for line in self.warnings() if "aiding" in line]


@pytest.fixture
def aided() -> Aided:
    drive = Aided(**KNOWN)
    drive.fly(0.0, 14.0)
    assert drive.state == "aiding"
    return drive


@pytest.mark.parametrize("ahead", [3600.0, -3600.0])
def test_one_reading_with_a_stray_stamp_is_refused_by_name(aided: Aided, ahead: float) -> None:
    aided.read(14.0, ahead)

    name = "stamped ahead of the IMU" if ahead > 0.0 else "too old"
    assert aided.estimator.inputs.counts[f"velocity: {name}"] == 1
    [line] = aided.aiding_warnings
    assert f"3600.0 s {'ahead of' if ahead > 0.0 else 'behind'} the IMU's" in line
    aided.fly(14.0, 14.4)
    assert aided.state == "aiding"  # it was never anything else: there is no new time base
    assert len(aided.aiding_warnings) == 1


def test_a_late_reading_is_compared_with_the_state_of_its_own_time() -> None:
    drive = Aided(**KNOWN)
    for k in range(round(25.0 / PERIOD)):
        t = PERIOD * (k + 1)
        drive.play(t - PERIOD, t)
        if t > 4.0:
            drive.read(t - 0.8)

    values = dict(drive.status("aiding").values)
    assert drive.state == "aiding" and not drive.aiding_warnings
    assert float(values["velocity_nis"]) < 1.0


@pytest.mark.parametrize(("measured_ahead", "state"), [(0.6, "aiding"), (0.0, "refused")])
def test_a_reading_that_is_ahead_of_the_imu_waits_for_it(measured_ahead: float, state: str) -> None:
    """It is compared with the state at its stamp: what it measures is of that time, or is not."""
    drive = Aided(**KNOWN)
    for k in range(round(25.0 / PERIOD)):
        t = PERIOD * (k + 1)
        drive.play(t - PERIOD, t)
        if t > 4.0:
            drive.read(t, 0.6, t + measured_ahead)

    assert drive.state == state
    nis = float(dict(drive.status("aiding").values)["velocity_nis"])
    assert (nis < 1.0) is (state == "aiding")


def test_readings_go_on_after_all_stamps_have_gone_back(aided: Aided) -> None:
    # WHEN simulated time starts again, or a bag is played again
    aided.shift_ns = -1_000_000_000_000
    aided.play(14.0, 15.0)
    assert aided.state == "absent"
    aided.fly(15.0, 32.0)

    assert aided.estimator.aligned and aided.state == "aiding"
    assert not aided.aiding_warnings


def test_readings_that_all_have_another_clock_are_told(aided: Aided) -> None:
    for k in range(20):
        aided.play(14.0 + PERIOD * k, 14.0 + PERIOD * (k + 1))
        aided.read(14.0 + PERIOD * (k + 1) - 0.02, 18.0)

    assert aided.state == "lost"
    first, *_, last = aided.aiding_warnings
    assert "18.0 s ahead of the IMU's: let both stamp by one clock" in first
    assert "aiding: velocity: no message of use for 2 s" in (last, *aided.aiding_warnings)
