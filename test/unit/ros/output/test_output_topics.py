"""Reports and odometry go out where somebody listens, and reports not in bursts."""

from typing import Any

import numpy as np

from hybrid_ins import parameters
from hybrid_ins.bags.messages import TYPES
from hybrid_ins.ros.output.message_types import OUTPUTS
from hybrid_ins.ros.output.output_topics import CROWD, OutputTopics
from hybrid_ins.ros.reporting.reports import Odometry, Report, Status, Vector


class Listened:
    """A publisher with subscribers, or without."""

    def __init__(self, subscribers: int) -> None:
        self.subscribers = subscribers
        self.messages: list[bytes] = []

    def publish(self, message: bytes) -> None:
        self.messages.append(message)

    def decoded(self, topic: str) -> list[Any]:
        return [TYPES.deserialize_cdr(data, OUTPUTS[topic]) for data in self.messages]

    def get_subscription_count(self) -> int:
        return self.subscribers


def make(**subscribers: int) -> tuple[OutputTopics, dict[str, Listened]]:
    topics = OutputTopics(parameters.defaults())
    publishers = {name.replace("__", "/"): Listened(n) for name, n in subscribers.items()}
    topics.publishers.update(publishers)
    topics.find_subscribers()
    return topics, publishers


def vectors(count: int, topic: str = "q/accelerometer") -> list[Report]:
    return [Report(topic, Vector(k, "base_link", np.zeros(3)), k) for k in range(count)]


def test_reports_go_out_one_by_one_and_only_where_somebody_listens() -> None:
    topics, publishers = make(q__accelerometer=1, q__gyroscope=0)
    published = publishers["q/accelerometer"]

    topics.publish_some(vectors(2) + vectors(2, "q/gyroscope") + vectors(1))
    assert [m.header.stamp.nanosec for m in published.decoded("q/accelerometer")] == [0]
    topics.publish_some(())
    topics.publish_some(())
    assert [m.header.stamp.nanosec for m in published.decoded("q/accelerometer")] == [0, 1, 0]
    topics.publish_all(vectors(3))
    assert len(published.messages) == 6
    assert not publishers["q/gyroscope"].messages


def test_a_crowd_goes_out_faster() -> None:
    topics, publishers = make(q__accelerometer=1)
    topics.publish_some(vectors(3 * CROWD))
    assert len(publishers["q/accelerometer"].messages) == 4


def test_odometry_keeps_its_rate() -> None:
    topics, publishers = make(odometry=1, odometry__local=0)
    topics.set_odometry_rate(50.0)
    for k in range(100):
        topics.publish_odometry(Odometry(10**9 + k * 10**7, np.zeros(85), np.zeros(85)))

    assert len(publishers["odometry"].messages) == 50
    assert not publishers["odometry/local"].messages


def test_the_datum_and_diagnostics_on_demand_need_no_listener() -> None:
    topics, publishers = make(datum=0, **{"/diagnostics": 0})
    topics.publish_diagnostics(1, [Status(0, "hybrid_ins: filter", "shut down", [])])

    [message] = publishers["/diagnostics"].decoded("/diagnostics")
    assert [s.message for s in message.status] == ["shut down"]
    assert "datum" in topics._subscribed


def test_statuses_say_which_vehicle_they_are_of() -> None:
    diagnostics, verdicts = Listened(1), Listened(1)
    topics = OutputTopics(parameters.defaults(), "/fleet/rover1", "front_ins")
    topics.publishers |= {"/diagnostics": diagnostics, "gnss/verdict": verdicts}
    topics.find_subscribers()

    topics.publish_diagnostics(1, [Status(0, "hybrid_ins: filter", "fine", [])])

    topics.publish_all([Report("gnss/verdict", Status(0, "hybrid_ins: gnss", "fused", []), 1)])

    [filter_status] = diagnostics.decoded("/diagnostics")[0].status
    [verdict] = verdicts.decoded("gnss/verdict")
    assert filter_status.name == "fleet/rover1: hybrid_ins: filter"
    assert filter_status.hardware_id == verdict.hardware_id == "/fleet/rover1/front_ins"


def test_without_a_namespace_the_hardware_id_is_the_node() -> None:
    topics, publishers = make(**{"/diagnostics": 1})

    topics.publish_diagnostics(1, [Status(0, "hybrid_ins: filter", "fine", [])])

    [message] = publishers["/diagnostics"].decoded("/diagnostics")
    assert message.status[0].hardware_id == "/ins_node"
