"""A node that is killed, and starts again with what it had found."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from support.ros_nodes import ENVIRONMENT, Client, start_node, until

from hybrid_ins.cli import simulate
from hybrid_ins.ros.start.saved_state import SavedState
from tools.processes import Processes

pytest.importorskip("rclpy", reason="no ROS 2 Python packages")
from std_srvs.srv import Trigger

pytestmark = pytest.mark.live


def play(processes: Processes, bag: Path) -> None:
    command = [sys.executable, "-m", "hybrid_ins.cli.play", str(bag), "--rate", "4"]
    player = processes.start(command, subprocess.PIPE, ENVIRONMENT)
    text, _ = player.communicate(timeout=90)
    assert player.returncode == 0, text


@pytest.mark.slow
def test_a_killed_node_starts_with_the_heading_that_it_had(
    processes: Processes, tmp_path: Path, client: Client
) -> None:
    """GIVEN a parked vehicle WHEN its node is killed THEN the next knows the heading at once."""
    bag, file = tmp_path / "parked.mcap", tmp_path / "state.yaml"
    words = [str(bag), "--trajectory", "static", "--duration", "12", "--imu-rate", "50"]
    assert simulate.main(words) == 0
    state = ("-p", f"state_file:={file}", "-p", "alignment.yaw_std:=0.01")
    logs = [tmp_path / f"{name}.log" for name in ("first", "second", "third")]

    node = start_node(processes, logs[0], *state)
    early = client.call(Trigger, "/ins_node/save", Trigger.Request(), 60.0)  # it is still starting
    assert not early.success
    assert "does not run yet" in early.message
    play(processes, bag)
    answer = client.call(Trigger, "/ins_node/save", Trigger.Request())
    assert answer.success, answer.message
    node.kill()
    node.wait()
    assert SavedState.read(file).standing

    node = start_node(processes, logs[1], *state, heading=False)
    assert f"loaded from {file}" in logs[1].read_text()
    play(processes, bag)
    until(lambda: "aligned: heading known to 2.0" in logs[1].read_text(), 30.0)
    assert "the vehicle has not moved" in logs[1].read_text()
    loaded = client.call(Trigger, "/ins_node/load", Trigger.Request())
    assert loaded.success, loaded.message
    assert processes.stop(node) == 0

    file.write_text("not what it was")
    start_node(processes, logs[2], *state, heading=False)
    assert f"{file}: no saved state of version 1: delete it; it is ignored" in logs[2].read_text()
