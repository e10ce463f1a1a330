"""The running node against the tables of its interface: topics, services, QoS, parameters."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
from support.ros_nodes import Client, start_node

from hybrid_ins.parameters.declared import PARAMETERS
from hybrid_ins.parameters.parameter import Parameter
from hybrid_ins.ros.messages import interface, type_names
from tools.processes import Processes

pytest.importorskip("rclpy", reason="no ROS 2 Python packages")
from rcl_interfaces.msg import ParameterType
from rcl_interfaces.srv import DescribeParameters, GetParameters
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy

pytestmark = pytest.mark.live

EVERY_NODE = {"/rosout", "/parameter_events", "/ins_node/transition_event"}
EVERY_NODES_SERVICES = {
    *("describe_parameters", "get_parameter_types", "get_parameters", "list_parameters"),
    *("set_parameters", "set_parameters_atomically", "change_state", "get_state"),
    *("get_available_states", "get_available_transitions", "get_transition_graph"),
    "get_type_description",
}
TYPES = {
    bool: ParameterType.PARAMETER_BOOL,
    int: ParameterType.PARAMETER_INTEGER,
    float: ParameterType.PARAMETER_DOUBLE,
    str: ParameterType.PARAMETER_STRING,
    list: ParameterType.PARAMETER_DOUBLE_ARRAY,
}


def full(name: str) -> str:
    return name.replace("~", "/ins_node") if name[0] in "/~" else f"/{name}"


class Running:
    """A node with every optional package that can be had here, and a client beside it."""

    def __init__(self, client: Client) -> None:
        self.client = client
        has_tf = type_names.TRANSFORMS in client_types()
        self.subscribed = {
            full(t.name): t for t in interface.SUBSCRIBED if has_tf or t.name != "/tf_static"
        }
        self.published = {full(t.name): t for t in interface.PUBLISHED if has_tf or t.name != "/tf"}

    def topics(self, what: str) -> dict[str, list[str]]:
        ask = getattr(self.client.node, f"get_{what}_names_and_types_by_node")
        return {name: kinds for name, kinds in ask("ins_node", "/") if name not in EVERY_NODE}

    def quality(self, topic: str, what: str) -> Any:
        """Return the QoS by which the node is known; the depth is a parameter's value."""
        ends = getattr(self.client.node, f"get_{what}s_info_by_topic")(topic)
        (profile,) = [end.qos_profile for end in ends if end.node_name == "ins_node"]
        name = f"qos_overrides.{topic}.{what}.depth"
        request = GetParameters.Request(names=[name])
        answer = self.client.call(GetParameters, "/ins_node/get_parameters", request)
        return interface.Quality(
            answer.values[0].integer_value,
            profile.reliability == ReliabilityPolicy.RELIABLE,
            profile.durability == DurabilityPolicy.TRANSIENT_LOCAL,
        )


def client_types() -> set[str]:
    try:
        import tf2_msgs.msg  # noqa: F401
    except ImportError:
        return set()
    return {type_names.TRANSFORMS}


@pytest.fixture(scope="module")
def running(types: dict[str, str], tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    log = tmp_path_factory.mktemp("interface") / "node.log"
    with Processes() as processes:
        start_node(processes, log, "-p", "datum:=[32.1, 34.8, 50.0]", environment=types)
        client = Client()
        client.spin_until(lambda: "ins_node" in client.node.get_node_names(), 60.0)
        yield Running(client)
        client.close()


@pytest.mark.parametrize("what", ["subscriber", "publisher"])
def test_topics_have_the_types_of_the_table(running: Running, what: str) -> None:
    expected = running.subscribed if what == "subscriber" else running.published

    running.client.spin_until(lambda: expected.keys() <= running.topics(what).keys(), 60.0)

    assert running.topics(what) == {name: [t.type_name] for name, t in expected.items()}


@pytest.mark.parametrize("what", ["subscription", "publisher"])
def test_topics_have_the_quality_of_service_of_the_table(running: Running, what: str) -> None:
    expected = running.subscribed if what == "subscription" else running.published
    known = getattr(running.client.node, f"get_{what}s_info_by_topic")
    running.client.spin_until(lambda: all(known(name) for name in expected), 60.0)

    assert {name: running.quality(name, what) for name in expected if name[:3] != "/tf"} == {
        name: t.quality for name, t in expected.items() if name[:3] != "/tf"
    }


def test_services_have_the_types_of_the_table(running: Running) -> None:
    expected = {full(s.name): [s.type_name] for s in interface.SERVICES}

    def served() -> dict[str, list[str]]:
        found = running.client.node.get_service_names_and_types_by_node("ins_node", "/")
        return {n: kinds for n, kinds in found if n.split("/")[-1] not in EVERY_NODES_SERVICES}

    running.client.spin_until(lambda: expected.keys() <= served().keys(), 60.0)

    assert served() == expected


def bounds(parameter: Parameter) -> tuple[float, float] | None:
    """Return the range that a parameter's descriptor can have."""
    low = 0.0 if parameter.or_zero else parameter.low
    if isinstance(parameter.default, bool | str | list) or max(abs(low), parameter.high) >= 1e300:
        return None
    return low, parameter.high


def test_parameters_are_described_with_their_ranges(running: Running) -> None:
    request = DescribeParameters.Request(names=list(PARAMETERS))
    answer = running.client.call(DescribeParameters, "/ins_node/describe_parameters", request)
    values = running.client.call(
        GetParameters, "/ins_node/get_parameters", GetParameters.Request(names=list(PARAMETERS))
    ).values

    assert len(answer.descriptors) == len(PARAMETERS) > 50
    for parameter, described, value in zip(
        PARAMETERS.values(), answer.descriptors, values, strict=True
    ):
        assert described.name == parameter.name
        assert parameter.text in described.description
        assert described.read_only == (not parameter.runtime), parameter.name
        ranges = [*described.floating_point_range, *described.integer_range]
        found = [(r.from_value, r.to_value) for r in ranges]
        limits = bounds(parameter)
        assert found == ([] if limits is None else [pytest.approx(limits)]), parameter.name
        if parameter.default != []:  # an empty list has no type in ROS
            assert value.type == TYPES[type(parameter.default)], parameter.name


def test_values_out_of_range_are_refused_with_the_range(running: Running) -> None:
    for parameter in PARAMETERS.values():
        limits = bounds(parameter)
        if parameter.runtime and limits is not None:
            beyond = type(parameter.default)(limits[1] * 2 + 1)
            refused = running.client.set(parameter.name, beyond)
            assert not refused.successful, parameter.name
            assert refused.reason, parameter.name


def test_a_gps_fix_is_heard(running: Running) -> None:
    """GIVEN gps_msgs WHEN a GPSFix comes THEN diagnostics tell its kind, which NavSatFix cannot."""
    from gps_msgs.msg import GPSFix

    client = running.client
    publisher = client.node.create_publisher(GPSFix, "/gnss/gpsfix", 10)
    client.spin_until(lambda: publisher.get_subscription_count() > 0, 60.0)
    message = GPSFix(latitude=32.1, longitude=34.8, altitude=50.0, hdop=0.7, err_horz=0.05)
    message.status.status, message.status.satellites_used = 20, 14

    def told() -> bool:
        message.header.stamp = client.node.get_clock().now().to_msg()
        publisher.publish(message)
        return any(
            {"fix_type": "RTK float", "satellites_used": "14", "hdop": "0.7"}.items()
            <= {pair.key: pair.value for pair in status.values}.items()
            for array in client.diagnostics
            for status in array.status
            if status.name.endswith("input")
        )

    client.spin_until(told, 60.0)
