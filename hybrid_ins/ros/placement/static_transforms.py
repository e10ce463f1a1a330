"""
The tree of fixed transforms of ``/tf_static``.

Reads the messages by attribute, so that it works on live messages and on those of a bag, with tf2
installed or not.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.inertial.rotations import matrix_from_quat
from hybrid_ins.resources import shortened
from hybrid_ins.ros.messages.conversions import Refused

Array = NDArray[np.float64]
Pose = tuple[Array, Array]  # rotation (3, 3) and translation (3,) [m] of a child in its parent

MOST_FRAMES = 1000  # of a vehicle
LONGEST_NAME = 256
SMALLEST_NORM = 0.5  # of a quaternion

TOO_MANY = Refused(
    "tf_static: too many frames",
    f"more than {MOST_FRAMES} frames, or names of more than {LONGEST_NAME} characters: left out",
)
NO_NAME = Refused(
    "tf_static: no frame",
    "a transform without header.frame_id or child_frame_id is left out, as tf2 does; correct its "
    "publisher",
)

NOT_PUBLISHED = "tf2_msgs is not installed: /tf is not published"
NOT_READ = "tf2_msgs is not installed: /tf_static is not read"
NOT_PLACED = (
    "tf2_msgs is not installed: /tf_static is not read, and neither imu.position nor "
    "gnss.antenna_position is given: IMU and antenna are taken to be at the origin of base_frame; "
    "install tf2_msgs (apt: ros-$ROS_DISTRO-tf2-msgs), set these parameters, or set use_tf_static "
    "to false if that is so"
)


class StaticTransforms:
    """The fixed frames received so far: at most ``MOST_FRAMES``."""

    def __init__(self) -> None:
        self._parents: dict[str, tuple[str, Pose]] = {}

    def add(self, message: Any) -> list[Refused]:
        """Add a tf2_msgs/TFMessage; returns why transforms of it are left out, for each."""
        faults = (self._add(transform) for transform in message.transforms)
        return [fault for fault in faults if fault is not None]

    def _add(self, transform: Any) -> Refused | None:
        child, parent = transform.child_frame_id.lstrip("/"), transform.header.frame_id.lstrip("/")
        if not (child and parent):
            return NO_NAME
        if max(len(child), len(parent)) > LONGEST_NAME or (
            child not in self._parents and len(self._parents) >= MOST_FRAMES
        ):
            return TOO_MANY
        q, p = transform.transform.rotation, transform.transform.translation
        quat = np.array([q.x, q.y, q.z, q.w], float)
        place = np.array([p.x, p.y, p.z], float)
        norm = float(np.linalg.norm(quat))
        name = f"the transform from '{shortened(parent)}' to '{shortened(child)}'"
        if not (math.isfinite(norm) and norm > SMALLEST_NORM and np.all(np.isfinite(place))):
            return Refused(
                "tf_static: no transform",
                f"{name} is left out: its quaternion has norm {norm:.2g}, its translation is "
                f"{place} m; correct its publisher",
            )
        if child in self._chain(parent):
            return Refused(
                "tf_static: a loop",
                f"{name} is left out: it closes a loop; stop one of the publishers",
            )
        self._parents[child] = parent, (matrix_from_quat(quat / norm), place)
        return None

    def _chain(self, frame: str) -> list[str]:
        """Return a frame, its parent, and so on to the root."""
        chain = [frame]
        while chain[-1] in self._parents:
            chain.append(self._parents[chain[-1]][0])
        return chain

    def root_of(self, frame: str) -> str:
        """Return the root of a frame's tree: the frame itself where it has no parent."""
        return self._chain(frame.lstrip("/"))[-1]

    def find(self, base: str, frame: str) -> Pose | None:
        """Return the pose of ``frame`` in ``base``; None where no chain connects them."""
        in_root, root = self._to_root(frame.lstrip("/"))
        base_in_root, base_root = self._to_root(base.lstrip("/"))
        if root != base_root:
            return None
        C, p = in_root
        C_base, p_base = base_in_root
        return C_base.T @ C, C_base.T @ (p - p_base)

    def _to_root(self, frame: str) -> tuple[Pose, str]:
        C, p = np.eye(3), np.zeros(3)
        for link in self._chain(frame)[:-1]:
            C_parent, p_parent = self._parents[link][1]
            C, p = C_parent @ C, C_parent @ p + p_parent
        return (C, p), self.root_of(frame)


def without_tf2(values: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Yield what is missed by checked parameters where tf2_msgs is: levels and texts for a log."""
    if values["publish_tf"]:
        yield "info", NOT_PUBLISHED
    if not values["use_tf_static"]:
        return
    if any(values["imu.position"]) or any(values["gnss.antenna_position"]):
        yield "info", NOT_READ
    else:
        yield "warn", NOT_PLACED
