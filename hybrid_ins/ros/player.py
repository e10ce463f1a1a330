"""
A recording published over DDS in real or scaled time.

Messages pass as the bytes that the bag holds; nothing is decoded, header stamps stay as they are.
"""

from __future__ import annotations

import importlib
import logging
import math
import struct
import sys
import time
from array import array
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import chain, islice
from typing import TYPE_CHECKING, Any

import numpy as np
import rclpy
from rclpy._rclpy_pybind11 import RCLError, RCLInvalidROSArgsError, UnknownROSArgsError
from rclpy.exceptions import NameValidationException
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.signals import SignalHandlerOptions
from rosgraph_msgs.msg import Clock

from hybrid_ins import progress
from hybrid_ins.errors import InputError
from hybrid_ins.ros import node_arguments

if TYPE_CHECKING:
    from rclpy.node import Node

_CLOCK_PERIOD = 0.025  # s, of bag time and of real time
_CLOCK_LAYOUT = struct.Struct("<4siI")
DEPTH = 10_000  # messages that wait for a slow subscriber, or for the recorder

_log = logging.getLogger(__name__)


@contextmanager
def started_node(ros_args: Sequence[str]) -> Iterator[Node]:
    """
    Yield a node of rclpy, which is started and shut down.

    Parameters
    ----------
    ros_args : sequence of str
        From ``--ros-args`` on.

    Raises
    ------
    InputError
        ROS refuses an argument, or a name that the block gives it.

    """
    try:
        # Ctrl-C and SIGTERM stay with Python, so that they unwind through the open bag.
        rclpy.init(args=list(ros_args), signal_handler_options=SignalHandlerOptions.NO)
        node = rclpy.create_node("ins_play", start_parameter_services=False, enable_rosout=False)
        try:
            yield node
        finally:
            node.destroy_node()
    except NameValidationException as error:
        reason, name = str(error).splitlines()[:2]
        raise InputError(f"{name.strip()}: {reason.rstrip(':')}: rename it with --remap") from None
    except UnknownROSArgsError as error:
        raise InputError(f"unknown ROS arguments: {error}") from None
    except (RCLError, RCLInvalidROSArgsError) as error:
        raise InputError(node_arguments.reason_of(error)) from None
    finally:
        rclpy.try_shutdown()


class Timeline:
    """
    The relation between the recording's time and the time that passes here.

    Attributes
    ----------
    next_ns : int
        Bag time of the next message to publish: until it is out, bag time cannot have passed it,
        however late we are.

    """

    def __init__(self, first_ns: int, rate: float) -> None:
        self.first_ns = first_ns
        self.rate = rate
        self.next_ns = first_ns
        self._zero = math.inf  # reading of time.perf_counter at first_ns

    def start(self) -> None:
        """Start the passing of bag time."""
        self._zero = time.perf_counter()

    def wait_until(self, bag_ns: int) -> float:
        """Sleep until bag time `bag_ns`; return by how much it is late [s]."""
        self.next_ns = bag_ns
        due = self._zero + (bag_ns - self.first_ns) * 1e-9 / self.rate
        while (left := due - time.perf_counter()) > 0.0:
            time.sleep(left)
        return -left

    def now_ns(self) -> int:
        """Return the present bag time [ns]; before `start` that of its first message."""
        passed = max(time.perf_counter() - self._zero, 0.0)
        return min(self.first_ns + int(passed * self.rate * 1e9), self.next_ns)

    def elapsed(self) -> float:
        """Return the real time since `start` [s]."""
        return time.perf_counter() - self._zero


class Player:
    """
    Publishes serialised messages and /clock at their times.

    Parameters
    ----------
    node : Node
    topics : dict
        Type name by topic.
    remap : mapping
        Name to publish under, by topic.
    latched : collection of str
        Topics whose last message late subscribers get, too.
    clock : bool
        Publish /clock.

    """

    def __init__(
        self,
        node: Node,
        topics: dict[str, str],
        remap: Mapping[str, str],
        *,
        latched: Collection[str] = (),
        clock: bool = True,
    ) -> None:
        self.lateness = array("f")  # s, of each message
        self.duration = 0.0  # s, of bag time
        self.real_duration = 0.0  # s
        self._counts = dict.fromkeys(topics, 0)
        self._publishers: dict[str, Any] = {}
        for topic, type_name in topics.items():
            message_type = message_type_of(topic, type_name)
            if message_type is not None:
                name = remap.get(topic, topic)
                quality = QoSProfile(depth=DEPTH)
                if topic in latched:
                    quality.durability = DurabilityPolicy.TRANSIENT_LOCAL
                self._publishers[topic] = node.create_publisher(message_type, name, quality)
        if not self._publishers:
            raise InputError("there is nothing to play: no topic has a type that is installed")
        self._clock = None
        if clock:
            self._clock = node.create_publisher(Clock, "/clock", 10)

    def wait_for_subscribers(self, patience: float) -> None:
        """Wait until every topic has one, at most `patience` seconds; name those that have none."""
        missing = wait_until_empty(
            lambda: [p.topic for p in self._publishers.values() if not p.get_subscription_count()],
            patience,
            "waiting for a subscriber of",
        )
        if missing:
            _log.warning("no subscriber of %s: played without", ", ".join(missing))

    def play(
        self,
        messages: Iterator[tuple[str, int, bytes]],
        timeline: Timeline,
        last_ns: int,
        check: Callable[[], None],
    ) -> None:
        """
        Publish all `messages` (topic, log time [ns], CDR bytes).

        `check` is called at every tick of the clock; what it raises ends the playing.
        """
        tick_ns = self._tick_ns(timeline)
        next_tick_ns = timeline.first_ns
        publish = {topic: publisher.publish for topic, publisher in self._publishers.items()}
        seconds = (last_ns - timeline.first_ns) / 1e9
        first = list(islice(messages, 1))  # slow: this opens the first chunk
        timeline.start()
        with progress.bar("playing", round(seconds, 1), "s") as bar:
            for topic, log_ns, data in chain(first, messages):
                while next_tick_ns <= log_ns:
                    timeline.wait_until(next_tick_ns)
                    self._publish_clock(next_tick_ns)
                    check()
                    bar.update(round((next_tick_ns - timeline.first_ns) / 1e9, 3) - bar.n)
                    next_tick_ns += tick_ns
                if topic in publish:
                    self.lateness.append(timeline.wait_until(log_ns))
                    publish[topic](data)
                    self._counts[topic] += 1
        self.duration = (timeline.next_ns - timeline.first_ns) / 1e9
        self.real_duration = timeline.elapsed()

    def drain(self, timeline: Timeline, seconds: float, check: Callable[[], None]) -> None:
        """Continue bag time for some real seconds after the last message."""
        tick_ns = self._tick_ns(timeline)
        next_tick_ns = timeline.next_ns
        end = timeline.elapsed() + seconds
        while timeline.elapsed() < end:
            next_tick_ns += tick_ns
            timeline.wait_until(next_tick_ns)
            self._publish_clock(next_tick_ns)
            check()

    def report(self, rate: float) -> str:
        """Return lines on what was played and how well the time was kept."""
        total = len(self.lateness)
        lines = [f"played {total} messages, {self.duration:.1f} s in {self.real_duration:.1f} s"]
        if total:
            held = self.duration / max(self.real_duration, 1e-9)
            median, p99, worst = 1e3 * np.percentile(self.lateness, (50, 99, 100))
            lines[0] += (
                f": rate {held:.3f} (asked {rate:g}), late by {median:.2f} ms (median),"
                f" {p99:.2f} ms (99 %), {worst:.1f} ms (worst)"
            )
        return "\n".join([*lines, *table(self._counts)])

    def _tick_ns(self, timeline: Timeline) -> int:
        return max(round(_CLOCK_PERIOD * min(1.0, timeline.rate) * 1e9), 1)

    def _publish_clock(self, bag_ns: int) -> None:
        if self._clock is not None:
            stamp = divmod(bag_ns, 1_000_000_000)
            self._clock.publish(_CLOCK_LAYOUT.pack(b"\x00\x01\x00\x00", *stamp))


def wait_until_empty(
    missing: Callable[[], list[str]], patience: float, announcement: str
) -> list[str]:
    """Call `missing` until it returns nothing or `patience` [s] ends; return its last result."""
    begin = time.monotonic()
    announced = False
    while (names := missing()) and (waited := time.monotonic() - begin) < patience:
        if waited > 1.0 and not announced:
            print(f"{announcement} {', '.join(names)}", file=sys.stderr)
            announced = True
        time.sleep(0.02)
    return names


def table(counts: dict[str, int]) -> list[str]:
    """Return a line for each topic with its number of messages."""
    width = max(map(len, counts), default=0)
    return [f"  {topic:<{width}} {count:>8}" for topic, count in counts.items()]


def message_type_of(topic: str, type_name: str) -> Any:
    """Return the class of a message type; None, with a warning, where it is not installed."""
    package, _, name = type_name.partition("/msg/")
    try:
        return getattr(importlib.import_module(f"{package}.msg"), name)
    except (ImportError, AttributeError):
        _log.warning("%s is left out: %s is not installed here", topic, type_name)
        return None
