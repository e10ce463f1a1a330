"""Simulated drives as recordings to calibrate with."""

from __future__ import annotations

import numpy as np

from hybrid_ins.calibration.innovations import POSITION, VELOCITY
from hybrid_ins.calibration.recording import Recording
from hybrid_ins.simulation.vehicles import Recording as Drive


def recording_of(drive: Drive) -> Recording:
    """Return a drive as its bag would be read, velocities included."""
    receiver = drive.vehicle.receiver
    kinds = [(POSITION, drive.fix_lla, np.asarray(receiver.claimed_std))]
    if drive.fix_velocity_n is not None:
        kinds.append((VELOCITY, drive.fix_velocity_n, np.full(3, receiver.velocity_std)))
    count = len(drive.fix_stamp)
    order = np.argsort(np.tile(drive.fix_stamp, len(kinds)), kind="stable")
    return Recording(
        drive.vehicle.name,
        drive.imu.t,
        np.ascontiguousarray(np.hstack((drive.imu.specific_force, drive.imu.angular_rate))),
        np.tile(drive.fix_stamp, len(kinds))[order],
        np.repeat([kind for kind, _, _ in kinds], count)[order],
        np.vstack([values for _, values, _ in kinds])[order],
        np.vstack([np.tile(np.diag(std**2), (count, 1, 1)) for *_, std in kinds])[order],
    )
