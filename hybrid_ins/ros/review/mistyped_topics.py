"""
Topics of the input with a publisher of another type: DDS delivers nothing of it, nor says so.
"""

from __future__ import annotations

from hybrid_ins.ros.messages.interface import INPUT_TYPES
from hybrid_ins.ros.review.topic_review import TopicReview


class MistypedTopics(TopicReview):
    """Warns, once for each topic, of a publisher whose messages cannot arrive."""

    def find(self) -> None:
        """Look at the types on each topic; called once a second."""
        present = dict(self._node.get_topic_names_and_types())
        for name, topic in self._untold(INPUT_TYPES):
            kind = INPUT_TYPES[name]
            if set(present.get(topic, ())) <= {kind}:
                continue
            for info in self._node.get_publishers_info_by_topic(topic):
                if info.topic_type != kind:
                    text = (
                        f"{info.node_name} publishes {info.topic_type} on {topic}, not {kind}: "
                        "nothing arrives from it; remap the topic, or convert the messages"
                    )
                    self._tell(name, topic, "another type", text)
                    break
