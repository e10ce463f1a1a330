"""A tilted mount is a warning with the mount to give, in the log and in diagnostics."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np

from hybrid_ins.core.imu.samples import SAMPLE_DTYPE
from hybrid_ins.core.inertial.earth import STANDARD_GRAVITY, curvature_scale
from hybrid_ins.core.inertial.rotations import matrix_from_quat, quat_from_rpy
from hybrid_ins.core.update.measurements import PositionFix
from hybrid_ins.parameters import defaults
from hybrid_ins.ros.messages.conversions import FLIP
from hybrid_ins.ros.placement.sensor_placement import SensorPlacement
from hybrid_ins.ros.reporting.diagnostics import input_status
from hybrid_ins.ros.reporting.input_log import InputLog
from hybrid_ins.ros.review.axes_monitor import AxesMonitor

START = np.array([0.8, 0.1, 400.0])  # rad, rad, m
ROLL, PITCH, YAW = 0.4, -0.52, 0.3


class Ring:
    """Samples of the last second."""

    def after(self, t_ns: int) -> np.ndarray:
        return self.samples[self.samples["t_ns"] > t_ns]

    samples = np.zeros(0, SAMPLE_DTYPE)


def test_a_tilted_mount_is_a_warning_until_level_motion() -> None:
    """
    GIVEN an IMU that is rolled and pitched, of which only the yaw is given
    WHEN it moves for more than a minute, and then for half a minute as the mount given has it
    THEN one warning names its mount, diagnostics too, as no error, until the second.
    """
    lines: list[str] = []
    inputs = InputLog(lambda level, text: lines.append(f"{level}: {text}"))
    placement = SensorPlacement({**defaults(), "imu.mount_rpy": [0.0, 0.0, YAW]}, inputs)
    navigator: Any = SimpleNamespace(last_ns=0, ring=Ring(), monitor=SimpleNamespace(fault=None))
    navigator.filter = None
    monitor = AxesMonitor(navigator, placement, inputs)
    true = matrix_from_quat(quat_from_rpy(ROLL, PITCH, YAW))

    def move(begin: int, end: int, mount: np.ndarray) -> None:
        for second in range(begin, end):
            samples = np.zeros(50, SAMPLE_DTYPE)
            samples["t_ns"] = 1_000_000_000 * (1000 + second) + 20_000_000 * np.arange(50)
            samples["f"] = placement.mount @ mount.T @ [0.0, 0.0, STANDARD_GRAVITY]
            navigator.ring.samples, navigator.last_ns = samples, int(samples["t_ns"][-1])
            lla = START + np.array([5.0 * second, 0.0, 0.0]) / curvature_scale(START)
            monitor.observe(PositionFix(navigator.last_ns, lla, np.eye(3), np.zeros(3)))
            monitor.run_periodic()

    move(0, 90, true)
    status = input_status(navigator, inputs, navigator.last_ns, tilt=monitor.tilt)

    assert monitor.fault is None
    [line] = [line for line in lines if "base_frame's z axis" in line]
    assert line.startswith("warn: imu/data: in 60 s of motion the mean specific force is 37° from")
    assert "set imu.mount_rpy to [0.4, -0.52, 0.3] (roll and pitch are measured" in line
    assert status.level == 1 and status.text.startswith("imu: tilted mount: in 80 s of motion")
    assert inputs.counts == {"imu: tilted mount": 1}

    move(90, 130, FLIP @ placement.mount)

    assert monitor.tilt is None
    assert len([line for line in lines if "base_frame's z axis" in line]) == 1
