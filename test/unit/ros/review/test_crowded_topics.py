"""Publishers beside the one that is meant; the graph is a stand-in."""

from types import SimpleNamespace

from hybrid_ins.ros.reporting.input_log import InputLog
from hybrid_ins.ros.review.crowded_topics import GONE, CrowdedTopics


class Graph:
    """A node that sees publishers of /imu/data alone."""

    def __init__(self, *publishers: str) -> None:
        self.publishers = publishers

    def resolve_topic_name(self, name: str) -> str:
        return f"/{name}"

    def count_publishers(self, topic: str) -> int:
        return len(self.get_publishers_info_by_topic(topic))

    def get_publishers_info_by_topic(self, topic: str) -> list[SimpleNamespace]:
        names = self.publishers if topic == "/imu/data" else ()
        return [SimpleNamespace(node_name=name) for name in names]


def test_a_driver_that_was_killed_and_started_again_is_one() -> None:
    """GIVEN a killed driver, which DDS still lists, WHEN another is there THEN that is told."""
    lines: list[str] = []
    graph = Graph("driver", GONE)
    crowded = CrowdedTopics(graph, InputLog(lambda level, text: lines.append(text)))
    crowded.find()
    assert not lines

    graph.publishers = ("driver", "driver_2", GONE)
    crowded.find()
    crowded.find()

    assert lines == [
        "imu/data: /imu/data has 2 publishers (driver, driver_2): stop or remap all but one"
    ]
