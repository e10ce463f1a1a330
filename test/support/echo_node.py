"""A stand-in for an estimator: answers each Imu with an Odometry of the same stamp, as bytes."""

import sys

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import Odometry
from rclpy.experimental import EventsExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.task import Future
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Imu, NavSatFix

from hybrid_ins.ros.messages.cdr import ImuDecoder, OdometryEncoder


class EchoNode(Node):  # type: ignore[misc]
    def __init__(self) -> None:
        super().__init__("echo_node")
        self.seen = {"imu": 0, "clock": 0, "fix": 0}
        self._decode = ImuDecoder().decode
        self._encoder = OdometryEncoder("map", "base_link")
        sensor = QoSProfile(depth=1000, reliability=ReliabilityPolicy.BEST_EFFORT)
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._odometry = self.create_publisher(Odometry, "odometry", 1000)
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", sensor)
        self._datum = self.create_publisher(NavSatFix, "datum", latched)
        self._datum.publish(NavSatFix())
        self.create_subscription(Imu, "imu/data", self._on_imu, sensor, raw=True)
        self.create_subscription(NavSatFix, "gnss/fix", self._on_fix, sensor)
        self.create_subscription(Clock, "/clock", self._on_clock, sensor, raw=True)

    def _on_imu(self, data: bytes) -> None:
        sample = self._decode(data)
        self.seen["imu"] += 1
        self._encoder.position[:] = sample.specific_force
        self._encoder.linear[0] = self.seen["imu"]
        self._encoder.pose_covariance[:] = np.eye(6)
        self._odometry.publish(self._encoder.message(sample.stamp_ns))

    def _on_fix(self, fix: NavSatFix) -> None:
        self.seen["fix"] += 1
        self._diagnostics.publish(DiagnosticArray(header=fix.header))

    def _on_clock(self, data: bytes) -> None:
        self.seen["clock"] += 1


def main() -> None:
    rclpy.init()
    node = EchoNode()
    executor = EventsExecutor()
    executor.add_node(node)
    never = Future()
    print("ready", flush=True)
    try:
        while rclpy.ok():
            executor.spin_until_future_complete(never, 0.2)
    finally:
        print(node.seen, flush=True)


if __name__ == "__main__":
    sys.exit(main())
