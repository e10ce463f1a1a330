"""
Topics of the input with a publisher of another type: DDS delivers nothing of it, nor says so.
"""

from __future__ import annotations

from typing import Any

from hybrid_ins.ros.messages import interface
from hybrid_ins.ros.messages.conversions import Refused
from hybrid_ins.ros.reporting.input_log import InputLog

KINDS = {topic.name: topic.type_name for topic in interface.SUBSCRIBED}


class MistypedTopics:
    """
    Warns, once for each topic, of a publisher whose messages cannot arrive.

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
        """Look at the types on each topic; called once a second."""
        node = self._node
        kinds = dict(node.get_topic_names_and_types())
        for name, kind in KINDS.items():
            topic = node.resolve_topic_name(name)
            if topic in self._found or set(kinds.get(topic, ())) <= {kind}:
                continue
            for info in node.get_publishers_info_by_topic(topic):
                if info.topic_type != kind:
                    self._found.add(topic)
                    self._inputs.count_and_warn(
                        name,
                        Refused(
                            f"{name}: another type",
                            f"{info.node_name} publishes {info.topic_type} on {topic}, not {kind}: "
                            "nothing arrives from it; remap the topic, or convert the messages",
                        ),
                    )
                    break
