"""
gps_msgs/GPSFix: position, velocity and the kind of fix in one message.

References
----------
.. [1] gps_msgs/msg/GPSFix.msg and GPSStatus.msg: track in degrees clockwise from north, speed and
       climb in m/s, uncertainties (``err_...``) at 95 %, 0 or less where they are unknown.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybrid_ins.core.inertial.earth import horizontal_displacement
from hybrid_ins.ros.messages.conversions import NewMessage
from hybrid_ins.ros.messages.type_names import FIX, GPS_FIX, TWIST

Array = NDArray[np.float64]
Message = Any

DEFINITIONS = {
    "gps_msgs/msg/GPSStatus": (
        "std_msgs/Header header\n"
        "uint16 satellites_used\nint32[] satellite_used_prn\nuint16 satellites_visible\n"
        "int32[] satellite_visible_prn\nint32[] satellite_visible_z\n"
        "int32[] satellite_visible_azimuth\nint32[] satellite_visible_snr\n"
        "int16 status\nuint16 motion_source\nuint16 orientation_source\nuint16 position_source\n"
    ),
    GPS_FIX: (
        "std_msgs/Header header\ngps_msgs/GPSStatus status\n"
        + "".join(
            f"float64 {name}\n"
            for name in (
                *("latitude", "longitude", "altitude", "track", "speed", "climb"),
                *("pitch", "roll", "dip", "time", "gdop", "pdop", "hdop", "vdop", "tdop"),
                *("err", "err_horz", "err_vert", "err_track", "err_speed", "err_climb"),
                *("err_time", "err_pitch", "err_roll", "err_dip"),
            )
        )
        + "float64[9] position_covariance\nuint8 position_covariance_type\n"
    ),
}
"""The fields of the types [1]_, to read recordings where the package is not installed."""

FIX_TYPES = {
    -1: "no fix",
    0: "single",
    1: "SBAS",
    2: "GBAS",
    18: "DGPS",
    19: "RTK fixed",
    20: "RTK float",
    33: "WAAS",
}
"""Names of ``GPSStatus.status``; those of NavSatStatus are the same up to 2."""
NAVSAT_STATUS = {-1: -1, 0: 0, 1: 1, 33: 1, 2: 2, 18: 2, 19: 2, 20: 2}

LINE, CIRCLE = 1.96, 2.448  # standard deviations in 95 % of one and of two dimensions
DIAGONAL = 2  # type of a covariance

LONGEST_STEP_NS, LONGEST_NS = 2_000_000_000, 10_000_000_000  # between messages, of a comparison
SHORTEST_WAY = 5.0  # m, of a comparison
AGREES = math.radians(25.0)
VOTES, MAJORITY = 5, 4


def fix_type(status: int) -> str:
    """Return the name of a ``GPSStatus.status`` or a ``NavSatStatus.status``."""
    return FIX_TYPES.get(status, f"unknown ({status})")


def position_of(message: Message, new: NewMessage) -> Message:
    """
    Return a GPSFix as a sensor_msgs/NavSatFix; any other message as it is.

    Where it has no covariance, that is made of its 95 % uncertainties, if it has these.
    """
    if not hasattr(message, "err_horz"):
        return message
    fix = new(FIX)
    fix.header = message.header
    fix.status.status = NAVSAT_STATUS.get(int(message.status.status), 0)
    fix.latitude, fix.longitude = message.latitude, message.longitude
    fix.altitude = message.altitude
    fix.position_covariance = message.position_covariance
    fix.position_covariance_type = message.position_covariance_type
    horizontal = _given(message.err_horz) or _given(message.err)
    if message.position_covariance_type == 0 and horizontal:
        vertical = _given(message.err_vert)
        variance_h = (horizontal / CIRCLE) ** 2
        variance_v = (vertical / LINE) ** 2 if vertical else 4.0 * variance_h
        fix.position_covariance = np.diag([variance_h, variance_h, variance_v]).ravel()
        fix.position_covariance_type = DIAGONAL
    return fix


def velocity_of(message: Message, new: NewMessage) -> Message | None:
    """
    Return a GPSFix's velocity as a geometry_msgs/TwistWithCovarianceStamped, ENU.

    None where it has none: all is zero without an uncertainty, or the track is no direction. An
    uncertainty that is not given leaves the covariance zero, which means unknown.
    """
    speed, climb, track = float(message.speed), float(message.climb), float(message.track)
    std = _given(message.err_speed) / LINE
    if int(message.status.status) < 0 or not (math.isfinite(speed) and abs(track) <= 360.0):
        return None
    if speed == 0.0 and (climb == 0.0 or math.isnan(climb)) and not std:
        return None
    twist = new(TWIST)
    twist.header = message.header
    sine, cosine = math.sin(math.radians(track)), math.cos(math.radians(track))
    linear = twist.twist.twist.linear
    linear.x, linear.y, linear.z = speed * sine, speed * cosine, climb
    if std:
        # A direction is not known better than the components are.
        across = max(std, abs(speed) * math.radians(_given(message.err_track) / LINE))
        turn = np.array([[sine, cosine], [cosine, -sine]])
        covariance = np.zeros((6, 6))
        covariance[:2, :2] = turn @ np.diag([std**2, min(across, std + abs(speed)) ** 2]) @ turn.T
        covariance[2, 2] = ((_given(message.err_climb) / LINE) or std) ** 2
        twist.twist.covariance = covariance.ravel()
    return twist


def _given(error: float) -> float:
    """Return an uncertainty; 0 where it is unknown."""
    return float(error) if math.isfinite(error) and error > 0.0 else 0.0


class TrackCheck:
    """
    Compares the way that the velocities make with the way that the positions make.

    Some publishers fill ``track`` with the angle from east, or with radians. A velocity that points
    elsewhere would be worse than none, so it is not used before the positions have confirmed it.

    Attributes
    ----------
    confirmed : bool
        Most of the last comparisons agree, and the very last one does.
    contradicted : str
        Where most do not: what the track seems to be.
    """

    def __init__(self) -> None:
        self.confirmed, self.contradicted = False, ""
        self._before: tuple[int, Array] | None = None  # stamp [ns], velocities of the last message
        self._from: tuple[int, float, float] | None = None  # stamp [ns], latitude, longitude [rad]
        self._way = np.zeros((3, 2))
        self._votes: deque[tuple[bool, ...]] = deque(maxlen=VOTES)

    def observe(self, t_ns: int, message: Message) -> None:
        """Use a GPSFix with a velocity at a stamp [ns]."""
        here = t_ns, math.radians(message.latitude), math.radians(message.longitude)
        velocities = _velocities(float(message.speed), float(message.track))
        before, self._before = self._before, (t_ns, velocities)
        if before is None or self._from is None or not 0 < t_ns - before[0] <= LONGEST_STEP_NS:
            self._begin(here)
            return
        self._way += 0.5e-9 * (t_ns - before[0]) * (before[1] + velocities)
        north, east = horizontal_displacement(self._from[1:], here[1:])
        moved = east, north
        if math.hypot(*moved) >= SHORTEST_WAY:
            self._votes.append(tuple(_angle(moved, way) < AGREES for way in self._way))
            self._decide()
            self._begin(here)
        elif t_ns - self._from[0] > LONGEST_NS:
            self._begin(here)

    def _begin(self, here: tuple[int, float, float]) -> None:
        self._from = here
        self._way = np.zeros((3, 2))

    def _decide(self) -> None:
        right, radians_from_east, degrees_from_east = map(sum, zip(*self._votes, strict=True))
        # Radians that are taken for degrees point north, which may be right for a while.
        agrees = right >= MAJORITY and right > radians_from_east
        self.confirmed = agrees and self._votes[-1][0]
        self.contradicted = ""
        if len(self._votes) == VOTES and not agrees:
            if radians_from_east >= MAJORITY:
                self.contradicted = "an angle in radians, from east"
            elif degrees_from_east >= MAJORITY:
                self.contradicted = "an angle from east"
            elif right <= VOTES - MAJORITY:
                self.contradicted = "not the direction of motion"


def _velocities(speed: float, track: float) -> Array:
    """Return east, north [m/s] with a track in degrees from north, radians, degrees from east."""
    angles = np.array([0.5 * math.pi - math.radians(track), track, math.radians(track)])
    return speed * np.column_stack((np.cos(angles), np.sin(angles)))


def _angle(one: tuple[float, float], other: Array) -> float:
    """Return the angle between two ways [rad]."""
    return abs(
        math.remainder(math.atan2(one[1], one[0]) - math.atan2(other[1], other[0]), math.tau)
    )
