"""A recorded flight in memory, and the ways in which faults change its messages."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hybrid_ins.bags.messages import TYPES as ROS_TYPES
from hybrid_ins.bags.messages import Message, new_message
from hybrid_ins.bags.reader import BagReader
from hybrid_ins.bags.writer import BagWriter
from hybrid_ins.core.inertial.rotations import quat_from_rpy
from hybrid_ins.ros.messages.conversions import KNOWN, fill_transform, set_stamp, stamp_ns
from hybrid_ins.ros.messages.type_names import TRANSFORMS

IMU, FIX, VELOCITY, POSE = "/imu/data", "/gnss/fix", "/gnss/velocity", "/initialpose"
TF_STATIC, TRANSFORM = "/tf_static", "geometry_msgs/msg/TransformStamped"
TYPES = {
    VELOCITY: "geometry_msgs/msg/TwistWithCovarianceStamped",
    POSE: "geometry_msgs/msg/PoseWithCovarianceStamped",
    TF_STATIC: TRANSFORMS,
}


@dataclass(slots=True)
class Entry:
    """One message of a recording, decoded where a fault reads it."""

    log_ns: int
    topic: str
    type_name: str
    content: Message | bytes

    @property
    def message(self) -> Message:
        """The message object; what changes in it is written."""
        if isinstance(self.content, bytes):
            self.content = ROS_TYPES.deserialize_cdr(self.content, self.type_name)
        return self.content

    @property
    def data(self) -> bytes:
        """The bytes as they are written."""
        if isinstance(self.content, bytes):
            return self.content
        return bytes(ROS_TYPES.serialize_cdr(self.content, self.type_name))


@dataclass
class Flight:
    """
    A recording in memory, and the stretch that a fault is to change.

    Attributes
    ----------
    entries : list of Entry
        In order of log time.
    types : dict of str
        Type by topic.
    origin_ns, from_ns, to_ns : int
        Log times: of the first message, and of the fault's beginning and end.
    rng : Generator
        Draws whatever is random in the fault.
    """

    entries: list[Entry]
    types: dict[str, str]
    origin_ns: int
    from_ns: int
    to_ns: int
    rng: np.random.Generator

    @classmethod
    def read(cls, path: Path, start: float, duration: float, seed: int = 0) -> Flight:
        """Read a bag; the fault lasts from ``start`` for ``duration`` [s]."""
        with BagReader(path) as bag:
            types = {**bag.topics, **TYPES}
            entries = [
                Entry(log_ns, topic, types[topic], bytes(data))
                for topic, log_ns, data in bag.raw()
                if topic in (IMU, FIX, VELOCITY) or topic.startswith("/truth/")
            ]
            origin = bag.start_ns
        return cls(
            entries,
            types,
            origin,
            origin + round(start * 1e9),
            origin + round((start + duration) * 1e9),
            np.random.default_rng(seed),
        )

    def write(self, path: Path) -> None:
        """Write the bag in order of log time."""
        with BagWriter(path, overwrite=True) as bag:
            for entry in sorted(self.entries, key=lambda e: e.log_ns):
                bag.write_raw(entry.topic, entry.type_name, entry.data, entry.log_ns)

    def within(self, topic: str) -> Iterator[Entry]:
        """Yield the entries of a topic that the fault is to change."""
        for entry in self.entries:
            if entry.topic == topic and self.from_ns <= entry.log_ns < self.to_ns:
                yield entry

    def some(self, topic: str, share: float) -> Iterator[Entry]:
        """Yield a random share of them."""
        for entry in self.within(topic):
            if self.rng.random() < share:
                yield entry

    def drop(self, topic: str, share: float = 1.0) -> None:
        """Lose a share of a topic's messages."""
        lost = {id(entry) for entry in self.some(topic, share)}
        self.entries = [entry for entry in self.entries if id(entry) not in lost]

    def insert(self, topic: str, log_ns: int, message: Message | bytes) -> None:
        """Add a message."""
        self.entries.append(Entry(log_ns, topic, self.types[topic], message))

    def sort(self) -> None:
        """Bring the entries into the order of their log times."""
        self.entries.sort(key=lambda entry: entry.log_ns)


Injection = Callable[[Flight], None]


def read_force(message: Message) -> np.ndarray[Any, Any]:
    """Return the specific force of an Imu message [m/s²], shape (3,)."""
    a = message.linear_acceleration
    return np.array([a.x, a.y, a.z])


def set_force(message: Message, force: Any) -> None:
    """Replace the specific force of an Imu message [m/s²]."""
    a = message.linear_acceleration
    a.x, a.y, a.z = map(float, force)


def read_rate(message: Message) -> np.ndarray[Any, Any]:
    """Return the angular rate of an Imu message [rad/s], shape (3,)."""
    w = message.angular_velocity
    return np.array([w.x, w.y, w.z])


def set_rate(message: Message, rate: Any) -> None:
    """Replace the angular rate of an Imu message [rad/s]."""
    w = message.angular_velocity
    w.x, w.y, w.z = map(float, rate)


def change_force(
    make: Callable[[np.ndarray[Any, Any], Flight], Any], share: float = 1.0
) -> Injection:
    """Return what replaces the specific force in a share of the Imu messages."""

    def inject(flight: Flight) -> None:
        for entry in flight.some(IMU, share):
            set_force(entry.message, make(read_force(entry.message), flight))

    return inject


def change_rate(
    make: Callable[[np.ndarray[Any, Any], Flight], Any], share: float = 1.0
) -> Injection:
    """Return what replaces the angular rate in a share of the Imu messages."""

    def inject(flight: Flight) -> None:
        for entry in flight.some(IMU, share):
            set_rate(entry.message, make(read_rate(entry.message), flight))

    return inject


def both(*injections: Injection) -> Injection:
    """Return what injects one after the other."""

    def inject(flight: Flight) -> None:
        for each in injections:
            each(flight)

    return inject


def imu_frozen(flight: Flight) -> None:
    """Repeat the first reading."""
    first = next(flight.within(IMU)).message
    force, rate = read_force(first), read_rate(first)
    for entry in flight.within(IMU):
        set_force(entry.message, force)
        set_rate(entry.message, rate)


def imu_interpolated(flight: Flight) -> None:
    """Put the readings on a line between the first and the last: a gap that a converter fills."""
    messages = [entry.message for entry in flight.within(IMU)]
    ends = [np.array([*read_force(m), *read_rate(m)]) for m in (messages[0], messages[-1])]
    for share, message in zip(np.linspace(0.0, 1.0, len(messages)), messages, strict=True):
        reading = (1.0 - share) * ends[0] + share * ends[1]
        set_force(message, reading[:3])
        set_rate(message, reading[3:])


def imu_saturated(flight: Flight) -> None:
    """Vibrate beyond the accelerometer's range of 16 m/s²."""
    for entry in flight.within(IMU):
        shaken = read_force(entry.message) + flight.rng.normal(0.0, 8.0, 3)
        set_force(entry.message, np.clip(shaken, -16.0, 16.0))


def imu_no_reading(flight: Flight) -> None:
    """Declare the acceleration absent."""
    for entry in flight.within(IMU):
        entry.message.linear_acceleration_covariance = np.array([-1.0, *np.zeros(8)])


def imu_covariances(flight: Flight) -> None:
    """Fill the covariances with NaN, zero and infinity."""
    for entry in flight.within(IMU):
        entry.message.linear_acceleration_covariance = np.full(9, math.nan)
        entry.message.angular_velocity_covariance = np.zeros(9)
        entry.message.orientation_covariance = np.full(9, math.inf)


def imu_noise(flight: Flight) -> None:
    """Add strong white noise to force and rate."""
    for entry in flight.within(IMU):
        set_force(entry.message, read_force(entry.message) + flight.rng.normal(0.0, 6.0, 3))
        set_rate(entry.message, read_rate(entry.message) + flight.rng.normal(0.0, 0.3, 3))


def imu_two_publishers(flight: Flight) -> None:
    """Add a second IMU that contradicts the first."""
    for entry in list(flight.within(IMU)):
        second = copy.deepcopy(entry.message)
        second.header.frame_id = "second_imu"
        set_force(second, -read_force(second))
        flight.insert(IMU, entry.log_ns + 100_000, second)


def change_stamps(topic: str, make: Callable[[int, Flight], int], share: float = 1.0) -> Injection:
    """Return what replaces the stamps [ns] in a share of a topic's messages."""

    def inject(flight: Flight) -> None:
        for entry in flight.some(topic, share):
            stamp = entry.message.header.stamp
            set_stamp(stamp, make(stamp_ns(stamp), flight))

    return inject


def repeat_stamps(flight: Flight) -> None:
    """Give every fourth Imu message the stamp before it."""
    last = None
    for k, entry in enumerate(flight.within(IMU)):
        if k % 4 == 3 and last is not None:
            set_stamp(entry.message.header.stamp, last)
        last = stamp_ns(entry.message.header.stamp)


def swap_in_time(flight: Flight) -> None:
    """Deliver some Imu messages in the wrong order."""
    entries = list(flight.within(IMU))
    for a, b in zip(entries[::8], entries[1::8], strict=False):
        a.log_ns, b.log_ns = b.log_ns, a.log_ns


def clock_jump(seconds: float) -> Injection:
    """Return what shifts all stamps from the fault's beginning on."""

    def inject(flight: Flight) -> None:
        for entry in flight.entries:
            if entry.log_ns >= flight.from_ns and entry.topic != "/truth/datum":
                stamp = entry.message.header.stamp
                set_stamp(stamp, stamp_ns(stamp) + round(seconds * 1e9))

    return inject


def bag_loop(flight: Flight) -> None:
    """Play the beginning, then all from the beginning again."""
    gap = 1_000_000
    behind = flight.from_ns - flight.origin_ns + gap
    before = [copy.deepcopy(entry) for entry in flight.entries if entry.log_ns < flight.from_ns]
    for entry in flight.entries:
        entry.log_ns += behind
    flight.entries = before + flight.entries


def change_fixes(change: Callable[[Message, Flight], None], share: float = 1.0) -> Injection:
    """Return what changes a share of the fixes."""

    def inject(flight: Flight) -> None:
        for entry in flight.some(FIX, share):
            change(entry.message, flight)

    return inject


def with_attributes(**values: Any) -> Callable[[Message, Flight], None]:
    """Return what sets attributes of a message."""

    def change(message: Message, _flight: Flight) -> None:
        for name, value in values.items():
            setattr(message, name, value)

    return change


def with_status(value: int) -> Callable[[Message, Flight], None]:
    """Return what sets the status of a fix."""

    def change(message: Message, _flight: Flight) -> None:
        message.status.status = value

    return change


def with_covariance(matrix: Any, kind: int = KNOWN) -> Callable[[Message, Flight], None]:
    """Return what sets the covariance of a fix [m²] and its type."""

    def change(message: Message, _flight: Flight) -> None:
        message.position_covariance = np.asarray(matrix, float).ravel()
        message.position_covariance_type = kind

    return change


def moved_north(metres: Callable[[Flight], float]) -> Callable[[Message, Flight], None]:
    """Return what moves a fix to the north [m]."""

    def change(message: Message, flight: Flight) -> None:
        message.latitude += metres(flight) / 111_000.0

    return change


def drift(flight: Flight) -> None:
    """Let the fixes drift to the north by 2 m/s."""
    for entry in flight.within(FIX):
        entry.message.latitude += 2.0 * (entry.log_ns - flight.from_ns) * 1e-9 / 111_000.0


def fix_frozen(flight: Flight) -> None:
    """Repeat the first position with new stamps."""
    first = next(flight.within(FIX)).message
    for entry in flight.within(FIX):
        for name in ("latitude", "longitude", "altitude"):
            setattr(entry.message, name, getattr(first, name))


def fix_repeated(flight: Flight) -> None:
    """Send every fix twice."""
    for entry in list(flight.within(FIX)):
        flight.insert(FIX, entry.log_ns + 1_000_000, copy.deepcopy(entry.message))


def fix_late(delay: Callable[[Flight], float]) -> Injection:
    """Return what delivers the fixes later [s]."""

    def inject(flight: Flight) -> None:
        for entry in flight.within(FIX):
            entry.log_ns += round(delay(flight) * 1e9)
        flight.sort()

    return inject


def fix_burst(flight: Flight) -> None:
    """Hold all fixes of 0.9 s back and deliver them at once."""
    for entry in flight.within(FIX):
        entry.log_ns += 900_000_000 - (entry.log_ns - flight.from_ns) % 900_000_000
    flight.sort()


def change_frame_id(topic: str, name: str) -> Injection:
    """Return what renames the frame of a topic's messages."""

    def inject(flight: Flight) -> None:
        for entry in flight.within(topic):
            entry.message.header.frame_id = name

    return inject


def stray_frame_id(topic: str, share: float) -> Injection:
    """Return what renames the frame of some messages, while /tf_static places that elsewhere."""

    def inject(flight: Flight) -> None:
        transforms, placed = new_message(TRANSFORMS), new_message(TRANSFORM)
        quarter = quat_from_rpy(0.0, 0.0, 0.5 * math.pi)
        fill_transform(placed, flight.from_ns, "base_link", "elsewhere", [1.0, 0.0, 0.5], quarter)
        transforms.transforms = [placed]
        for entry in flight.some(topic, share):
            entry.message.header.frame_id = "elsewhere"
        flight.insert(TF_STATIC, flight.from_ns, transforms)

    return inject


def first_fix_wild(flight: Flight) -> None:
    """Move the first fix of the flight far away."""
    first = next(entry for entry in flight.entries if entry.topic == FIX)
    first.message.latitude += 1.0


def late_start(topic: str) -> Injection:
    """Return what removes a topic's messages before the fault's beginning."""

    def inject(flight: Flight) -> None:
        flight.entries = [
            entry
            for entry in flight.entries
            if entry.topic != topic or entry.log_ns >= flight.to_ns
        ]

    return inject


def insert_velocity(components: Callable[[Flight], tuple[float, float, float]]) -> Injection:
    """Return what adds velocity messages with these components, ENU [m/s]."""

    def inject(flight: Flight) -> None:
        for entry in list(flight.within(FIX)):
            message = new_message(TYPES[VELOCITY])
            message.header = copy.deepcopy(entry.message.header)
            linear = message.twist.twist.linear
            linear.x, linear.y, linear.z = components(flight)
            message.twist.covariance[[0, 7, 14]] = 0.05**2
            flight.insert(VELOCITY, entry.log_ns + 500_000, message)

    return inject


def insert_pose(quat_xyzw: tuple[float, float, float, float], yaw_std: float = 0.05) -> Injection:
    """Return what adds one initialpose."""

    def inject(flight: Flight) -> None:
        message = new_message(TYPES[POSE])
        q = message.pose.pose.orientation
        q.x, q.y, q.z, q.w = quat_xyzw
        message.pose.covariance[35] = yaw_std**2
        flight.insert(POSE, flight.from_ns, message)

    return inject


NAN, INF = math.nan, math.inf
INDEFINITE = [[1.0, 2.0, 0.0], [2.0, 1.0, 0.0], [0.0, 0.0, 1.0]]


def always(flight: Flight, inject: Injection) -> None:
    """Inject a fault into the whole flight."""
    flight.from_ns, flight.to_ns = flight.origin_ns, 2**62
    inject(flight)
