"""
Watches whether IMU samples and fixes come, by the time of their arrival.

The estimator's time is the stamps of the samples, which stops with them. Here the computer's clock
goes on, or the simulated one, which stops with a bag that is paused.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from hybrid_ins.ros.estimator.estimator import Estimator
from hybrid_ins.ros.messages.interface import INPUT_TYPES
from hybrid_ins.ros.output.message_types import OUTPUTS
from hybrid_ins.ros.output.output_topics import OutputTopics
from hybrid_ins.ros.reporting.diagnostics import status
from hybrid_ins.ros.reporting.reports import Report, Status
from hybrid_ins.ros.review.silent_input import OutageLog, Silence, why_missing

SILENCE = 0.9  # s: a second of the timer without a sample
IMU, FIX = "imu/data", "gnss/fix"
LAUNCH_ARGUMENTS = {IMU: "imu_topic", FIX: "fix_topic"}
ESTIMATES = tuple(f"/{name.lstrip('/')}" for name in OUTPUTS)  # of any ins_node
DRIVER_STOPPED = "restart the driver, check the cable; until they come the state is lost"
RECEIVER_STOPPED = (
    "while the IMU's come: restart the receiver's driver, check the cable; until they come the "
    "position drifts"
)
NO_CLOCK = (
    "use_sim_time is true: start the simulator, play the bag with --clock, or set use_sim_time to "
    "false"
)


class Clocks:
    """
    How far the computer's clock and that of a node of rclpy go on.

    A simulated clock of which nothing has come yet is none: the computer's stands in for it.

    Attributes
    ----------
    is_missing : bool
        The node's is to be simulated, and nothing has come of it.
    """

    def __init__(self, node: Any) -> None:
        self._node = node
        self._last = self._read()

    def _read(self) -> tuple[float, float, bool]:
        """Return both [s], and whether the node's is a simulated one that runs."""
        clock, wall = self._node.get_clock(), time.monotonic()
        now_ns = clock.now().nanoseconds if clock.ros_time_is_active else 0
        self.is_missing = clock.ros_time_is_active and not now_ns
        return wall, now_ns * 1e-9 if now_ns else wall, now_ns != 0

    def elapsed(self) -> tuple[float, float]:
        """Return how far each went on since the last call [s]; a clock that was set did not."""
        (wall, node, was_simulated), self._last = self._last, self._read()
        is_same = was_simulated is self._last[2]
        return self._last[0] - wall, max(self._last[1] - node, 0.0) if is_same else 0.0


class InputWatch:
    """
    Says what is missing: in diagnostics, on ``validity``, and in the log.

    Parameters
    ----------
    node : Node
        Of rclpy.
    estimator : Estimator
    topics : OutputTopics

    Attributes
    ----------
    imu_messages, fixes : int
        How many came, to be counted by the owner.
    """

    def __init__(self, node: Any, estimator: Estimator, topics: OutputTopics) -> None:
        self._node = node
        self._estimator = estimator
        self._topics = topics
        self.imu_messages = self.fixes = 0
        self.start()

    def start(self) -> None:
        """Begin to wait: the node is active from now on."""
        log, name = self._estimator.inputs.log, self._node.resolve_topic_name
        self._heard, self._used, self._located = Silence(), Silence(), Silence()
        self._imu_outage, self._fix_outage = OutageLog(log, name(IMU)), OutageLog(log, name(FIX))
        self._clock_outage, self._clockless = OutageLog(log, "/clock"), 0.0
        self._clocks = Clocks(self._node)

    def on_second(self) -> None:
        """Say what does not come; called by a timer of the computer's clock."""
        elapsed, of_node = self._clocks.elapsed()
        heard = self._heard.update(self.imu_messages, elapsed)
        self._used.update(self._estimator.navigator.last_ns, of_node)
        self._log_outages(heard, elapsed)
        if self.silent:
            self._publish_lost()
        if self.silent or heard >= SILENCE:
            statuses = self._estimator.status.diagnostics(self._now_ns, self.silent)
            self._publish_diagnostics([*statuses, self._imu_status(heard)])

    def end(self, state: str) -> None:
        """Say last that the node is in a ``state`` in which nothing is estimated."""
        self._publish_lost()
        first, *others = self._estimator.status.diagnostics(self._now_ns, self.silent, is_over=True)
        self._publish_diagnostics([first._replace(text=f"{state}; {first.text}"), *others])

    def _publish_lost(self) -> None:
        """Publish that what was estimated is lost, unless that is known."""
        changed = self._estimator.aids.validity.changed(self._now_ns, is_silent=True)
        if changed is not None:
            self._topics.publish_all([Report("validity", changed, self._now_ns)])

    def _publish_diagnostics(self, statuses: list[Status]) -> None:
        self._topics.publish_diagnostics(self._node.get_clock().now().nanoseconds, statuses)

    @property
    def silent(self) -> float:
        """For how long no IMU sample was used [s]; 0 while they come."""
        return self._used.seconds if self._used.seconds >= SILENCE else 0.0

    @property
    def _now_ns(self) -> int:
        """The present in the clock of the samples' stamps [ns]."""
        return self._estimator.navigator.last_ns + round(self.silent * 1e9)

    def _imu_status(self, heard: float) -> Status:
        topic = self._node.resolve_topic_name(IMU)
        text = (
            f"no messages on {topic} for {heard:.0f} s: is the driver running, the topic remapped, "
            "the QoS compatible?"
            if heard >= SILENCE
            else f"no message on {topic} was of use for {self.silent:.0f} s: the status of the "
            "input says why"
        )
        publishers = self._node.count_publishers(topic)
        return status("imu", 2, text, {"topic": topic, "publishers": publishers})

    # The log.

    def _log_outages(self, heard: float, elapsed: float) -> None:
        self._clockless = self._clockless + elapsed if self._clocks.is_missing else 0.0
        self._clock_outage.note(self._clockless, lambda: NO_CLOCK)
        # A bag that is paused is no outage.
        is_paused = heard >= SILENCE and self.fixes > 0
        located = self._located.update(self.fixes, 0.0 if is_paused else elapsed)
        if self.imu_messages:
            self._imu_outage.note(min(heard, self._used.seconds), lambda: DRIVER_STOPPED)
        else:
            self._imu_outage.note(heard, self._since_the_start(IMU))
        if self.fixes:
            self._fix_outage.note(located, lambda: RECEIVER_STOPPED)
        else:
            self._fix_outage.note(located, self._since_the_start(FIX))

    def _since_the_start(self, name: str) -> Callable[[], str]:
        """Return what says why nothing has come on a topic yet."""
        node, kind = self._node, INPUT_TYPES[name]

        def describe() -> str:
            publishers = node.count_publishers(node.resolve_topic_name(name))
            return why_missing(name, kind, publishers, self._others(kind), LAUNCH_ARGUMENTS[name])

        return describe

    def _others(self, kind: str) -> list[str]:
        """Return the topics of a type that others publish, but no estimate of another ins_node."""
        node = self._node
        ours = {node.resolve_topic_name(name) for name in (*INPUT_TYPES, *OUTPUTS)}
        return sorted(
            name
            for name, kinds in node.get_topic_names_and_types()
            if kind in kinds
            and name not in ours
            and not name.endswith(ESTIMATES)
            and node.count_publishers(name)
        )
