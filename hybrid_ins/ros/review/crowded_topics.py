"""
Topics with several publishers: of the input, or of what only this node is to publish.
"""

from __future__ import annotations

from typing import Any

from hybrid_ins.ros.messages.conversions import Refused
from hybrid_ins.ros.reporting.input_log import InputLog

INPUT, OUTPUT = ("imu/data", "gnss/fix", "gnss/velocity"), ("odometry", "odometry/local")
GONE = "_NODE_NAME_UNKNOWN_"  # of a process that was killed, which DDS keeps for some 20 s
REMEDIES = dict.fromkeys(INPUT, "stop or remap all but one") | dict.fromkeys(
    OUTPUT, "is another ins_node running? Stop the other, or give this one a namespace"
)


class CrowdedTopics:
    """
    Warns, once for each topic, of several publishers.

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
        for name, remedy in REMEDIES.items():
            topic = node.resolve_topic_name(name)
            if topic in self._found or node.count_publishers(topic) < 2:
                continue
            names = [info.node_name for info in node.get_publishers_info_by_topic(topic)]
            nodes = [name for name in names if name != GONE]
            if len(nodes) < 2:
                continue
            self._found.add(topic)
            self._inputs.count_and_warn(
                name,
                Refused(
                    f"{name}: several publishers",
                    f"{topic} has {len(nodes)} publishers ({', '.join(nodes)}): {remedy}",
                ),
            )
