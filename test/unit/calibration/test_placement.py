"""Where /tf_static puts the sensors of recordings that are calibrated."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from support.bags import START_NS, imu_message

from hybrid_ins import parameters
from hybrid_ins.bags.messages import new_message
from hybrid_ins.bags.writer import BagWriter
from hybrid_ins.calibration.placement import NAMES, with_placement
from hybrid_ins.core.inertial.rotations import quat_from_rpy
from hybrid_ins.errors import InputError
from hybrid_ins.ros.messages.conversions import mount_matrix
from hybrid_ins.ros.messages.type_names import FIX, TRANSFORMS

IMU_RPY, IMU_PLACE = (math.pi, 0.0, 0.5 * math.pi), (0.6, -0.3, 0.2)


def bag_with(
    path: Path, frames: Sequence[tuple[str, Sequence[float], Sequence[float]]] | None
) -> Path:
    """Write a bag with the poses (name, place, roll pitch yaw) of frames in base_link."""
    with BagWriter(path) as bag:
        if frames is not None:
            tree = new_message(TRANSFORMS)
            for name, place, rpy in frames:
                one = new_message("geometry_msgs/msg/TransformStamped")
                one.header.frame_id, one.child_frame_id = "base_link", name
                p, q = one.transform.translation, one.transform.rotation
                p.x, p.y, p.z = place
                q.x, q.y, q.z, q.w = quat_from_rpy(*rpy).tolist()
                tree.transforms.append(one)
            bag.write("/tf_static", tree, START_NS)
        bag.write("/imu/data", imu_message(0), START_NS + 1)
        fix = new_message(FIX)
        fix.header.frame_id = "antenna"
        bag.write("/gnss/fix", fix, START_NS + 2)
    return path


def placed(*bags: Path, **given: list[float]) -> dict[str, list[float]]:
    values = {**parameters.defaults(), **{k.replace("__", "."): v for k, v in given.items()}}
    return with_placement(bags, values, "/imu/data", "/gnss/fix")


def test_sensors_are_where_the_transforms_put_them(tmp_path: Path) -> None:
    frames = [("imu_link", IMU_PLACE, IMU_RPY), ("antenna", (-0.5, 0.1, 1.4), (0.0, 0.0, 0.0))]
    found = placed(bag_with(tmp_path / "robot.mcap", frames))

    assert found["imu.position"] == pytest.approx(IMU_PLACE)
    assert found["gnss.antenna_position"] == pytest.approx((-0.5, 0.1, 1.4))
    assert mount_matrix(found["imu.mount_rpy"]) == pytest.approx(mount_matrix(IMU_RPY))


def test_parameters_prevail_and_without_transforms_nothing_changes(tmp_path: Path) -> None:
    frames = [("imu_link", IMU_PLACE, IMU_RPY), ("antenna", (-0.5, 0.1, 1.4), (0.0, 0.0, 0.0))]
    robot = bag_with(tmp_path / "robot.mcap", frames)
    given = placed(robot, gnss__antenna_position=[1.0, 2.0, 3.0], imu__position=[0.1, 0.0, 0.0])
    bare = placed(bag_with(tmp_path / "bare.mcap", None))

    assert given["gnss.antenna_position"] == [1.0, 2.0, 3.0]
    assert given["imu.position"] == [0.1, 0.0, 0.0] and given["imu.mount_rpy"] == [0.0, 0.0, 0.0]
    assert all(bare[name] == [0.0, 0.0, 0.0] for name in NAMES)


def test_recordings_of_different_robots_are_refused(tmp_path: Path) -> None:
    one = bag_with(tmp_path / "one.mcap", [("antenna", (0.0, 0.0, 1.0), (0.0, 0.0, 0.0))])
    other = bag_with(tmp_path / "other.mcap", [("antenna", (0.0, 0.0, 1.2), (0.0, 0.0, 0.0))])

    with pytest.raises(InputError, match=r"other\.mcap: .*antenna_position.*1\.2.*one\.mcap"):
        placed(one, other)
    assert np.allclose(placed(one, one)["gnss.antenna_position"], [0.0, 0.0, 1.0])
