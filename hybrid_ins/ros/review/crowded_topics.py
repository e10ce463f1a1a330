"""
Topics with several publishers: of the input, or of what only this node is to publish.
"""

from __future__ import annotations

from collections import Counter
from typing import Any

from hybrid_ins.ros.reporting.input_log import InputLog
from hybrid_ins.ros.review.topic_review import TopicReview

INPUT, OUTPUT = ("imu/data", "gnss/fix", "gnss/velocity"), ("odometry", "odometry/local")
LEASE = 25  # s: for 20 s DDS lists the publishers of a process that was killed
GONE = "_NODE_NAMESPACE_UNKNOWN_/_NODE_NAME_UNKNOWN_"  # as which some of them are listed
REMEDIES = dict.fromkeys(INPUT, "stop or remap all but one") | dict.fromkeys(
    OUTPUT, "is another ins_node running? Stop the other, or give this one a namespace"
)


class CrowdedTopics(TopicReview):
    """
    Warns, once for each topic, of several publishers.

    Those of one node name may be a driver that was killed and started again, until DDS forgets it.
    """

    def __init__(self, node: Any, inputs: InputLog) -> None:
        super().__init__(node, inputs)
        self._seconds: Counter[str] = Counter()  # with several publishers, by topic

    def find(self) -> None:
        """Count the publishers of each topic; called once a second."""
        node = self._node
        for name, topic in self._untold(REMEDIES):
            if node.count_publishers(topic) < 2:
                del self._seconds[topic]
                continue
            self._seconds[topic] += 1
            infos = node.get_publishers_info_by_topic(topic)
            nodes = {f"{info.node_namespace}/{info.node_name}" for info in infos} - {GONE}
            if len(nodes) < 2 and self._seconds[topic] < LEASE:
                continue
            names = ", ".join(info.node_name for info in infos)
            text = f"{topic} has {len(infos)} publishers ({names}): {REMEDIES[name]}"
            self._tell(name, topic, "several publishers", text)
