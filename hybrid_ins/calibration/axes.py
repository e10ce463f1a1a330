"""The check of the IMU's axes, units and mount over a recording, before anything is calibrated."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from hybrid_ins.calibration.innovations import POSITION
from hybrid_ins.calibration.recording import Recording
from hybrid_ins.calibration.stamps import stamps_of
from hybrid_ins.core.imu.samples import as_samples
from hybrid_ins.core.imu_axes.faults import AxesFault
from hybrid_ins.core.imu_axes.level import Tilt
from hybrid_ins.core.imu_axes.monitor import ImuAxesCheck
from hybrid_ins.ros.messages.conversions import FLIP, mount_matrix

STEP = 0.1  # s, between two shares of the check's work


def axes_fault(recording: Recording, values: Mapping[str, Any]) -> AxesFault | Tilt | None:
    """
    Return what is wrong with axes, units or mount of a recording's IMU; None: nothing was found.

    Parameters
    ----------
    recording : Recording
    values : mapping
        Checked parameters: the mount, and where IMU and antenna are.
    """
    lever_b = FLIP @ np.subtract(values["gnss.antenna_position"], values["imu.position"])
    check = ImuAxesCheck(mount_matrix(values["imu.mount_rpy"]), lever_b)
    t_ns, readings = stamps_of(recording.t), recording.samples
    samples = as_samples(t_ns, readings[:, :3], readings[:, 3:])
    positions = recording.aid_kind == POSITION
    fixes = zip(stamps_of(recording.aid_t[positions]), recording.aid[positions], strict=True)
    waiting = next(fixes, None)
    at = 0
    for t in np.arange(STEP, recording.t[-1], STEP):
        end = int(np.searchsorted(recording.t, t))
        check.add_samples(samples[at:end])
        at = end
        now_ns = int(stamps_of(t))
        while waiting is not None and waiting[0] <= now_ns:
            check.add_fix(int(waiting[0]), waiting[1])
            waiting = next(fixes, None)
        check.advance(now_ns)
    return check.fault or check.tilt
