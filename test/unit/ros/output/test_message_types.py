"""Reports become the bytes of messages that bags and rclpy understand alike."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from hybrid_ins.ros.output.message_types import OUTPUTS, encode
from hybrid_ins.ros.reporting.reports import (
    Diagnostics,
    ImuBiases,
    Position,
    Report,
    Status,
    Vector,
)

TYPES = get_typestore(Stores.ROS2_JAZZY)
T_NS = 5_000_000_006
STATUSES = [
    Status(1, "hybrid_ins: filter", "aligning, größer", [("state", "aligning"), ("σ", "0.5")]),
    Status(0, "hybrid_ins: input", "", []),
]
REPORTS = [
    Report(
        "gnss/filtered", Position(T_NS, "base_link", 32.1, -34.8, 20.5, np.arange(9.0), 3), T_NS
    ),
    Report("datum", Position(T_NS, "map", -32.1, 34.8, -3.0, np.zeros(9), 0), T_NS),
    Report("q/accelerometer", Vector(T_NS, "base_link", np.array([1e-3, 2e-3, 3e-3])), T_NS),
    Report(
        "imu/bias",
        ImuBiases(T_NS, "b", np.array([0.1, 0.2, 0.3]), np.array([4e-3, 5e-3, 6e-3]), np.ones(36)),
        T_NS,
    ),
    Report("gnss/verdict", STATUSES[0], T_NS),
    Report("/diagnostics", Diagnostics(T_NS, STATUSES), T_NS),
]


@pytest.mark.parametrize("report", REPORTS, ids=lambda report: report.topic)
def test_every_value_arrives(report: Report) -> None:
    message: Any = TYPES.deserialize_cdr(encode(report), OUTPUTS[report.topic])

    content = report.content
    if isinstance(content, Status):
        assert (message.level, message.name, message.message) == content[:3]
        assert [(v.key, v.value) for v in message.values] == list(content.values)
        return
    stamp = message.header.stamp
    assert (stamp.sec, stamp.nanosec) == (5, 6)
    if isinstance(content, Position):
        assert (message.latitude, message.longitude, message.altitude) == (
            content.latitude,
            content.longitude,
            content.height,
        )
        assert message.position_covariance == pytest.approx(content.covariance_enu)
        assert message.position_covariance_type == content.covariance_type
        assert message.header.frame_id == content.frame_id
    elif isinstance(content, Vector):
        vector = message.vector
        assert [vector.x, vector.y, vector.z] == content.xyz.tolist()
    elif isinstance(content, ImuBiases):
        linear, angular = message.accel.accel.linear, message.accel.accel.angular
        assert [linear.x, linear.y, linear.z] == content.accelerometer.tolist()
        assert [angular.x, angular.y, angular.z] == content.gyroscope.tolist()
        assert message.accel.covariance == pytest.approx(content.covariance)
    else:
        assert [status.message for status in message.status] == [s.text for s in content.statuses]


@pytest.mark.parametrize("report", REPORTS, ids=lambda report: report.topic)
def test_the_bytes_are_those_of_a_message_object(report: Report) -> None:
    data, type_name = encode(report, "/ins_node"), OUTPUTS[report.topic]

    assert bytes(TYPES.serialize_cdr(TYPES.deserialize_cdr(data, type_name), type_name)) == data


@pytest.mark.parametrize("report", REPORTS, ids=lambda report: report.topic)
def test_rclpy_says_the_same(report: Report) -> None:
    serialization = pytest.importorskip("rclpy.serialization", reason="no ROS 2 Python packages")
    from hybrid_ins.ros.messages import node_messages

    data, type_name = encode(report), OUTPUTS[report.topic]
    live: Any = serialization.deserialize_message(data, node_messages.MESSAGES[type_name])

    back = TYPES.deserialize_cdr(serialization.serialize_message(live), type_name)
    assert bytes(TYPES.serialize_cdr(back, type_name)) == data


@pytest.mark.parametrize("longitude", [325.2, -34.8, -394.8])
def test_longitudes_lie_within_180_degrees(longitude: float) -> None:
    """GIVEN fixes from 0 to 360° east, or a way around the Earth THEN maps find the place."""
    position = Position(T_NS, "map", 32.1, longitude, 0.0, np.eye(3).ravel(), 3)

    message: Any = TYPES.deserialize_cdr(encode(Report("datum", position, T_NS)), OUTPUTS["datum"])

    assert message.longitude == pytest.approx(-34.8)
