"""What warns of the publishers of a topic, once for each topic."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

from hybrid_ins.ros.messages.conversions import Refused
from hybrid_ins.ros.reporting.input_log import InputLog


class TopicReview:
    """
    Knows which topics it has told of.

    Parameters
    ----------
    node : Node
        Of rclpy.
    inputs : InputLog
    """

    def __init__(self, node: Any, inputs: InputLog) -> None:
        self._node = node
        self._inputs = inputs
        self._told: set[str] = set()

    def _untold(self, names: Iterable[str]) -> Iterator[tuple[str, str]]:
        """Yield the names of topics that nothing was told of, each with what it resolves to."""
        for name in names:
            topic = self._node.resolve_topic_name(name)
            if topic not in self._told:
                yield name, topic

    def _tell(self, name: str, topic: str, what: str, text: str) -> None:
        """Count ``what`` is wrong with a topic, and warn with ``text``."""
        self._told.add(topic)
        self._inputs.count_and_warn(name, Refused(f"{name}: {what}", text))
