"""
The node that a first attempt gives: default executor, typed messages, no mathematics at all.

It takes Imu and NavSatFix and answers each Imu with an Odometry, as any estimator on rclpy must.
What it costs is rclpy; the benchmark holds ``ins_node`` against it.
"""

import sys

import rclpy
from nav_msgs.msg import Odometry
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import QoSProfile, qos_profile_sensor_data
from sensor_msgs.msg import Imu, NavSatFix


class NaiveNode(Node):
    """Answers each Imu with an Odometry of the same stamp."""

    def __init__(self) -> None:
        super().__init__("naive_node")
        self._publisher = self.create_publisher(Odometry, "odometry", 10)
        deep = QoSProfile(depth=2000, reliability=qos_profile_sensor_data.reliability)
        self.create_subscription(Imu, "imu/data", self._on_imu, deep)
        self.create_subscription(NavSatFix, "gnss/fix", self._on_fix, deep)
        self.create_timer(1.0, self._on_second)

    def _on_imu(self, imu: Imu) -> None:
        odometry = Odometry()
        odometry.header.stamp = imu.header.stamp
        odometry.header.frame_id = "map"
        odometry.child_frame_id = "base_link"
        odometry.twist.twist.angular = imu.angular_velocity
        self._publisher.publish(odometry)

    def _on_fix(self, fix: NavSatFix) -> None:
        pass

    def _on_second(self) -> None:
        pass


def main() -> int:
    """Run the node until it is told to stop."""
    rclpy.init()
    node = NaiveNode()
    print("ready", flush=True)
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        rclpy.try_shutdown()
    return 0


if __name__ == "__main__":
    sys.exit(main())
