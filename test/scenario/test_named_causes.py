"""What the estimator says where a flight does not start, or the IMU's axes are wrong."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from support.drive import KNOWN, Drive

from hybrid_ins.bags.messages import new_message
from hybrid_ins.ros.messages.conversions import set_stamp


class Spoiled(Drive):
    """A flight whose fixes are stamped by another clock, or refused for another reason."""

    def __init__(self, ahead: float = 0.0, status: int = 0, **values: Any) -> None:
        super().__init__(**values)
        self.ahead_ns, self.status_of_fixes = round(ahead * 1e9), status

    def fix(self, k: int) -> None:
        message = new_message("sensor_msgs/msg/NavSatFix")
        set_stamp(message.header.stamp, self.stamp(float(self.fix_t[k])) + self.ahead_ns)
        message.latitude, message.longitude = np.degrees(self.fix_lla[k, :2]).tolist()
        message.altitude = float(self.fix_lla[k, 2])
        message.status.status = self.status_of_fixes
        message.position_covariance = np.diag([0.01, 0.01, 0.02]).ravel()
        message.position_covariance_type = 2
        self.estimator.handle_fix(message)


@pytest.mark.parametrize(
    ("ahead", "words"),
    [
        (18.0, "18.0 s ahead of the IMU's (one driver stamps in GPS time, the other in UTC: 18 s)"),
        (-18.0, "18.0 s behind the IMU's (one driver stamps in GPS time, the other in UTC: 18 s)"),
        (5.0, "5.0 s ahead of the IMU's (two clocks that were set differently, or a computer"),
        (30.0, "30.0 s ahead of the IMU's (two clocks that were set differently)"),
        (-7200.0, "0.1 days behind"),
        (-1.7e9 + 60.0, "53.9 years behind the IMU's (one clock counts from its start"),
    ],
)
def test_fixes_by_another_clock_are_named_with_the_remedy(ahead: float, words: str) -> None:
    drive = Spoiled(ahead)
    drive.play(0.0, 6.0)

    assert not drive.estimator.aligned
    [line] = [text for text in drive.warnings() if "of no use" in text]
    for text in (line, drive.estimator.status.waiting_for, drive.status("filter").text):
        assert words in text and "use_receive_time: true" in text


def test_an_imu_that_stops_is_no_fault_of_the_clocks() -> None:
    """
    GIVEN an estimate
    WHEN fixes go on without IMU samples, and both after a jump of the receiver's clock
    THEN the IMU is blamed for the first, and the clocks for the second.
    """
    drive = Spoiled(**KNOWN)
    drive.play(0.0, 6.0)
    assert drive.estimator.aligned
    for k in np.flatnonzero((drive.fix_t > 6.0) & (drive.fix_t < 12.0)):
        drive.fix(int(k))

    [line] = [text for text in drive.warnings() if "of no use" in text]
    assert "s before this one: restart the driver of the IMU" in line

    jumped = Spoiled(**KNOWN)
    jumped.play(0.0, 6.0)
    jumped.ahead_ns = 30_000_000_000
    jumped.play(6.0, 12.0)

    [line] = [text for text in jumped.warnings() if "of no use" in text]
    assert "s ahead of the IMU's (two clocks that were set differently)" in line


def test_fixes_without_a_position_are_named_as_what_it_waits_for() -> None:
    drive = Spoiled(status=-1)
    drive.play(0.0, 6.0)

    assert "fixes are of no use: status -1 means no fix" in drive.status("filter").text
    assert sum("of no use" in text for text in drive.warnings()) == 1


def test_samples_of_which_none_is_of_use_are_named_as_what_it_waits_for() -> None:
    drive = Drive()
    drive.play(0.0, 2.0, force=lambda f: f * np.nan)

    expected = "IMU samples; NaN or inf in the reading: check the driver"
    assert drive.estimator.status.waiting_for == expected

    drive.play(2.0, 3.5)

    assert "NaN" not in drive.estimator.status.waiting_for


def test_usable_fixes_are_not_blamed() -> None:
    drive = Drive()
    drive.play(0.0, 3.5)

    assert "of no use" not in drive.estimator.status.waiting_for
    assert not any("of no use" in text for text in drive.warnings())


@pytest.mark.slow
def test_wrong_axes_are_an_error_and_no_clock_offset() -> None:
    """
    GIVEN an IMU whose x and y axes are exchanged
    WHEN it flies
    THEN log and diagnostics name the axes, and no line blames the clock before.
    """
    drive = Drive()
    drive.force, drive.rate = drive.force[:, [1, 0, 2]], drive.rate[:, [1, 0, 2]]
    drive.play(0.0, 45.0)

    status = drive.status("input")
    assert status.level == 2
    assert "imu: wrong axes: the axes do not fit the motion: x and y of linear" in status.text
    assert sum("axes do not fit the motion" in text for text in drive.warnings()) == 1
    assert not any("time_offset" in text for text in drive.warnings())


@pytest.mark.slow
def test_a_sound_flight_is_not_accused() -> None:
    drive = Drive()
    drive.play(0.0, 59.0)

    assert not any("axes" in text or "mount" in text for text in drive.warnings())
    assert not [name for name in drive.estimator.inputs.counts if name.startswith("imu:")]


def set_covariance(drive: Drive, values: np.ndarray, kind: int) -> None:
    """Let the fixes of a flight carry another covariance."""
    handle = drive.estimator.handle_fix

    def changed(message: Any, received_ns: int | None = None) -> None:
        message.position_covariance, message.position_covariance_type = values.ravel(), kind
        handle(message, received_ns)

    drive.estimator.handle_fix = changed  # type: ignore[method-assign]


@pytest.mark.parametrize(
    ("covariance", "kind", "words"),
    [
        (np.zeros((3, 3)), 2, "position_covariance 0, 0 is not positive"),
        (np.full((3, 3), np.nan), 3, "position_covariance nan, nan is not finite"),
        (-np.eye(3), 2, "position_covariance -1, -1 is not positive"),
        (np.eye(3) + 2.0 * (1.0 - np.eye(3)), 3, "position_covariance is not positive definite"),
        (np.eye(3), 0, "position_covariance_type 0 means unknown"),
    ],
)
def test_a_missing_covariance_is_named_once_with_what_is_used(
    covariance: np.ndarray, kind: int, words: str
) -> None:
    drive = Drive()
    set_covariance(drive, covariance, kind)
    drive.play(0.0, 3.0)

    [line] = [text for text in drive.warnings() if words in text]
    assert "gnss.position_std_default, 3, 3, 6 m, is used instead" in line
    assert ("gnss: covariance", line) in drive.status("input").values
    assert drive.status("input").level == 0


def test_a_covariance_that_is_one_is_not_mentioned() -> None:
    drive = Drive()
    drive.play(0.0, 3.0)

    assert not drive.warnings()


def test_fixes_that_wait_for_the_filter_do_not_make_the_input_suspect() -> None:
    drive = Drive()
    drive.play(0.0, 10.0)

    assert drive.estimator.inputs.counts["gnss: aligning"] > 0
    assert (drive.status("input").level, drive.status("input").text) == (0, "all input used")


def test_the_input_is_suspect_while_something_is_new() -> None:
    drive = Drive(**KNOWN)
    drive.play(0.0, 8.0)
    drive.play(8.0, 8.1, force=lambda f: f * np.nan)
    drive.play(8.1, 10.0)
    assert drive.status("input").level == 1

    drive.play(10.0, 23.0)

    status = drive.status("input")
    assert status.level == 0 and "0 of them new" in status.text
    assert dict(status.values)["imu: not finite"] == "10"


def test_the_filtered_position_has_a_fix_only_with_gnss() -> None:
    drive = Drive(**KNOWN)
    drive.play(0.0, 12.0)
    drive.estimator.pop_reports()

    drive.play(12.0, 18.0, with_fixes=False)

    at = {
        (report.content.t_ns - drive.stamp(0.0)) * 1e-9: report.content.has_fix
        for report in drive.estimator.pop_reports()
        if report.topic == "gnss/filtered"
    }
    assert all(has_fix for t, has_fix in at.items() if t < 13.5)
    assert not any(has_fix for t, has_fix in at.items() if t > 14.5)


def test_restarts_again_and_again_do_not_fill_the_log() -> None:
    drive = Drive()
    drive.play(0.0, 1.0)
    for k in range(1, 60):
        drive.shift_ns = -20_000_000_000 * k
        drive.play(1.0, 1.1)

    told = [text for text in drive.warnings() if "stamps went back" in text]
    assert drive.estimator.inputs.counts["restart: the IMU's stamps went back"] == 59
    assert len(told) == 10


def test_fixes_that_all_come_too_late_are_told_with_their_remedy() -> None:
    drive = Spoiled(ahead=-1.5, **KNOWN)
    drive.play(0.0, 12.0)

    told = [text for text in drive.warnings() if "too late" in text]
    assert drive.estimator.inputs.counts["gnss: too old"] > 10
    assert len(told) == 1
    assert told[0].startswith("gnss/fix: 10 fixes came too late to be used, this one 1.5 s after")
    assert told[0].endswith("raise gnss.max_delay to 3")


@pytest.mark.parametrize(("step", "words"), [(30.0, "30.0 s ahead of"), (-30.0, "30.0 s behind")])
def test_a_receiver_whose_clock_is_set_in_flight_is_named(step: float, words: str) -> None:
    """GIVEN a flight WHEN its fixes are stamped otherwise THEN the clocks are blamed."""
    drive = Spoiled(**KNOWN)
    drive.play(0.0, 6.0)

    drive.ahead_ns = round(step * 1e9)
    drive.play(6.0, 10.0)

    assert drive.estimator.aligned
    (line,) = (text for text in drive.warnings() if "of no use" in text)
    assert line.startswith(f"gnss/fix: 10 fixes are of no use: their stamps are {words} the IMU's")
    assert line.endswith("let both drivers stamp by one clock, or set use_receive_time: true")
