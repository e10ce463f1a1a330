"""
Random bytes and random messages on every topic of the live node, which has to survive them.

Byte strings are noise, headers without a message, cut messages and messages with flipped bits.
Messages are well formed; their numbers and texts are random: odd values, or random bits. Afterwards
a sound flight is played: the node has to navigate it.
"""

from __future__ import annotations

import argparse
import importlib
import os
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hybrid_ins.bags.messages import TYPES, new_message
from hybrid_ins.cli import options, simulate
from hybrid_ins.cli import program as shell
from hybrid_ins.ros.aids import aiding_sources
from hybrid_ins.ros.messages.type_names import FIX, IMU, POSE, TWIST
from tools.processes import Processes, isolated_ros, program
from tools.robustness.soak import resident

INPUTS = {
    "imu/data": IMU,
    "gnss/fix": FIX,
    "gnss/velocity": TWIST,
    "initialpose": POSE,
    **aiding_sources.TOPICS,
}
ODD = (np.nan, np.inf, -np.inf, 0.0, -1.0, 1.0, 9.81, 90.0, 1e3, 1e9, 1e308, -1e308, 5e-324)
HEADER = b"\0\1\0\0"
BURST, PAUSE = 50, 0.02  # messages, and s between two bursts: 2500 a second at most
Draw = Callable[[np.random.Generator, str], bytes]


def random_bytes(rng: np.random.Generator, type_name: str) -> bytes:
    """Return a byte string that is seldom a message of a type."""
    kind = rng.integers(4)
    if kind == 0:
        return bytes(rng.bytes(int(rng.integers(1, 600))))
    if kind == 1:
        return HEADER + bytes(rng.bytes(int(rng.integers(0, 400))))
    data = np.frombuffer(random_message(rng, type_name), np.uint8).copy()
    if kind == 2:
        return data[: int(rng.integers(1, len(data)))].tobytes()
    data[rng.integers(len(data), size=3)] ^= rng.integers(1, 256, size=3, dtype=np.uint8)
    return data.tobytes()


def random_message(rng: np.random.Generator, type_name: str) -> bytes:
    """Return a well-formed message of a type with random numbers and texts."""
    message = new_message(type_name)
    _fill(rng, message)
    return bytes(TYPES.serialize_cdr(message, type_name))


def _fill(rng: np.random.Generator, message: Any) -> None:
    for name in message.__dataclass_fields__:
        value = getattr(message, name)
        if isinstance(value, str):
            length = int(rng.choice([0, 4, 200]))
            setattr(message, name, "".join(chr(c) for c in rng.integers(32, 0x2000, length)))
        elif isinstance(value, float):
            setattr(message, name, _number(rng))
        elif isinstance(value, np.ndarray) and value.dtype.kind == "f":
            value[:] = [_number(rng) for _ in value]
        elif isinstance(value, int) and not isinstance(value, bool):
            setattr(message, name, int(rng.integers(0, 100)))
        elif hasattr(value, "__dataclass_fields__"):
            _fill(rng, value)


def _number(rng: np.random.Generator) -> float:
    kind = rng.integers(3)
    if kind == 0:
        return float(rng.choice(ODD))
    if kind == 1:
        return float(rng.integers(0, 2**63, dtype=np.int64).view(np.float64))
    return float(rng.normal(0.0, 10.0))


class Attacker:
    """Publishes on all inputs of the node, and listens to its diagnostics."""

    def __init__(self) -> None:
        import rclpy
        from diagnostic_msgs.msg import DiagnosticArray
        from rclpy.executors import SingleThreadedExecutor

        rclpy.init()
        self._shutdown = rclpy.shutdown
        self.node = rclpy.create_node("attacker")
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self.node)
        self.statuses: dict[str, Any] = {}
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._keep, 100)
        self.publishers = {
            topic: self.node.create_publisher(_class(kind), topic, 100)
            for topic, kind in INPUTS.items()
        }

    def _keep(self, message: Any) -> None:
        self.statuses.update({status.name: status for status in message.status})

    def wait(self, condition: Callable[[], bool], patience: float) -> bool:
        """Spin until a condition holds; return whether it did within `patience` [s]."""
        end = time.monotonic() + patience
        while not condition() and time.monotonic() < end:
            self._executor.spin_once(0.1)
        return condition()

    def send(self, draw: Draw, count: int, rng: np.random.Generator) -> None:
        """Publish what is drawn, on the topics in turn, most on that of the IMU."""
        topics = ["imu/data"] * len(INPUTS) + list(INPUTS)
        for k in range(count):
            topic = topics[k % len(topics)]
            self.publishers[topic].publish(draw(rng, INPUTS[topic]))
            if k % BURST == 0:
                self._executor.spin_once(PAUSE)

    def counted(self) -> int:
        """Return how many messages the node has refused, or found remarkable."""
        status = self.statuses.get("hybrid_ins: input")
        numbers = [item.value for item in status.values] if status is not None else []
        return sum(int(number) for number in numbers if number.isdigit())

    def close(self) -> None:
        """End rclpy."""
        self.node.destroy_node()
        self._shutdown()


def main(argv: Sequence[str] | None = None) -> int:
    """Run it."""
    parser = shell.parser("live_fuzz", __doc__ or "")
    parser.add_argument(
        "--count",
        type=options.positive_count,
        default=100_000,
        metavar="N",
        help="of each kind [%(default)s]",
    )
    parser.add_argument("--seed", type=options.count, default=1, help="[%(default)s]")
    return shell.run(_body, parser.parse_args(argv))


def _body(args: argparse.Namespace) -> int:
    os.environ.update(isolated_ros())
    rng = np.random.default_rng(args.seed)
    with tempfile.TemporaryDirectory() as folder, Processes() as processes:
        flight, log = Path(folder) / "flight.mcap", Path(folder) / "node.log"
        simulate.main([str(flight), "--duration", "30", "--imu-rate", "100"])
        with log.open("w") as output:
            node = processes.start([program("ins_node")], output)
        attacker = Attacker()
        try:
            wanted = attacker.publishers["imu/data"].get_subscription_count
            if not attacker.wait(lambda: wanted() > 0, 600.0):
                print(f"the node did not start: {log.read_text()[-400:]}")
                return 1
            for name, draw in (("byte strings", random_bytes), ("messages", random_message)):
                before, started = resident(node.pid), time.monotonic()
                attacker.send(draw, args.count, rng)
                attacker.wait(lambda: False, 3.0)
                seconds, after = time.monotonic() - started, resident(node.pid)
                print(
                    f"{args.count} random {name} in {seconds:.0f} s: {attacker.counted()} refused "
                    f"or remarkable so far, memory {before:.0f} -> {after:.0f} MB, "
                    f"node {'alive' if node.poll() is None else 'ENDED'}",
                    flush=True,
                )
            player = processes.start([program("ins_play"), flight, "--wait", "60"])
            navigates = attacker.wait(lambda: _navigates(attacker), 300.0)
            processes.stop(player)
        finally:
            attacker.close()
        alive, status = node.poll() is None, processes.stop(node)
        words = log.read_text(errors="replace")
    faults = [line for line in words.splitlines() if "internal error" in line]
    print(
        f"afterwards a flight {'is navigated' if navigates else 'is NOT navigated'}; exit status "
        f"{status}; log of {len(words) / 1000.0:.0f} kB, {len(faults)} internal errors"
    )
    for line in faults:
        print(line)
    return int(not alive or not navigates or bool(status) or bool(faults) or "Traceback" in words)


def _class(type_name: str) -> Any:
    package, _, name = type_name.split("/")
    return getattr(importlib.import_module(f"{package}.msg"), name)


def _navigates(attacker: Attacker) -> bool:
    status = attacker.statuses.get("hybrid_ins: filter")
    return status is not None and status.message == "aligned, GNSS fused"


if __name__ == "__main__":
    raise SystemExit(main())
