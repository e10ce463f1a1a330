"""
ins_play: a recording published over DDS in real or scaled time, its echo recorded.

It stands in for ``ros2 bag play`` and ``ros2 bag record`` where ROS 2 is installed without rosbag2.
Messages pass as the bytes that the bag holds; nothing is decoded, header stamps stay as they are.
"""

from __future__ import annotations

import argparse
import importlib
import logging
import math
import struct
import sys
import threading
import time
from array import array
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from itertools import chain, islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from tqdm import tqdm

from hybrid_ins.bags.messages import is_standard
from hybrid_ins.bags.reader import BagReader
from hybrid_ins.bags.writer import BagWriter
from hybrid_ins.cli import options, program
from hybrid_ins.errors import InputError

if TYPE_CHECKING:
    from rclpy.node import Node
    from typing_extensions import Self

ESTIMATES = (
    "/odometry",
    "/odometry/local",
    "/gnss/filtered",
    "/q/accelerometer",
    "/q/gyroscope",
    "/imu/bias",
    "/gnss/verdict",
    "/diagnostics",
    "/datum",
)
NOT_PLAYED = (*ESTIMATES, "/clock", "/tf", "/tf_static", "/rosout", "/parameter_events")
TRUTH = "/truth/"

_CLOCK_PERIOD = 0.025  # s, of bag time and of real time
_CLOCK_LAYOUT = struct.Struct("<4siI")
_DEPTH = 10_000  # messages that wait for a slow subscriber, or for the recorder
_SETTLING = 0.3  # s; a subscriber knows of us a little later than we know of it

_log = logging.getLogger(__name__)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the program; see the parser's text."""
    words = list(sys.argv[1:] if argv is None else argv)
    split = words.index("--ros-args") if "--ros-args" in words else len(words)
    parser = program.parser(
        "ins_play",
        "Publish a recording over DDS in real or scaled time, with /clock in its time.\n"
        "Without --topics everything is published except /truth/* and what ins_node publishes.\n"
        "With --record what comes back is written to a bag, stamped in the recording's time.",
        "ins_play flight.mcap --rate 2 --record estimate.mcap",
    )
    parser.set_defaults(ros_args=words[split:])
    add = parser.add_argument
    add("bag", type=Path, metavar="IN", help="rosbag2 directory, .mcap, .db3 or ROS 1 .bag")
    add("--rate", type=options.positive, default=1.0, help="bag seconds per second (default 1)")
    add("--topics", nargs="+", metavar="T", help="publish these topics only")
    add(
        "--start",
        type=options.not_negative,
        default=0.0,
        metavar="S",
        help="skip the first S seconds",
    )
    add(
        "--duration",
        type=options.positive,
        default=math.inf,
        metavar="S",
        help="play S seconds only",
    )
    add(
        "--remap",
        nargs="+",
        action="extend",
        default=[],
        type=_remapping,
        metavar="A:=B",
        help="topic A of a bag is topic B of ROS, for playing and recording",
    )
    add("--no-clock", action="store_true", help="do not publish /clock")
    add(
        "--wait",
        type=options.not_negative,
        default=10.0,
        metavar="S",
        help="wait at most S seconds until every topic has its subscriber (default 10)",
    )
    add("--record", type=Path, metavar="OUT", help="write what is received: directory or .mcap")
    add(
        "--record-topics",
        nargs="+",
        metavar="T",
        default=list(ESTIMATES),
        help="what to record (default: what ins_node publishes)",
    )
    add("--overwrite", action="store_true", help="replace OUT if it exists")
    add(
        "--drain",
        type=options.not_negative,
        default=1.0,
        metavar="S",
        help="after the last message go on for S seconds, for what is on its way (default 1)",
    )
    return program.run(_play, parser.parse_args(words[:split]))


def _play(args: argparse.Namespace) -> None:
    try:
        import rclpy
        from rclpy.signals import SignalHandlerOptions
    except ImportError as error:
        raise InputError(
            f"ROS 2 is not there ({error}): source its setup file, or install hybrid_ins[ros]"
        ) from None

    with ExitStack() as stack:
        bag = stack.enter_context(BagReader(args.bag))
        topics = _topics_to_play(bag, args.topics)
        first_ns = bag.start_ns + round(args.start * 1e9)
        last_ns = bag.end_ns
        if args.duration < math.inf:
            last_ns = min(last_ns, first_ns + round(args.duration * 1e9))
        if first_ns > bag.end_ns:
            seconds = (bag.end_ns - bag.start_ns) / 1e9
            raise InputError(f"--start {args.start:g}: {args.bag} is only {seconds:.1f} s long")

        remap = dict(args.remap)
        # Ctrl-C and SIGTERM stay with Python, so that they unwind through the open bag.
        rclpy.init(args=args.ros_args, signal_handler_options=SignalHandlerOptions.NO)
        stack.callback(rclpy.try_shutdown)
        node = rclpy.create_node("ins_play", start_parameter_services=False, enable_rosout=False)
        stack.callback(node.destroy_node)

        messages = (m for m in bag.raw(*topics) if first_ns <= m[1] <= last_ns)
        timeline = Timeline(first_ns, args.rate)
        player = Player(node, topics, remap, clock=not args.no_clock)
        recorder = None
        if args.record:
            out = stack.enter_context(BagWriter(args.record, overwrite=args.overwrite))
            recorder = stack.enter_context(Recorder(node, out, timeline))
            recorder.subscribe(args.record_topics, remap, args.wait)
        player.wait_for_subscribers(args.wait)
        time.sleep(_SETTLING)

        def check() -> None:
            if recorder is not None:
                recorder.check()

        player.play(messages, timeline, last_ns, check)
        player.drain(timeline, args.drain, check)
        print(player.report(args.rate))
        if recorder is not None:
            print(recorder.report(args.record))


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
        """Let bag time begin to pass."""
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
    """Publishes serialised messages and /clock at their times."""

    def __init__(
        self, node: Node, topics: dict[str, str], remap: dict[str, str], clock: bool
    ) -> None:
        from rclpy.qos import QoSProfile

        self.lateness = array("f")  # s, of each message
        self.duration = 0.0  # s, of bag time
        self.real_duration = 0.0  # s
        self._counts = dict.fromkeys(topics, 0)
        self._publishers: dict[str, Any] = {}
        for topic, type_name in topics.items():
            message_type = _message_type(topic, type_name)
            if message_type is not None:
                name = remap.get(topic, topic)
                self._publishers[topic] = node.create_publisher(
                    message_type, name, QoSProfile(depth=_DEPTH)
                )
        if not self._publishers:
            raise InputError("there is nothing to play: no topic has a type that is installed")
        self._clock = None
        if clock:
            from rosgraph_msgs.msg import Clock

            self._clock = node.create_publisher(Clock, "/clock", 10)

    def wait_for_subscribers(self, patience: float) -> None:
        """Wait until every topic has one, at most `patience` seconds; name those that have none."""
        missing = _wait_until_empty(
            lambda: [p.topic for p in self._publishers.values() if not p.get_subscription_count()],
            patience,
            "waiting for a subscriber of",
        )
        if missing:
            _log.warning("nobody subscribes to %s: playing all the same", ", ".join(missing))

    def play(
        self,
        messages: Iterator[tuple[str, int, bytes]],
        timeline: Timeline,
        last_ns: int,
        check: Callable[[], None],
    ) -> None:
        """
        Publish all `messages` (topic, log time [ns], CDR bytes).

        `check` is called now and then and may raise to end it.
        """
        tick_ns = self._tick_ns(timeline)
        next_tick_ns = timeline.first_ns
        publish = {topic: publisher.publish for topic, publisher in self._publishers.items()}
        seconds = (last_ns - timeline.first_ns) / 1e9
        first = list(islice(messages, 1))  # the first one takes long: what reads bags is loaded
        timeline.start()
        with tqdm(total=round(seconds, 1), desc="playing", unit="s", disable=None) as bar:
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
        """Let bag time pass for some real seconds more."""
        tick_ns = self._tick_ns(timeline)
        next_tick_ns = timeline.next_ns
        end = timeline.elapsed() + seconds
        while timeline.elapsed() < end:
            next_tick_ns += tick_ns
            timeline.wait_until(next_tick_ns)
            self._publish_clock(next_tick_ns)
            check()

    def report(self, rate: float) -> str:
        """Say what was played and how well the time was kept."""
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
    Writes what it receives to a bag, byte for byte, stamped in bag time.

    It receives in a thread of its own. The middleware queues what arrives while the player has the
    interpreter, so that nothing is lost.
    """

    def __init__(self, node: Node, bag: BagWriter, timeline: Timeline) -> None:
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.task import Future

        try:
            from rclpy.experimental import EventsExecutor as Executor
        except ImportError:
            Executor = SingleThreadedExecutor
        self._node = node
        self._bag = bag
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

    def subscribe(self, topics: Sequence[str], remap: dict[str, str], patience: float) -> None:
        """
        Wait for the publishers of `topics`, subscribe as they offer, and begin to receive.

        Topics that nobody publishes within `patience` seconds are named and left out.
        """
        names = {topic: remap.get(topic, topic) for topic in map(_absolute, topics)}
        missing = _wait_until_empty(
            lambda: [n for n in names.values() if not self._node.get_publishers_info_by_topic(n)],
            patience,
            "waiting for a publisher of",
        )
        if missing:
            _log.warning("nobody publishes %s: not recorded", ", ".join(missing))
        for topic, name in names.items():
            if name not in missing:
                self._subscribe(topic, name)
        self._thread.start()

    def check(self) -> None:
        """Raise what went wrong in the recording thread."""
        if self._failure is not None:
            raise self._failure

    def report(self, path: Path) -> str:
        """
        Say what was recorded.

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
        return "\n".join([f"recorded {total} messages in {path}", *_table(self._counts)])

    def _subscribe(self, topic: str, name: str) -> None:
        from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

        offers = self._node.get_publishers_info_by_topic(name)
        type_name = offers[0].topic_type
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
        counts, write, now_ns = self._counts, self._bag.write_raw, self._timeline.now_ns
        counts[topic] = 0

        def receive(data: bytes) -> None:
            write(topic, type_name, data, now_ns())
            counts[topic] += 1

        self._node.create_subscription(message_type, name, receive, quality, raw=True)

    def _spin(self) -> None:
        try:
            # EventsExecutor.spin() of some releases never returns.
            while not self._stopped.done():
                self._executor.spin_until_future_complete(self._stopped, 0.5)
        except Exception as failure:  # handed to the main thread
            self._failure = failure


def _topics_to_play(bag: BagReader, named: Sequence[str] | None) -> dict[str, str]:
    if named is None:
        topics = {
            topic: type_name
            for topic, type_name in bag.topics.items()
            if topic not in NOT_PLAYED and not topic.startswith(TRUTH)
        }
    else:
        names = [_absolute(name) for name in named]
        unknown = [name for name in names if name not in bag.topics]
        if unknown:
            raise InputError(
                f"--topics {unknown[0]}: {bag.path} has {', '.join(sorted(bag.topics))}"
            )
        topics = {name: bag.topics[name] for name in names}
    if not topics:
        raise InputError(
            f"{bag.path}: has only {', '.join(sorted(bag.topics))}: name what to play with --topics"
        )
    return topics


def _message_type(topic: str, type_name: str) -> Any:
    package, _, name = type_name.partition("/msg/")
    if not is_standard(type_name):
        _log.warning("%s is left out: %s is no standard message type", topic, type_name)
        return None
    try:
        return getattr(importlib.import_module(f"{package}.msg"), name)
    except (ImportError, AttributeError):
        _log.warning("%s is left out: %s is not installed here", topic, type_name)
        return None


def _wait_until_empty(
    missing: Callable[[], list[str]], patience: float, announcement: str
) -> list[str]:
    """Ask `missing` until it returns nothing or patience ends; return what it said last."""
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


def _absolute(topic: str) -> str:
    return topic if topic.startswith("/") else f"/{topic}"


def _remapping(text: str) -> tuple[str, str]:
    old, separator, new = text.partition(":=")
    if not (old and separator and new):
        raise argparse.ArgumentTypeError(f"{text} is not of the form old:=new")
    return _absolute(old), _absolute(new)


if __name__ == "__main__":
    sys.exit(main())
