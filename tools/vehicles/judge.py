"""
The node's own estimator over a drive, and what came of it.

Fixes that were withheld from real recordings are compared with the odometry at their stamps plus
the clock offset in force, as fixes that are fused would be: of no receiver is the age known to
better than 0.05 s, in which a fixed wing moves a metre.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.bags.messages import new_message
from hybrid_ins.core.inertial.earth import LocalFrame
from hybrid_ins.core.inertial.rotations import matrix_from_quat
from hybrid_ins.core.navigator.notices import Notice
from hybrid_ins.core.update.gate import Verdict
from hybrid_ins.ros.estimator.estimator import Estimator
from hybrid_ins.ros.estimator.imu_block import handle_imu_block
from hybrid_ins.ros.messages import conversions
from hybrid_ins.ros.messages.conversions import SWAP
from hybrid_ins.ros.messages.trajectory import Array
from hybrid_ins.ros.reporting.reports import MapOdometry, Report
from tools.vehicles.aiding import Aiding
from tools.vehicles.drives import Drive

SETTLED = 30.0  # s after the start of the motion, from which errors count
FAR, LASTING = 2.0, 5.0  # times three sigma, s: silently wrong
LONGEST_GAP = 0.6  # s, of the odometry: nothing is claimed in a longer one
DOUBT = 1.5, math.radians(10.0)  # m, rad: of real drives the truth is known no better


@dataclass(frozen=True)
class Score:
    """Figures of one run; positions in metres, times in seconds."""

    aligned: float  # s after the start of the motion; NaN: never
    heading_at_start: float  # deg, error when aligned
    used: float  # share of the fixes since the alignment that were fused
    rmse: float  # horizontal, at the truth's epochs
    rmse_up: float
    nees: float  # horizontal position, over 2
    nis: float  # mean over the dimension
    covered: float  # share of the truth's epochs with an estimate
    silent: float  # s, silently wrong in position or heading
    worst: float  # m, horizontal
    resets: int
    offset: float  # s, in force at the end
    heading: float  # deg, rms error of the heading where known


class Judged(Estimator):
    """
    Keeps what it says of the fixes, and odometry of the search for the heading.

    Attributes
    ----------
    search : list of MapOdometry
    """

    def __init__(self, values: Mapping[str, Any], log: Any = lambda level, text: None) -> None:
        self.rows: list[tuple[bool, float, int, bool]] = []
        self.offsets: list[tuple[int, float]] = []  # IMU's time [ns], offset in force [s]
        self.search: list[MapOdometry] = []
        super().__init__(values, log)

    def on_notice(self, notice: Notice) -> None:
        """See `Estimator`."""
        if isinstance(notice, Verdict) and notice.reason not in ("aligning", "repeated stamp"):
            self.rows.append((notice.accepted, notice.nis, len(notice.sigma), notice.inflated))
        super().on_notice(notice)

    def handle_fix(self, message: Any, received_ns: int | None = None) -> None:
        """See `Estimator`."""
        super().handle_fix(message, received_ns)
        self.offsets.append((self.navigator.last_ns, self.clock.offset))

    def pop_reports(self) -> Sequence[Report]:
        """See `Estimator`."""
        reports = super().pop_reports()
        self.search += [r.content for r in reports if isinstance(r.content, MapOdometry)]
        return reports


def run(
    drive: Drive,
    values: Mapping[str, Any],
    log: Any = lambda level, text: None,
    aiding: Sequence[Aiding] = (),
    estimator: Judged | None = None,
) -> tuple[Judged, NDArray[np.int64], Array]:
    """
    Return the estimator in its last state, stamps [ns] and odometry (N, 85).

    ``aiding`` holds messages of other sensors in the order of their arrival; ``estimator`` is used
    in place of one with ``values``.
    """
    estimator = estimator or Judged(values, log)
    fix = new_message("sensor_msgs/msg/NavSatFix")
    velocity = new_message("geometry_msgs/msg/TwistWithCovarianceStamped")
    done: list[tuple[NDArray[np.int64], Array]] = []
    start = 0

    waiting = deque(aiding)

    def advance(stop: int) -> None:
        while waiting:
            at = int(np.searchsorted(drive.imu_ns, waiting[0].arrival_ns, side="right"))
            if at > stop:
                break
            advance_imu(at)
            _, topic, message = waiting.popleft()
            estimator.aids.sources.handle(topic, message)
        advance_imu(stop)

    def advance_imu(stop: int) -> None:
        nonlocal start
        if stop > start:
            part = slice(start, stop)
            done.extend(
                (block.t_ns, block.in_map)
                for block in handle_imu_block(
                    estimator, drive.imu_ns[part], drive.force[part], drive.rate[part]
                )
            )
            start = stop

    for k in range(len(drive.fix_ns)):
        advance(int(np.searchsorted(drive.imu_ns, drive.arrival_ns[k], side="right")))
        conversions.set_stamp(fix.header.stamp, int(drive.fix_ns[k]))
        fix.latitude, fix.longitude = np.degrees(drive.fix_lla[k, :2]).tolist()
        fix.altitude = float(drive.fix_lla[k, 2])
        known = bool(np.all(np.isfinite(drive.fix_std[k])))
        fix.position_covariance_type = 2 if known else 0
        fix.position_covariance = np.diag(np.nan_to_num(drive.fix_std[k]) ** 2).ravel()
        estimator.handle_fix(fix)
        if drive.velocity_enu is not None and np.all(np.isfinite(drive.velocity_enu[k])):
            conversions.set_stamp(velocity.header.stamp, int(drive.fix_ns[k]))
            linear = velocity.twist.twist.linear
            linear.x, linear.y, linear.z = drive.velocity_enu[k].tolist()
            covariance = np.zeros((6, 6))
            assert drive.velocity_std is not None
            covariance[:3, :3] = np.diag(np.nan_to_num(drive.velocity_std[k]) ** 2)
            velocity.twist.covariance = covariance.ravel()
            estimator.handle_velocity(velocity)
        estimator.pop_reports()
    advance(len(drive.imu_ns))
    estimator.pop_reports()
    if not done:
        return estimator, np.empty(0, np.int64), np.empty((0, 85))
    return estimator, np.concatenate([t for t, _ in done]), np.concatenate([v for _, v in done])


def score(drive: Drive, values: Mapping[str, Any], log: Any = lambda level, text: None) -> Score:
    """Run and judge: `Score.silent` all odometry, the rest from when the heading is known."""
    estimator, t_ns, rows = run(drive, values, log)
    search_ns = np.array([found.t_ns for found in estimator.search], np.int64)
    everything = np.concatenate([*[f.values[None] for f in estimator.search], rows])
    if not drive.absolute and estimator.offsets:
        drive = replace(drive, truth_ns=at_offset_in_force(drive, estimator.offsets))
        rows, everything = (_of_antenna(some, values) for some in (rows, everything))
    silent = _silently_wrong(drive, np.concatenate((search_ns, t_ns)), everything)
    nan = math.nan
    if len(t_ns) < 2:
        return Score(nan, nan, 0.0, nan, nan, nan, nan, 0.0, silent, nan, 0, 0.0, nan)
    seen, horizontal, up, P = _position_errors(drive, t_ns, rows)
    counts = drive.truth_ns >= drive.motion_ns + round(SETTLED * 1e9)
    used = seen & counts
    nees = np.einsum("ki,ki->k", horizontal, np.linalg.solve(P, horizontal[..., None])[..., 0])
    distance = np.linalg.norm(horizontal, axis=1)
    yaw_ns, off, _ = _heading_errors(drive, t_ns, rows)
    moving = yaw_ns >= drive.motion_ns + round(SETTLED * 1e9)
    verdicts = estimator.rows
    nis = [row[1] / row[2] for row in verdicts if row[2] and math.isfinite(row[1])]
    return Score(
        (int(t_ns[0]) - drive.motion_ns) * 1e-9,
        math.degrees(float(off[0])) if len(off) else nan,
        float(np.mean([row[0] for row in verdicts])) if verdicts else nan,
        _rms(distance[used]),
        _rms(up[used]),
        float(np.mean(nees[used])) / 2.0 if np.any(used) else nan,
        float(np.mean(nis)) if nis else nan,
        float(np.sum(used)) / max(1, int(np.sum(counts))),
        silent,
        float(distance[used].max(initial=0.0)),
        sum(row[3] for row in verdicts),
        estimator.clock.offset,
        math.degrees(_rms(off[moving])),
    )


def _position_errors(
    drive: Drive, t_ns: NDArray[np.int64], rows: Array
) -> tuple[NDArray[np.bool_], Array, Array, Array]:
    """
    Return errors at the truth's K epochs.

    Whether there is odometry (K,), the horizontal error (K, 2) and that upwards (K,) [m], and the
    covariance of the first (K, 2, 2).
    """
    truth = LocalFrame(drive.fix_lla[0]).position(drive.truth_lla) @ SWAP
    at = np.clip(np.searchsorted(t_ns, drive.truth_ns), 1, len(t_ns) - 1)
    gap = (t_ns[at] - t_ns[at - 1]) * 1e-9
    share = (drive.truth_ns - t_ns[at - 1]) / np.maximum(t_ns[at] - t_ns[at - 1], 1)
    seen = (drive.truth_ns >= t_ns[0]) & (drive.truth_ns <= t_ns[-1]) & (gap < LONGEST_GAP)
    error = rows[at - 1, :3] + share[:, None] * (rows[at, :3] - rows[at - 1, :3]) - truth
    P = rows[at, 7:43].reshape(-1, 6, 6)[:, :2, :2]
    return seen, error[:, :2], error[:, 2], P


def _heading_errors(
    drive: Drive, t_ns: NDArray[np.int64], rows: Array
) -> tuple[NDArray[np.int64], Array, Array]:
    """Return stamps [ns] of the truth's headings, the error and its σ [rad], each (L,)."""
    seen = (drive.truth_yaw_ns >= t_ns[0]) & (drive.truth_yaw_ns <= t_ns[-1])
    k = np.clip(np.searchsorted(t_ns, drive.truth_yaw_ns), 0, len(t_ns) - 1)
    seen &= t_ns[k] - drive.truth_yaw_ns < LONGEST_GAP * 1e9
    k = k[seen]
    C = matrix_from_quat(rows[k, 3:7])
    yaw = 0.5 * np.pi - np.arctan2(C[:, 1, 0], C[:, 0, 0])
    off = np.abs((yaw - drive.truth_yaw[seen] + np.pi) % (2.0 * np.pi) - np.pi)
    return drive.truth_yaw_ns[seen], off, np.sqrt(rows[k, 7 + 35])


def _silently_wrong(drive: Drive, t_ns: NDArray[np.int64], rows: Array) -> float:
    """Return for how long [s] the position or the heading is wrong by far more than claimed."""
    if len(t_ns) < 2:
        return 0.0
    metres, radians = (0.0, 0.0) if drive.absolute else DOUBT
    seen, horizontal, _, P = _position_errors(drive, t_ns, rows)
    sigma = np.sqrt(np.maximum(np.trace(P, axis1=1, axis2=2), 1e-12))
    distance = np.linalg.norm(horizontal, axis=1)
    silent = _lasting(drive.truth_ns, seen & (distance > 3.0 * FAR * sigma + metres))
    yaw_ns, off, std = _heading_errors(drive, t_ns, rows)
    return float(max(silent, _lasting(yaw_ns, off > 3.0 * FAR * std + radians)))


def _of_antenna(rows: Array, values: Mapping[str, Any]) -> Array:
    """Return odometry with the position of the antenna, where the fixes are."""
    moved = rows.copy()
    moved[:, :3] += matrix_from_quat(rows[:, 3:7]) @ np.asarray(values["gnss.antenna_position"])
    return moved


def at_offset_in_force(drive: Drive, offsets: Sequence[tuple[int, float]]) -> NDArray[np.int64]:
    """Return the times of fixes that were withheld, (K,) [ns], by the clock offset in force."""
    since, offset = np.array([t for t, _ in offsets]), np.array([o for _, o in offsets])
    k = np.clip(np.searchsorted(since, drive.truth_ns, side="right") - 1, 0, None)
    moved: NDArray[np.int64] = np.round(1e9 * (offset[k] - drive.offset)).astype(np.int64)
    return drive.truth_ns + moved


def _lasting(t_ns: NDArray[np.int64], wrong: NDArray[np.bool_]) -> float:
    """Return how long something is wrong in all, in stretches of at least ``LASTING`` [s]."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], wrong, [False])).astype(np.int8)))
    total = 0.0
    for begin, end in zip(edges[::2], edges[1::2], strict=True):
        span = (t_ns[end - 1] - t_ns[begin]) * 1e-9
        total += span if span >= LASTING else 0.0
    return total


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2))) if len(values) else math.nan


def as_row(found: Score) -> dict[str, float]:
    """Return a score as plain numbers."""
    return asdict(found)
