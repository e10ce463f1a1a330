"""Recordings of vehicles, real and simulated, in arrays: what the node would be given; truth."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from hybrid_ins.cli import options
from hybrid_ins.core.inertial.rotations import rpy_from_quat
from hybrid_ins.dataset.logs.formats import read_estimate, read_logs
from hybrid_ins.ros.messages.conversions import SWAP
from hybrid_ins.ros.messages.trajectory import Array, Stamps
from hybrid_ins.simulation.vehicles import Recording

Log = tuple[Path, ...]  # one file, or that of the IMU and that of the receiver

EPOCH_NS = 1_000_000_000_000  # added to all times: no stamp is zero
STEEP = np.radians(60.0)  # of the nose, above which its course says little
USUAL_AGE = 0.1  # s, of a fix in an autopilot's log, behind its stamp
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
    yaw_t, yaw = np.empty(0), np.empty(0)
    if (folder / "attitude.csv.gz").exists():
        attitude = np.genfromtxt(folder / "attitude.csv.gz", delimiter=",", names=True)
        yaw_t, yaw = attitude["t"], np.radians(attitude["yaw"])
    velocity_enu = _columns(gnss, "ve", "vn", "vu")
    has_velocity = not np.all(np.isnan(velocity_enu))
    drive = Drive(
        folder.name,
        _ns(imu["t"]),
        _columns(imu, "ax", "ay", "az"),
        _columns(imu, "gx", "gy", "gz"),
        _ns(gnss["t"]),
        _ns(gnss["t"]),
        _columns(gnss, "lat", "lon", "height") * [np.pi / 180.0, np.pi / 180.0, 1.0],
        _columns(gnss, "sd_e", "sd_n", "sd_u"),
        velocity_enu if has_velocity else None,
        _columns(gnss, "sd_ve", "sd_vn", "sd_vu"),
        np.empty(0, np.int64),
        np.empty((0, 3)),
        _ns(yaw_t),
        yaw,
        0,
        -AGE[folder.name],
        False,
    )
    return _with_some_withheld(drive, feed)


def log(text: str) -> Log:
    """Return the files of ``FILE`` or ``IMU,GNSS``; a type of argparse."""
    return tuple(options.path(part) for part in text.split(","))


def from_log(paths: Log, feed: str) -> Drive:
    """Read one log, or one of the IMU and one of the receiver; ``feed`` as for `load`."""
    imu, gnss = read_logs(list(paths))
    yaw_t, yaw = np.empty(0), np.empty(0)
    if (estimate := read_estimate(paths[0])) is not None:
        _, pitch, yaw = rpy_from_quat(estimate.quat_xyzw).T
        yaw_t = estimate.t - imu.t[0]
        has_heading = np.abs(pitch) < STEEP
        yaw_t, yaw = yaw_t[has_heading], yaw[has_heading]
    R = gnss.velocity_covariance_n
    R = R if R is not None else np.full((len(gnss.t), 3, 3), np.nan)
    start = imu.t[0]
    drive = Drive(
        paths[0].stem,
        _ns(imu.t - start),
        imu.specific_force,
        imu.angular_rate,
        _ns(gnss.t - start),
        _ns(gnss.t - start),
        gnss.lla,
        np.sqrt(np.diagonal(gnss.covariance_n, axis1=1, axis2=2)) @ np.abs(SWAP),
        None if gnss.velocity_n is None else gnss.velocity_n @ SWAP,
        np.sqrt(np.diagonal(R, axis1=1, axis2=2)) @ np.abs(SWAP),
        np.empty(0, np.int64),
        np.empty((0, 3)),
        _ns(yaw_t),
        yaw,
        0,
        -USUAL_AGE,
        False,
    )
    return _with_some_withheld(drive, feed)


def _with_some_withheld(drive: Drive, feed: str) -> Drive:
    """Return a drive with the fixes of a ``feed``, and the others as its truth."""
    ns = drive.fix_ns
    drive = drive.thinned(np.concatenate(([True], np.diff(ns) > 1_000)))
    ns = drive.fix_ns
    if feed == "half":
        fed = np.arange(len(ns)) % 2 == 0
    elif feed == "1 Hz":
        fed = np.diff(ns // 1_000_000_000, prepend=-1) > 0
    else:
        fed = np.ones(len(ns), bool)
    speed = np.full(len(ns), 9.0)  # without velocities all counts as motion
    if drive.velocity_enu is not None:
        speed = np.nan_to_num(np.linalg.norm(drive.velocity_enu[:, :2], axis=1), nan=9.0)
    moving = np.flatnonzero(speed > 0.8)
    true_ns = ns + round(drive.offset * 1e9)
    withheld = fed if feed == "all" else ~fed
    scored = withheld & (speed > 0.5) & (true_ns > drive.imu_ns[0]) & (true_ns < drive.imu_ns[-1])
    return replace(
        drive,
        name=f"{drive.name}, {feed}",
        truth_ns=true_ns[scored],
        truth_lla=drive.fix_lla[scored],
        motion_ns=int(ns[moving[5]] if len(moving) > 5 else ns[0]),
    ).thinned(fed)


def _columns(table: npt.NDArray[np.void], *names: str) -> Array:
    return np.stack([table[name] for name in names], axis=1)


def _ns(t: Array) -> Stamps:
    return EPOCH_NS + np.round(np.asarray(t) * 1e9).astype(np.int64)
