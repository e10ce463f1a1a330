"""
The node's topics and services: types, quality of service, and what each is for.

The node is built from these tables, the tables in ``docs/ros_interface.md`` are written from them,
and a test compares them with a running node.
"""

from __future__ import annotations

from typing import NamedTuple

from hybrid_ins.ros.messages import type_names


class Quality(NamedTuple):
    """Quality of service of a topic; history is "keep last"."""

    depth: int  # messages
    reliable: bool
    transient_local: bool = False  # late subscribers get the last messages


class Topic(NamedTuple):
    """A topic, relative to the node's namespace unless its name begins with ``/``."""

    name: str
    type_name: str
    quality: Quality
    text: str  # Markdown


class Service(NamedTuple):
    """A service; names that begin with ``~`` are relative to the node's name."""

    name: str
    type_name: str
    text: str  # Markdown


IMU = Quality(2000, reliable=False)
SENSOR = Quality(50, reliable=False)
OUTPUT = Quality(100, reliable=True)
FIXED = Quality(100, reliable=True, transient_local=True)
LATEST = Quality(1, reliable=True, transient_local=True)

AIDING = (
    Topic(
        "aiding/velocity",
        type_names.TWIST,
        SENSOR,
        "optional. Velocity of the vehicle in the axes of `base_frame`: wheels, a Doppler log. "
        "Axes with a variance of 0 or above 100 (m/s)² are not used. Where no axis is left and "
        "that of x is 0: the x axis, with `aiding.velocity_std_min`. Used in outages; its scale "
        "and its place are found with fixes",
    ),
    Topic(
        "aiding/odometry",
        type_names.ODOMETRY,
        SENSOR,
        "optional. The same from the twist of an odometry, of which nothing else is used",
    ),
    Topic(
        "aiding/heading",
        type_names.IMU,
        SENSOR,
        "optional. Orientation of `base_frame` (forward, left, up) in east-north-up, of which the "
        "yaw is used: two antennas, a compass. Only after the motion has confirmed it",
    ),
    Topic(
        "aiding/pressure",
        type_names.PRESSURE,
        SENSOR,
        "optional. Its height is used in outages; its offset is found with fixes",
    ),
)

SUBSCRIBED = (
    Topic(
        "imu/data",
        type_names.IMU,
        IMU,
        "required. Angular rates [rad/s] and specific force [m/s²] as REP-145 defines them: at "
        "rest +9.8 on the axis that points up",
    ),
    Topic(
        "gnss/fix",
        type_names.FIX,
        SENSOR,
        "required, unless `gnss/gpsfix` is given. A fix is valid when `status.status` is 0 or "
        "more. Altitude is above the WGS-84 ellipsoid; where it is NaN only the horizontal "
        "position is corrected. What drivers publish is in [GNSS drivers](gnss_drivers.md)",
    ),
    Topic(
        "gnss/gpsfix",
        type_names.GPS_FIX,
        SENSOR,
        "in place of `gnss/fix`, where gps_msgs is installed: position, velocity (track, speed, "
        "climb), kind of fix, DOP. Uncertainties are 95 % values. The velocity is used once "
        "positions have confirmed the track. Not used while `gnss/fix` has messages",
    ),
    Topic(
        "gnss/velocity",
        type_names.TWIST,
        SENSOR,
        "optional. Velocity of the antenna, in east-north-up axes. A vertical component of exactly "
        "0 without a positive variance says nothing of the climb",
    ),
    *AIDING,
    Topic(
        "initialpose",
        type_names.POSE,
        OUTPUT,
        "optional. Sets the heading by hand, in the frame `map`; RViz publishes it with *2D Pose "
        "Estimate*",
    ),
    Topic(
        "/tf_static",
        type_names.TRANSFORMS,
        FIXED,
        "optional, where tf2 is installed. Positions of the sensors, used where the parameters "
        "`imu.position` and `imu.mount_rpy`, or `gnss.antenna_position`, are zero",
    ),
)

PUBLISHED = (
    Topic(
        "odometry",
        type_names.ODOMETRY,
        OUTPUT,
        "pose of `base_link` in `map`, twist in `base_link`, full covariances; at the IMU's rate, "
        "or at `odometry_rate`. From the first fix until the heading is known it comes at 10 Hz "
        "at most, with large variances of the heading and of the twist, in the vehicle's axes; "
        "before the second fix the velocity is zero with a σ of 100 m/s, and the position's σ "
        "grows by as much",
    ),
    Topic(
        "odometry/local",
        type_names.ODOMETRY,
        OUTPUT,
        "the same in `odom`: continuous, without jumps when a fix corrects the estimate; the "
        "pose's covariance grows with the way since the start",
    ),
    Topic(
        "gnss/filtered",
        type_names.FIX,
        OUTPUT,
        "the estimated position with its covariance; `status.status` is -1 (no fix) while dead "
        "reckoning, from two seconds after the last fused fix on",
    ),
    Topic(
        "q/accelerometer",
        type_names.VECTOR,
        OUTPUT,
        "the noise variance per IMU sample that the filter uses, for each axis; an upper bound "
        "where fast motion or vibration covers the noise",
    ),
    Topic("q/gyroscope", type_names.VECTOR, OUTPUT, "the same of the gyroscope"),
    Topic(
        "imu/bias",
        type_names.ACCELERATION,
        OUTPUT,
        "estimated biases with covariance; linear: accelerometer, angular: gyroscope",
    ),
    Topic(
        "gnss/verdict",
        type_names.STATUS,
        OUTPUT,
        "for each fix: accepted or the reason for rejection, NIS, threshold, σ used",
    ),
    Topic(
        "aiding/verdict",
        type_names.STATUS,
        OUTPUT,
        "the same for each reading of an aiding sensor that was given to the filter",
    ),
    Topic(
        "validity",
        type_names.STATUS,
        LATEST,
        "position, velocity and heading: *good*, *waiting* (WARN: no estimate yet), *coasting* "
        "(WARN: no fixes, σ within `validity.*_std_max`) or *lost* (ERROR: σ beyond it, no "
        "estimate any more, no IMU sample for a second, or the node is not active); on every "
        "change",
    ),
    Topic("datum", type_names.FIX, LATEST, "origin of `map`; late subscribers receive it, too"),
    Topic(
        "/diagnostics",
        type_names.DIAGNOSTICS,
        OUTPUT,
        "once a second; see [diagnostics](diagnostics.md)",
    ),
    Topic(
        "/tf",
        type_names.TRANSFORMS,
        OUTPUT,
        "map → odom → base_link at 50 Hz, where tf2 is installed and `publish_tf` is true",
    ),
)

TRIGGER = "std_srvs/srv/Trigger"
SERVICES = (
    Service("~/reset", TRIGGER, "discards the state and the clock offset, and aligns again"),
    Service("~/save", TRIGGER, "writes `state_file`, see [warm start](warm_start.md)"),
    Service("~/load", TRIGGER, "reads it, and starts the alignment again"),
    Service(
        "datum",
        "robot_localization/srv/SetDatum",
        "moves the origin of `map`; an orientation is ignored, since the axes of `map` are always "
        "east, north, up",
    ),
    Service(
        "fromLL",
        "robot_localization/srv/FromLL",
        "from latitude, longitude [deg] and ellipsoidal height [m] to the frame `map`",
    ),
    Service("toLL", "robot_localization/srv/ToLL", "the way back"),
    Service("fromLLArray", "robot_localization/srv/FromLLArray", "`fromLL` for many points"),
)

INPUT_TYPES = {topic.name: topic.type_name for topic in SUBSCRIBED}
QUALITY = {topic.name: topic.quality for topic in (*SUBSCRIBED, *PUBLISHED)}
