"""The byte layouts against two independent serialisers: rosbags and rclpy."""

import random
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_typestore

from hybrid_ins.ros.messages.cdr import ImuDecoder, OdometryEncoder, imu_records

TYPES = get_typestore(Stores.ROS2_JAZZY)
IMU, ODOMETRY = "sensor_msgs/msg/Imu", "nav_msgs/msg/Odometry"

stamps_ns = st.integers(-(2**31) * 10**9, (2**31 - 1) * 10**9 + 999_999_999)
names = st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"]), max_size=40)
finite_or_not = st.floats(allow_nan=True, allow_infinity=True)


def vectors(size: int) -> st.SearchStrategy[list[float]]:
    return st.lists(finite_or_not, min_size=size, max_size=size)


def typed(type_name: str, *values: Any) -> Any:
    return TYPES.types[type_name](*values)


def header(stamp_ns: int, frame_id: str) -> Any:
    stamp = typed("builtin_interfaces/msg/Time", *divmod(stamp_ns, 1_000_000_000))
    return typed("std_msgs/msg/Header", stamp, frame_id)


def imu_bytes(stamp_ns: int, frame_id: str, v: list[float], *, little_endian: bool = True) -> bytes:
    """Serialise an Imu whose 37 numbers are `v`."""
    message = typed(
        IMU,
        header(stamp_ns, frame_id),
        typed("geometry_msgs/msg/Quaternion", *v[0:4]),
        np.array(v[4:13]),
        typed("geometry_msgs/msg/Vector3", *v[13:16]),
        np.array(v[16:25]),
        typed("geometry_msgs/msg/Vector3", *v[25:28]),
        np.array(v[28:37]),
    )
    return bytes(TYPES.serialize_cdr(message, IMU, little_endian=little_endian))


def same(a: Any, b: Any) -> bool:
    return bool(np.array_equal(np.ravel(a), np.ravel(b), equal_nan=True))


@given(st.lists(st.tuples(stamps_ns, names, vectors(37)), min_size=1, max_size=5))
def test_one_decoder_reads_imu_messages_of_changing_layout(
    messages: list[tuple[int, str, list[float]]],
) -> None:
    decoder = ImuDecoder()
    for stamp_ns, frame_id, v in messages:
        fields = decoder.decode(imu_bytes(stamp_ns, frame_id, v))
        assert (fields.stamp_ns, fields.frame_id) == (stamp_ns, frame_id)
        assert same(fields.orientation_xyzw, v[0:4])
        assert same(fields.orientation_cov0, v[4])
        assert same(fields.angular_rate, v[13:16])
        assert same(fields.angular_rate_cov0, v[16])
        assert same(fields.specific_force, v[25:28])
        assert same(fields.specific_force_cov0, v[28])


@given(
    names, st.lists(st.tuples(stamps_ns, vectors(37)), min_size=1, max_size=5), st.integers(0, 3)
)
def test_records_view_many_imu_messages(
    frame_id: str, messages: list[tuple[int, list[float]]], padding: int
) -> None:
    table = imu_records([imu_bytes(t, frame_id, v) + bytes(padding) for t, v in messages])
    stamps = table["seconds"].astype(np.int64) * 1_000_000_000 + table["nanoseconds"]
    numbers = np.array([v for _, v in messages])
    assert list(stamps) == [t for t, _ in messages]
    assert same(table["orientation_xyzw"], numbers[:, 0:4])
    assert same(table["orientation_covariance"], numbers[:, 4:13])
    assert same(table["angular_rate"], numbers[:, 13:16])
    assert same(table["angular_rate_covariance"], numbers[:, 16:25])
    assert same(table["specific_force"], numbers[:, 25:28])
    assert same(table["specific_force_covariance"], numbers[:, 28:37])


NUMBERS = [float(k) for k in range(37)]


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\x00\x01\x00\x00",
        imu_bytes(1, "imu", NUMBERS)[:-1],
        imu_bytes(1, "imu", NUMBERS) + bytes(4),
        imu_bytes(1, "imu", NUMBERS, little_endian=False),
        b"\x00\x07" + imu_bytes(1, "imu", NUMBERS)[2:],  # XCDR2: doubles lie elsewhere
        bytes(12) + b"\xff\xff\xff\xff" + bytes(400),
    ],
    ids=["empty", "header only", "short", "long", "big endian", "XCDR2", "endless name"],
)
def test_other_layouts_are_left_to_the_typed_path(data: bytes) -> None:
    decoder = ImuDecoder()
    for _ in range(2):
        with pytest.raises(ValueError):
            decoder.decode(data)
    assert decoder.decode(imu_bytes(7, "imu", NUMBERS)).stamp_ns == 7
    with pytest.raises(ValueError):
        decoder.decode(data)
    with pytest.raises(ValueError):
        imu_records([imu_bytes(7, "imu", NUMBERS), data])


def test_padding_by_the_middleware_is_ignored() -> None:
    decoder = ImuDecoder()
    for padding in (0, 1, 2, 3, 0):
        fields = decoder.decode(imu_bytes(7, "imu", NUMBERS) + bytes(padding))
        assert (fields.stamp_ns, fields.specific_force) == (7, (25.0, 26.0, 27.0))


def test_mixed_layouts_are_refused_in_bulk() -> None:
    for other in (imu_bytes(1, "ima", NUMBERS), imu_bytes(1, "imu/data", NUMBERS)):
        mixed = [imu_bytes(1, "imu", NUMBERS), other]
        if len(other) == len(mixed[0]):
            assert len(imu_records(mixed)) == 2  # another name of the same length is no matter
        else:
            with pytest.raises(ValueError, match="differ"):
                imu_records(mixed)


@settings(max_examples=50)
@given(st.integers(0, 2**32))
def test_no_bytes_provoke_anything_but_a_value_error(seed: int) -> None:
    rng = random.Random(seed)
    data = bytearray(imu_bytes(1, "imu", NUMBERS))
    decoder = ImuDecoder()
    for _ in range(100):
        mutant = bytearray(data)
        for _ in range(rng.randrange(1, 4)):
            mutant[rng.randrange(24)] = rng.randrange(256)
        mutant = mutant[: rng.choice((len(data), rng.randrange(len(data))))]
        try:
            decoder.decode(bytes(mutant))
        except ValueError:
            continue


ODOMETRY_VALUES = st.tuples(
    stamps_ns, vectors(3), vectors(4), vectors(36), vectors(3), vectors(3), vectors(36)
)


@given(names, names, st.lists(ODOMETRY_VALUES, min_size=1, max_size=3))
def test_odometry_equals_the_bytes_of_rosbags(
    frame_id: str, child_frame_id: str, messages: list[tuple[Any, ...]]
) -> None:
    encoder = OdometryEncoder(frame_id, child_frame_id)
    for stamp_ns, position, quat, pose_cov, linear, angular, twist_cov in messages:
        expected = typed(
            ODOMETRY,
            header(stamp_ns, frame_id),
            child_frame_id,
            typed(
                "geometry_msgs/msg/PoseWithCovariance",
                typed(
                    "geometry_msgs/msg/Pose",
                    typed("geometry_msgs/msg/Point", *position),
                    typed("geometry_msgs/msg/Quaternion", *quat),
                ),
                np.array(pose_cov),
            ),
            typed(
                "geometry_msgs/msg/TwistWithCovariance",
                typed(
                    "geometry_msgs/msg/Twist",
                    typed("geometry_msgs/msg/Vector3", *linear),
                    typed("geometry_msgs/msg/Vector3", *angular),
                ),
                np.array(twist_cov),
            ),
        )
        pose_matrix, twist_matrix = np.reshape(pose_cov, (6, 6)), np.reshape(twist_cov, (6, 6))
        data = encoder.encode(stamp_ns, position, quat, pose_matrix, linear, angular, twist_matrix)
        assert data == bytes(TYPES.serialize_cdr(expected, ODOMETRY))
        encoder.values[:] = 0.0
        encoder.values[:] = [*position, *quat, *pose_cov, *linear, *angular, *twist_cov]
        assert encoder.message(stamp_ns) == data


# --- rclpy ----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def ros() -> SimpleNamespace:
    serialization = pytest.importorskip("rclpy.serialization", reason="no ROS 2 Python packages")
    from nav_msgs.msg import Odometry
    from sensor_msgs.msg import Imu

    return SimpleNamespace(serialize=serialization.serialize_message, Imu=Imu, Odometry=Odometry)


def test_imu_as_rclpy_serialises_it(ros: SimpleNamespace) -> None:
    decoder = ImuDecoder()
    for frame_id in (
        "",
        "i",
        "im",
        "imu",
        "imu_",
        "imu_l",
        "imu_li",
        "imu_lin",
        "imu_link",
        "größe",
    ):
        message = ros.Imu()
        message.header.stamp.sec, message.header.stamp.nanosec = 5, 6
        message.header.frame_id = frame_id
        message.orientation.w, message.orientation.x = 0.5, 0.25
        message.orientation_covariance[0] = -1.0
        message.angular_velocity.y = 2.0
        message.linear_acceleration.z = 9.8
        message.linear_acceleration_covariance[0] = 0.1
        fields = decoder.decode(ros.serialize(message))
        assert fields == (
            5_000_000_006,
            (0.0, 0.0, 9.8),
            (0.0, 2.0, 0.0),
            frame_id,
            (0.25, 0.0, 0.0, 0.5),
            0.1,
            0.0,
            -1.0,
        )


def test_odometry_as_rclpy_serialises_it(ros: SimpleNamespace) -> None:
    for frame_id, child in (("map", "base_link"), ("", ""), ("odom", "b"), ("robot1/map", "größe")):
        message = ros.Odometry()
        message.header.stamp.sec, message.header.stamp.nanosec = 1_700_000_000, 999_999_999
        message.header.frame_id, message.child_frame_id = frame_id, child
        position, quaternion = message.pose.pose.position, message.pose.pose.orientation
        position.x, position.y, position.z = 1.0, 2.0, 3.0
        quaternion.x, quaternion.y, quaternion.z, quaternion.w = 0.1, 0.2, 0.3, 0.4
        twist = message.twist.twist
        twist.linear.x, twist.linear.y, twist.linear.z = 4.0, 5.0, 6.0
        twist.angular.x, twist.angular.y, twist.angular.z = 7.0, 8.0, 9.0
        message.pose.covariance[:] = np.arange(36.0)
        message.twist.covariance[:] = np.arange(36.0) + 100.0
        data = OdometryEncoder(frame_id, child).encode(
            1_700_000_000_999_999_999,
            (1, 2, 3),
            (0.1, 0.2, 0.3, 0.4),
            np.arange(36.0).reshape(6, 6),
            (4, 5, 6),
            (7, 8, 9),
            np.arange(36.0).reshape(6, 6) + 100.0,
        )
        theirs = ros.serialize(message)
        assert len(data) == len(theirs)
        differing = {k for k, (a, b) in enumerate(zip(data, theirs, strict=True)) if a != b}
        assert differing <= gaps(frame_id, child)


def gaps(frame_id: str, child_frame_id: str) -> set[int]:
    """Return the offsets before aligned fields; Fast CDR leaves there what it finds."""
    first = 16 + len(frame_id.encode()) + 1
    second = first + -first % 4
    third = second + 4 + len(child_frame_id.encode()) + 1
    return {*range(first, second), *range(third, third + (4 - third) % 8)}
