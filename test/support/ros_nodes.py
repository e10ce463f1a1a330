"""The real node in a process of its own, and an rclpy node of the test that asks it."""

from __future__ import annotations

import math
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from support.paths import ROOT

from tools.processes import Processes

ENVIRONMENT = {"PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}
# With a clock that is known as well, nothing is searched for when a short flight begins.
HEADING = [
    "alignment.heading_source:=parameter",
    f"alignment.yaw:={math.pi / 2:.6f}",
    "gnss.time_offset.estimate:=false",
]


def start_node(
    processes: Processes,
    log: Path,
    *words: str,
    said: str = "ready",
    heading: bool = True,
    environment: dict[str, str] | None = None,
) -> subprocess.Popen[str]:
    """Start ``ins_node`` and wait until it has said something; the heading is given to it."""
    parameters = [word for value in HEADING for word in ("-p", value)] if heading else []
    with log.open("w") as output:
        node = processes.start(
            [sys.executable, "-m", "hybrid_ins.ros.node", "--ros-args", *parameters, *words],
            output,
            ENVIRONMENT | (environment or {}),
        )
    if said:
        until(lambda: said in log.read_text() or node.poll() is not None, 90.0)
        assert said in log.read_text(), log.read_text()
    return node


def start_player(
    processes: Processes, flight: Path, out: Path, rate: float
) -> subprocess.Popen[str]:
    """Start ``ins_play``, which records what comes back."""
    words = [str(flight), "--record", str(out), "--rate", f"{rate:g}"]
    return processes.start(
        [sys.executable, "-m", "hybrid_ins.cli.play", *words], subprocess.PIPE, ENVIRONMENT
    )


def until(condition: Any, patience: float = 15.0) -> None:
    """Wait until a condition holds."""
    end = time.monotonic() + patience
    while not condition():
        assert time.monotonic() < end, "waited too long"
        time.sleep(0.05)


class Client:
    """An rclpy node that asks and listens."""

    def __init__(self) -> None:
        import rclpy
        from diagnostic_msgs.msg import DiagnosticArray
        from rclpy.executors import SingleThreadedExecutor

        self._rclpy = rclpy
        self.context = rclpy.Context()
        rclpy.init(context=self.context)
        self.node = rclpy.create_node("asking", context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        self.diagnostics: list[Any] = []
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self.diagnostics.append, 10)

    def spin_until(self, condition: Any, patience: float = 15.0) -> None:
        end = time.monotonic() + patience
        while not condition():
            assert time.monotonic() < end, "waited too long"
            self.executor.spin_once(0.1)

    def call(self, kind: Any, name: str, request: Any, patience: float = 15.0) -> Any:
        client = self.node.create_client(kind, name)
        assert client.wait_for_service(30.0), name
        answer = client.call_async(request)
        self.spin_until(answer.done, patience)
        return answer.result()

    def set(self, name: str, value: Any, node: str = "/ins_node") -> Any:
        from rcl_interfaces.srv import SetParameters
        from rclpy.parameter import Parameter

        request = SetParameters.Request(
            parameters=[Parameter(name, value=value).to_parameter_msg()]
        )
        return self.call(SetParameters, f"{node}/set_parameters", request).results[0]

    def close(self) -> None:
        self.node.destroy_node()
        self._rclpy.shutdown(context=self.context)
