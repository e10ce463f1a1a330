"""
The estimator on a node's topics. Callbacks convert, call, publish.

Publishers exist as long as a `LiveEstimator`, subscriptions, services and timers while it is
active.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from typing import Any

from geometry_msgs.msg import (
    PoseWithCovarianceStamped,
    TransformStamped,
    TwistWithCovarianceStamped,
)
from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.exceptions import ParameterException
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
from sensor_msgs.msg import Imu, NavSatFix
from std_srvs.srv import Trigger

try:
    from tf2_msgs.msg import TFMessage
except ImportError:  # the wheels of ROS have none
    TFMessage = None
try:
    from gps_msgs.msg import GPSFix
except ImportError:
    GPSFix = None

from hybrid_ins.errors import InputError
from hybrid_ins.ros.aids import aiding_sources
from hybrid_ins.ros.callback_guard import CallbackGuard
from hybrid_ins.ros.estimator.estimator import Estimator
from hybrid_ins.ros.estimator.gps_fix_input import ABSENT, GpsFixInput
from hybrid_ins.ros.geographic_services import GeographicServices
from hybrid_ins.ros.input_watch import InputWatch
from hybrid_ins.ros.messages import conversions, interface
from hybrid_ins.ros.messages.cdr import ImuDecoder, ImuFields
from hybrid_ins.ros.messages.node_messages import MESSAGES, new_message
from hybrid_ins.ros.node_arguments import reason_of
from hybrid_ins.ros.output.message_types import OUTPUTS, fill_transforms
from hybrid_ins.ros.output.output_topics import OutputTopics
from hybrid_ins.ros.output.rate_limiter import RateLimiter
from hybrid_ins.ros.placement.static_transforms import without_tf2
from hybrid_ins.ros.reporting.input_log import Log
from hybrid_ins.ros.review.crowded_topics import CrowdedTopics
from hybrid_ins.ros.review.mistyped_topics import MistypedTopics
from hybrid_ins.ros.start.memory import HypothesesHeap
from hybrid_ins.ros.start.warm_start import WarmStart

TRANSFORM_RATE = 50.0  # Hz, on /tf
LAST_MESSAGES = Duration(seconds=0.2)  # of a publisher, to arrive before it is given up


def _qos(topic: str) -> QoSProfile:
    """Return the quality of service of a topic of `interface`."""
    quality = interface.QUALITY[topic]
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=quality.depth,
        reliability=(
            ReliabilityPolicy.RELIABLE if quality.reliable else ReliabilityPolicy.BEST_EFFORT
        ),
        durability=(
            DurabilityPolicy.TRANSIENT_LOCAL
            if quality.transient_local
            else DurabilityPolicy.VOLATILE
        ),
    )


@contextmanager
def _about(topic: str) -> Iterator[None]:
    """Name the topic that rclpy cannot create."""
    try:
        yield
    except (RuntimeError, ParameterException) as error:
        raise InputError(f"{topic}: {reason_of(error)}: check qos_overrides") from None


def _answering(action: Callable[[], str], guard: CallbackGuard) -> Callable[[Any, Any], Any]:
    """Return a Trigger service's callback that answers with what an action returns or raises."""

    def answer(_request: object, response: Trigger.Response) -> Trigger.Response:
        response.success, response.message = False, "internal error: see the log"
        try:
            response.message = action()
            response.success = True
        except InputError as error:
            response.message = str(error)
        except Exception as error:  # see `CallbackGuard`
            guard.on_error(error)
        return response

    return answer


class LiveEstimator:
    """
    Connects an estimator with the topics of a node.

    Parameters
    ----------
    node : Node
        Owns the topics.
    values : mapping
        Checked parameters.
    log : callable
        Called with a level (info, warn, error) and a line for the user.

    Attributes
    ----------
    estimator : Estimator
    guard : CallbackGuard
        Counts and logs what callbacks raise.
    """

    def __init__(self, node: Node, values: Mapping[str, Any], log: Log) -> None:
        self._node = node
        self._decoder = ImuDecoder()
        self.estimator = Estimator(values, log)
        self.guard = CallbackGuard(self.estimator.inputs)
        self._by_receipt = bool(values["use_receive_time"])
        self._transforms_due = RateLimiter(TRANSFORM_RATE)
        self._crowded = CrowdedTopics(node, self.estimator.inputs)
        self._mistyped = MistypedTopics(node, self.estimator.inputs)
        self._heap = HypothesesHeap()
        self._input: list[tuple[Callable[[Any], bool], Any]] = []  # how to destroy each, and it
        self._gps_fix = GpsFixInput(self.estimator, new_message)
        self._geographic: GeographicServices | None = None
        self._warm_start = WarmStart(self.estimator, values)
        self._warm_start.load_at_start()
        self._topics = OutputTopics(values, node.get_namespace(), node.get_name())
        self._watch = InputWatch(node, self.estimator, self._topics)
        self._transforms: Any = None
        self._transform_publisher: Any = None

    def advertise(self) -> None:
        """
        Create the publishers.

        Raises
        ------
        InputError
            A topic cannot be published, such as for the parameters of its QoS.
        """
        node, values = self._node, self.estimator.values
        for topic, type_name in OUTPUTS.items():
            with _about(topic):
                self._topics.publishers[topic] = node.create_publisher(
                    MESSAGES[type_name],
                    topic,
                    _qos(topic),
                    event_callbacks=PublisherEventCallbacks(matched=self._topics.find_subscribers),
                    qos_overriding_options=QoSOverridingOptions.with_default_policies(),
                )
        if TFMessage is None:
            for level, text in without_tf2(values):
                self.estimator.inputs.log(level, text)
        elif values["publish_tf"]:
            self._transforms = TFMessage(transforms=[TransformStamped(), TransformStamped()])
            self._transform_publisher = node.create_publisher(TFMessage, "/tf", _qos("/tf"))
        self._topics.find_subscribers()
        self._publish_reports()

    def activate(self) -> None:
        """
        Subscribe, and offer the services.

        Raises
        ------
        InputError
            A topic cannot be subscribed to, such as for the parameters of its QoS.
        """
        if TFMessage is not None:
            self._subscribe(TFMessage, "/tf_static", self.estimator.handle_static_transforms)
        self._watch.start()
        self._subscribe(Imu, "imu/data", self._on_imu, self._decode_imu)
        self._subscribe(NavSatFix, "gnss/fix", self._on_fix)
        if GPSFix is None:
            self.estimator.inputs.inform("gps_msgs", ABSENT)
        else:
            self._subscribe(GPSFix, "gnss/gpsfix", self._on_gps_fix)
        self._subscribe(TwistWithCovarianceStamped, "gnss/velocity", self._on_velocity)
        for topic, kind in aiding_sources.TOPICS.items():
            self._subscribe(MESSAGES[kind], topic, partial(self._on_aiding, topic))
        self._subscribe(PoseWithCovarianceStamped, "initialpose", self._on_initial_pose)
        node = self._node
        for name, action in (
            ("reset", self._reset),
            ("save", self._warm_start.save),
            ("load", self._load),
        ):
            service = node.create_service(Trigger, f"~/{name}", _answering(action, self.guard))
            self._input.append((node.destroy_service, service))
        clock = Clock(clock_type=ClockType.STEADY_TIME)  # of the computer, whatever it is set to
        timer = node.create_timer(1.0, self.guard.wrap(self._on_second), clock=clock)
        self._input.append((node.destroy_timer, timer))
        self._geographic = GeographicServices(
            node, self.estimator, self.guard, self._publish_reports
        )
        self._geographic.offer()

    def deactivate(self, state: str) -> None:
        """Stop to listen; diagnostics say last that the node is in ``state``."""
        if not self._input:
            return
        if self._geographic is not None:
            self._geographic.withdraw()
        while self._input:
            destroy, entity = self._input.pop()
            destroy(entity)
        self._publish_reports()
        self._warm_start.save_at_end()
        self._watch.end(state)

    def destroy(self) -> None:
        """Give the publishers up."""
        for publisher in self._topics.publishers.values():
            if self._node.context.ok():
                publisher.wait_for_all_acked(LAST_MESSAGES)
            self._node.destroy_publisher(publisher)
        self._topics.publishers.clear()
        if self._transform_publisher is not None:
            self._node.destroy_publisher(self._transform_publisher)
        self._topics.find_subscribers()

    def change(self, checked: Mapping[str, Any]) -> None:
        """Use checked values of run-time parameters."""
        self.estimator.change(checked)
        self._topics.set_odometry_rate(self.estimator.values["odometry_rate"])

    def _subscribe(
        self,
        kind: Any,
        topic: str,
        callback: Callable[[Any], None],
        decode: Callable[[bytes], Any] | None = None,
    ) -> None:
        node, decode = self._node, decode or (lambda data: deserialize_message(data, kind))

        def incompatible(event: Any) -> None:
            policy = qos_policy_name_from_kind(event.last_policy_kind)
            node.get_logger().error(
                f"{node.resolve_topic_name(topic)}: the {policy} of a publisher's QoS is "
                "incompatible: nothing arrives from it; change it there, or ours by qos_overrides"
            )

        with _about(topic):
            subscription = node.create_subscription(
                kind,
                topic,
                self.guard.decoding(topic, decode, callback),
                _qos(topic),
                raw=True,
                event_callbacks=SubscriptionEventCallbacks(incompatible_qos=incompatible),
                qos_overriding_options=QoSOverridingOptions.with_default_policies(),
            )
        self._input.append((node.destroy_subscription, subscription))

    # Input.

    def _decode_imu(self, data: bytes) -> ImuFields:
        try:
            return self._decoder.decode(data)
        except ValueError:  # another byte order
            return conversions.imu_fields(deserialize_message(data, Imu))

    def _on_imu(self, imu: ImuFields) -> None:
        estimator = self.estimator
        self._watch.imu_messages += 1
        odometry = estimator.handle_imu(imu, self._received_ns())
        if odometry is not None:
            self._topics.publish_odometry(odometry)
            if self._transforms is not None and self._transforms_due.is_due(odometry.t_ns):
                fill_transforms(self._transforms.transforms, odometry, estimator.values)
                self._transform_publisher.publish(self._transforms)
        estimator.run_periodic()
        self._topics.publish_some(estimator.pop_reports())

    def _received_ns(self) -> int | None:
        return self._node.get_clock().now().nanoseconds if self._by_receipt else None

    def _on_fix(self, message: NavSatFix) -> None:
        self._watch.fixes += 1
        received_ns = self._received_ns()
        self._gps_fix.note_fix(message, received_ns)
        self.estimator.handle_fix(message, received_ns)
        self._warm_start.on_fix(message)
        self._publish_reports()

    def _on_gps_fix(self, message: Any) -> None:
        self._watch.fixes += 1
        for fix in self._gps_fix.handle(message, self._received_ns())[:1]:
            self._warm_start.on_fix(fix)
        self._publish_reports()

    def _on_velocity(self, message: TwistWithCovarianceStamped) -> None:
        self.estimator.handle_velocity(message, self._received_ns())
        self._publish_reports()

    def _on_aiding(self, topic: str, message: Any) -> None:
        self.estimator.aids.sources.handle(topic, message, self._received_ns())
        self._publish_reports()

    def _on_initial_pose(self, message: PoseWithCovarianceStamped) -> None:
        self.estimator.handle_initial_pose(message)
        self._publish_reports()

    def _reset(self) -> str:
        self.estimator.reset()
        return "aligning anew"

    def _load(self) -> str:
        text = self._warm_start.load()
        self.estimator.reset()
        return text

    def _publish_reports(self) -> None:
        self._topics.publish_all(self.estimator.pop_reports())

    # The topics.

    def _on_second(self) -> None:
        """Check the topics, save, and say what does not come."""
        self._topics.find_subscribers()
        self._crowded.find()
        self._mistyped.find()
        self._warm_start.save_where_due()
        self._heap.update(len(self.estimator.navigator.phases.filters))
        if self._geographic is not None:
            self._geographic.offer()
        self._watch.on_second()
