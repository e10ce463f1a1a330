"""ins_status beside a running node, and two vehicles in one ROS domain."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from support.ros_nodes import ENVIRONMENT, start_node, until

from hybrid_ins.cli import simulate
from tools.processes import Processes

pytest.importorskip("rclpy", reason="no ROS 2 Python packages")

pytestmark = pytest.mark.live

STATUS = [sys.executable, "-m", "hybrid_ins.cli.status"]


def ask(*words: str) -> tuple[int, str]:
    done = subprocess.run(
        [*STATUS, *words],
        capture_output=True,
        text=True,
        timeout=90,
        env=os.environ | ENVIRONMENT,
        check=False,
    )
    assert "Traceback" not in done.stderr, done.stderr
    return done.returncode, done.stdout


@pytest.mark.slow
def test_two_vehicles_are_told_apart(processes: Processes, tmp_path: Path) -> None:
    """
    GIVEN nodes in two namespaces, one of which gets a flight WHEN asked THEN each has its status.
    """
    bag = tmp_path / "flight.mcap"
    assert simulate.main([str(bag), "--duration", "40", "--imu-rate", "100"]) == 0
    for name in ("rover1", "rover2"):
        frames = [
            word
            for frame in ("map", "odom", "base")
            for word in ("-p", f"{frame}_frame:={name}/{frame}")
        ]
        start_node(processes, tmp_path / f"{name}.log", "-r", f"__ns:=/{name}", *frames, said="")
    for name in ("rover1", "rover2"):
        log = tmp_path / f"{name}.log"
        until(lambda log=log: "ready" in log.read_text(), 90.0)
    topics = ["/imu/data:=/rover1/imu/data", "/gnss/fix:=/rover1/gnss/fix"]
    play = [sys.executable, "-m", "hybrid_ins.cli.play", str(bag), "--remap", *topics]
    processes.start(play, subprocess.DEVNULL, ENVIRONMENT)

    level, output = ask("--once", "--json", "--wait", "20", "--namespace", "rover1")
    for _ in range(12):  # until the flight is well under way
        found = json.loads(output)
        state = found["statuses"].get("filter", {"values": {"state": ""}})["values"]["state"]
        if level == 0 and found["fixes"]["judged"] and state == "aligned":
            break
        level, output = ask("--once", "--json", "--namespace", "rover1")
    first = json.loads(output)
    _, output = ask("--once", "--json", "--wait", "20", "--namespace", "/rover2/")
    second = json.loads(output)

    assert level == 0
    state = first["statuses"]["filter"]["values"]["state"]
    assert state in ("aligned", "dead reckoning", "no IMU samples")  # once the flight is over
    assert first["fixes"]["judged"] > 0
    assert first["verdict"]["kind"] == "position"
    assert second["statuses"]["imu"]["level"] == "ERROR"
    assert "/rover2/imu/data" in second["statuses"]["imu"]["message"]
    assert second["verdict"] is None
    level, text = ask("--once", "--wait", "5")
    assert level == 1 and "/rover" in text and "choose by --namespace" in text
    _, text = ask("--once", "--wait", "20", "--namespace", "rover1")
    assert "σ heading" in " ".join(text.split()), text


def test_nothing_heard_is_an_exit_status() -> None:
    level, text = ask("--once", "--wait", "1")

    assert level == 1
    assert "is ins_node active" in text


def test_it_ends_when_nobody_reads_it_any_more(processes: Processes) -> None:
    """GIVEN ``ins_status --json | head -1`` WHEN the reader has its line THEN both end."""
    status = processes.start([*STATUS, "--json"], subprocess.PIPE, ENVIRONMENT)
    assert status.stdout is not None
    assert status.stdout.readline().startswith("{")
    status.stdout.close()

    assert status.wait(30.0) == 0


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["--namespace", "a b"], "Invalid namespace"),
        (["--ros-args", "--none"], "unknown ROS arguments: "),
    ],
)
def test_a_wrong_argument_is_one_line(words: list[str], complaint: str) -> None:
    done = subprocess.run(
        [*STATUS, "--once", *words], capture_output=True, text=True, timeout=60, check=False
    )

    assert done.returncode == 2
    assert done.stderr.startswith(f"ins_status: error: {complaint}")
    assert done.stderr.count("\n") == 1
