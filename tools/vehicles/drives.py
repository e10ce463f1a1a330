"""Recordings of vehicles, real and simulated, in arrays: what the node would be given; truth."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from hybrid_ins.core.rotations import rpy_from_quat
from hybrid_ins.ros.conversions import SWAP
from hybrid_ins.ros.trajectory import Array, Stamps
from hybrid_ins.simulation.vehicles import Recording

EPOCH_NS = 1_000_000_000_000  # added to all times: no stamp is zero
AGE = {  # s, of a position behind its stamp, by the data's own README
    "pedestrian_rtk": 0.0,
    "plane_x8": 0.30,
    "quad106": 0.16,
    "quad_low": 0.14,
    "car_circles": 0.3,
}


@dataclass(frozen=True, eq=False)
class Drive:
    """One run. Times of truth are the IMU's; stamps of fixes as the receiver gives them."""

    name: str
    imu_ns: Stamps  # (N,)
    force: Array  # (N, 3) m/s2, FLU
    rate: Array  # (N, 3) rad/s, FLU
    fix_ns: Stamps  # (M,) stamps
    arrival_ns: Stamps  # (M,) IMU's time
    fix_lla: Array  # (M, 3) rad, rad, m
    fix_std: Array  # (M, 3) m, east north up; NaN: not claimed
    velocity_enu: Array | None  # (M, 3) m/s
    velocity_std: Array | None  # (M, 3) m/s; NaN: not claimed
    truth_ns: Stamps  # (K,) IMU's time
    truth_lla: Array  # (K, 3)
    truth_yaw_ns: Stamps  # (L,)
    truth_yaw: Array  # (L,) rad from north
    motion_ns: int  # when it begins to move
    offset: float  # s, true clock offset at the start
    absolute: bool  # the truth is true, not just withheld fixes

    def thinned(self, keep: npt.NDArray[np.bool_]) -> Drive:
        """Return the same with some of the fixes."""
        return replace(
            self,
            fix_ns=self.fix_ns[keep],
            arrival_ns=self.arrival_ns[keep],
            fix_lla=self.fix_lla[keep],
            fix_std=self.fix_std[keep],
            velocity_enu=None if self.velocity_enu is None else self.velocity_enu[keep],
            velocity_std=None if self.velocity_std is None else self.velocity_std[keep],
        )


def from_simulation(recording: Recording, delay: float = 0.0) -> Drive:
    """Return a simulated run; fixes arrive ``delay`` [s] after their time."""
    truth, imu, receiver = recording.truth, recording.imu, recording.vehicle.receiver
    flip = np.array([1.0, -1.0, -1.0])
    std = np.asarray(receiver.claimed_std)[[1, 0, 2]]
    step = max(1, round(0.1 * recording.vehicle.imu_rate))
    ns = _ns(truth.t)
    velocity_n = recording.fix_velocity_n
    velocity_enu = None if velocity_n is None else velocity_n @ SWAP
    return Drive(
        recording.vehicle.name,
        _ns(imu.t),
        imu.specific_force * flip,
        imu.angular_rate * flip,
        _ns(recording.fix_stamp),
        _ns(recording.fix_t + delay),
        recording.fix_lla,
        np.tile(std, (len(recording.fix_t), 1)),
        velocity_enu,
        None if velocity_enu is None else np.full(velocity_enu.shape, receiver.velocity_std),
        ns[::step],
        truth.lla[::step],
        ns[::step],
        rpy_from_quat(truth.quat_xyzw[::step])[..., 2] if truth.quat_xyzw.ndim > 1 else np.empty(0),
        int(_ns(np.array([recording.vehicle.rest]))[0]),
        receiver.offset,
        True,
    )


def load(folder: Path, feed: str) -> Drive:
    """
    Read a real set; ``feed`` is half (every second fix), 1 Hz, or all (scored where fed).
    """
    imu = np.genfromtxt(folder / "imu.csv.gz", delimiter=",", names=True)
    gnss = np.genfromtxt(folder / "gnss.csv", delimiter=",", names=True)
    lla = np.stack((np.radians(gnss["lat"]), np.radians(gnss["lon"]), gnss["height"]), axis=1)
    velocity = np.stack([gnss[n] for n in ("ve", "vn", "vu")], axis=1)
    age = AGE[folder.name]
    t = gnss["t"]
    yaw_t, yaw = np.empty(0), np.empty(0)
    if (folder / "attitude.csv.gz").exists():
        attitude = np.genfromtxt(folder / "attitude.csv.gz", delimiter=",", names=True)
        yaw_t, yaw = attitude["t"], np.radians(attitude["yaw"])
    fresh = np.concatenate(([True], np.diff(t) > 1e-6))
    t, lla, velocity, gnss = t[fresh], lla[fresh], velocity[fresh], gnss[fresh]
    if feed == "half":
        fed = np.arange(len(t)) % 2 == 0
    elif feed == "1 Hz":
        fed = np.concatenate(([True], np.floor(t[1:]) > np.floor(t[:-1])))
    else:
        fed = np.ones(len(t), bool)
    withheld = ~fed if feed != "all" else fed
    speed = np.linalg.norm(velocity[:, :2], axis=1)
    moving = np.flatnonzero(np.nan_to_num(speed, nan=9.0) > 0.8)
    motion = t[moving[5]] if len(moving) > 5 else t[0]
    # A stretch at 3/5 of its run of speed: the last time before it moves for good is not needed.
    inside = (t - age > imu["t"][0]) & (t - age < imu["t"][-1])
    drive = Drive(
        f"{folder.name}, {feed}",
        _ns(imu["t"]),
        np.stack([imu[n] for n in ("ax", "ay", "az")], axis=1),
        np.stack([imu[n] for n in ("gx", "gy", "gz")], axis=1),
        _ns(t),
        _ns(t),
        lla,
        np.stack([gnss[n] for n in ("sd_e", "sd_n", "sd_u")], axis=1),
        None if np.all(np.isnan(velocity)) else velocity,
        np.stack([gnss[n] for n in ("sd_ve", "sd_vn", "sd_vu")], axis=1),
        _ns(t - age)[withheld & inside & (np.nan_to_num(speed, nan=9.0) > 0.5)],
        lla[withheld & inside & (np.nan_to_num(speed, nan=9.0) > 0.5)],
        _ns(yaw_t),
        yaw,
        int(_ns(np.array([motion]))[0]),
        -age,
        False,
    )
    return drive.thinned(fed)


def _ns(t: Array) -> Stamps:
    return EPOCH_NS + np.round(np.asarray(t) * 1e9).astype(np.int64)
