"""
The node under a lifecycle manager, which asks as nav2_lifecycle_manager does.

That manager waits for the services ``change_state`` and ``get_state`` of each node, sends the
numbers of transitions, and looks at the answer and at the state that follows.
"""

from __future__ import annotations

import importlib.util
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from support.ros_nodes import ENVIRONMENT, Client, start_node, start_player, until

from hybrid_ins.bags.reader import BagReader
from hybrid_ins.cli import simulate
from tools.processes import Processes

pytest.importorskip("rclpy", reason="no ROS 2 Python packages")
from diagnostic_msgs.msg import DiagnosticStatus
from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import ChangeState, GetAvailableTransitions, GetState
from rclpy.qos import DurabilityPolicy, QoSProfile

pytestmark = pytest.mark.live

MANAGED = ("-p", "autostart:=false")
UNCONFIGURED, INACTIVE, ACTIVE, FINALIZED = (
    State.PRIMARY_STATE_UNCONFIGURED,
    State.PRIMARY_STATE_INACTIVE,
    State.PRIMARY_STATE_ACTIVE,
    State.PRIMARY_STATE_FINALIZED,
)
CONFIGURE, CLEANUP, ACTIVATE, DEACTIVATE = (
    Transition.TRANSITION_CONFIGURE,
    Transition.TRANSITION_CLEANUP,
    Transition.TRANSITION_ACTIVATE,
    Transition.TRANSITION_DEACTIVATE,
)
NAMES = {
    CONFIGURE: "configure",
    CLEANUP: "clean up",
    ACTIVATE: "activate",
    DEACTIVATE: "deactivate",
    Transition.TRANSITION_ACTIVE_SHUTDOWN: "shut down",
}


class Manager(Client):
    """Asks as a lifecycle manager does, and keeps a transcript."""

    def __init__(self) -> None:
        super().__init__()
        self.transcript: list[str] = []

    def change(self, transition: int, name: str = "/ins_node") -> bool:
        request = ChangeState.Request(transition=Transition(id=transition))
        answer = self.call(ChangeState, f"{name}/change_state", request, 60.0)
        state = self.call(GetState, f"{name}/get_state", GetState.Request()).current_state
        asked = NAMES.get(transition, transition)
        answered = "success" if answer.success else "no success"
        self.transcript.append(f"{asked}: {answered}, {state.label}")
        return bool(answer.success)

    def state(self, name: str = "/ins_node") -> int:
        answer = self.call(GetState, f"{name}/get_state", GetState.Request())
        return int(answer.current_state.id)

    def topics(self) -> set[str]:
        """What the node publishes and subscribes to; its answers come before it is discovered."""
        node, patience = self.node, time.monotonic() + 30.0
        while "ins_node" not in node.get_node_names() and time.monotonic() < patience:
            time.sleep(0.1)
        names = node.get_publisher_names_and_types_by_node("ins_node", "/")
        names += node.get_subscriber_names_and_types_by_node("ins_node", "/")
        return {name for name, _ in names}


@pytest.fixture
def manager() -> Iterator[Manager]:
    asking = Manager()
    yield asking
    asking.close()
    print("\n" + "\n".join(asking.transcript))


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    bag = tmp_path_factory.mktemp("lifecycle") / "flight.mcap"
    assert simulate.main([str(bag), "--duration", "12", "--imu-rate", "50"]) == 0
    return bag


def count(bag: Path, topic: str) -> int:
    with BagReader(bag) as reader:
        return reader.count(topic) if topic in reader.topics else 0


@pytest.mark.slow
def test_a_manager_brings_the_node_up_and_down(
    processes: Processes, tmp_path: Path, manager: Manager, flight: Path
) -> None:
    """GIVEN autostart false WHEN a manager asks THEN each state has what belongs to it."""
    log = tmp_path / "node.log"
    node = start_node(processes, log, *MANAGED, said="unconfigured")
    assert manager.state() == UNCONFIGURED
    assert "/imu/data" not in manager.topics()
    assert "/odometry" not in manager.topics()
    assert manager.set("imu.position", [0.1, 0.0, 0.0]).successful  # nothing is in force yet
    assert not manager.set("gnss.patience", -1.0).successful

    assert manager.change(CONFIGURE)
    assert manager.state() == INACTIVE
    manager.spin_until(lambda: "/odometry" in manager.topics())
    assert "/imu/data" not in manager.topics()
    refused = manager.set("imu.position", [0.2, 0.0, 0.0])
    assert "takes effect only at the start" in refused.reason

    told: list[str] = []
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    manager.node.create_subscription(
        DiagnosticStatus, "/validity", lambda message: told.append(message.message), latched
    )

    assert manager.change(ACTIVATE)
    assert manager.state() == ACTIVE
    assert "ready: waiting for" in log.read_text()
    manager.spin_until(lambda: "/imu/data" in manager.topics())
    first = tmp_path / "first.mcap"
    text, _ = start_player(processes, flight, first, 4.0).communicate(timeout=60)
    assert count(first, "/odometry") > 400, text

    assert manager.change(DEACTIVATE)
    assert manager.state() == INACTIVE
    manager.spin_until(
        lambda: any(d.status[0].message.startswith("inactive; ") for d in manager.diagnostics)
    )
    manager.spin_until(lambda: "/imu/data" not in manager.topics())

    assert manager.change(ACTIVATE)
    second = tmp_path / "second.mcap"
    player = start_player(processes, flight, second, 4.0)
    manager.spin_until(lambda: told[-1].startswith("position good"), 60.0)  # it aligned again
    assert manager.change(DEACTIVATE)  # while samples come
    lost = "position lost, velocity lost, heading lost"
    manager.spin_until(lambda: told[-1] == lost)
    manager.spin_until(lambda: manager.diagnostics[-1].status[0].message.startswith("inactive; "))
    last = {status.name: status.message for status in manager.diagnostics[-1].status}
    assert last["hybrid_ins: validity"] == lost
    processes.stop(player)
    assert manager.change(CLEANUP)
    assert manager.state() == UNCONFIGURED
    manager.spin_until(lambda: "/odometry" not in manager.topics())
    assert manager.set("imu.position", [0.0, 0.0, 0.0]).successful
    assert manager.change(CONFIGURE)
    assert manager.change(ACTIVATE)
    before = len(manager.diagnostics)
    manager.spin_until(lambda: len(manager.diagnostics) > before)  # it hears the new publisher
    before = len(manager.diagnostics)
    assert manager.change(Transition.TRANSITION_ACTIVE_SHUTDOWN)
    assert manager.state() == FINALIZED
    manager.spin_until(
        lambda: any(
            d.status[0].message.startswith("shut down; ") for d in manager.diagnostics[before:]
        )
    )
    assert processes.stop(node) == 0, log.read_text()
    assert "Traceback" not in log.read_text()
    assert "internal error" not in log.read_text()


def test_a_failing_configure_can_be_repeated(
    processes: Processes, tmp_path: Path, manager: Manager
) -> None:
    """GIVEN a model that is missing WHEN configured THEN it fails until the parameter is set."""
    log = tmp_path / "node.log"
    model = tmp_path / "missing.onnx"
    wrong = ("-p", f"noise.model:={model}", "-p", "base_frame:=map")
    node = start_node(processes, log, *MANAGED, *wrong, said="unconfigured")

    assert not manager.change(CONFIGURE)
    assert manager.state() == UNCONFIGURED
    assert "base_frame" in log.read_text()  # contradicts map_frame
    assert manager.set("base_frame", "base_link").successful

    assert not manager.change(CONFIGURE)
    assert manager.state() == UNCONFIGURED
    _, line = [text for text in log.read_text().splitlines() if "ERROR" in text]
    assert "configure: " in line
    assert str(model) in line
    assert "No such file" in line

    assert manager.set("noise.model", "spectral").successful
    assert manager.change(CONFIGURE)
    assert manager.change(ACTIVATE)
    assert manager.state() == ACTIVE
    assert processes.stop(node) == 0
    assert "Traceback" not in log.read_text()


def test_a_qos_that_cannot_be_fails_at_activate(
    processes: Processes, tmp_path: Path, manager: Manager
) -> None:
    log = tmp_path / "node.log"
    wrong = ("-p", "qos_overrides./imu/data.subscription.reliability:=perhaps")
    node = start_node(processes, log, *MANAGED, *wrong, said="unconfigured")

    assert manager.change(CONFIGURE)
    assert not manager.change(ACTIVATE)
    assert manager.state() == INACTIVE
    assert "activate: imu/data: Unexpected QoS" in log.read_text()
    assert manager.change(CLEANUP)
    assert manager.change(CONFIGURE)
    assert manager.state() == INACTIVE
    assert processes.stop(node) == 0, log.read_text()  # SIGTERM while inactive
    assert "Traceback" not in log.read_text()


BROKEN = """
import sys
from hybrid_ins.ros import node
from hybrid_ins.ros.live_estimator import LiveEstimator
sound = LiveEstimator.activate
def activate(self):
    LiveEstimator.activate = sound
    raise ZeroDivisionError("of the test")
LiveEstimator.activate = activate
sys.exit(node.main(["--ros-args", "-p", "autostart:=false"]))
"""


def test_an_error_in_a_transition_leads_back_to_unconfigured(
    processes: Processes, tmp_path: Path, manager: Manager
) -> None:
    """GIVEN an error of the program WHEN activated THEN all is discarded, and may begin again."""
    log = tmp_path / "node.log"
    with log.open("w") as output:
        node = processes.start([sys.executable, "-c", BROKEN], output, ENVIRONMENT)

    assert manager.change(CONFIGURE)
    assert not manager.change(ACTIVATE)
    assert manager.state() == UNCONFIGURED
    assert "internal error: ZeroDivisionError" in log.read_text()
    manager.spin_until(lambda: "/odometry" not in manager.topics())
    assert manager.change(CONFIGURE)
    assert manager.change(ACTIVATE)
    assert processes.stop(node) == 0


@pytest.mark.slow
def test_a_manager_may_restart_an_autostarted_node(
    processes: Processes, tmp_path: Path, manager: Manager
) -> None:
    """GIVEN an active node WHEN it is to be activated or configured THEN the answer is no."""
    log = tmp_path / "node.log"
    node = start_node(processes, log)

    assert manager.state() == ACTIVE  # by autostart
    for package in ("robot_localization", "gps_msgs"):
        if importlib.util.find_spec(package) is None:
            assert log.read_text().count(f"{package} is not installed") == 1
    assert not manager.change(ACTIVATE)
    assert not manager.change(CONFIGURE)
    assert not manager.change(99)
    assert manager.state() == ACTIVE
    possible = manager.call(
        GetAvailableTransitions,
        "/ins_node/get_available_transitions",
        GetAvailableTransitions.Request(),
    ).available_transitions
    assert {t.transition.label for t in possible} == {"deactivate", "shutdown"}
    until(lambda: "not in the present state" in log.read_text(), 30.0)

    for transition in (DEACTIVATE, CLEANUP, CONFIGURE, ACTIVATE, DEACTIVATE, CLEANUP):
        assert manager.change(transition), manager.transcript
    assert manager.state() == UNCONFIGURED
    assert processes.stop(node) == 0, log.read_text()  # SIGTERM while unconfigured
    assert "Traceback" not in log.read_text()
