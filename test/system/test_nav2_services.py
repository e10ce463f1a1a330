"""
The services that Nav2 calls, under the types of robot_localization, from another process.

The types come from that package where it is installed. Where it is not, they are generated and
compiled from their published fields: the same generators, type support and middleware as there.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.ros_nodes import Client, start_node

from hybrid_ins.core.inertial.earth import LocalFrame, lla_to_ecef
from tools.processes import Processes

pytest.importorskip("rclpy", reason="no ROS 2 Python packages")

pytestmark = pytest.mark.live

DATUM = (32.1, 34.8, 50.0)


def enu(latitude: float, longitude: float, height: float) -> np.ndarray[Any, Any]:
    """The same by another way: Earth-fixed difference, turned into NED, swapped."""
    datum = np.array([math.radians(DATUM[0]), math.radians(DATUM[1]), DATUM[2]])
    lla = np.array([math.radians(latitude), math.radians(longitude), height])
    ned = LocalFrame(datum).C_en.T @ (lla_to_ecef(lla) - lla_to_ecef(datum))
    return np.array([ned[1], ned[0], -ned[2]])


def test_a_waypoint_follower_gets_its_points(
    processes: Processes, tmp_path: Path, client: Client, types: dict[str, str]
) -> None:
    """
    GIVEN a datum WHEN a client asks as nav2_waypoint_follower does THEN the points are right.

    That one takes each GeoPose's position to ``/fromLL`` and makes a PoseStamped in ``map`` of the
    answer. Before there is a datum only ``datum`` is offered; it may be moved.
    """
    from geographic_msgs.msg import GeoPoint, GeoPose
    from geometry_msgs.msg import Point
    from rclpy.qos import DurabilityPolicy, QoSProfile
    from robot_localization.srv import FromLL, FromLLArray, SetDatum, ToLL
    from sensor_msgs.msg import NavSatFix

    start_node(processes, tmp_path / "node.log", environment=types)
    heard: list[Any] = []
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    client.node.create_subscription(NavSatFix, "/datum", heard.append, latched)
    client.spin_until(lambda: "/datum" in dict(client.node.get_service_names_and_types()), 30.0)
    assert "/fromLL" not in dict(client.node.get_service_names_and_types())

    for place in ((10.0, 5.0, 100.0), DATUM):
        point = GeoPoint(latitude=place[0], longitude=place[1], altitude=place[2])
        client.call(SetDatum, "/datum", SetDatum.Request(geo_pose=GeoPose(position=point)))
        client.spin_until(
            lambda latitude=place[0]: heard and heard[-1].latitude == pytest.approx(latitude), 30.0
        )
        there = client.call(FromLL, "/fromLL", FromLL.Request(ll_point=point)).map_point
        assert (there.x, there.y, there.z) == pytest.approx((0.0, 0.0, 0.0), abs=1e-6)

    rng = np.random.default_rng(1)
    points = [
        GeoPoint(
            latitude=DATUM[0] + float(rng.uniform(-0.6, 0.6)),
            longitude=DATUM[1] + float(rng.uniform(-0.7, 0.7)),
            altitude=float(rng.uniform(-50.0, 3000.0)),
        )
        for _ in range(8)
    ]

    for point in points:
        there = client.call(FromLL, "/fromLL", FromLL.Request(ll_point=point)).map_point
        assert np.allclose(
            [there.x, there.y, there.z],
            enu(point.latitude, point.longitude, point.altitude),
            atol=1e-6,
        )
        back = client.call(ToLL, "/toLL", ToLL.Request(map_point=there)).ll_point
        metres = np.array([111e3, 111e3, 1.0]) * (
            back.latitude - point.latitude,
            back.longitude - point.longitude,
            back.altitude - point.altitude,
        )
        assert np.linalg.norm(metres) < 1e-3
    many = client.call(FromLLArray, "/fromLLArray", FromLLArray.Request(ll_points=points))
    assert [p.x for p in many.map_points] == pytest.approx(
        [enu(p.latitude, p.longitude, p.altitude)[0] for p in points]
    )

    unknown = GeoPoint(latitude=DATUM[0], longitude=DATUM[1], altitude=math.nan)
    there = client.call(FromLL, "/fromLL", FromLL.Request(ll_point=unknown)).map_point
    assert (there.x, there.y, there.z) == pytest.approx((0.0, 0.0, 0.0), abs=1e-6)
    wrong = client.call(FromLL, "/fromLL", FromLL.Request(ll_point=GeoPoint(latitude=91.0)))
    assert math.isnan(wrong.map_point.x)
    assert "latitude 91," in (tmp_path / "node.log").read_text()

    for x in (math.nan, math.inf, 1e300):
        nowhere = client.call(ToLL, "/toLL", ToLL.Request(map_point=Point(x=x))).ll_point
        assert math.isnan(nowhere.latitude) and math.isnan(nowhere.longitude)
    log = (tmp_path / "node.log").read_text()
    assert log.count("m in the map is not a point on Earth") == 3 and "RuntimeWarning" not in log
    space = GeoPoint(latitude=DATUM[0], longitude=DATUM[1], altitude=1e300)
    client.call(SetDatum, "/datum", SetDatum.Request(geo_pose=GeoPose(position=space)))
    there = client.call(FromLL, "/fromLL", FromLL.Request(ll_point=unknown)).map_point
    assert (there.x, there.y, there.z) == pytest.approx((0.0, 0.0, 0.0), abs=1e-6)
    assert "altitude 1e+300 is not a point on Earth" in (tmp_path / "node.log").read_text()

    kinds = dict(client.node.get_service_names_and_types())
    assert kinds["/fromLL"] == ["robot_localization/srv/FromLL"]
    assert kinds["/toLL"] == ["robot_localization/srv/ToLL"]
    assert kinds["/fromLLArray"] == ["robot_localization/srv/FromLLArray"]
    assert kinds["/datum"] == ["robot_localization/srv/SetDatum"]
