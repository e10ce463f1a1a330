"""
What an IMU's readings themselves show to be wrong with it: units, gravity, a stuck sensor.

Looked for now and then in the last second of samples. Each fault has a name, and words for the
user with the value seen and what to do.

"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.compilation import kernel
from hybrid_ins.core.rotations import matrix_from_quat, quat_from_rotvec
from hybrid_ins.core.samples import readings_of

Array = NDArray[np.float64]
Fault = tuple[str, str]  # name and words

GRAVITY = 9.80665  # m/s²
FORCE, RATE = slice(0, 3), slice(3, 6)
LEAST_FORCE, MOST_FORCE = 0.4 * GRAVITY, 4.0 * GRAVITY  # of a vehicle's mean over a second
FROZEN = 0.5  # share of the window in which nothing changes
AT_LIMIT, AT_LIMIT_SHARE = 8, 0.05  # samples at the very largest reading
LIMIT_FORCE, LIMIT_RATE = 15.0, 2.0  # m/s², rad/s: smaller largest readings are no limit
NO_GRAVITY = "imu: no gravity"  # or a free fall
UNUSABLE = (NO_GRAVITY, "imu: too much gravity", "imu: frozen", "imu: degrees")
SPIKE = 12.0  # times the median of how far a sample lies off its neighbours
SPIKE_FORCE, SPIKE_RATE = 50.0, 2.0  # m/s², rad/s: propellers make smaller ones
WINDMILL = 3.0  # rad turned in the window: more is a spin, or degrees


def find_fault(samples: NDArray[np.void]) -> Fault | None:
    """Return the gravest fault that about a second of samples (``SAMPLE_DTYPE``) shows."""
    if len(samples) < 10:
        return None
    readings = readings_of(samples)
    means, size, top, at_limit, off, frozen, turned = _survey(samples["t_ns"], readings)
    mean = float(np.linalg.norm(means[:3]))
    if mean < LEAST_FORCE and float(size[:3].mean()) < LEAST_FORCE:
        remedy = (
            "the unit seems to be g: multiply by 9.80665"
            if 0.7 < mean < 1.3
            else "gravity seems to be removed: let the driver publish specific force"
        )
        return NO_GRAVITY, f"mean acceleration is {mean:.2f} m/s², not 9.8: {remedy}"
    if mean > MOST_FORCE:
        return "imu: too much gravity", (
            f"mean acceleration is {mean:.1f} m/s², not 9.8: check the unit (m/s² is meant)"
        )
    steps = len(readings) - 1
    if frozen >= int(FROZEN * steps) and np.abs(readings[-1, 3:]).max() > 0.05:
        return "imu: frozen", (
            "the same reading again and again while it shows a turn: restart "
            "the driver, check the cable"
        )
    for sensor, least, name, unit in (
        (FORCE, LIMIT_FORCE, "acceleration", "m/s²"),
        (RATE, LIMIT_RATE, "rate", "rad/s"),
    ):
        for axis in np.flatnonzero(top[sensor] >= least):
            most = max(AT_LIMIT, AT_LIMIT_SHARE * len(readings))
            if frozen < steps and at_limit[sensor][axis] >= most:
                return f"imu: saturated {name}", (
                    f"{name} on axis {'xyz'[axis]} stays at {top[sensor][axis]:.2f} {unit}: "
                    "choose a larger range, or dampen the mount"
                )
    for sensor, least, name, unit in (
        (FORCE, SPIKE_FORCE, "acceleration", "m/s²"),
        (RATE, SPIKE_RATE, "rate", "rad/s"),
    ):
        if off[sensor].max() <= least:
            continue
        spike = _largest_spike(readings[:, sensor], least)
        if spike:
            return f"imu: spikes in {name}", (
                f"single readings of {name} jump away by {spike:.1f} {unit} and back: check "
                "plugs, cables, shielding"
            )
    if turned >= WINDMILL and _in_degrees(samples):
        return "imu: degrees", (
            f"rates of {top[RATE].max():.0f} do not fit the acceleration: they seem to be in "
            "degrees per second; radians per second are meant"
        )
    return None


@kernel()
def _survey(t_ns, readings):  # type: ignore[no-untyped-def]
    """
    Look once at stamps (N,) [ns] and readings (N, 6).

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


def _largest_spike(readings: Array, least: float) -> float:
    """Return how far the worst single reading lies off its neighbours; 0 where none is odd."""
    off = np.abs(readings[1:-1] - 0.5 * (readings[2:] + readings[:-2]))
    alone = np.abs(readings[2:] - readings[:-2]) < 0.5 * off
    usual = np.median(off, axis=0)
    return float(off[alone & (off > np.maximum(SPIKE * usual, least))].max(initial=0.0))


def _in_degrees(samples: NDArray[np.void]) -> bool:
    """Tell whether gravity turns as it would if the rates were in degrees, not radians."""
    force, rate = samples["f"], samples["w"]
    dt = np.diff(samples["t_ns"])[:, None] * 1e-9
    turn = 0.5 * (rate[1:] + rate[:-1]) * dt
    part = max(len(force) // 5, 2)
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
