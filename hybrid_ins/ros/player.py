"""
A recording published over DDS in real or scaled time, and what comes back received.

Messages pass as the bytes that the bag holds; nothing is decoded, header stamps stay as they are.
"""

from __future__ import annotations

import importlib
import logging
import math
import struct
import sys
import threading
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
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future
from rosgraph_msgs.msg import Clock

from hybrid_ins import progress
from hybrid_ins.errors import InputError
from hybrid_ins.ros import node_arguments

try:
    from rclpy.experimental import EventsExecutor as Executor
except ImportError:  # older than Jazzy's second release
    Executor = SingleThreadedExecutor

if TYPE_CHECKING:
    from rclpy.node import Node
    from typing_extensions import Self

Write = Callable[[str, str, bytes, int], None]  # topic, type name, CDR bytes, time [ns]

_CLOCK_PERIOD = 0.025  # s, of bag time and of real time
_CLOCK_LAYOUT = struct.Struct("<4siI")
_DEPTH = 10_000  # messages that wait for a slow subscriber, or for the recorder

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
            message_type = _message_type(topic, type_name)
            if message_type is not None:
                name = remap.get(topic, topic)
                quality = QoSProfile(depth=_DEPTH)
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
        missing = _wait_until_empty(
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
        return "\n".join([*lines, *_table(self._counts)])

    def _tick_ns(self, timeline: Timeline) -> int:
        return round(_CLOCK_PERIOD * min(1.0, timeline.rate) * 1e9)

    def _publish_clock(self, bag_ns: int) -> None:
        if self._clock is not None:
            stamp = divmod(bag_ns, 1_000_000_000)
            self._clock.publish(_CLOCK_LAYOUT.pack(b"\x00\x01\x00\x00", *stamp))


class Recorder:
    """
    Passes on what it receives, byte for byte, stamped in bag time.

    It receives in a thread of its own. The middleware queues what arrives while the player has the
    interpreter, so that nothing is lost.

    Parameters
    ----------
    node : Node
    write : callable
        Called with topic, type name, CDR bytes and bag time [ns] of each message.
    is_known : callable
        Returns whether `write` accepts a type.
    timeline : Timeline

    """

    def __init__(
        self, node: Node, write: Write, is_known: Callable[[str], bool], timeline: Timeline
    ) -> None:
        self._node = node
        self._write = write
        self._is_known = is_known
        self._timeline = timeline
        self._counts: dict[str, int] = {}
        self._failure: Exception | None = None
        self._executor = Executor()
        self._executor.add_node(node)
        self._stopped = Future()
        self._thread = threading.Thread(target=self._spin, name="recorder")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._stopped.set_result(None)
        if self._thread.is_alive():
            self._thread.join()
        self._executor.remove_node(self._node)
        self._executor.shutdown()

    def subscribe(self, topics: Sequence[str], remap: Mapping[str, str], patience: float) -> None:
        """
        Wait for the publishers of `topics`, subscribe with the QoS they offer, start to receive.

        Topics without a publisher within `patience` seconds are named and left out.
        """
        names = {topic: remap.get(topic, topic) for topic in topics}
        missing = _wait_until_empty(
            lambda: [n for n in names.values() if not self._node.get_publishers_info_by_topic(n)],
            patience,
            "waiting for a publisher of",
        )
        if missing:
            _log.warning("no publisher of %s: not recorded", ", ".join(missing))
        for topic, name in names.items():
            if name not in missing:
                self._subscribe(topic, name)
        self._thread.start()

    def check(self) -> None:
        """Raise the exception that ended the recording, if any did."""
        if self._failure is not None:
            raise self._failure

    def report(self, place: str) -> str:
        """
        Return lines on what was recorded and where.

        Raises
        ------
        InputError
            Nothing was.

        """
        total = sum(self._counts.values())
        if not total:
            raise InputError(
                "nothing came back to record: is the node running, with the same ROS_DOMAIN_ID?"
            )
        return "\n".join([f"recorded {total} messages in {place}", *_table(self._counts)])

    def _subscribe(self, topic: str, name: str) -> None:
        offers = self._node.get_publishers_info_by_topic(name)
        type_name = offers[0].topic_type
        if not self._is_known(type_name):
            _log.warning("%s is left out: %s is not a standard message type", name, type_name)
            return
        message_type = _message_type(name, type_name)
        if message_type is None:
            return
        reliable = all(o.qos_profile.reliability == ReliabilityPolicy.RELIABLE for o in offers)
        latched = all(o.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL for o in offers)
        quality = QoSProfile(
            depth=_DEPTH,
            reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
            durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
        )
        counts, write, now_ns = self._counts, self._write, self._timeline.now_ns
        counts[topic] = 0

        def receive(data: bytes) -> None:
            if self._failure is None:
                try:
                    write(topic, type_name, data, now_ns())
                    counts[topic] += 1
                except Exception as failure:  # the executor would print a traceback
                    self._failure = failure

        self._node.create_subscription(message_type, name, receive, quality, raw=True)

    def _spin(self) -> None:
        try:
            # EventsExecutor.spin() of some releases never returns.
            while not self._stopped.done():
                self._executor.spin_until_future_complete(self._stopped, 0.5)
        except Exception as failure:  # handed to the main thread
            self._failure = failure


def _message_type(topic: str, type_name: str) -> Any:
    package, _, name = type_name.partition("/msg/")
    try:
        return getattr(importlib.import_module(f"{package}.msg"), name)
    except (ImportError, AttributeError):
        _log.warning("%s is left out: %s is not installed here", topic, type_name)
        return None


def _wait_until_empty(
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


def _table(counts: dict[str, int]) -> list[str]:
    width = max(map(len, counts), default=0)
    return [f"  {topic:<{width}} {count:>8}" for topic, count in counts.items()]
