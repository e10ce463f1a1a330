"""
Kinds of motion, and what gravity and the course over ground show of the mount of an IMU.

A force that lasts in the vehicle's axes, as in a long turn, adds to gravity in the mean specific
force. So a mount is wrong where the attitudes by the fit show the same as that mean.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.imu_axes.faults import AxesFault, mount_as_shown, mount_upright
from hybrid_ins.core.imu_axes.fit import STEP, Fit, Motion, attitudes

Array = NDArray[np.float64]

TURN = 0.35  # rad, about an axis or of the course, that is a kind of motion
LEAST_SPEED = 1.5  # m/s, of a course
NOSE_SPREAD, NOSE_ANGLE = 0.95, 0.7  # mean resultant length; rad, from the course
NEAR = 0.2  # rad, from a quarter of a circle: IMUs are mounted square more often than not


def courses(motion: Motion) -> tuple[Array, Array]:
    """Return the courses [rad from north] where there is speed, and their times [s]."""
    first, _, last = motion.triples.T
    t = motion.fix_t
    velocity = (motion.position_n[last] - motion.position_n[first])[:, :2]
    velocity /= (t[last] - t[first])[:, None]
    fast = np.hypot(*velocity.T) > LEAST_SPEED
    course = np.arctan2(velocity[fast, 1], velocity[fast, 0])
    return course, 0.5 * (t[first] + t[last])[fast]


def is_winding(course: Array) -> bool:
    """Return whether courses [rad] are no straight run: the wind, or a drone flying sideways."""
    return len(course) >= 10 and abs(np.mean(np.exp(1j * course))) < 0.9


def kinds_of(motion: Motion) -> list[str]:
    """Return what kinds of motion there are: turns about the IMU's axes, and of the course."""
    turned = np.ptp(np.cumsum(motion.turn, axis=0), axis=0) > TURN
    course = np.unwrap(courses(motion)[0])
    is_curved = len(course) > 0 and float(np.ptp(course)) > TURN
    turns = [f"turn about {axis}" for axis, is_seen in zip("xyz", turned, strict=True) if is_seen]
    return ["speed", *turns, *(["course"] if is_curved else [])]


def mount_fault(
    given: Array, motion: Motion, accelerometer: Array, gyroscope: Array, fitted: Fit
) -> AxesFault | None:
    """Return the fault if the mount given, (3, 3), does not fit gravity or course."""
    upright = _mount_upright(
        given, accelerometer @ motion.impulse.sum(axis=0), _mean_up(motion, accelerometer, fitted)
    )
    mount = given if upright is None else upright
    along = _mount_along_course(motion, mount, accelerometer, fitted)
    if upright is None and along is None:
        return None
    chosen = mount if along is None else along
    by_course = along is not None
    explanation = ((accelerometer, gyroscope),)
    return AxesFault(explanation, chosen, turned=True, by_course=by_course)


def _mount_upright(given: Array, mean_force: Array, mean_up: Array) -> Array | None:
    """
    Return the mount with which mean specific force and attitudes point up; None: the one given.

    A bank that lasts moves one of both: the mount is skew where neither fits right angles.
    """
    upright = mount_upright(given, mean_force)
    nearest = mount_upright(given, mean_up, least=1.0)
    if upright is None or nearest is None or not np.allclose(nearest, upright):
        return None
    if any(np.allclose(mount_as_shown(given, one), upright) for one in (mean_force, mean_up)):
        return upright
    both = mean_force / np.linalg.norm(mean_force) + mean_up / np.linalg.norm(mean_up)
    return mount_as_shown(given, both)


def _attitudes_n(motion: Motion, accelerometer: Array, fitted: Fit) -> Array:
    """Return the rotations (N, 3, 3) from the IMU's axes, corrected, to n by a fit."""
    rotation = fitted.sign * accelerometer  # from the fit's axes to the IMU's corrected ones
    C = attitudes(motion.turn @ fitted.gyroscope.T - STEP * fitted.bias)
    return np.asarray(fitted.C_ni @ C @ rotation.T)


def _mean_up(motion: Motion, accelerometer: Array, fitted: Fit) -> Array:
    """Return where up is in the IMU's axes, corrected, on average (3,), by a fit."""
    return np.asarray(-_attitudes_n(motion, accelerometer, fitted)[:, 2].mean(axis=0))


def _mount_along_course(
    motion: Motion, mount: Array, accelerometer: Array, fitted: Fit
) -> Array | None:
    """Return the mount turned about up so that the vehicle moves along its nose, if it does so."""
    turned = _nose_from_course(motion, mount, accelerometer, fitted)
    if turned is None or abs(turned) < NOSE_ANGLE:
        return None
    quarter = round(turned / (0.5 * np.pi)) * 0.5 * np.pi
    turned = quarter if abs(turned - quarter) < NEAR else round(turned, 2)
    c, s = np.cos(turned), np.sin(turned)
    return np.asarray(np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]) @ mount)


def moves_along_nose(given: Array, motion: Motion, accelerometer: Array, fitted: Fit) -> bool:
    """Return whether a vehicle with the mount given, (3, 3), moves where it points."""
    turned = _nose_from_course(motion, given, accelerometer, fitted)
    return turned is not None and abs(turned) < NOSE_ANGLE


def _nose_from_course(
    motion: Motion, mount: Array, accelerometer: Array, fitted: Fit
) -> float | None:
    """Return the mean angle [rad] from the nose to the course; None: the course shows no nose."""
    course, t = courses(motion)
    if not is_winding(course):
        return None
    k = np.clip(((t - motion.t[0]) / STEP).astype(np.intp), 0, len(motion.turn) - 1)
    nose_n = _attitudes_n(motion, accelerometer, fitted)[k] @ mount.T[:, 0]
    angle = course - np.arctan2(nose_n[:, 1], nose_n[:, 0])
    mean = np.mean(np.exp(1j * angle))
    return None if abs(mean) < NOSE_SPREAD else float(np.angle(mean))
