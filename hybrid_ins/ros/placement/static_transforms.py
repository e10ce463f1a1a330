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

Array = NDArray[np.float64]
Pose = tuple[Array, Array]  # rotation (3, 3) and translation (3,) [m] of a child in its parent

LONGEST_CHAIN = 64
MOST_FRAMES = 1000  # of a vehicle
LONGEST_NAME = 256

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

    def add(self, message: Any) -> int:
        """
        Add a tf2_msgs/TFMessage; transforms that are not finite are left out.

        Returns how many are left out because there are too many frames, or their names too long.
        """
        refused = 0
        for transform in message.transforms:
            q, p = transform.transform.rotation, transform.transform.translation
            quat = np.array([q.x, q.y, q.z, q.w], float)
            place = np.array([p.x, p.y, p.z], float)
            norm = float(np.linalg.norm(quat))
            if math.isfinite(norm) and norm > 0.5 and np.all(np.isfinite(place)):
                child = transform.child_frame_id.lstrip("/")
                parent = transform.header.frame_id.lstrip("/")
                is_new = child not in self._parents
                if max(len(child), len(parent)) > LONGEST_NAME or (
                    is_new and len(self._parents) >= MOST_FRAMES
                ):
                    refused += 1
                    continue
                self._parents[child] = parent, (matrix_from_quat(quat / norm), place)
        return refused

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
        for _ in range(LONGEST_CHAIN):
            if frame not in self._parents:
                break
            frame, (C_parent, p_parent) = self._parents[frame]
            C, p = C_parent @ C, C_parent @ p + p_parent
        return (C, p), frame


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
