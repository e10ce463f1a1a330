"""
Where IMU and antenna are in the base frame: by parameters, or by ``/tf_static`` without them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybrid_ins import parameters
from hybrid_ins.resources import shortened
from hybrid_ins.ros.messages.conversions import FLIP, Message, Refused, mount_matrix
from hybrid_ins.ros.placement.frame_id import CONFIRMED, LASTING_NS, FrameId
from hybrid_ins.ros.placement.static_transforms import Pose, StaticTransforms
from hybrid_ins.ros.reporting.input_log import InputLog

Array = NDArray[np.float64]

PARAMETERS = {
    "imu/data": ("imu.position", "imu.mount_rpy"),
    "gnss/fix": ("gnss.antenna_position", "gnss.antenna_position_std"),
}
"""Parameters that place the sensor of a topic; all zero: ``/tf_static`` does."""


MOST_UNPLACED = 20  # frames that nothing places, to be told
FARTHEST = parameters.find("gnss.antenna_position").high  # m, along an axis of the base frame


class SensorPlacement:
    """
    Places the sensors.

    Parameters
    ----------
    values : mapping
        Checked parameters.
    inputs : InputLog
        Warns of frames that change.

    Attributes
    ----------
    is_given : dict of str to bool
        Whether parameters place the sensor of a topic, which ``/tf_static`` then does not.
    mount : ndarray, shape (3, 3)
        From the IMU message's axes to b.
    arm_b : ndarray, shape (3,)
        IMU relative to the base frame's origin [m], b.
    lever_b : ndarray, shape (3,)
        Antenna relative to the IMU [m], b.
    antenna_error_b, antenna_std : ndarray, shape (3,)
        What it contains besides what is given [m], b, as the motion has shown; its σ, or of the
        place that is given.
    """

    def __init__(self, values: Mapping[str, Any], inputs: InputLog) -> None:
        self._inputs = inputs
        self._base = values["base_frame"]
        self._use_transforms = values["use_tf_static"]
        self._mount_rpy = values["imu.mount_rpy"]
        self._position = values["imu.position"]
        self._antenna = values["gnss.antenna_position"]
        self._antenna_std = np.array(values["gnss.antenna_position_std"])
        self.is_given = {
            topic: any(any(values[name]) for name in names) for topic, names in PARAMETERS.items()
        }
        self._transforms = StaticTransforms()
        self._unplaced: set[tuple[str, str]] = set()  # topics and their frames that were told
        self._frames = {topic: FrameId() for topic in PARAMETERS}
        self._given_b: Array = np.full(3, np.nan)  # the antenna's place without that error
        self.antenna_error_b: Array = np.zeros(3)
        self.antenna_std: Array = np.zeros(3)
        self._imu_error_b: Array = np.zeros(3)  # what arm_b contains besides what is given
        self._place()

    def to_body(self, x: float, y: float, z: float) -> tuple[float, float, float]:
        """Return a vector in b of one in the IMU message's axes: once per reading, no arrays."""
        xx, xy, xz, yx, yy, yz, zx, zy, zz = self._mount_rows
        return xx * x + xy * y + xz * z, yx * x + yy * y + yz * z, zx * x + zy * y + zz * z

    @property
    def antenna_is_placed(self) -> bool:
        """Whether parameters or ``/tf_static`` say where the antenna is relative to the IMU."""
        by_parameters = self.is_given["gnss/fix"] or any(self._position)
        return by_parameters or self._is_placed_by_transform("gnss/fix")

    @property
    def imu_is_placed(self) -> bool:
        """Whether they say where the IMU is in the base frame."""
        return any(self._position) or self._is_placed_by_transform("imu/data")

    def _is_placed_by_transform(self, topic: str) -> bool:
        frame = self.frame_of(topic)
        is_base = frame.lstrip("/") == self._base  # so say drivers that do not know it
        return not is_base and self._transform_of(frame) is not None

    def frame_of(self, topic: str) -> str:
        """Return the frame_id in force of the messages on ``imu/data`` or ``gnss/fix``."""
        return self._frames[topic].in_force or ""

    def is_settled(self, topic: str, frame: str) -> bool:
        """Return whether a message's frame_id needs no check by `admits`."""
        return self._frames[topic].is_settled(frame)

    def admits(self, topic: str, frame: str, t_ns: int) -> bool:
        """
        Return whether a message's frame_id may be set; else the message is refused, and counted.

        ``t_ns`` is its stamp [ns].
        A frame_id that puts the sensor elsewhere, by ``/tf_static``, has to last: else one message
        of another publisher would end the estimate.
        """
        known = self._frames[topic]
        if known.is_confirmed(frame, t_ns) or known.in_force is None:
            return True
        if self.is_given[topic] or _are_equal(self._find(known.in_force), self._find(frame)):
            return True
        self._inputs.count_and_warn(
            topic,
            Refused(
                f"{topic}: another frame_id",
                f"the frame_id is '{shortened(frame)}', not '{shortened(known.in_force)}', and "
                f"/tf_static does not place both alike: rejected until {CONFIRMED} messages in a "
                f"row have it for {LASTING_NS * 1e-9:g} s; do two publishers share the topic?",
            ),
        )
        return False

    def set_frame(self, topic: str, frame: str) -> bool:
        """Set the frame_id of the messages on a topic; True where that moves a sensor."""
        known = self._frames[topic].in_force
        self._frames[topic].set(frame)
        if known and frame != known:
            self._inputs.count_and_warn(
                topic,
                Refused(
                    f"{topic}: frame_id changes",
                    f"frame_id changes from '{shortened(known)}' to '{shortened(frame)}': two "
                    "publishers on one topic?",
                ),
            )
        self._warn_of_misplaced(topic)
        moved = self._place_again()
        names_other = frame != self._base if frame else moved
        is_placed = self.is_given[topic] or self._transform_of(frame) is not None
        if frame != known and names_other and not is_placed:
            self._inform_of_missing_transform(topic, shortened(frame))
        elif moved:
            self._inform_of_transforms()
        return moved

    def add_transforms(self, message: Message) -> bool:
        """Use a tf2_msgs/TFMessage of /tf_static; True where it moves a sensor."""
        for fault in self._transforms.add(message):
            self._inputs.count_and_warn("/tf_static", fault)
        for topic in PARAMETERS:
            self._warn_of_misplaced(topic)
        moved = self._place_again()
        if moved:
            self._inform_of_transforms()
        return moved

    def move_antenna(self, error_b: Array, std: Array, moves_odometry: bool = True) -> None:
        """
        Take the antenna to be ``error_b`` ± ``std`` (3,) [m], b, from where it was so far.

        Otherwise the IMU is moved: the odometry remains that of the antenna.
        """
        self.antenna_error_b = self.antenna_error_b + error_b
        self.antenna_std = std
        if not moves_odometry:
            self._imu_error_b = self._imu_error_b - error_b
        self._place()

    def _place_again(self) -> bool:
        before = self.mount, self.arm_b, self.lever_b
        self._place()
        return not _are_equal(before, (self.mount, self.arm_b, self.lever_b))

    def _inform_of_transforms(self) -> None:
        self._inputs.inform(
            "sensors moved", f"/tf_static gives the positions of IMU and antenna in '{self._base}'"
        )

    def _inform_of_missing_transform(self, topic: str, frame: str) -> None:
        """Log that nothing places a frame, once: those of two publishers alternate."""
        if (topic, frame) in self._unplaced or len(self._unplaced) == MOST_UNPLACED:
            return
        self._unplaced.add((topic, frame))
        self._inputs.log(
            "info",
            f"{topic}: no transform from '{self._base}' to '{frame}' (neither "
            f"{PARAMETERS[topic][0]} nor /tf_static): assuming that they coincide",
        )

    def _place(self) -> None:
        mount, position, antenna = mount_matrix(self._mount_rpy), self._position, self._antenna
        if not self.is_given["imu/data"]:
            C, place = self._find(self.frame_of("imu/data"))
            mount, position = FLIP @ C, place.tolist()
        if not self.is_given["gnss/fix"]:
            antenna = self._find(self.frame_of("gnss/fix"))[1].tolist()
        self.mount = mount
        self._mount_rows: tuple[float, ...] = tuple(mount.ravel().tolist())
        given_b = FLIP @ np.subtract(antenna, position)
        if not np.array_equal(given_b, self._given_b):  # what was found is of the place before
            self._given_b, self.antenna_std = given_b, self._antenna_std
            self.antenna_error_b = self._imu_error_b = np.zeros(3)
        self.arm_b: Array = FLIP @ np.array(position) + self._imu_error_b
        self.lever_b: Array = given_b + self.antenna_error_b

    def _warn_of_misplaced(self, topic: str) -> None:
        """Warn where ``/tf_static`` has the frame of a topic, but at no possible place."""
        frame = self.frame_of(topic)
        if not frame or not self._use_transforms or self.is_given[topic]:
            return
        root, base_root = map(self._transforms.root_of, (frame, self._base))
        found = self._transforms.find(self._base, frame)
        if found is None and root != frame.lstrip("/"):
            self._inputs.warn_once(
                f"{topic}: other tree",
                f"{topic}: /tf_static has '{shortened(frame)}' below '{shortened(root)}', but no "
                f"transform to '{base_root}': set base_frame, or publish that transform; until "
                "then it is assumed to coincide",
            )
        elif found is not None and not _is_on_vehicle(found):
            self._inputs.warn_once(
                f"{topic}: too far",
                f"{topic}: /tf_static puts '{shortened(frame)}' {np.linalg.norm(found[1]):.0f} m "
                f"from '{self._base}': not used; metres are expected, up to {FARTHEST:g}",
            )

    def _find(self, frame: str) -> tuple[Array, Array]:
        """Return rotation and position in the base frame of a frame that messages have."""
        found = self._transform_of(frame)
        return (np.eye(3), np.zeros(3)) if found is None else found

    def _transform_of(self, frame: str) -> tuple[Array, Array] | None:
        """Return that as ``/tf_static`` says it; None where it does not."""
        if not frame or not self._use_transforms:
            return None
        found = self._transforms.find(self._base, frame)
        return found if found is not None and _is_on_vehicle(found) else None


def _is_on_vehicle(pose: Pose) -> bool:
    return float(np.abs(pose[1]).max()) <= FARTHEST


def _are_equal(one: Sequence[Array], other: Sequence[Array]) -> bool:
    """Return whether two places are the same, array by array."""
    return all(map(np.array_equal, one, other))
