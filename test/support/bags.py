"""Recordings that tests write, and their messages."""

from pathlib import Path

from rosbags.typesys import Stores, get_typestore

from hybrid_ins.bags.messages import Message, new_message
from hybrid_ins.bags.reader import BagReader
from hybrid_ins.bags.writer import BagWriter
from hybrid_ins.ros.messages.type_names import FIX, IMU

START_NS = 1_700_000_000_000_000_000
TYPES = get_typestore(Stores.ROS2_JAZZY)


def imu_message(k: int, frame_id: str = "imu_link") -> Message:
    message = new_message(IMU)
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns(k), 1_000_000_000)
    message.header.frame_id = frame_id
    message.linear_acceleration.x = 0.1 * k
    message.linear_acceleration.z = 9.8
    message.angular_velocity.y = -0.01 * k
    return message


def stamp_ns(k: int) -> int:
    return START_NS + 5_000_000 * k


def serialised(message: Message) -> bytes:
    return bytes(TYPES.serialize_cdr(message, message.__msgtype__))


def write_flight(path: Path, count: int = 2000) -> Path:
    """Write an Imu topic at 200 Hz with a fix at every 40th sample; several chunks."""
    with BagWriter(path) as bag:
        for k in range(count):
            bag.write("imu/data", imu_message(k), stamp_ns(k) + 1000)
            if k % 40 == 0:
                bag.write("/gnss/fix", new_message(FIX), stamp_ns(k) + 2000)
    return path


def with_unstamped_pressure(flight: Path, path: Path) -> Path:
    """Write a recording again, with an altimeter whose driver does not stamp."""
    pressure = new_message("sensor_msgs/msg/FluidPressure")
    pressure.fluid_pressure = 101_325.0
    with BagReader(flight) as bag, BagWriter(path) as out:
        for topic, log_ns, data in bag.raw("/imu/data", "/gnss/fix"):
            out.write_raw(topic, bag.topics[topic], data, log_ns)
            if topic == "/gnss/fix":
                out.write("/aiding/pressure", pressure, log_ns)
    return path
