"""
Topics with several publishers: of the input, or of what only this node is to publish.
"""

from __future__ import annotations

from collections import Counter
from typing import Any

from hybrid_ins.ros.messages.conversions import Refused
from hybrid_ins.ros.reporting.input_log import InputLog

INPUT, OUTPUT = ("imu/data", "gnss/fix", "gnss/velocity"), ("odometry", "odometry/local")
LEASE = 25  # s: for 20 s DDS lists the publishers of a process that was killed
GONE = "_NODE_NAMESPACE_UNKNOWN_/_NODE_NAME_UNKNOWN_"  # as which some of them are listed
REMEDIES = dict.fromkeys(INPUT, "stop or remap all but one") | dict.fromkeys(
    OUTPUT, "is another ins_node running? Stop the other, or give this one a namespace"
)


class CrowdedTopics:
    """
    Warns, once for each topic, of several publishers.

    Those of one node name may be a driver that was killed and started again, until DDS forgets it.

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
        self._seconds: Counter[str] = Counter()  # with several publishers, by topic

    def find(self) -> None:
        """Count the publishers of each topic; called once a second."""
        node = self._node
        for name, remedy in REMEDIES.items():
            topic = node.resolve_topic_name(name)
            if topic in self._found:
                continue
            if node.count_publishers(topic) < 2:
                del self._seconds[topic]
                continue
            self._seconds[topic] += 1
            infos = node.get_publishers_info_by_topic(topic)
            nodes = {f"{info.node_namespace}/{info.node_name}" for info in infos} - {GONE}
            if len(nodes) < 2 and self._seconds[topic] < LEASE:
                continue
            self._found.add(topic)
            names = ", ".join(info.node_name for info in infos)
            self._inputs.count_and_warn(
                name,
                Refused(
                    f"{name}: several publishers",
                    f"{topic} has {len(infos)} publishers ({names}): {remedy}",
                ),
            )
