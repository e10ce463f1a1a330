"""
What an IMU's readings themselves show to be wrong with it: units, gravity, a stuck sensor.

Looked for now and then in the last second of samples. Each fault has a name, and words for the
user with the value seen and what to do.

"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.attitude import matrix_from_quat, quat_from_rotvec

Array = NDArray[np.float64]
Fault = tuple[str, str]  # name and words

GRAVITY = 9.80665  # m/s²
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
    force, rate = samples["f"], samples["w"]
    mean = float(np.linalg.norm(force.mean(axis=0)))
    if mean < LEAST_FORCE and float(np.abs(force).mean()) < LEAST_FORCE:
        remedy = ("the unit seems to be g: multiply by 9.80665" if 0.7 < mean < 1.3 else
                  "gravity seems to be removed: let the driver publish specific force")
        return NO_GRAVITY, f"mean acceleration is {mean:.2f} m/s², not 9.8: {remedy}"
    if mean > MOST_FORCE:
        return "imu: too much gravity", (
            f"mean acceleration is {mean:.1f} m/s², not 9.8: check the unit (m/s² is meant)")
    same = np.all((force[1:] == force[:-1]) & (rate[1:] == rate[:-1]), axis=1)
    if same[-int(FROZEN * len(same)):].all() and np.abs(rate[-1]).max() > 0.05:
        return "imu: frozen", ("the same reading again and again while it shows a turn: restart "
                               "the driver, check the cable")
    for readings, least, name, unit in (
            (force, LIMIT_FORCE, "acceleration", "m/s²"), (rate, LIMIT_RATE, "rate", "rad/s")):
        size = np.abs(readings)
        top = size.max(axis=0)
        for axis in np.flatnonzero(top >= least):
            at_limit = np.count_nonzero(size[:, axis] == top[axis])
            if not same.all() and at_limit >= max(AT_LIMIT, AT_LIMIT_SHARE * len(size)):
                return f"imu: saturated {name}", (
                    f"{name} on axis {'xyz'[axis]} stays at {top[axis]:.2f} {unit}: choose a "
                    "larger range, or dampen the mount")
    for readings, least, name, unit in (
            (force, SPIKE_FORCE, "acceleration", "m/s²"), (rate, SPIKE_RATE, "rate", "rad/s")):
        spike = _largest_spike(readings, least)
        if spike:
            return f"imu: spikes in {name}", (
                f"single readings of {name} jump away by {spike:.1f} {unit} and back: check "
                "plugs, cables, shielding")
    if _in_degrees(samples):
        return "imu: degrees", (
            f"rates of {np.abs(rate).max():.0f} do not fit the acceleration: they seem to be in "
            "degrees per second; radians per second are meant")
    return None


def _largest_spike(readings: Array, least: float) -> float:
    """Return how far the worst single reading lies off its neighbours; 0 where none is odd."""
    off = np.abs(readings[1:-1] - 0.5 * (readings[2:] + readings[:-2]))
    if off.max() <= least:
        return 0.0
    alone = np.abs(readings[2:] - readings[:-2]) < 0.5 * off
    usual = np.median(off, axis=0)
    return float(off[alone & (off > np.maximum(SPIKE * usual, least))].max(initial=0.0))


def _in_degrees(samples: NDArray[np.void]) -> bool:
    """Tell whether gravity turns as it would if the rates were in degrees, not radians."""
    force, rate = samples["f"], samples["w"]
    dt = np.diff(samples["t_ns"])[:, None] * 1e-9
    turn = (0.5 * (rate[1:] + rate[:-1]) * dt)
    if np.abs(turn).sum() < WINDMILL:
        return False
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

