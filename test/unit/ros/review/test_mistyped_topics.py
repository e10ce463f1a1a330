"""Publishers whose type is not that of the input; the graph is a stand-in."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from hybrid_ins.ros.reporting.input_log import InputLog
from hybrid_ins.ros.review.mistyped_topics import MistypedTopics

TWIST, STAMPED = "geometry_msgs/msg/TwistWithCovarianceStamped", "geometry_msgs/msg/TwistStamped"


class Graph:
    """A node with publishers and subscribers of these types on the topic /vel."""

    def __init__(self, published: list[str], subscribed: list[str]) -> None:
        self.published, self.kinds = published, sorted({*published, *subscribed})

    def resolve_topic_name(self, name: str) -> str:
        return "/vel" if name == "gnss/velocity" else f"/{name.lstrip('/')}"

    def get_topic_names_and_types(self) -> list[tuple[str, list[str]]]:
        return [("/vel", self.kinds), ("/imu/data", ["sensor_msgs/msg/Imu"])]

    def get_publishers_info_by_topic(self, topic: str) -> list[SimpleNamespace]:
        assert topic == "/vel"  # the others have one type
        return [SimpleNamespace(node_name="nmea", topic_type=kind) for kind in self.published]


@pytest.mark.parametrize(
    ("published", "subscribed", "is_told"),
    [
        ([STAMPED], [TWIST], True),
        ([TWIST, STAMPED], [TWIST], True),
        ([TWIST], [TWIST, STAMPED], False),
        ([], [TWIST], False),
    ],
)
def test_a_publisher_of_another_type_is_named_once(
    published: list[str], subscribed: list[str], is_told: bool
) -> None:
    lines: list[str] = []
    inputs = InputLog(lambda level, text: lines.append(f"{level}: {text}"))
    topics = MistypedTopics(Graph(published, subscribed), inputs)
    for _ in range(3):
        topics.find()

    said = (
        f"warn: gnss/velocity: nmea publishes {STAMPED} on /vel, not {TWIST}: nothing arrives "
        "from it; remap the topic, or convert the messages"
    )
    assert lines == ([said] if is_told else [])
