"""
Where IMU and antenna are in the base frame: by parameters, or by ``/tf_static`` without them.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.resources import shortened
from hybrid_ins.ros.messages.conversions import FLIP, Message, Refused, mount_matrix
from hybrid_ins.ros.placement.static_transforms import LONGEST_NAME, MOST_FRAMES, StaticTransforms
from hybrid_ins.ros.reporting.input_log import InputLog

Array = NDArray[np.float64]

PARAMETERS = {
    "imu/data": ("imu.position", "imu.mount_rpy"),
    "gnss/fix": ("gnss.antenna_position", "gnss.antenna_position_std"),
}
"""Parameters that place the sensor of a topic; all zero: ``/tf_static`` does."""


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
        self._frames = dict.fromkeys(PARAMETERS, "")
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
        is_base = self._frames[topic] == self._base  # so say drivers that do not know it
        return not is_base and self._transform_of(topic) is not None

    def frame_of(self, topic: str) -> str:
        """Return the frame_id of the last message on ``imu/data`` or ``gnss/fix``."""
        return self._frames[topic]

    def set_frame(self, topic: str, frame: str) -> bool:
        """Set the frame_id of the messages on a topic; True where that moves a sensor."""
        known, self._frames[topic] = self._frames[topic], frame
        if known and frame != known:
            self._inputs.count_and_warn(
                topic,
                Refused(
                    f"{topic}: frame_id changes",
                    f"frame_id changes from '{shortened(known)}' to '{shortened(frame)}': two "
                    "publishers on one topic?",
                ),
            )
        if (
            not known
            and frame not in ("", self._base)
            and not self.is_given[topic]
            and self._transforms.find(self._base, frame) is None
        ):
            self._inputs.inform(
                f"{topic}: no transform",
                f"{topic}: no transform from '{self._base}' to '{shortened(frame)}' (neither "
                f"{PARAMETERS[topic][0]} nor /tf_static): assuming that they coincide",
            )
        return self._place_again()

    def add_transforms(self, message: Message) -> bool:
        """Use a tf2_msgs/TFMessage of /tf_static; True where it moves a sensor."""
        if self._transforms.add(message):
            self._inputs.count_and_warn(
                "/tf_static",
                Refused(
                    "tf_static: too many frames",
                    f"more than {MOST_FRAMES} frames, or names of more than {LONGEST_NAME} "
                    "characters: left out",
                ),
            )
        return self._place_again()

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
        if all(map(np.array_equal, before, (self.mount, self.arm_b, self.lever_b))):
            return False
        self._inputs.inform(
            "sensors moved", f"/tf_static gives the positions of IMU and antenna in '{self._base}'"
        )
        return True

    def _place(self) -> None:
        mount, position, antenna = mount_matrix(self._mount_rpy), self._position, self._antenna
        if not self.is_given["imu/data"]:
            C, place = self._find("imu/data")
            mount, position = FLIP @ C, place.tolist()
        if not self.is_given["gnss/fix"]:
            antenna = self._find("gnss/fix")[1].tolist()
        self.mount = mount
        self._mount_rows: tuple[float, ...] = tuple(mount.ravel().tolist())
        given_b = FLIP @ np.subtract(antenna, position)
        if not np.array_equal(given_b, self._given_b):  # what was found is of the place before
            self._given_b, self.antenna_std = given_b, self._antenna_std
            self.antenna_error_b = self._imu_error_b = np.zeros(3)
        self.arm_b: Array = FLIP @ np.array(position) + self._imu_error_b
        self.lever_b: Array = given_b + self.antenna_error_b

    def _find(self, topic: str) -> tuple[Array, Array]:
        """Rotation and position in the base frame of the frame that a topic's messages have."""
        found = self._transform_of(topic)
        return (np.eye(3), np.zeros(3)) if found is None else found

    def _transform_of(self, topic: str) -> tuple[Array, Array] | None:
        """Return that as ``/tf_static`` says it; None where it does not."""
        frame = self._frames[topic]
        return self._transforms.find(self._base, frame) if frame and self._use_transforms else None
