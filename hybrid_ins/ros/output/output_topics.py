"""
Publishing of odometry and reports: only on topics with subscribers, and not in bursts.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, Protocol

from hybrid_ins import parameters
from hybrid_ins.ros.messages.cdr import OdometryEncoder
from hybrid_ins.ros.messages.interface import QUALITY
from hybrid_ins.ros.output.message_types import encode
from hybrid_ins.ros.output.rate_limiter import RateLimiter
from hybrid_ins.ros.reporting.reports import Diagnostics, Odometry, Report, Status

CROWD = 8  # waiting reports of which more than one goes out with a sample


class Publisher(Protocol):
    """A publisher of rclpy."""

    def publish(self, message: Any) -> None:
        """Publish a message object, or its bytes."""

    def get_subscription_count(self) -> int:
        """Return how many subscribers there are."""

    def wait_for_all_acked(self, timeout: Any) -> bool:
        """Wait until the subscribers have what was published."""


class OutputTopics:
    """
    The node's publishers.

    Parameters
    ----------
    values : mapping
        Checked parameters.
    namespace, node_name : str
        Those of the node: names and hardware_id of statuses distinguish several vehicles.

    Attributes
    ----------
    publishers : dict
        By topic, to be filled before the first `find_subscribers`.
    """

    def __init__(
        self,
        values: Mapping[str, Any],
        namespace: str = "/",
        node_name: str = parameters.NODE_NAME,
    ) -> None:
        self._prefix = prefix_of(namespace)
        self._hardware_id = f"{namespace.rstrip('/')}/{node_name}"
        self.publishers: dict[str, Publisher] = {}
        self._map_encoder = OdometryEncoder(values["map_frame"], values["base_frame"])
        self._odom_encoder = OdometryEncoder(values["odom_frame"], values["base_frame"])
        self._odometry_due = RateLimiter(values["odometry_rate"])
        self._waiting: deque[Report] = deque()
        self._subscribed: dict[str, Callable[[Any], None]] = {}

    def set_odometry_rate(self, rate: float) -> None:
        """Publish odometry at another rate [Hz]; 0: with every IMU sample."""
        self._odometry_due.change(rate)

    def find_subscribers(self, _event: object = None) -> None:
        """Find the topics worth publishing on: those with subscribers, and latched ones."""
        self._subscribed = {
            topic: publisher.publish
            for topic, publisher in self.publishers.items()
            if QUALITY[topic].transient_local or publisher.get_subscription_count()
        }

    def publish_odometry(self, odometry: Odometry) -> None:
        """Publish odometry where it is due."""
        if not self._odometry_due.is_due(odometry.t_ns):
            return
        publish = self._subscribed.get("odometry")
        if publish is not None:
            publish(self._map_encoder.encode_values(odometry.t_ns, odometry.in_map))
        publish = self._subscribed.get("odometry/local")
        if publish is not None:
            publish(self._odom_encoder.encode_values(odometry.t_ns, odometry.in_odom))

    def publish_some(self, reports: Sequence[Report]) -> None:
        """Publish one of the reports that wait, or a few: IMU samples are not to wait for all."""
        self._waiting.extend(reports)
        if self._waiting:
            self._publish_waiting(1 + len(self._waiting) // CROWD)

    def publish_all(self, reports: Sequence[Report]) -> None:
        """Publish all reports that wait."""
        self._waiting.extend(reports)
        self._publish_waiting(len(self._waiting))

    def _publish_waiting(self, most: int) -> None:
        while self._waiting and most:
            report = self._waiting.popleft()
            publish = self._subscribed.get(report.topic)
            if publish is not None:
                publish(self._message(report))
                most -= 1

    def publish_diagnostics(self, t_ns: int, statuses: Sequence[Status]) -> None:
        """Publish diagnostics at once, with or without subscribers."""
        report = Report("/diagnostics", Diagnostics(t_ns, statuses), t_ns)
        self.publishers["/diagnostics"].publish(self._message(report))

    def _message(self, report: Report) -> bytes:
        content = report.content
        if self._prefix and isinstance(content, Diagnostics):
            named = [s._replace(name=self._prefix + s.name) for s in content.statuses]
            report = replace(report, content=replace(content, statuses=named))
        return encode(report, self._hardware_id)


def prefix_of(namespace: str) -> str:
    """Return what the names of a node's statuses begin with in its namespace; empty in ``/``."""
    name = namespace.strip("/")
    return f"{name}: " if name else ""
