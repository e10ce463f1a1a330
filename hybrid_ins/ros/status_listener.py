"""
Listens to the diagnostics and verdicts of a running node.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

try:
    import rclpy
except ModuleNotFoundError as error:
    if error.name != "rclpy":
        raise
    rclpy = None
from hybrid_ins.errors import InputError
from hybrid_ins.ros import node_arguments
from hybrid_ins.ros.output.output_topics import prefix_of
from hybrid_ins.ros.reporting.reports import Status
from hybrid_ins.ros.reporting.status_view import NodeStatus

OURS = "hybrid_ins: "
STEP = 0.1  # s, between two checks of the clock


class StatusListener:
    """
    A ROS node that collects what ``ins_node`` says of itself.

    Parameters
    ----------
    namespace : str
        That of the node, such as ``/rover1``.
    ros_args : sequence of str
        Arguments for ROS.

    Attributes
    ----------
    status : NodeStatus

    Raises
    ------
    InputError
        ROS 2 is not installed, or the namespace or the arguments are not valid.
    """

    def __init__(self, namespace: str, ros_args: Sequence[str] = ()) -> None:
        if rclpy is None:
            raise InputError(
                'ROS 2 is not installed: source its setup.bash, or pip install "hybrid_ins[ros]"'
            )
        from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
        from rclpy._rclpy_pybind11 import UnknownROSArgsError
        from rclpy.validate_namespace import validate_namespace

        self.status = NodeStatus()
        self._heard = -1.0
        namespace = "/" + namespace.strip("/")
        self._prefix = prefix_of(namespace) + OURS
        try:
            validate_namespace(namespace)  # rclpy would print a warning besides
            rclpy.init(args=["ins_status", *ros_args])
            self._node = rclpy.create_node("ins_status", namespace=namespace)
        except Exception as error:  # rclpy's errors share no public base
            rclpy.try_shutdown()
            unknown = isinstance(error, UnknownROSArgsError)
            what = "unknown ROS arguments: " if unknown else ""
            raise InputError(what + node_arguments.reason_of(error)) from None
        self._node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 10)
        self._node.create_subscription(DiagnosticStatus, "gnss/verdict", self._on_verdict, 50)

    def close(self) -> None:
        """Leave ROS."""
        self._node.destroy_node()
        rclpy.try_shutdown()

    def listen(self, seconds: float, enough: Callable[[], bool] = lambda: False) -> None:
        """Listen for some seconds, or until that is enough."""
        end = time.monotonic() + seconds
        while time.monotonic() < end and not enough():
            rclpy.spin_once(self._node, timeout_sec=STEP)

    @property
    def age(self) -> float:
        """Time since the last diagnostics [s]; infinite before the first."""
        return float("inf") if self._heard < 0.0 else time.monotonic() - self._heard

    def _on_diagnostics(self, message: Any) -> None:
        found = [s.name.partition(OURS) for s in message.status if OURS in s.name]
        self.status.elsewhere |= {f"/{prefix.removesuffix(': ')}" for prefix, _, _ in found}
        ours = [status for status in message.status if status.name.startswith(self._prefix)]
        if not ours:
            return
        self._heard = time.monotonic()
        self.status.statuses = {s.name[len(self._prefix) :]: _status(s) for s in ours}

    def _on_verdict(self, message: Any) -> None:
        self.status.verdicts.append(_status(message))


def _status(message: Any) -> Status:
    level = message.level[0] if isinstance(message.level, bytes) else int(message.level)
    values = [(pair.key, pair.value) for pair in message.values]
    return Status(min(level, 3), message.name, message.message, values)
