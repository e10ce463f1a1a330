"""
Two processes that a node is measured between: one sends IMU and GNSS, the other takes odometry.

    python -m tools.benchmark.imu_load send RATE DURATION OUT.npy [--aiding]
    python -m tools.benchmark.imu_load take OUT.npy [--times]

The first writes the stamps [ns] of the Imu messages that it sent, with --aiding beside the velocity
of wheels and the pressure of a barometer; the second those of the Odometry
messages that came until SIGTERM, with the times at which they were published.

A stamp is the wall clock's time right before the message was given to the middleware, so that the
publication time of its answer says what happened to it in between.
"""

from __future__ import annotations

import argparse
import signal
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from geometry_msgs.msg import TwistWithCovarianceStamped
from nav_msgs.msg import Odometry
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.experimental import EventsExecutor
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.task import Future
from sensor_msgs.msg import FluidPressure, Imu, NavSatFix

from hybrid_ins.ros.messages.cdr import StampedEncoder
from hybrid_ins.ros.messages.conversions import DIAGONAL, set_stamp

FIX_PERIOD_NS, AIDING_PERIOD_NS = 200_000_000, 20_000_000
NOISE = np.array([0.002] * 3 + [0.02] * 3)  # rad/s, m/s²: an MPU-9250
LATENCY_OF_FIX_NS = 50_000_000
DEEP = QoSProfile(depth=20_000, reliability=ReliabilityPolicy.BEST_EFFORT)


def send(rate: float, duration: float, out: Path, aiding: bool) -> None:
    """Send Imu at a rate and fixes at 5 Hz, once somebody listens, of a vehicle that hovers."""
    rclpy.init()
    node = rclpy.create_node("imu_load")
    publisher = node.create_publisher(Imu, "imu/data", DEEP)
    fixes = node.create_publisher(NavSatFix, "gnss/fix", DEEP)
    imu = StampedEncoder(("imu_link",), 37)
    imu.values[3] = 1.0  # level, facing east
    imu.values[[4, 8, 12]] = 0.01
    fix = NavSatFix(latitude=32.1, longitude=34.8, altitude=50.0)
    fix.header.frame_id, fix.status.status, fix.status.service = "gnss", 0, 0
    fix.position_covariance = np.diag([0.01, 0.01, 0.02]).ravel()
    fix.position_covariance_type = DIAGONAL
    velocities = node.create_publisher(TwistWithCovarianceStamped, "aiding/velocity", DEEP)
    pressures = node.create_publisher(FluidPressure, "aiding/pressure", DEEP)
    velocity = TwistWithCovarianceStamped()
    velocity.header.frame_id = "base_link"
    velocity.twist.covariance = np.diag([0.01] * 6).ravel()
    pressure = FluidPressure(fluid_pressure=101_325.0, variance=25.0)
    noise = np.random.default_rng(0).normal(size=(4096, 6)) * NOISE
    end = time.monotonic() + 20.0
    while publisher.get_subscription_count() == 0:
        if time.monotonic() > end:
            raise SystemExit("imu_load.py: nobody listens to imu/data")
        time.sleep(0.02)
    period = 1.0 / rate
    sent = np.zeros(int(rate * duration) + 1, np.int64)
    next_fix_ns = next_aiding_ns = 0
    start = time.perf_counter()
    publish, values, message = publisher.publish, imu.values, imu.message
    for k in range(len(sent)):
        ahead = start + k * period - time.perf_counter()
        if ahead > 2e-5:
            time.sleep(ahead)
        row = noise[k & 4095]
        values[13:16] = row[:3]
        values[25:28] = row[3:]
        values[27] += 9.8
        t_ns = time.time_ns()
        sent[k] = t_ns
        publish(message(t_ns))
        if t_ns >= next_fix_ns:
            next_fix_ns = t_ns + FIX_PERIOD_NS
            set_stamp(fix.header.stamp, t_ns - LATENCY_OF_FIX_NS)
            fixes.publish(fix)
        if aiding and t_ns >= next_aiding_ns:
            next_aiding_ns = t_ns + AIDING_PERIOD_NS
            set_stamp(velocity.header.stamp, t_ns)
            velocities.publish(velocity)
            set_stamp(pressure.header.stamp, t_ns)
            pressures.publish(pressure)
    np.save(out, sent)
    time.sleep(0.5)  # what is on the way arrives
    rclpy.try_shutdown()


def take(out: Path, times: bool) -> None:
    """Take Odometry until SIGTERM."""
    rclpy.init()
    node = rclpy.create_node("odometry_take")
    stamps: list[bytes] = []
    published: list[int] = []
    add, add_time = stamps.append, published.append
    reliable = QoSProfile(depth=20_000, reliability=ReliabilityPolicy.RELIABLE)

    def with_time(data: bytes, info: dict[str, Any]) -> None:
        add(data[4:12])
        add_time(info["source_timestamp"])

    def without_time(data: bytes) -> None:
        add(data[4:12])

    node.create_subscription(
        Odometry, "odometry", with_time if times else without_time, reliable, raw=True
    )
    # The faster executor does not hand over when a message was published.
    executor = SingleThreadedExecutor() if times else EventsExecutor()
    executor.add_node(node)
    asked_to_stop: Future[None] = Future()
    signal.signal(signal.SIGTERM, lambda *_: asked_to_stop.set_result(None))
    print("ready", flush=True)
    try:
        while rclpy.ok() and not asked_to_stop.done():
            executor.spin_until_future_complete(asked_to_stop, 0.2)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    seconds = np.frombuffer(b"".join(stamps), "<i4")[::2].astype(np.int64)
    nanoseconds = np.frombuffer(b"".join(stamps), "<u4")[1::2]
    np.save(
        out,
        np.stack(
            (
                seconds * 1_000_000_000 + nanoseconds,
                np.array(published if times else np.zeros(len(stamps)), np.int64),
            )
        ),
    )
    rclpy.try_shutdown()


def main() -> int:
    """Run one of the two."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(dest="command", required=True)
    sending = commands.add_parser("send")
    sending.add_argument("rate", type=float)
    sending.add_argument("duration", type=float)
    sending.add_argument("out", type=Path)
    sending.add_argument("--aiding", action="store_true")
    taking = commands.add_parser("take")
    taking.add_argument("out", type=Path)
    taking.add_argument("--times", action="store_true")
    args = parser.parse_args()
    if args.command == "send":
        send(args.rate, args.duration, args.out, args.aiding)
    else:
        take(args.out, args.times)
    return 0


if __name__ == "__main__":
    sys.exit(main())
