"""
The running node on ``/tf`` and ``/tf_static``, with the types of tf2.

Where tf2_msgs is not installed its only type is generated and compiled, see `support.interfaces`.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.ros_nodes import ENVIRONMENT, Client, start_node

from hybrid_ins.cli import simulate
from hybrid_ins.core.inertial.rotations import matrix_from_quat
from hybrid_ins.ros.messages.conversions import fill_transform, stamp_ns
from tools.processes import Processes

pytest.importorskip("rclpy", reason="no ROS 2 Python packages")

pytestmark = pytest.mark.live

PLACES = {"imu_link": [0.3, 0.0, 0.1], "gnss_link": [0.0, 0.0, 0.0]}
UNTURNED = [0.0, 0.0, 0.0, 1.0]


def pose(position: Any, quat: Any) -> np.ndarray[Any, Any]:
    """Homogeneous matrix (4, 4) of a message's position and quaternion."""
    matrix = np.eye(4)
    matrix[:3, :3] = matrix_from_quat(np.array([quat.x, quat.y, quat.z, quat.w]))
    matrix[:3, 3] = position.x, position.y, position.z
    return matrix


def test_transforms_are_a_tree_that_agrees_with_the_odometry(
    processes: Processes, tmp_path: Path, client: Client, types: dict[str, str]
) -> None:
    """GIVEN /tf_static that came before the node WHEN it runs THEN /tf is map, odom, base_link."""
    from geometry_msgs.msg import TransformStamped
    from nav_msgs.msg import Odometry
    from rclpy.duration import Duration
    from rclpy.qos import DurabilityPolicy, QoSProfile
    from tf2_msgs.msg import TFMessage

    flight, log = tmp_path / "flight.mcap", tmp_path / "node.log"
    assert simulate.main([str(flight), "--duration", "10", "--imu-rate", "200"]) == 0
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    fixed = TFMessage(transforms=[TransformStamped() for _ in PLACES])
    for transform, (name, place) in zip(fixed.transforms, PLACES.items(), strict=True):
        fill_transform(transform, 0, "base_link", name, place, UNTURNED)
    publisher = client.node.create_publisher(TFMessage, "/tf_static", latched)
    publisher.publish(fixed)
    heard: list[Any] = []
    odometry: dict[int, Any] = {}
    client.node.create_subscription(TFMessage, "/tf", heard.append, 1000)
    client.node.create_subscription(
        Odometry, "/odometry", lambda m: odometry.update({stamp_ns(m.header.stamp): m}), 10_000
    )
    start_node(processes, log, environment=types)
    client.spin_until(lambda: publisher.get_subscription_count() > 0, 30.0)
    assert publisher.wait_for_all_acked(Duration(seconds=30.0)), "the node got no /tf_static"
    play = [sys.executable, "-m", "hybrid_ins.cli.play", str(flight)]

    processes.start(play, subprocess.DEVNULL, ENVIRONMENT)
    client.spin_until(lambda: len(heard) > 200, 60.0)

    assert "/tf_static gives the positions of IMU and antenna in 'base_link'" in log.read_text()
    assert "no transform" not in log.read_text()
    for message in heard:
        frames = [(t.header.frame_id, t.child_frame_id) for t in message.transforms]
        assert frames == [("map", "odom"), ("odom", "base_link")]
    stamps = [stamp_ns(m.transforms[0].header.stamp) for m in heard]
    assert all(np.diff(stamps) > 0)
    compared = 0
    for message, stamp in zip(heard, stamps, strict=True):
        if stamp in odometry:
            first, second = (
                pose(t.transform.translation, t.transform.rotation) for t in message.transforms
            )
            there = odometry[stamp].pose.pose
            assert np.allclose(first @ second, pose(there.position, there.orientation), atol=1e-6)
            compared += 1
    assert compared > 100
