"""The node's estimator over a recording, some of its fixes withheld: how good parameters are."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.bags import messages
from hybrid_ins.bags.messages import absolute
from hybrid_ins.bags.reader import BagReader, InputTopics, received
from hybrid_ins.core.fix_checks.repeated_fixes import without_held
from hybrid_ins.core.inertial.earth import LocalFrame, displacement
from hybrid_ins.core.inertial.rotations import matrix_from_quat
from hybrid_ins.ros.estimator.estimator import Estimator
from hybrid_ins.ros.estimator.imu_block import handle_imu_block
from hybrid_ins.ros.messages import gps_fix, type_names
from hybrid_ins.ros.messages.conversions import SWAP, GnssInput, Refused

Array = NDArray[np.float64]

SPAN = 2.0  # s of fixes that are withheld together
EVERY = 4  # spans, one of which is withheld
MAX_STEP = 0.6  # s between two odometry messages that are interpolated
TRIM = 0.95  # share of the withheld fixes that count: a receiver's outliers are no one's fault
WORSE = 1.05  # factor on the error at the withheld fixes from which parameters are worse
LESS_USED = 0.02  # share of the fixes
NOTHING_COMPARED = "no withheld fix could be compared with the odometry of both"


@dataclass(frozen=True, eq=False)
class Trial:
    """What an estimator did with a recording of which some fixes were withheld."""

    error: Array  # (M,) m, at the withheld fixes; NaN where there was no odometry
    nis: Array  # (M,) their normalised squares over the number of axes that are compared
    used: float  # share of the other fixes that were fused


@dataclass(frozen=True, eq=False)
class _Track:
    """Odometry in the map frame, its axes ENU, and where to find it by time."""

    t_ns: Array  # (N,) int64, IMU clock
    pose: Array  # (N, 43) position, quaternion (x y z w), 6 x 6 covariance: as in Odometry
    frame: LocalFrame

    def antenna(self, t_ns: int, antenna_b: Array) -> tuple[Array, Array] | None:
        """Return the antenna's position and its covariance (3, 3); None outside the odometry."""
        i = int(np.searchsorted(self.t_ns, t_ns))
        if not 0 < i < len(self.t_ns) or self.t_ns[i] - self.t_ns[i - 1] > MAX_STEP * 1e9:
            return None
        a = (t_ns - self.t_ns[i - 1]) / (self.t_ns[i] - self.t_ns[i - 1])
        before, after = self.pose[i - 1], self.pose[i]
        position = before[:3] + a * (after[:3] - before[:3])
        covariance = after[7:].reshape(6, 6)[:3, :3]
        return position + matrix_from_quat(after[3:7]) @ antenna_b, covariance


@dataclass(frozen=True, eq=False)
class _Withheld:
    """A fix that the estimator did not get."""

    t_ns: int  # IMU clock
    lla: Array  # (3,) rad, rad, m; a height that is not known is NaN
    covariance_n: Array  # (3, 3) m²

    def compare(self, track: _Track, antenna_b: Array) -> tuple[float, float]:
        """
        Return the distance of the track to the fix [m] and its normalised square over its axes.

        They are horizontal where the fix has no height, and NaN where there is no odometry.
        """
        found = track.antenna(self.t_ns, antenna_b)
        if found is None:
            return math.nan, math.nan
        away_n = displacement(track.frame.lla(found[0] @ SWAP), self.lla)
        S = SWAP @ found[1] @ SWAP.T + self.covariance_n
        seen = np.isfinite(away_n) & np.isfinite(np.diag(S))
        if not np.any(seen):
            return math.nan, math.nan
        away, S = away_n[seen], S[np.ix_(seen, seen)]
        nis = away @ np.linalg.solve(S, away) / len(away)
        return float(np.linalg.norm(away)), float(nis)


def run_trial(
    path: Path, values: Mapping[str, Any], topics: InputTopics, rows: slice = slice(None)
) -> Trial:
    """
    Run the estimator over a bag with some fixes withheld, and compare it with them.

    Parameters
    ----------
    path : Path
        A bag that `recording.read_recording` has read.
    values : mapping
        Checked parameters.
    topics : InputTopics
        Where the input is.
    rows : slice
        The Imu messages that are used.
    """
    estimator = Estimator(values, lambda level, text: None)
    track, all_withheld, given = _run(path, values, topics, rows, estimator)
    withheld = without_held(all_withheld)
    antenna_b = np.asarray(values["gnss.antenna_position"], float)
    error, nis = np.full(len(withheld), np.nan), np.full(len(withheld), np.nan)
    if track is not None:
        for k, fix in enumerate(withheld):
            error[k], nis[k] = fix.compare(track, antenna_b)
    return Trial(error, nis, min(estimator.reporter.fixes_fused / given, 1.0) if given else 0.0)


def _run(
    path: Path,
    values: Mapping[str, Any],
    topics: InputTopics,
    rows: slice,
    estimator: Estimator,
) -> tuple[_Track | None, list[_Withheld], int]:
    """Return the odometry, the withheld fixes, and how many an aligned estimator was given."""
    convert = GnssInput.from_parameters({**values, "gnss.time_offset.value": 0.0})
    withheld: list[_Withheld] = []
    t_blocks, pose_blocks = [np.empty(0, np.int64)], [np.empty((0, 43))]
    with BagReader(path) as bag:
        imu = bag.imu(topics["imu_topic"])
        fix_topic = bag.require(topics["fix_topic"], type_names.FIX, "--fix-topic")
        velocity_topic = absolute(topics["velocity_topic"])
        has_velocity = bag.topics.get(velocity_topic) == type_names.TWIST
        used = np.arange(len(imu.log_ns))[rows]
        used = used[imu.has_reading[used]]
        stamps, log_ns = imu.times_ns(values)[used], imu.log_ns[used]
        force, rate = imu.specific_force[used], imu.angular_rate[used]
        estimator.noise.preload(stamps, force, rate)
        given, start, first_ns = 0, 0, 0

        def advance(stop: int) -> None:
            nonlocal start
            part = slice(start, max(start, stop))
            for block in handle_imu_block(estimator, stamps[part], force[part], rate[part]):
                t_blocks.append(block.t_ns)
                pose_blocks.append(block.in_map[:, :43].copy())
            estimator.pop_reports()
            start = part.stop

        for topic, at_ns, message in bag.messages(fix_topic, *[velocity_topic] * has_velocity):
            advance(int(np.searchsorted(log_ns, at_ns, side="right")))
            message = gps_fix.position_of(message, messages.new_message)
            if start == len(stamps):
                break
            first_ns, received_ns = first_ns or at_ns, received(values, at_ns)
            withhold = int((at_ns - first_ns) * 1e-9 / SPAN) % EVERY == EVERY - 1
            if topic == velocity_topic and not withhold:
                estimator.handle_velocity(message, received_ns)
            elif topic == fix_topic and withhold:
                fix = convert.position(message, received_ns)
                if not isinstance(fix, Refused):
                    offset_ns = round(estimator.clock.offset * 1e9)
                    withheld.append(_Withheld(fix.t_ns + offset_ns, fix.lla, fix.covariance_n))
            elif topic == fix_topic:
                given += estimator.aligned
                estimator.handle_fix(message, received_ns)
        advance(len(stamps))
    if estimator.odometry.map is None:
        return None, withheld, given
    frame = LocalFrame(estimator.odometry.map.datum_lla)
    return _Track(np.concatenate(t_blocks), np.vstack(pose_blocks), frame), withheld, given


@dataclass(frozen=True)
class Comparison:
    """Two parameter sets on the same recordings: before and after."""

    used: tuple[float, float]  # share of the fixes
    rms: tuple[float, float]  # m, at withheld fixes for which both have odometry, without the worst
    nis: tuple[float, float]  # of these, over their axes
    covered: tuple[float, float]  # share of the withheld fixes that odometry can be compared with

    @property
    def is_blind(self) -> bool:
        """No withheld fix can be compared with the odometry of both."""
        return not math.isfinite(self.rms[0]) or not math.isfinite(self.rms[1])

    @property
    def objection(self) -> str:
        """Return why the second set should not replace the first; empty where it may."""
        if self.is_blind and not self.covered[0] == 0.0 < self.covered[1]:
            return (
                f"not compared with the given parameters: {NOTHING_COMPARED}: record longer, with "
                "turns and changes of speed"
            )
        worse = self._worse()
        return f"worse than the given parameters: {worse}" if worse else ""

    def _worse(self) -> str:
        """Return why the second set is worse than the first; empty where it is not."""
        if self.covered[1] < self.covered[0] - 0.1:
            return (
                f"the filter is aligned for {_percent(self.covered[1])} of the time, with the "
                f"given parameters for {_percent(self.covered[0])}"
            )
        if self.rms[1] > WORSE * self.rms[0]:
            return (
                f"withheld fixes are {self.rms[1]:.3f} m off, with the given parameters "
                f"{self.rms[0]:.3f} m"
            )
        if self.used[1] < self.used[0] - LESS_USED:
            return (
                f"{_percent(self.used[1])} of the fixes are used, with the given parameters "
                f"{_percent(self.used[0])}"
            )
        return ""

    def text(self) -> str:
        """Return a line for the user."""
        outcome = (
            f"these are {self.rms[0]:.3f} -> {self.rms[1]:.3f} m off, NIS/dof "
            f"{self.nis[0]:.2f} -> {self.nis[1]:.2f} (1 expected)"
        )
        if self.is_blind:
            before, after = map(_percent, self.covered)
            outcome = (
                f"{NOTHING_COMPARED}: the filter is aligned for {before} -> {after} of the time"
            )
        return (
            "replayed with every fourth 2 s of fixes withheld: "
            f"{outcome}; fixes used {_percent(self.used[0])} -> {_percent(self.used[1])}"
        )


def compare(before: Sequence[Trial], after: Sequence[Trial]) -> Comparison:
    """Compare the trials of the same recordings with two parameter sets."""
    error = np.array([np.concatenate([t.error for t in s]) for s in (before, after)])
    nis = np.array([np.concatenate([t.nis for t in s]) for s in (before, after)])
    both = np.all(np.isfinite(error), axis=0)
    least = np.min(error[:, both], axis=0)
    counts = np.flatnonzero(both)[least <= np.quantile(least, TRIM)] if len(least) else []
    rms = [math.sqrt(np.mean(row[counts] ** 2)) if len(counts) else math.nan for row in error]
    mean = [float(np.mean(row[counts])) if len(counts) else math.nan for row in nis]
    return Comparison(
        (_mean([t.used for t in before]), _mean([t.used for t in after])),
        (rms[0], rms[1]),
        (mean[0], mean[1]),
        (_share(np.isfinite(error[0])), _share(np.isfinite(error[1]))),
    )


def _mean(values: Sequence[float]) -> float:
    return float(np.mean(values)) if values else math.nan


def _share(of: NDArray[np.bool_]) -> float:
    return float(np.mean(of)) if len(of) else 0.0


def _percent(share: float) -> str:
    return f"{100.0 * share:.1f} %"
