"""Where recordings put the sensors: /tf_static as parameters, and the frames of messages."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hybrid_ins.bags.reader import BagReader
from hybrid_ins.core.inertial.rotations import quat_from_matrix, rpy_from_quat
from hybrid_ins.errors import InputError
from hybrid_ins.ros.messages import type_names
from hybrid_ins.ros.messages.conversions import FLIP
from hybrid_ins.ros.placement.sensor_placement import PARAMETERS, SensorPlacement
from hybrid_ins.ros.reporting.input_log import InputLog

NAMES = ("imu.position", "imu.mount_rpy", "gnss.antenna_position")


def with_placement(
    paths: Sequence[Path], values: Mapping[str, Any], imu_topic: str, fix_topic: str
) -> dict[str, Any]:
    """
    Return the parameters with the sensors where the node would have them.

    Parameters
    ----------
    paths : sequence of Path
        Bags of one robot.
    values : mapping
        Checked parameters; those that place a sensor prevail over /tf_static.
    imu_topic, fix_topic : str
        Their messages name the sensors' frames.

    Raises
    ------
    InputError
        A topic is missing, or the bags put the sensors in different places.
    """
    found = [_placement(path, values, imu_topic, fix_topic) for path in paths]
    for path, one in zip(paths, found, strict=True):
        for name in NAMES:
            if not np.allclose(one[name], found[0][name], atol=1e-6):
                raise InputError(
                    f"{path}: /tf_static gives {name} {one[name]}, that of {paths[0]} "
                    f"{found[0][name]}: calibrate recordings of one robot, or set {name}"
                )
    return {**values, **found[0]}


def _placement(
    path: Path, values: Mapping[str, Any], imu_topic: str, fix_topic: str
) -> dict[str, list[float]]:
    """Return the parameters ``NAMES`` by a bag."""
    placement = SensorPlacement(values, InputLog(lambda level, text: None))
    with BagReader(path) as bag:
        if bag.topics.get("/tf_static") == type_names.TRANSFORMS:
            for *_, message in bag.messages("/tf_static"):
                placement.add_transforms(message)
        for sensor, topic, kind, option in (
            ("imu/data", imu_topic, type_names.IMU, "--imu-topic"),
            ("gnss/fix", fix_topic, type_names.FIX, "--fix-topic"),
        ):
            frame = _frame(bag, bag.require(topic, kind, option))
            if frame is not None:
                placement.set_frame(sensor, frame)
    position = FLIP @ placement.arm_b
    rpy = rpy_from_quat(quat_from_matrix(FLIP @ placement.mount))
    rows = position, np.array(rpy), position + FLIP @ placement.lever_b
    found = {name: (row + 0.0).tolist() for name, row in zip(NAMES, rows, strict=True)}
    for topic, names in PARAMETERS.items():
        if placement.is_given[topic]:
            found |= {name: values[name] for name in names}
    return found


def antenna_is_base(
    paths: Sequence[Path], values: Mapping[str, Any], fix_topic: str = "/gnss/fix"
) -> bool:
    """Return whether the fixes are of base_frame itself: by frame_id, and no antenna is given."""

    def frame(path: Path) -> str:
        with BagReader(path) as bag:
            return _frame(bag, bag.require(fix_topic, type_names.FIX, "--fix-topic")) or ""

    return not any(values["gnss.antenna_position"]) and all(
        frame(path).lstrip("/") == values["base_frame"] for path in paths
    )


def _frame(bag: BagReader, topic: str) -> str | None:
    """Return the frame_id of the first message on a topic; None where there is none."""
    return next((str(message.header.frame_id) for *_, message in bag.messages(topic)), None)
