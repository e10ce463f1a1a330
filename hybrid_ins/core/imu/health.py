"""
Faults that an IMU's readings show by themselves: wrong unit, missing gravity, a stuck sensor.

Searched for in about a second of samples. A fault is a kind and the value that shows it; the words
for the user are in `hybrid_ins.ros.reporting.wording`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.compilation import kernel
from hybrid_ins.core.imu.samples import readings_of
from hybrid_ins.core.inertial.earth import STANDARD_GRAVITY
from hybrid_ins.core.inertial.rotations import matrix_from_quat, quat_from_rotvec

Array = NDArray[np.float64]

FORCE, RATE = slice(0, 3), slice(3, 6)
LEAST_FORCE = 0.4 * STANDARD_GRAVITY  # of a vehicle's mean over a second
MOST_FORCE = 4.0 * STANDARD_GRAVITY
FROZEN = 0.5  # share of the window in which nothing changes
AT_LIMIT, AT_LIMIT_SHARE = 8, 0.05  # samples at the very largest reading
DROP, STEADY = 4.5, 0.5  # resolutions, and share of repeats: coarse readings do no more
LIMIT_FORCE, LIMIT_RATE = 15.0, 2.0  # m/s², rad/s: smaller largest readings are no limit
SPIKE = 12.0  # times the median distance of a sample from its neighbours
SPIKE_FORCE, SPIKE_RATE = 50.0, 2.0  # m/s², rad/s: propellers make smaller ones
MOST_ACCELERATION = 0.15 * STANDARD_GRAVITY  # of a vehicle whose specific force is gravity
LARGEST_TURN = 3.0  # rad turned in the window: more is a spin, or degrees
OWN_AXES = np.eye(3)  # of an IMU that lies along b
DECIMALS = 9  # of readings turned back into the IMU's axes: a limit is one number again


class FaultKind(Enum):
    """What is wrong with the IMU; the value is the name under which it is counted."""

    NO_GRAVITY = "no gravity"  # or a free fall
    TOO_MUCH_GRAVITY = "too much gravity"
    FROZEN = "frozen"
    DEGREES = "degrees"
    SATURATED_FORCE = "saturated acceleration"
    SATURATED_RATE = "saturated rate"
    SPIKES_FORCE = "spikes in acceleration"
    SPIKES_RATE = "spikes in rate"


UNUSABLE = (
    FaultKind.NO_GRAVITY,
    FaultKind.TOO_MUCH_GRAVITY,
    FaultKind.FROZEN,
    FaultKind.DEGREES,
)
"""Faults with which no filter can run; the others mislead it for a while."""


@dataclass(frozen=True, slots=True)
class ImuFault:
    """
    A fault of the IMU.

    Attributes
    ----------
    kind : FaultKind
    value : float
        The value that shows it, rounded for the user: the mean specific force [m/s²] for faults
        of gravity, the reading [m/s² or rad/s] for the others; 0 for a frozen sensor.
    axis : int
        Of a saturated sensor: 0 to 2 for the IMU's own x, y, z.
    lost_turn : float
        Of a saturated gyroscope: by how much more than it says the IMU may have turned [rad].
    lost_speed : tuple of float
        Of a saturated accelerometer: what its axes may lack of a second's velocity [m/s], b.
    """

    kind: FaultKind
    value: float = 0.0
    axis: int = 0
    lost_turn: float = field(default=0.0, compare=False)
    lost_speed: tuple[float, float, float] = field(default=(0.0, 0.0, 0.0), compare=False)

    @property
    def unusable(self) -> bool:
        """No filter can run on such samples."""
        return self.kind in UNUSABLE


def find_fault(samples: NDArray[np.void], mount: Array = OWN_AXES) -> ImuFault | None:
    """
    Return the gravest fault that about a second of samples (``SAMPLE_DTYPE``, in b) shows.

    ``mount``, shape (3, 3), leads from the IMU's own axes to b: one of those has a limit, and none
    of b does.
    """
    if len(samples) < 10:
        return None
    samples = _in_own_axes(samples, mount)
    readings = readings_of(samples)
    means, size, top, at_limit, off, frozen, turned = _survey(samples["t_ns"], readings)
    mean = float(np.linalg.norm(means[:3]))
    if mean < LEAST_FORCE and float(size[:3].mean()) < LEAST_FORCE:
        return ImuFault(FaultKind.NO_GRAVITY, round(mean, 2))
    if mean > MOST_FORCE:
        return ImuFault(FaultKind.TOO_MUCH_GRAVITY, round(mean, 1))
    steps = len(readings) - 1
    if frozen >= int(FROZEN * steps) and np.abs(readings[-1, 3:]).max() > 0.05:
        return ImuFault(FaultKind.FROZEN)
    for kind, sensor, least in (
        (FaultKind.SATURATED_RATE, RATE, LIMIT_RATE),
        (FaultKind.SATURATED_FORCE, FORCE, LIMIT_FORCE),
    ):
        for axis in np.flatnonzero(top[sensor] >= least).tolist():
            most = max(AT_LIMIT, AT_LIMIT_SHARE * len(readings))
            stays = frozen < steps and at_limit[sensor][axis] >= most
            if stays and _is_cut_off(readings[:, sensor], axis):
                limit = float(top[sensor][axis])
                if sensor is RATE:
                    return ImuFault(kind, round(limit, 2), axis, _lost_turn(samples, limit))
                x, y, z = np.sqrt(mount**2 @ _lost_speed(samples, limit) ** 2).tolist()
                return ImuFault(kind, round(limit, 2), axis, lost_speed=(x, y, z))
    for kind, sensor, least in (
        (FaultKind.SPIKES_FORCE, FORCE, SPIKE_FORCE),
        (FaultKind.SPIKES_RATE, RATE, SPIKE_RATE),
    ):
        if off[sensor].max() <= least:
            continue
        spike = _largest_spike(readings[:, sensor], least)
        if spike:
            return ImuFault(kind, round(spike, 1))
    if turned >= LARGEST_TURN and _in_degrees(samples):
        return ImuFault(FaultKind.DEGREES, round(float(top[RATE].max())))
    return None


def _in_own_axes(samples: NDArray[np.void], mount: Array) -> NDArray[np.void]:
    """Return samples as the IMU gave them; see `find_fault`."""
    own = samples.copy()
    for name in ("f", "w"):
        own[name] = np.round(samples[name] @ mount, DECIMALS)
    return own


@kernel()
def _survey(t_ns, readings):  # type: ignore[no-untyped-def]
    """
    Gather the statistics of stamps (N,) [ns] and readings (N, 6) in one pass.

    Returns
    -------
    means, size : ndarray, shape (6,)
        Of the readings, and of their absolute values.
    top, at_limit, off : ndarray, shape (6,)
        Largest absolute value, how often it occurs, and the farthest that a reading lies off the
        mean of its neighbours.
    frozen : int
        Steps without any change at the end.
    turned : float
        Sum of the turns about all axes [rad].
    """
    count = readings.shape[0]
    means, size, top = np.zeros(6), np.zeros(6), np.zeros(6)
    at_limit, off = np.zeros(6, np.int64), np.zeros(6)
    frozen, turned = 0, 0.0
    for k in range(count):
        same = k > 0
        for c in range(6):
            value = readings[k, c]
            means[c] += value / count
            size[c] += abs(value) / count
            if abs(value) > top[c]:
                top[c], at_limit[c] = abs(value), 0
            at_limit[c] += abs(value) == top[c]
            if k == 0:
                continue
            same &= value == readings[k - 1, c]
            if c >= 3:
                turned += abs(0.5 * (value + readings[k - 1, c]) * (t_ns[k] - t_ns[k - 1]) * 1e-9)
            if k > 1:
                middle = readings[k - 1, c]
                off[c] = max(off[c], abs(middle - 0.5 * (value + readings[k - 2, c])))
        frozen = frozen + 1 if same else 0
    return means, size, top, at_limit, off, frozen, turned


def _is_cut_off(readings: Array, axis: int) -> bool:
    """
    Return whether an axis of a sensor's readings (N, 3) stays at its largest because of a limit.

    A coarse sensor does in each steady turn, too. The peak of a parabola that is rounded falls by
    three resolutions within half the time that it stays; a steady turn does by fewer, one that is
    cut off by more. Where it stays all the time, the other axes show whether readings do.
    """
    size = np.abs(readings[:, axis])
    below, last = size.max() - size, len(size) - 1
    edges = np.flatnonzero(np.diff(np.concatenate(([0], below == 0.0, [0]))))
    begin, end = edges.reshape(-1, 2).T
    half = np.maximum((end - begin) // 2, 1)
    before = below[np.maximum(begin - half, 0)][begin > 0]
    after = below[np.minimum(end - 1 + half, last)][end <= last]
    drops = np.sort(np.concatenate((before, after)))
    if not len(drops):
        others = np.delete(readings, axis, axis=1)
        return bool(np.mean(np.diff(others, axis=0) == 0.0) < STEADY)
    gaps = np.diff(np.sort(readings, axis=0), axis=0)
    resolution = np.min(gaps, where=gaps > 10.0**-DECIMALS, initial=np.inf)
    return bool(drops[(len(drops) - 1) // 2] > DROP * resolution)


def _lost_turn(samples: NDArray[np.void], limit: float) -> float:
    """
    Return by how much more the IMU may have turned than a gyroscope says that stays at ``limit``.

    A rate that passes the limit with the slope s, and falls below it a time d later, exceeds it
    like a parabola: by s d²/6. Of a longer turn it is taken to be twice the limit. What vibration
    loses to and fro is no turn.
    """
    t, lost = samples["t_ns"] * 1e-9, np.zeros(3)
    for axis, rate in enumerate(samples["w"].T):
        edges = np.flatnonzero(np.diff(np.concatenate(([0], abs(rate) >= limit, [0]))))
        for begin, end in edges.reshape(-1, 2):  # of the samples at the limit
            lasted = t[end - 1] - t[begin]
            steps = [k for k in (begin - 2, begin - 1, end - 1, end) if 0 <= k < len(t) - 1]
            slopes = [abs(rate[k + 1] - rate[k]) / (t[k + 1] - t[k]) for k in steps]
            slope = max(slopes, default=math.inf)
            lost[axis] += math.copysign(min(slope * lasted / 6.0, limit) * lasted, rate[begin])
    return float(np.abs(lost).sum())


def _lost_speed(samples: NDArray[np.void], limit: float) -> Array:
    """
    Return what the axes of an accelerometer that stays at ``limit`` may lack of the velocity.

    A force is beyond the limit for no longer than from the sample before those at the limit to the
    one after them, d, and exceeds it like a parabola, as a rate of `_lost_turn`, by s d²/6.
    Vibration loses as much to as fro, but not each time the same: squares add up beside the sum.

    Returns
    -------
    ndarray, shape (3,)
        Along the IMU's own axes [m/s].
    """
    t, lost = samples["t_ns"] * 1e-9, np.zeros(3)
    for axis, force in enumerate(samples["f"].T):
        edges = np.flatnonzero(np.diff(np.concatenate(([0], abs(force) >= limit, [0]))))
        parts = []
        for begin, end in edges.reshape(-1, 2):  # of the samples at the limit
            before, after = max(begin - 1, 0), min(end, len(t) - 1)
            slopes = [abs(force[k + 1] - force[k]) / (t[k + 1] - t[k]) for k in {before, after - 1}]
            lasted = t[after] - t[before]
            part = min(max(slopes) * lasted / 6.0, limit) * lasted
            parts.append(math.copysign(part, force[begin]))
        lost[axis] = math.hypot(sum(parts), math.hypot(*parts))
    return lost


def _largest_spike(readings: Array, least: float) -> float:
    """Return the largest distance of a single reading from its neighbours; 0 where none jumps."""
    off = np.abs(readings[1:-1] - 0.5 * (readings[2:] + readings[:-2]))
    alone = np.abs(readings[2:] - readings[:-2]) < 0.5 * off
    usual = np.median(off, axis=0)
    return float(off[alone & (off > np.maximum(SPIKE * usual, least))].max(initial=0.0))


def _in_degrees(samples: NDArray[np.void]) -> bool:
    """
    Return whether gravity turns as it would if the rates were in degrees, not radians.

    Thrust and lift stay along an axis of the body, too, but rarely equal gravity for long.
    """
    force, rate = samples["f"], samples["w"]
    dt = np.diff(samples["t_ns"])[:, None] * 1e-9
    turn = 0.5 * (rate[1:] + rate[:-1]) * dt
    part = max(len(force) // 5, 2)
    weight = np.linalg.norm([f.mean(axis=0) for f in np.array_split(force, 5)], axis=1)
    if np.abs(weight - STANDARD_GRAVITY).max() > MOST_ACCELERATION:
        return False
    first, last = force[:part].mean(axis=0), force[-part:].mean(axis=0)
    middle = slice(part // 2, len(turn) - part // 2)
    angles = []
    for scale in (1.0, np.pi / 180.0):
        C = np.eye(3)
        for step in matrix_from_quat(quat_from_rotvec(-scale * turn[middle])):
            C = step @ C
        cosine = (C @ first) @ last / (np.linalg.norm(first) * np.linalg.norm(last) + 1e-9)
        angles.append(np.arccos(np.clip(cosine, -1.0, 1.0)))
    return bool(angles[0] > 0.6 and angles[1] < 0.3)
