"""
Services between latitude and longitude and the map, as Nav2 calls them.

Their types are robot_localization's, since its clients ask for those; where that package is not
installed there are no such services.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from geometry_msgs.msg import Point
from numpy.typing import NDArray
from rclpy.node import Node

try:
    from robot_localization.srv import FromLL, FromLLArray, SetDatum, ToLL
except ImportError:
    FromLL = None

from hybrid_ins.ros.callback_guard import CallbackGuard
from hybrid_ins.ros.estimator.estimator import Estimator
from hybrid_ins.ros.messages.conversions import HIGHEST, MapFrame, place_of, set_place

Array = NDArray[np.float64]
Message = Any

ABSENT = (
    "robot_localization is not installed: the services fromLL, toLL, fromLLArray and datum, which "
    "have its types, are not offered"
)


class GeographicServices:
    """
    The services ``datum``, and ``fromLL``, ``toLL``, ``fromLLArray`` once the map has its origin.

    Parameters
    ----------
    node : Node
        Offers them.
    estimator : Estimator
        Has the map.
    guard : CallbackGuard
    on_change : callable
        Called after the map has moved.
    """

    def __init__(
        self, node: Node, estimator: Estimator, guard: CallbackGuard, on_change: Callable[[], None]
    ) -> None:
        self._node = node
        self._estimator = estimator
        self._guard = guard
        self._on_change = on_change
        self._services: list[Any] = []
        self._converting = FromLL is None
        if FromLL is None:
            estimator.inputs.inform("robot_localization", ABSENT)
        else:
            self._offer(SetDatum, "datum", self._set_datum)

    def offer(self) -> None:
        """Offer the conversions where they are possible by now; clients wait for a service."""
        if self._converting or self._estimator.odometry.map is None:
            return
        self._converting = True
        self._offer(FromLL, "fromLL", self._from_ll)
        self._offer(ToLL, "toLL", self._to_ll)
        self._offer(FromLLArray, "fromLLArray", self._from_ll_array)

    def withdraw(self) -> None:
        """Offer nothing more."""
        while self._services:
            self._node.destroy_service(self._services.pop())

    def _offer(self, kind: Any, name: str, answer: Callable[[Message, Message], None]) -> None:
        def guarded(request: Message, response: Message) -> Message:
            try:
                answer(request, response)
            except Exception as error:  # see `CallbackGuard`
                self._guard.on_error(error)
            return response

        self._services.append(self._node.create_service(kind, name, guarded))

    @property
    def _map(self) -> MapFrame:
        found = self._estimator.odometry.map
        assert found is not None
        return found

    def _from_ll(self, request: Message, response: Message) -> None:
        response.map_point = self._point(request.ll_point)

    def _from_ll_array(self, request: Message, response: Message) -> None:
        response.map_points = [self._point(point) for point in request.ll_points]

    def _to_ll(self, request: Message, response: Message) -> None:
        point = request.map_point
        position, lla = np.array([point.x, point.y, point.z]), np.full(3, math.nan)
        if np.isfinite(position).all():
            lla = self._map.lla(position)
        if not abs(lla[2]) <= HIGHEST:
            lla[:] = math.nan
            text = f"{position} m in the map is not a point on Earth: give metres"
            self._estimator.inputs.log("error", text)
        set_place(response.ll_point, lla)

    def _point(self, geographic: Message) -> Point:
        """Return a geographic_msgs/GeoPoint in the map; NaN for what is no point on Earth."""
        lla = lla_of(geographic, float(self._map.datum_lla[2]))
        if lla is None:
            self._refuse(geographic)
            return Point(x=math.nan, y=math.nan, z=math.nan)
        x, y, z = self._map.position(lla).tolist()
        return Point(x=x, y=y, z=z)

    def _refuse(self, geographic: Message) -> None:
        self._estimator.inputs.log(
            "error",
            f"{place_of(geographic.latitude, geographic.longitude)}, altitude "
            f"{geographic.altitude:.7g} is not a point on Earth: give degrees, and metres above "
            "the ellipsoid",
        )

    def _set_datum(self, request: Message, response: Message) -> None:
        pose = request.geo_pose
        lla = lla_of(pose.position, 0.0)
        text = "the map has its origin there"
        if lla is None:
            self._refuse(pose.position)
            text = "not a point on Earth: the map stays where it is"
        else:
            turned = math.hypot(pose.orientation.x, pose.orientation.y, pose.orientation.z) > 1e-3
            if turned:
                self._estimator.inputs.log(
                    "warn", "datum: the orientation is ignored: the map's axes are east, north, up"
                )
            self._estimator.inputs.log(
                "info",
                f"datum: {pose.position.latitude:.7f}°, {pose.position.longitude:.7f}°, "
                f"{lla[2]:.2f} m",
            )
            self._estimator.set_datum(lla, max(self._estimator.navigator.last_ns, 1))
            self._on_change()
            self.offer()
        if hasattr(response, "success"):  # since 2026
            response.success, response.message = lla is not None, text


def lla_of(geographic: Message, height: float) -> Array | None:
    """
    Latitude, longitude [rad] and height [m], shape (3,), of a geographic_msgs/GeoPoint.

    None for what is no point on Earth; an altitude that is NaN is ``height``.
    """
    latitude, longitude, altitude = geographic.latitude, geographic.longitude, geographic.altitude
    if not (abs(latitude) < 90.0 and abs(longitude) <= 360.0) or abs(altitude) > HIGHEST:
        return None
    altitude = height if math.isnan(altitude) else altitude
    return np.array([math.radians(latitude), math.radians(longitude), altitude])
