"""
Whether base_frame's z axis is up in ordinary motion, by the mean specific force of ten seconds.

Over minutes the specific force of nearly all vehicles points along their z axis within 10°, be they
cars, boats, aircraft that bank in turns or multirotors. So a mount is wrong where it is far from
there again and again, in one direction, and never along z. A tailsitter that hovers is not named
once it has cruised, a long climb is not after a level start, and a car that circles has more than
gravity.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.imu.health import LEAST_FORCE
from hybrid_ins.core.imu_axes.faults import mount_as_shown
from hybrid_ins.core.inertial.earth import STANDARD_GRAVITY, displacement

Array = NDArray[np.float64]

SECONDS_NS = 10_000_000_000  # over which the specific force is averaged
MOVED = 3.0  # m over ground in that time: more than fixes of a vehicle at rest wander
GRAVITY_ALONE = 0.04  # of gravity: the mean may differ from it where nothing else acts
EXPLAINED, LEAST_COSINE = 0.6, 0.8  # share of what an acceleration would add to the force
LEVEL, TILTED = np.radians(10.0), np.radians(18.0)  # from z: of a right mount, of a wrong one
FEWEST, ALONG_ONE = 6, 0.96  # means that show a tilt; their mean resultant length
WORTH, MOST_LEVEL = 20, 6  # tilted means that one level mean outweighs; level means that count
IN_A_ROW = 3  # level means that withdraw a tilt


def is_gravity_alone(force: float) -> bool:
    """Return whether a mean specific force is as large [m/s²] as that of gravity."""
    return abs(force / STANDARD_GRAVITY - 1.0) < GRAVITY_ALONE


def _is_tilt(force: float, cosine: float) -> bool:
    """
    Return whether a mean force [m/s²] at an angle to z, by its cosine, is not by an acceleration.

    One that turns gravity by that angle would make the force larger.
    """
    most = 1.0 + EXPLAINED * (1.0 / max(cosine, LEAST_COSINE) - 1.0)
    return is_gravity_alone(force) or 1.0 < force / STANDARD_GRAVITY < most


@dataclass(frozen=True, slots=True, eq=False)
class Tilt:
    """
    A mount with which the mean specific force is not along base_frame's z axis.

    Attributes
    ----------
    angle : float
        Between both [rad].
    seconds : float
        Time of the motion that shows it [s].
    mount : ndarray, shape (3, 3)
        Rotation from the IMU's axes to b with which they are parallel.
    """

    angle: float
    seconds: float
    mount: Array


class LevelCheck:
    """
    Compares the mean specific force of ten seconds, again and again, with base_frame's z axis.

    Parameters
    ----------
    mount : ndarray, shape (3, 3)
        From the IMU's own axes to b, as given.

    Attributes
    ----------
    tilt : Tilt or None
        How the mount is tilted, if it is.
    has_moved_level : bool
        Motion has shown that z is up with the mount as given.
    """

    def __init__(self, mount: Array) -> None:
        self._mount = mount
        self.tilt: Tilt | None = None
        self.has_moved_level = False
        self._forget_tilted()
        self._level = self._in_a_row = 0
        self.reset()

    def reset(self) -> None:
        """Begin to average anew, as after a gap; what was shown remains."""
        self._begin_ns = 0
        self._sum_b, self._count = np.zeros(3), 0
        self._first_lla: Array | None = None
        self._last_lla = np.zeros(3)

    def add_fix(self, lla: Array) -> None:
        """Add a position fix: latitude, longitude [rad] and height [m], (3,)."""
        if self._first_lla is None:
            self._first_lla = lla
        self._last_lla = lla

    def add_samples(self, samples: NDArray[np.void]) -> None:
        """Add samples (``SAMPLE_DTYPE``, in b) that follow the last ones."""
        if not len(samples):
            return
        if not self._count:
            self._begin_ns = int(samples["t_ns"][0])
        self._sum_b += samples["f"].sum(axis=0)
        self._count += len(samples)
        if samples["t_ns"][-1] - self._begin_ns >= SECONDS_NS:
            self._use(self._sum_b / self._count, self._moved() > MOVED)
            self.reset()

    def _moved(self) -> float:
        """Return how far the fixes have moved over ground [m]."""
        if self._first_lla is None:
            return 0.0
        return float(np.hypot(*displacement(self._first_lla, self._last_lla)[:2]))

    def _use(self, force_b: Array, moves: bool) -> None:
        """Use a mean specific force (3,) [m/s²], of a vehicle that moves or stands."""
        size = float(np.linalg.norm(force_b))
        if size < LEAST_FORCE:
            return
        up_b = force_b / size
        if -up_b[2] > np.cos(LEVEL):
            self.has_moved_level |= moves
            self._level = min(self._level + 1, MOST_LEVEL)
            self._in_a_row += 1
            if self._in_a_row >= IN_A_ROW:
                self._forget_tilted()
        else:
            self._in_a_row = 0
            if moves and _is_tilt(size, -up_b[2]):
                self._tilted += 1
                self._tilted_sum_b += up_b
        self.tilt = self._judge()

    def _forget_tilted(self) -> None:
        self._tilted, self._tilted_sum_b = 0, np.zeros(3)

    def _judge(self) -> Tilt | None:
        """Return how the mount is tilted by the means so far, if it is."""
        if self._tilted < max(FEWEST, WORTH * self._level):
            return None
        length = float(np.linalg.norm(self._tilted_sum_b))
        up_b = self._tilted_sum_b / length
        angle = float(np.arccos(np.clip(-up_b[2], -1.0, 1.0)))
        if length < ALONG_ONE * self._tilted or angle < TILTED:
            return None
        mount = mount_as_shown(self._mount, self._mount.T @ up_b)
        return Tilt(angle, 1e-9 * SECONDS_NS * self._tilted, mount)
