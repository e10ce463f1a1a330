"""
``ins_node``: the estimator on ROS 2. Callbacks convert, call, publish.
"""

from __future__ import annotations

import gc
import os
import signal
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any

try:
    import rclpy
except ModuleNotFoundError as error:
    if error.name != "rclpy":
        raise
    raise SystemExit(
        "ins_node: error: ROS 2 is not installed: source /opt/ros/jazzy/setup.bash, or install its "
        'wheels: pip install "hybrid_ins[ros]"'
    ) from None
from geometry_msgs.msg import (
    PoseWithCovarianceStamped,
    TransformStamped,
    TwistWithCovarianceStamped,
)
from rcl_interfaces.msg import SetParametersResult
from rclpy._rclpy_pybind11 import RCLError, RCLInvalidROSArgsError, UnknownROSArgsError
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.exceptions import ParameterException
from rclpy.executors import ExternalShutdownException
from rclpy.experimental import EventsExecutor
from rclpy.node import Node
from rclpy.qos import (
    DurabilityPolicy,
    HistoryPolicy,
    QoSProfile,
    ReliabilityPolicy,
    qos_policy_name_from_kind,
)
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.serialization import deserialize_message
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future
from sensor_msgs.msg import Imu, NavSatFix
from std_srvs.srv import Trigger

try:
    from tf2_msgs.msg import TFMessage
except ImportError:  # the wheels of ROS have none
    TFMessage = None

from hybrid_ins import kernels, parameters
from hybrid_ins.errors import InputError
from hybrid_ins.ros import conversions, node_parameters
from hybrid_ins.ros.callback_guard import CallbackGuard
from hybrid_ins.ros.cdr import ImuDecoder, ImuFields
from hybrid_ins.ros.diagnostics import status
from hybrid_ins.ros.estimator import Estimator
from hybrid_ins.ros.message_types import OUTPUTS, fill_transforms
from hybrid_ins.ros.node_messages import MESSAGES, new_message
from hybrid_ins.ros.output_topics import OutputTopics
from hybrid_ins.ros.rate_limiter import RateLimiter
from hybrid_ins.ros.warm_up import warm_up

IMU_QOS = QoSProfile(
    history=HistoryPolicy.KEEP_LAST, depth=2000, reliability=ReliabilityPolicy.BEST_EFFORT
)
GNSS_QOS = QoSProfile(
    history=HistoryPolicy.KEEP_LAST, depth=50, reliability=ReliabilityPolicy.BEST_EFFORT
)
OUTPUT_QOS = QoSProfile(
    history=HistoryPolicy.KEEP_LAST, depth=100, reliability=ReliabilityPolicy.RELIABLE
)
LATCHED_QOS = QoSProfile(
    history=HistoryPolicy.KEEP_LAST,
    depth=1,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)
TRANSFORM_RATE = 50.0  # Hz, on /tf
FIXED_QOS = QoSProfile(
    history=HistoryPolicy.KEEP_LAST,
    depth=100,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)
SILENCE = 2.0  # s without IMU data after which diagnostics come from the wall clock


class InsNode(Node):
    """INS/GNSS navigation of one vehicle."""

    def __init__(self) -> None:
        super().__init__(parameters.NODE_NAME)
        given: dict[str, Any] = {}
        for p in parameters.PARAMETERS.values():
            described = node_parameters.descriptor(p)
            value = self.declare_parameter(p.name, p.default, described).value
            if value is not None:  # what ROS makes of an empty list in a file
                given[p.name] = node_parameters.plain(value)
        self._warn_of_unknown_parameters()
        values: dict[str, Any] = dict(parameters.check_all(given))
        self._decoder = ImuDecoder()
        self._estimator = Estimator(values, self._log)
        self.guard = CallbackGuard(self._estimator.inputs)
        self._by_receipt = bool(values["use_receive_time"])
        self._transforms_due = RateLimiter(TRANSFORM_RATE)
        self._crowded: set[str] = set()
        self._last_imu = time.monotonic()

        self._topics = OutputTopics(values, new_message)
        for topic, type_name in OUTPUTS.items():
            self._topics.publishers[topic] = self.create_publisher(
                MESSAGES[type_name],
                topic,
                LATCHED_QOS if topic == "datum" else OUTPUT_QOS,
                event_callbacks=PublisherEventCallbacks(matched=self._topics.find_subscribers),
                qos_overriding_options=QoSOverridingOptions.with_default_policies(),
            )
        self._transforms: Any = None
        if TFMessage is None:
            if values["publish_tf"]:
                self.get_logger().info(
                    "tf2_msgs is not installed: /tf is not published and /tf_static not read"
                )
        else:
            if values["publish_tf"]:
                self._transforms = TFMessage(transforms=[TransformStamped(), TransformStamped()])
                self._publish_transforms = self.create_publisher(
                    TFMessage, "/tf", OUTPUT_QOS
                ).publish
            self._subscribe(
                TFMessage, "/tf_static", self._estimator.handle_static_transforms, FIXED_QOS
            )
        self._subscribe(Imu, "imu/data", self._on_imu, IMU_QOS, self._decode_imu)
        self._subscribe(NavSatFix, "gnss/fix", self._on_fix, GNSS_QOS)
        self._subscribe(TwistWithCovarianceStamped, "gnss/velocity", self._on_velocity, GNSS_QOS)
        self._subscribe(PoseWithCovarianceStamped, "initialpose", self._on_initial_pose, OUTPUT_QOS)
        self.create_service(Trigger, "~/reset", self._on_reset)
        self.create_timer(1.0, self.guard.wrap(self._on_second), clock=rclpy.clock.Clock())
        self.add_pre_set_parameters_callback(node_parameters.read_texts)
        self.add_on_set_parameters_callback(self._check_parameters)
        self.add_post_set_parameters_callback(self.guard.wrap(self._use_parameters))
        self._topics.find_subscribers()
        self._publish_reports()

    def prepare(self) -> None:
        """Load and run everything once, so that the first message is handled as fast as any."""
        kernels.prepare(self.get_logger().info)
        warm_up(new_message)
        # What exists now stays: the collector need not traverse it again and again.
        gc.collect()
        gc.freeze()
        self.get_logger().info("ready: waiting for " + self._estimator.waiting_for)

    def _subscribe(
        self,
        kind: Any,
        topic: str,
        callback: Callable[[Any], None],
        qos: QoSProfile,
        decode: Callable[[bytes], Any] | None = None,
    ) -> None:
        decode = decode or (lambda data: deserialize_message(data, kind))

        def incompatible(event: Any) -> None:
            policy = qos_policy_name_from_kind(event.last_policy_kind)
            self.get_logger().error(
                f"{self.resolve_topic_name(topic)}: the {policy} of a publisher's QoS is "
                "incompatible: nothing arrives from it; change it there, or ours by qos_overrides"
            )

        self.create_subscription(
            kind,
            topic,
            self.guard.decoding(topic, decode, callback),
            qos,
            raw=True,
            event_callbacks=SubscriptionEventCallbacks(incompatible_qos=incompatible),
            qos_overriding_options=QoSOverridingOptions.with_default_policies(),
        )

    # Input.

    def _decode_imu(self, data: bytes) -> ImuFields:
        try:
            return self._decoder.decode(data)
        except ValueError:  # another byte order
            return conversions.imu_fields(deserialize_message(data, Imu))

    def _on_imu(self, imu: ImuFields) -> None:
        estimator = self._estimator
        self._last_imu = time.monotonic()
        odometry = estimator.handle_imu(imu, self._received_ns())
        if odometry is not None:
            self._topics.publish_odometry(odometry)
            if self._transforms is not None and self._transforms_due.is_due(odometry.t_ns):
                fill_transforms(self._transforms.transforms, odometry, estimator.values)
                self._publish_transforms(self._transforms)
        estimator.run_periodic()
        self._topics.publish_some(estimator.pop_reports())

    def _received_ns(self) -> int | None:
        return self.get_clock().now().nanoseconds if self._by_receipt else None

    def _on_fix(self, message: NavSatFix) -> None:
        self._estimator.handle_fix(message, self._received_ns())
        self._publish_reports()

    def _on_velocity(self, message: TwistWithCovarianceStamped) -> None:
        self._estimator.handle_velocity(message, self._received_ns())
        self._publish_reports()

    def _on_initial_pose(self, message: PoseWithCovarianceStamped) -> None:
        self._estimator.handle_initial_pose(message)
        self._publish_reports()

    def _on_reset(self, _request: object, response: Trigger.Response) -> Trigger.Response:
        response.success, response.message = False, "internal error: see the log"
        try:
            self._estimator.reset()
            response.success, response.message = True, "aligning anew"
        except Exception as error:  # see `CallbackGuard`
            self.guard.on_error(error)
        return response

    def _on_second(self) -> None:
        """Check the topics, and keep diagnostics alive when no IMU sample drives them."""
        self._topics.find_subscribers()
        for name in ("imu/data", "gnss/fix", "gnss/velocity"):
            topic = self.resolve_topic_name(name)
            if topic not in self._crowded and self.count_publishers(topic) > 1:
                self._crowded.add(topic)
                nodes = [info.node_name for info in self.get_publishers_info_by_topic(topic)]
                self._estimator.inputs.count_and_warn(
                    name,
                    conversions.Refused(
                        f"{name}: several publishers",
                        f"{topic} has {len(nodes)} publishers "
                        f"({', '.join(nodes)}): stop or remap all but one",
                    ),
                )
        silent = time.monotonic() - self._last_imu
        if silent < SILENCE:
            return
        now = self.get_clock().now().nanoseconds
        topic = self.resolve_topic_name("imu/data")
        self._topics.publish_diagnostics(
            now,
            [
                *self._estimator.diagnostics(now),
                status(
                    "imu",
                    2,
                    f"no messages on {topic} for {silent:.0f} s: is the driver running, the topic "
                    "remapped, the QoS compatible?",
                    {"topic": topic, "publishers": self.count_publishers(topic)},
                ),
            ],
        )

    def _publish_reports(self) -> None:
        self._topics.publish_all(self._estimator.pop_reports())

    def _log(self, level: str, text: str) -> None:
        # One line for each level: rclpy ties a severity to the line it is logged from.
        if level == "info":
            self.get_logger().info(text)
        elif level == "warn":
            self.get_logger().warning(text)
        else:
            self.get_logger().error(text)

    # Parameters.

    def _warn_of_unknown_parameters(self) -> None:
        """Warn of names that ROS ignores silently; a file for '/**' may address other nodes."""
        for name in self._parameter_overrides:
            if name != "use_sim_time" and not name.startswith("qos_overrides."):
                try:
                    parameters.find(name)
                except InputError as error:
                    self.get_logger().warning(str(error))

    def _check_parameters(self, changes: list[Any]) -> SetParametersResult:
        try:
            self._checked(changes)
        except InputError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _checked(self, changes: list[Any]) -> dict[str, Any]:
        """Check changes of this package's parameters; others are not ours to check."""
        ours = [p for p in changes if p.name in parameters.PARAMETERS]
        known = {p.name: node_parameters.plain(p.value) for p in ours}
        return parameters.check_change(self._estimator.values, known)

    def _use_parameters(self, changes: list[Any]) -> None:
        checked = self._checked(changes)
        if checked:
            self._estimator.change(checked)
            self._topics.set_odometry_rate(self._estimator.values["odometry_rate"])

    def publish_end(self) -> None:
        """Publish what is left and a last diagnostics message."""
        self._publish_reports()
        now = self.get_clock().now().nanoseconds
        first, *others = self._estimator.diagnostics(now)
        first = first._replace(text=f"shut down; {first.text}")
        self._topics.publish_diagnostics(now, [first, *others])


def main(argv: Sequence[str] | None = None) -> int:
    """Run the node until Ctrl-C or SIGTERM."""
    arguments = list(sys.argv if argv is None else ["ins_node", *argv])
    if {"-h", "--help"} & set(arguments[1:]):
        print(node_parameters.help_text())
        return 0
    try:
        rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
    except (RCLError, RCLInvalidROSArgsError, UnknownROSArgsError) as error:
        return _refuse_start(error)
    asked_to_stop: Future[None] = Future()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: asked_to_stop.set_result(None))
    node = None
    try:
        node = InsNode()
        node.prepare()
        executor = EventsExecutor()
        executor.add_node(node)
        while rclpy.ok() and not asked_to_stop.done():
            try:
                # The executor's endless spin() ignores signals.
                executor.spin_until_future_complete(asked_to_stop, 0.2)
            except ExternalShutdownException:
                break
            except Exception as error:  # what no callback caught
                node.guard.on_error(error)
                time.sleep(0.01)  # it may come again at once
    except ExternalShutdownException:
        pass
    except (InputError, ParameterException) as error:
        return _refuse_start(error)
    finally:
        if node is not None:
            if rclpy.ok():
                node.publish_end()
            node.destroy_node()
        rclpy.try_shutdown()
    return 0


def _refuse_start(error: Exception) -> int:
    """Print in one line why the node does not start."""
    line = " ".join(str(error).split())
    if isinstance(error, UnknownROSArgsError):
        line = f"unknown ROS arguments {line}: see ins_node --help"
    print(f"ins_node: error: {line[:400]}", file=sys.stderr)
    return 2


if __name__ == "__main__":
    exit_status = main()
    sys.stdout.flush()
    os._exit(exit_status)
