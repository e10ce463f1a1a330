"""Reads IMU samples and GNSS measurements from bags for calibration."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.bags import messages
from hybrid_ins.bags.reader import BagReader, ImuTable, has_optional, received, velocities_topic
from hybrid_ins.calibration.admission import (
    FEWEST_SAMPLES,
    check_fixes,
    check_imu,
    check_rest,
    check_stamps,
)
from hybrid_ins.calibration.innovations import POSITION, VELOCITY
from hybrid_ins.core.aiding.measurements import BodyVelocity
from hybrid_ins.core.filter.gap import LONG_GAP
from hybrid_ins.core.fix_checks.repeated_fixes import RepetitionCheck, without_held
from hybrid_ins.core.fix_checks.velocity_check import VelocityCheck
from hybrid_ins.core.imu.samples import sample_period
from hybrid_ins.core.inertial.earth import LocalFrame, displacement
from hybrid_ins.core.update.measurements import PositionFix, VelocityFix
from hybrid_ins.errors import InputError
from hybrid_ins.resources import printable
from hybrid_ins.ros.estimator.imu_admission import admitted_readings
from hybrid_ins.ros.messages import conversions, gps_fix, type_names
from hybrid_ins.ros.messages.aiding_conversions import AidingMessages
from hybrid_ins.ros.messages.conversions import FLIP, SWAP, GnssInput, Refused
from hybrid_ins.ros.reporting.clocks import describe_clocks
from hybrid_ins.ros.reporting.wording import describe_contradiction

Array = NDArray[np.float64]

TRUTH_STD = 0.03  # m, of a position of the truth used as a fix
MOTION_STEP = 2.0  # s, over which changes of velocity are seen
BEFORE_AND_AFTER = 10.0  # s, from the samples: fixes that are used
WHEELS = {"/aiding/velocity": type_names.TWIST, "/aiding/odometry": type_names.ODOMETRY}

_log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Recording:
    """IMU samples and GNSS measurements of one recording."""

    name: str
    t: Array  # (N,) s
    samples: Array  # (N, 6) specific force m/s², angular rate rad/s, b
    aid_t: Array  # (M,) s, GNSS clock
    aid_kind: NDArray[np.int64]  # (M,) POSITION or VELOCITY
    aid: Array  # (M, 3) rad rad m, or m/s NED
    aid_R: Array  # (M, 3, 3)
    attitude: tuple[Array, Array] | None = None  # truth: (K,) s GNSS clock, (K, 4) C_nb
    body_velocity: tuple[BodyVelocity, ...] = ()  # of wheels; stamps since the first sample
    delay: Array = field(default_factory=lambda: np.empty(0))  # (L,) s, IMU's stamp at the arrival
    # of a fix, less its own
    loudness: Array = field(default_factory=lambda: np.zeros((1, 2)))  # (N, 2) or (1, 2): logarithm
    # of the noise that accelerometer and gyroscope seem to have, relative to its mean
    rows: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, np.int64))  # (N,) numbers
    # of the samples among the bag's Imu messages
    begin: float = 0.0  # s, time 0 after the first sample
    states_std: bool = True  # the receiver states the standard deviations of most fixes

    @property
    def period(self) -> float:
        """Time between IMU samples [s], as the filter finds it."""
        return sample_period(np.rint(1e9 * self.t).astype(np.int64))

    def noise(self, follow_a: float, follow_g: float) -> Array:
        """Return factors (N, 2) on the noise densities, these powers of the loudness."""
        factors = np.exp(np.array([follow_a, follow_g]) * self.loudness)
        return np.broadcast_to(factors, (len(self.t), 2)).copy()  # a view is another type to numba

    def measured_at(self, offset: float, velocity_age: float) -> Array:
        """
        Return when measurements were valid, (M,) [s], by the IMU's clock.

        ``offset`` is added to their stamps; velocities are younger by ``velocity_age`` [s].
        """
        return self.aid_t + offset + velocity_age * (self.aid_kind == VELOCITY)

    def begin_of_motion(self, length: float) -> float:
        """
        Return the time of the fix [s] from which the vehicle's motion changes most in a length [s].

        The first fix, unless its velocity changes less than half as much there.
        """
        fixes = np.flatnonzero(self.aid_kind == POSITION)
        fixes = fixes[np.isfinite(self.aid[fixes, :2]).all(axis=1)]
        start = float(self.aid_t[0])
        t = np.arange(self.aid_t[fixes[0]], self.aid_t[fixes[-1]], MOTION_STEP)
        if len(t) < 3 or t[-1] - start <= length:
            return start
        moved = displacement(np.nan_to_num(self.aid[fixes[0]]), self.aid[fixes])
        track = [np.interp(t, self.aid_t[fixes], moved[:, k]) for k in (0, 1)]
        change = np.sum(np.diff(track, 2) ** 2, axis=0)
        sums = np.concatenate(([0.0, 0.0], np.cumsum(change)))
        by_begin = sums[np.minimum(np.searchsorted(t, t + length), len(t) - 1)] - sums[: len(t)]
        best = int(np.argmax(by_begin))
        return start if by_begin[0] > 0.5 * by_begin[best] else float(t[best])

    def part_in_motion(self, length: float) -> Recording:
        """Return the part of at most a length [s] in which the motion changes most."""
        last = float(self.t[-1])
        if last <= length:
            return self
        at = int(np.searchsorted(self.t, min(self.begin_of_motion(length), last - length)))
        begin = float(self.t[at])
        samples = slice(at, int(np.searchsorted(self.t, begin + length, side="right")))
        used = self.with_measurements_between(
            begin - BEFORE_AND_AFTER, begin + length + BEFORE_AND_AFTER
        )
        begin_ns = round(begin * 1e9)
        shifted = (replace(one, t_ns=one.t_ns - begin_ns) for one in self.body_velocity)
        attitude = self.attitude
        return replace(
            used,
            begin=begin,
            t=self.t[samples] - begin,
            samples=self.samples[samples],
            rows=self.rows[samples],
            aid_t=used.aid_t - begin,
            attitude=None if attitude is None else (attitude[0] - begin, attitude[1]),
            body_velocity=tuple(one for one in shifted if 0 <= one.t_ns <= length * 1e9),
        )

    def fixes_within(self, offset: float, margin: float) -> Array:
        """Return the times (K,) [s] of the fixes within the samples, whatever the clock offset."""
        first, last = self.t[0] - offset + margin, self.t[-1] - offset - margin
        fixes = self.aid_t[self.aid_kind == POSITION]
        return fixes[(fixes >= first) & (fixes <= last)]

    def with_measurements_between(self, first: float, last: float) -> Recording:
        """Return the recording with the GNSS measurements of an interval of their clock [s]."""
        return self.only((self.aid_t >= first) & (self.aid_t <= last))

    def only(self, keep: NDArray[np.bool_]) -> Recording:
        """Return the recording with some of the GNSS measurements, (M,)."""
        return replace(
            self,
            aid_t=self.aid_t[keep],
            aid_kind=self.aid_kind[keep],
            aid=self.aid[keep],
            aid_R=self.aid_R[keep],
        )


def read_recording(
    path: Path,
    values: Mapping[str, Any],
    *,
    imu_topic: str = "/imu/data",
    fix_topic: str = "/gnss/fix",
    velocity_topic: str = "/gnss/velocity",
    use_truth: bool = False,
    longest: float = math.inf,
    search: float = 0.0,
) -> Recording:
    """
    Read the IMU samples and GNSS measurements of a bag.

    Parameters
    ----------
    path : Path
        A bag with IMU samples and fixes.
    values : mapping
        Checked parameters: mount, bounds and defaults of the covariances.
    imu_topic, fix_topic, velocity_topic : str
        The topics; velocities are used where the bag has them.
    use_truth : bool
        Use the positions of the truth in place of the fixes.
    longest : float
        Use only so much time [s], see `Recording.part_in_motion`.
    search : float
        Clock offsets within this of the nominal one will be searched [s].

    Returns
    -------
    Recording
        The longest part without a gap of the IMU samples that the node would use.

    Raises
    ------
    InputError
        A topic is missing, the IMU's stamps or units are wrong, there are too few samples or fixes
        or too few are left by ``longest`` and ``search``, they are stamped by two clocks, or
        velocities contradict the positions.
    """
    with BagReader(path) as bag:
        imu = bag.imu(imu_topic)
        imu_ns, place = imu.times_ns(values), f"{path}: {imu_topic}"
        rows = _longest_part(imu, values, place)
        wheels = _wheels(bag, values)
        if use_truth:
            found, attitude = _truth(bag)
        else:
            fix_topic = bag.require(fix_topic, type_names.FIX, "--fix-topic")
            found, attitude = _fixes(bag, values, imu, fix_topic, velocity_topic), None
    if found.ahead_ns:
        ahead = (np.median(found.ahead_ns) - np.median((imu_ns - imu.log_ns)[rows])) * 1e-9
        if abs(ahead) > BEFORE_AND_AFTER:
            raise InputError(
                f"{path}: fixes on {fix_topic}: {describe_clocks(float(ahead))}: let both drivers "
                "stamp by one clock, and record again"
            )
    aid = sorted(found.aid, key=lambda one: (one.t_ns, one.kind))
    mount = conversions.mount_matrix(values["imu.mount_rpy"])
    samples = np.hstack((imu.specific_force[rows] @ mount.T, imu.angular_rate[rows] @ mount.T))
    origin = int(imu_ns[rows[0]])
    t = np.asarray((imu_ns[rows] - origin) * 1e-9, float)
    check_imu(t, samples, place)
    first, last = -BEFORE_AND_AFTER, t[-1] + BEFORE_AND_AFTER
    near = [one for one in aid if first < (one.t_ns - origin) * 1e-9 < last]
    fixes = [one for one in near if isinstance(one, PositionFix)]
    positions = np.array([fix.t_ns - origin for fix in fixes]) * 1e-9
    others = sum(isinstance(one, PositionFix) for one in aid) - len(fixes)
    check_fixes(positions, others, float(t[-1]), str(path))
    _refuse_wrong_velocities(path, velocity_topic, near)
    reference = None
    if attitude is not None:
        reference = np.asarray((attitude[0] - origin) * 1e-9, float), attitude[1]
    whole = Recording(
        printable(path.name),
        t,
        samples,
        np.array([(one.t_ns - origin) * 1e-9 for one in near]),
        np.array(
            [POSITION if isinstance(one, PositionFix) else VELOCITY for one in near], np.int64
        ),
        np.array([one.lla if isinstance(one, PositionFix) else one.velocity_n for one in near]),
        np.array([one.covariance_n for one in near]),
        reference,
        tuple(
            replace(one, t_ns=one.t_ns - origin)
            for one in wheels
            if 0 <= (one.t_ns - origin) * 1e-9 <= t[-1]
        ),
        np.array(found.delay_ns) * 1e-9,
        rows=rows,
        states_std=2 * found.unstated <= len(found.delay_ns),
    )
    used = whole.part_in_motion(longest)
    left = used.fixes_within(values["gnss.time_offset.value"], search)
    check_rest(left, float(used.t[-1]), search, used is not whole, str(path))
    return used


@dataclass
class _Found:
    """Measurements of a receiver, and what their arrival says."""

    aid: list[PositionFix | VelocityFix] = field(default_factory=list)
    ahead_ns: list[int] = field(default_factory=list)  # stamps of fixes, of the recorder's clock
    delay_ns: list[int] = field(default_factory=list)  # of fixes behind the IMU
    unstated: int = 0  # fixes without a covariance


def _fixes(
    bag: BagReader, values: Mapping[str, Any], imu: ImuTable, fix_topic: str, velocity_topic: str
) -> _Found:
    """Return the fixes that are neither repeated nor held, and the velocities, if any."""
    found, imu_ns = _Found(), imu.times_ns(values)
    fixes: list[PositionFix] = []
    gnss = GnssInput.from_parameters({**values, "gnss.time_offset.value": 0.0})
    repetition = RepetitionCheck()
    for _, log_ns, message in bag.messages(fix_topic):
        message = gps_fix.position_of(message, messages.new_message)
        fix = gnss.position(message, received(values, log_ns))
        if isinstance(fix, Refused) or (repetition.is_again(fix.lla) and repetition.repeats):
            continue
        fixes.append(fix)
        found.ahead_ns.append(fix.t_ns - log_ns)
        before = int(np.searchsorted(imu.log_ns, log_ns, side="right"))
        found.delay_ns.append(int(imu_ns[max(before - 1, 0)]) - fix.t_ns)
        found.unstated += bool(conversions.missing_covariance(message))
    found.aid += without_held(fixes)
    if len(found.aid) < len(fixes):
        _log.warning(
            "%s: %s: %d of %d fixes are left out: their receiver repeats a position that the "
            "vehicle has left",
            bag.path,
            fix_topic,
            len(fixes) - len(found.aid),
            len(fixes),
        )
    velocity_topic = velocities_topic(bag, velocity_topic)
    if velocity_topic:
        for _, log_ns, message in bag.messages(velocity_topic):
            velocity = gnss.velocity(message, received(values, log_ns))
            if not isinstance(velocity, Refused):
                found.aid.append(velocity)
    return found


def _refuse_wrong_velocities(
    path: Path, topic: str, aid: Sequence[PositionFix | VelocityFix]
) -> None:
    """Raise InputError where velocities contradict the positions."""
    check = VelocityCheck()
    for one in aid:
        check.observe(one)
    if check.contradiction is not None:
        raise InputError(
            f"{path}: {topic} contradicts the positions: "
            f"{describe_contradiction(check.contradiction)}, or leave the velocities out: "
            '--velocity-topic ""'
        )


def _wheels(bag: BagReader, values: Mapping[str, Any]) -> list[BodyVelocity]:
    """Return the velocities of wheels by stamp, in b relative to the IMU."""
    arm_b = FLIP @ np.array(values["imu.position"])
    convert = AidingMessages.from_parameters(values, arm_b)
    found = []
    for topic, kind in WHEELS.items():
        if not has_optional(bag, topic, kind):
            continue
        for _, log_ns, message in bag.messages(topic):
            read = convert.twist if kind == type_names.TWIST else convert.odometry
            reading = read(message, received(values, log_ns))
            if not isinstance(reading, Refused):
                found.append(reading)
    return sorted(found, key=lambda one: one.t_ns)


def _truth(bag: BagReader) -> tuple[_Found, tuple[NDArray[np.int64], Array] | None]:
    """Return the positions of the truth as fixes, and its attitude: stamps [ns], C_nb (K, 4)."""
    topic = bag.require("/truth/odometry", type_names.ODOMETRY, "a bag with truth")
    datum = next(bag.messages("/truth/datum"), None)
    if datum is None:
        raise InputError(f"{bag.path}: no /truth/datum: the origin of the truth's map is unknown")
    origin = datum[2]
    frame = LocalFrame(
        np.array([math.radians(origin.latitude), math.radians(origin.longitude), origin.altitude])
    )
    stamps, positions, quats = [], [], []
    for _, _, message in bag.messages(topic):
        pose = message.pose.pose
        stamps.append(conversions.stamp_ns(message.header.stamp))
        positions.append((pose.position.x, pose.position.y, pose.position.z))
        q = pose.orientation
        quats.append((q.x, q.y, q.z, q.w))
    lla = frame.lla(np.array(positions) @ SWAP)
    R = np.eye(3) * TRUTH_STD**2
    found = _Found(
        [PositionFix(t, row, R, np.zeros(3)) for t, row in zip(stamps, lla, strict=True)]
    )
    norm = np.linalg.norm(quats, axis=1)
    known = np.abs(norm - 1.0) < 0.1
    if not np.any(known):
        return found, None
    attitudes = np.array([conversions.quat_nb_from_enu(q) for q in np.array(quats)[known]])
    return found, (np.array(stamps, np.int64)[known], attitudes)


def _longest_part(imu: ImuTable, values: Mapping[str, Any], place: str) -> NDArray[np.int64]:
    """Return the rows of the longest part without a gap of the samples that the node would use."""
    t_ns = imu.times_ns(values)
    check_stamps(t_ns, place)
    admitted = admitted_readings(
        values, t_ns, imu.specific_force, imu.angular_rate, imu.has_reading
    )
    for count, refused in admitted.refused:
        _log.warning("%s: %d of %d samples are left out: %s", place, count, len(t_ns), refused.text)
    rows = admitted.rows
    if len(rows) < FEWEST_SAMPLES:
        raise InputError(
            f"{place} has {len(rows)} usable samples: calibration needs {FEWEST_SAMPLES}"
        )
    steps = np.diff(t_ns[rows])
    edges = np.flatnonzero((steps <= 0) | (steps > LONG_GAP * 1e9)) + 1
    starts, stops = np.concatenate(([0], edges)), np.concatenate((edges, [len(rows)]))
    best = int(np.argmax(stops - starts))
    return rows[starts[best] : stops[best]]
