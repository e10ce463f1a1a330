"""Publishers beside the one that is meant; the graph is a stand-in."""

from types import SimpleNamespace

from hybrid_ins.ros.reporting.input_log import InputLog
from hybrid_ins.ros.review.crowded_topics import LEASE, CrowdedTopics


class Graph:
    """A node that sees publishers of /imu/data alone."""

    def __init__(self, *publishers: str) -> None:
        self.publishers: tuple[str, ...] = publishers

    def resolve_topic_name(self, name: str) -> str:
        return f"/{name}"

    def count_publishers(self, topic: str) -> int:
        return len(self.get_publishers_info_by_topic(topic))

    def get_publishers_info_by_topic(self, topic: str) -> list[SimpleNamespace]:
        names = self.publishers if topic == "/imu/data" else ()
        names = [name.removesuffix(" (dead)") for name in names]
        return [
            SimpleNamespace(
                node_name=name,
                node_namespace="_NODE_NAMESPACE_UNKNOWN_" if name.startswith("_") else "/",
            )
            for name in names
        ]


def find(*publishers: str, seconds: int = LEASE + 5) -> list[str]:
    """Return the lines about such publishers, whose dead ones DDS forgets after 20 s."""
    lines: list[str] = []
    graph = Graph(*publishers)
    crowded = CrowdedTopics(graph, InputLog(lambda level, text: lines.append(text)))
    for second in range(seconds):
        if second == 20:
            graph.publishers = tuple(name for name in publishers if not name.endswith(" (dead)"))
        crowded.find()
    return lines


def test_two_drivers_are_named_at_once() -> None:
    assert find("driver", "other", seconds=1) == [
        "imu/data: /imu/data has 2 publishers (driver, other): stop or remap all but one"
    ]


def test_two_drivers_of_one_name_are_named_once_the_dead_would_be_forgotten() -> None:
    assert not find("driver", "driver", seconds=20)
    assert len(find("driver", "driver")) == 1


def test_a_driver_that_was_killed_and_started_again_is_one() -> None:
    """GIVEN a killed driver, which DDS still lists THEN it is no second one, under either name."""
    assert not find("driver", "driver (dead)")
    assert not find("driver", "_NODE_NAME_UNKNOWN_ (dead)")
