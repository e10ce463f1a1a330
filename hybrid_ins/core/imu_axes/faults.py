"""What may be wrong with the axes, units and mount of an IMU."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

DEGREES = np.pi / 180.0


@dataclass(frozen=True, slots=True)
class AxesFault:
    """
    What is wrong with an IMU's axes or units, in the IMU's own axes.

    Attributes
    ----------
    explanations : tuple of (ndarray, ndarray)
        What the readings of accelerometer and gyroscope are to be multiplied by, (3, 3) each; the
        most ordinary explanation of what was found comes first.
    mount : ndarray, shape (3, 3)
        Rotation from the IMU's axes to b, after that.
    turned : bool
        The mount is not the one given.
    by_course : bool
        The mount was found from the course: it holds for a vehicle that moves along its nose.
    no_turns : bool
        The gyroscope shows no turns; nothing else is found.
    at_rest : bool
        Found from gravity alone: the accelerations may be reversed instead.
    shown_by : tuple of float, optional
        Beginning and end [s] of the motion that shows it, where that may be chance.
    """

    explanations: tuple[tuple[Array, Array], ...]
    mount: Array
    turned: bool = False
    by_course: bool = False
    no_turns: bool = False
    at_rest: bool = False
    shown_by: tuple[float, float] | None = None

    def is_confirmed_by(self, other: AxesFault) -> bool:
        """Return whether another check that found the same is evidence of its own."""
        if self.shown_by is None or other.shown_by is None:
            return True
        begin, end = other.shown_by
        return end - self.shown_by[1] >= NEW_MOTION * (end - begin)

    def in_common(self, other: AxesFault) -> AxesFault | None:
        """Return the fault with the explanations that another check found, too; None without."""
        both = tuple(
            one
            for one in self.explanations
            if any(np.allclose(one, another) for another in other.explanations)
        )
        alike = (self.turned, self.by_course, self.no_turns, self.at_rest) == (
            other.turned,
            other.by_course,
            other.no_turns,
            other.at_rest,
        ) and _are_alike(self.mount, other.mount)
        return replace(self, explanations=both) if both and alike else None

    def same(self, other: AxesFault) -> bool:
        """Return whether another check found the same."""
        both = self.in_common(other)
        return both is not None and (
            len(self.explanations) == len(other.explanations) == len(both.explanations)
        )


def _signed_permutations() -> Array:
    """Return all (48, 3, 3), those with the fewest changes of axes and signs first."""
    found = []
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            matrix = np.zeros((3, 3))
            matrix[range(3), order] = signs
            found.append(matrix)
    moved = [3 * sum(m.diagonal() == 0) + sum(m.sum(axis=1) < 0) for m in found]
    return np.array(found)[np.argsort(moved, kind="stable")]


PERMUTATIONS = _signed_permutations()
ROTATIONS = PERMUTATIONS[np.linalg.det(PERMUTATIONS) > 0.0]
NEW_MOTION = 0.5  # share of the motion that shows a fault again, where that may be chance
UP = 0.5  # cosine of the angle between mean specific force and up that a vehicle may have
SQUARE, ALIKE = np.radians(12.0), 0.25  # rad: from a right angle; between a mount measured twice
SCALES = (DEGREES, 1.0 / DEGREES)


def _explanations() -> list[tuple[Array, Array]]:
    """Return what may be wrong with accelerometer and gyroscope, the most ordinary first."""
    one = np.eye(3)
    reversals = [np.diag(d) for d in ((1.0, 1.0, -1.0), (1.0, -1.0, 1.0), (-1.0, 1.0, 1.0))]
    exchanges = [one[list(order)] for order in ((1, 0, 2), (2, 1, 0), (0, 2, 1))]
    half_turns = [-m for m in reversals]
    return [
        *((one, scale * one) for scale in SCALES),
        (-one, one),
        *((one, m) for m in (*reversals, -one)),
        *((m, m) for m in (*exchanges, *reversals, -one)),
        *((one, m) for m in (*exchanges, *half_turns)),
        *((m, one) for m in (*reversals, *exchanges, *half_turns)),
    ]


EXPLANATIONS = _explanations()


def to_hypothesis(accelerometer: Array, gyroscope: Array) -> tuple[float, Array]:
    """Return the sign and the gyroscope's factor that fit the motion like an explanation."""
    sign = float(np.linalg.det(accelerometer))
    return sign, (sign * accelerometer).T @ gyroscope


def mount_upright(mount: Array, mean_up: Array, least: float = UP) -> Array | None:
    """
    Return the mount with which a mean, such as that of the specific force, points up.

    None: the given one, with which the cosine of its angle to up is above ``least``.
    """
    up = mean_up / max(float(np.linalg.norm(mean_up)), 1e-9)
    if -(mount @ up)[2] > least:
        return None
    heights = [-(mount @ rotation @ up)[2] for rotation in ROTATIONS]
    for rotation, height in zip(ROTATIONS, heights, strict=True):  # the least turned first
        if height > max(heights) - 1e-3:
            return np.asarray(mount @ rotation)
    return None


def mount_as_shown(mount: Array, mean_up: Array) -> Array:
    """
    Return the mount, turned by right angles, with which a mean points up; a skew one if it has to.

    Parameters
    ----------
    mount : ndarray, shape (3, 3)
        From the IMU's axes to b, as given.
    mean_up : ndarray, shape (3,)
        What points up, in the IMU's axes, such as the mean specific force.

    Returns
    -------
    ndarray, shape (3, 3)
        Where no such mount leaves less than ``SQUARE``: by the mean alone. It shows no yaw, so the
        IMU's x axis keeps the horizontal direction it has as given.
    """
    square = mount_upright(mount, mean_up, least=1.0)
    up = mean_up / max(float(np.linalg.norm(mean_up)), 1e-9)
    if square is not None and -(square @ up)[2] > np.cos(SQUARE):
        return square
    x_axis = np.array([1.0, 0.0, 0.0])
    along = x_axis - (x_axis @ up) * up
    along /= max(float(np.linalg.norm(along)), 1e-9)
    along_b, up_b = np.array([mount[0, 0], mount[1, 0], 0.0]), np.array([0.0, 0.0, -1.0])
    length = float(np.linalg.norm(along_b))
    along_b = x_axis if length < 1e-6 else along_b / length
    axes_b = np.column_stack((along_b, up_b, np.cross(along_b, up_b)))
    return np.asarray(axes_b @ np.vstack((along, up, np.cross(along, up))))


def _are_alike(mount: Array, other: Array) -> bool:
    """Return whether two checks found one mount, (3, 3); one that is measured varies."""
    if np.allclose(mount[2], other[2]):  # as given or by right angles
        return bool(np.allclose(mount, other))
    return float(np.trace(mount.T @ other)) > 1.0 + 2.0 * np.cos(ALIKE)
