"""
Input topics with several publishers.
"""

from __future__ import annotations

from typing import Any

from hybrid_ins.ros.messages.conversions import Refused
from hybrid_ins.ros.reporting.input_log import InputLog

TOPICS = ("imu/data", "gnss/fix", "gnss/velocity")


class CrowdedTopics:
    """
    Warns, once for each input topic, of several publishers.

    Parameters
    ----------
    node : Node
        Of rclpy.
    inputs : InputLog
    """

    def __init__(self, node: Any, inputs: InputLog) -> None:
        self._node = node
        self._inputs = inputs
        self._found: set[str] = set()

    def find(self) -> None:
        """Count the publishers of each topic."""
        node = self._node
        for name in TOPICS:
            topic = node.resolve_topic_name(name)
            if topic in self._found or node.count_publishers(topic) < 2:
                continue
            self._found.add(topic)
            nodes = [info.node_name for info in node.get_publishers_info_by_topic(topic)]
            self._inputs.count_and_warn(
                name,
                Refused(
                    f"{name}: several publishers",
                    f"{topic} has {len(nodes)} publishers "
                    f"({', '.join(nodes)}): stop or remap all but one",
                ),
            )
