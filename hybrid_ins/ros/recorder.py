"""What comes back over DDS while a recording is played, received and passed on as bytes."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING

from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.task import Future
from rclpy.validate_full_topic_name import validate_full_topic_name

from hybrid_ins.errors import InputError
from hybrid_ins.ros.player import DEPTH, Timeline, message_type_of, table, wait_until_empty

try:
    from rclpy.experimental import EventsExecutor as Executor
except ImportError:  # older than Jazzy's second release
    Executor = SingleThreadedExecutor

if TYPE_CHECKING:
    from rclpy.node import Node
    from typing_extensions import Self

Write = Callable[[str, str, bytes, int], None]  # topic, type name, CDR bytes, time [ns]

_PERIOD = 1.0  # s, after which at the latest what was received is in the file

_log = logging.getLogger(__name__)


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
    flush : callable
        Called from time to time: what was written has to survive that the process is killed.

    """

    def __init__(
        self,
        node: Node,
        write: Write,
        is_known: Callable[[str], bool],
        timeline: Timeline,
        flush: Callable[[], None],
    ) -> None:
        self._node = node
        self._write = write
        self._is_known = is_known
        self._timeline = timeline
        self._flush = flush
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
        for name in names.values():
            validate_full_topic_name(name)
        missing = wait_until_empty(
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
        return "\n".join([f"recorded {total} messages in {place}", *table(self._counts)])

    def _subscribe(self, topic: str, name: str) -> None:
        offers = self._node.get_publishers_info_by_topic(name)
        type_name = offers[0].topic_type
        if not self._is_known(type_name):
            _log.warning("%s is left out: %s is not a standard message type", name, type_name)
            return
        message_type = message_type_of(name, type_name)
        if message_type is None:
            return
        reliable = all(o.qos_profile.reliability == ReliabilityPolicy.RELIABLE for o in offers)
        latched = all(o.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL for o in offers)
        quality = QoSProfile(
            depth=DEPTH,
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
                self._executor.spin_until_future_complete(self._stopped, _PERIOD)
                self._flush()
        except Exception as failure:  # handed to the main thread
            self._failure = failure
