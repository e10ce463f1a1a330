"""
``ins_node``: the estimator on ROS 2. Callbacks convert, call, publish; nothing is computed here.
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
        "ins_node: error: ROS 2 is not here: source /opt/ros/jazzy/setup.bash, or install its "
        'wheels: pip install "hybrid_ins[ros]"'
    ) from None
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import (
    AccelWithCovarianceStamped,
    PoseWithCovarianceStamped,
    TransformStamped,
    TwistWithCovarianceStamped,
    Vector3Stamped,
)
from nav_msgs.msg import Odometry
from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
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
from hybrid_ins.parameter import Parameter
from hybrid_ins.ros import conversions
from hybrid_ins.ros.cdr import ImuDecoder, OdometryEncoder, Status, encode_diagnostics
from hybrid_ins.ros.estimator import Estimator, warm_up
from hybrid_ins.ros.rate_limiter import RateLimiter

MESSAGES = {
    "nav_msgs/msg/Odometry": Odometry,
    "sensor_msgs/msg/NavSatFix": NavSatFix,
    "geometry_msgs/msg/TwistWithCovarianceStamped": TwistWithCovarianceStamped,
    "geometry_msgs/msg/Vector3Stamped": Vector3Stamped,
    "geometry_msgs/msg/AccelWithCovarianceStamped": AccelWithCovarianceStamped,
    "diagnostic_msgs/msg/DiagnosticStatus": DiagnosticStatus,
    "diagnostic_msgs/msg/DiagnosticArray": DiagnosticArray,
    "diagnostic_msgs/msg/KeyValue": KeyValue,
}
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
CROWD = 8  # waiting messages of which more than one goes out with a sample
SILENCE = 2.0  # s without IMU data after which diagnostics come from the wall clock


class InsNode(Node):
    """INS/GNSS navigation of one vehicle."""

    def __init__(self) -> None:
        super().__init__(parameters.NODE_NAME)
        given: dict[str, Any] = {}
        for p in parameters.PARAMETERS.values():
            value = self.declare_parameter(p.name, p.default, _descriptor(p)).value
            if value is not None:  # what ROS makes of an empty list in a file
                given[p.name] = _plain(value)
        self._tell_unknown_parameters()
        values: dict[str, Any] = dict(parameters.check_all(given))
        self._decoder = ImuDecoder()
        self._encoder = OdometryEncoder(values["map_frame"], values["base_frame"])
        self._estimator = Estimator(values, self._say)
        self._local_encoder = OdometryEncoder(values["odom_frame"], values["base_frame"])
        self._estimator.odometry = self._encoder.values
        self._estimator.local = self._local_encoder.values
        self._by_receipt = bool(values["use_receive_time"])
        self._transforms_due = RateLimiter(TRANSFORM_RATE)
        self._crowded: set[str] = set()
        self._last_imu = time.monotonic()
        self._odometry_due = RateLimiter(values["odometry_rate"])

        self._heard: dict[str, Callable[[bytes], None]] = {}
        self._heard_poses: list[tuple[Callable[[bytes], None], OdometryEncoder]] = []
        self._publishers_by_topic = {
            topic: self.create_publisher(
                MESSAGES[type_name],
                topic,
                LATCHED_QOS if topic == "datum" else OUTPUT_QOS,
                event_callbacks=PublisherEventCallbacks(matched=self._find_listeners),
                qos_overriding_options=QoSOverridingOptions.with_default_policies(),
            )
            for topic, type_name in conversions.OUTPUTS.items()
        }
        self._transforms: Any = None
        if TFMessage is None:
            if values["publish_tf"]:
                self.get_logger().info(
                    "tf2_msgs is not installed: nothing is said on /tf, and "
                    "nothing heard on /tf_static"
                )
        else:
            if values["publish_tf"]:
                self._transforms = TFMessage(transforms=[TransformStamped(), TransformStamped()])
                self._publish_transforms = self.create_publisher(
                    TFMessage, "/tf", OUTPUT_QOS
                ).publish
            self.create_subscription(
                TFMessage, "/tf_static", self._estimator.static_transforms, FIXED_QOS
            )
        self._subscribe(Imu, "imu/data", self._on_imu, IMU_QOS, raw=True)
        self._subscribe(NavSatFix, "gnss/fix", self._on_fix, GNSS_QOS)
        self._subscribe(TwistWithCovarianceStamped, "gnss/velocity", self._on_velocity, GNSS_QOS)
        self._subscribe(PoseWithCovarianceStamped, "initialpose", self._on_initial_pose, OUTPUT_QOS)
        self.create_service(Trigger, "~/reset", self._on_reset)
        self.create_timer(1.0, self._on_second, clock=rclpy.clock.Clock())
        self.add_on_set_parameters_callback(self._check_parameters)
        self.add_post_set_parameters_callback(self._take_parameters)
        self._find_listeners()
        self._flush()

    def prepare(self) -> None:
        """Make everything quick from the first message on; those that come meanwhile wait."""
        kernels.prepare(self.get_logger().info)
        warm_up(lambda name: MESSAGES[name]())
        # What there is now stays: the collector need not look at it again and again.
        gc.collect()
        gc.freeze()
        self.get_logger().info("ready: waiting for " + self._estimator.navigator.waiting_for)

    def _subscribe(
        self, kind: Any, topic: str, callback: Any, qos: QoSProfile, raw: bool = False
    ) -> None:
        def incompatible(event: Any) -> None:
            policy = qos_policy_name_from_kind(event.last_policy_kind)
            self.get_logger().error(
                f"{self.resolve_topic_name(topic)}: a publisher's QoS does not fit by its "
                f"{policy}: nothing arrives from it; change it there, or ours by qos_overrides"
            )

        self.create_subscription(
            kind,
            topic,
            callback,
            qos,
            raw=raw,
            event_callbacks=SubscriptionEventCallbacks(incompatible_qos=incompatible),
            qos_overriding_options=QoSOverridingOptions.with_default_policies(),
        )

    # Input.

    def _on_imu(self, data: bytes) -> None:
        estimator = self._estimator
        try:
            imu = self._decoder.decode(data)
        except ValueError:
            imu = conversions.imu_fields(deserialize_message(data, Imu))
        self._last_imu = time.monotonic()
        if estimator.imu_message(imu, self._received_ns()):
            self._tell_pose(estimator.navigator.last_ns)
        estimator.tick()
        if estimator.outbox:
            self._flush(1 + len(estimator.outbox) // CROWD)

    def _received_ns(self) -> int | None:
        return self.get_clock().now().nanoseconds if self._by_receipt else None

    def _on_fix(self, message: NavSatFix) -> None:
        self._estimator.fix(message, self._received_ns())
        self._flush()

    def _on_velocity(self, message: TwistWithCovarianceStamped) -> None:
        self._estimator.velocity(message, self._received_ns())
        self._flush()

    def _on_initial_pose(self, message: PoseWithCovarianceStamped) -> None:
        self._estimator.initial_pose(message)
        self._flush()

    def _on_reset(self, _request: object, response: Trigger.Response) -> Trigger.Response:
        self._estimator.reset()
        response.success, response.message = True, "aligning anew"
        return response

    def _on_second(self) -> None:
        """Look at the topics, and keep diagnostics alive when no IMU sample drives them."""
        self._find_listeners()
        for name in ("imu/data", "gnss/fix", "gnss/velocity"):
            topic = self.resolve_topic_name(name)
            if topic not in self._crowded and self.count_publishers(topic) > 1:
                self._crowded.add(topic)
                nodes = [info.node_name for info in self.get_publishers_info_by_topic(topic)]
                self._estimator.remark(
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
        self._publish_diagnostics(
            now,
            [
                *self._estimator.diagnostics(now),
                conversions.status(
                    "imu",
                    2,
                    f"no messages on {topic} for {silent:.0f} s: is the driver running, the topic "
                    "remapped, the QoS compatible?",
                    {"topic": topic, "publishers": self.count_publishers(topic)},
                ),
            ],
        )

    # Output.

    def _tell_pose(self, t_ns: int) -> None:
        """Publish odometry and transforms where they are due."""
        if self._odometry_due.is_due(t_ns):
            for publish, encoder in self._heard_poses:
                publish(encoder.message(t_ns))
        if self._transforms is not None and self._transforms_due.is_due(t_ns):
            self._estimator.fill_transforms(self._transforms.transforms)
            self._publish_transforms(self._transforms)

    def _flush(self, most: int = sys.maxsize) -> None:
        """Publish what waits, or the first of it that somebody listens to."""
        outbox = self._estimator.outbox
        while outbox and most:
            topic, message = outbox.popleft()
            publish = self._heard.get(topic)
            if publish is not None:
                publish(message)
                most -= 1

    def _find_listeners(self, _event: object = None) -> None:
        """Publishing is worth its time only where somebody listens, or will: datum is latched."""
        self._heard = {
            topic: publisher.publish
            for topic, publisher in self._publishers_by_topic.items()
            if topic == "datum" or publisher.get_subscription_count()
        }
        self._heard_poses = [
            (self._heard[topic], encoder)
            for topic, encoder in (
                ("odometry", self._encoder),
                ("odometry/local", self._local_encoder),
            )
            if topic in self._heard
        ]

    def _publish_diagnostics(self, t_ns: int, statuses: list[Status]) -> None:
        self._publishers_by_topic["/diagnostics"].publish(encode_diagnostics(t_ns, statuses))

    def _say(self, level: str, text: str) -> None:
        # One line for each level: rclpy ties a severity to the line it is logged from.
        if level == "info":
            self.get_logger().info(text)
        elif level == "warn":
            self.get_logger().warning(text)
        else:
            self.get_logger().error(text)

    # Parameters.

    def _tell_unknown_parameters(self) -> None:
        """Warn of names that ROS passes over in silence; a file for '/**' may mean others."""
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
        """Check changes of this package's parameters; others are not ours to judge."""
        known = {p.name: _plain(p.value) for p in changes if p.name in parameters.PARAMETERS}
        return parameters.check_change(self._estimator.values, known)

    def _take_parameters(self, changes: list[Any]) -> None:
        checked = self._checked(changes)
        if checked:
            self._estimator.change(checked)
            self._odometry_due.change(self._estimator.values["odometry_rate"])

    def say_goodbye(self) -> None:
        """Publish what is left and a last diagnostics message."""
        self._flush()
        now = self.get_clock().now().nanoseconds
        first, *others = self._estimator.diagnostics(now)
        first = first._replace(text=f"shut down; {first.text}")
        self._publish_diagnostics(now, [first, *others])


def _descriptor(parameter: Parameter) -> ParameterDescriptor:
    descriptor = ParameterDescriptor(
        description=parameter.text + (f" [{parameter.unit}]" if parameter.unit else ""),
        additional_constraints=", ".join(parameter.choices) or parameter.bounds(),
        read_only=not parameter.runtime,
        dynamic_typing=True,
    )
    low = 0.0 if parameter.or_zero else parameter.low
    bounded = abs(low) < 1e300 and abs(parameter.high) < 1e300
    if bounded and isinstance(parameter.default, float):
        descriptor.floating_point_range = [
            FloatingPointRange(from_value=low, to_value=parameter.high)
        ]
    elif (
        bounded and isinstance(parameter.default, int) and (not isinstance(parameter.default, bool))
    ):
        descriptor.integer_range = [IntegerRange(from_value=int(low), to_value=int(parameter.high))]
    return descriptor


def _plain(value: Any) -> Any:
    """Return a parameter's value as rclpy's arrays and numbers are in YAML."""
    return list(value) if hasattr(value, "__len__") and not isinstance(value, str) else value


def main(argv: Sequence[str] | None = None) -> int:
    """Run the node until Ctrl-C or SIGTERM."""
    arguments = list(sys.argv if argv is None else ["ins_node", *argv])
    if {"-h", "--help"} & set(arguments[1:]):
        print(_help())
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
            # The executor's endless spin() ignores signals.
            executor.spin_until_future_complete(asked_to_stop, 0.2)
    except ExternalShutdownException:
        pass
    except (InputError, ParameterException) as error:
        return _refuse_start(error)
    finally:
        if node is not None:
            if rclpy.ok():
                node.say_goodbye()
            node.destroy_node()
        rclpy.try_shutdown()
    return 0


def _refuse_start(error: Exception) -> int:
    """Say in one line why the node does not start."""
    line = " ".join(str(error).split())
    if isinstance(error, UnknownROSArgsError):
        line = f"unknown ROS arguments {line}: see ins_node --help"
    print(f"ins_node: error: {line[:400]}", file=sys.stderr)
    return 2


def _help() -> str:
    rows = []
    for p in parameters.PARAMETERS.values():
        unit = f" [{p.unit}]" if p.unit else ""
        words = f" ({', '.join(p.choices)})" if p.choices else ""
        rows.append(f"  {p.name} = {p.default}{unit}\n      {p.text}{words}")
    return (
        "usage: ins_node --ros-args [--params-file F] [-p NAME:=VALUE] [-r FROM:=TO]\n\n"
        "INS/GNSS navigation: imu/data and gnss/fix in, odometry out.\n\n"
        "example:\n  ins_node --ros-args --params-file params.yaml -r imu/data:=/my_imu/data\n\n"
        "parameters and their defaults:\n" + "\n".join(rows)
    )


if __name__ == "__main__":
    status = main()
    sys.stdout.flush()
    os._exit(status)
