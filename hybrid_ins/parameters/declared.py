"""Every parameter, declared once, in the order in which a user needs them."""

from __future__ import annotations

from hybrid_ins.parameters.noise import NOISE
from hybrid_ins.parameters.parameter import Parameter
from hybrid_ins.parameters.sensors import GNSS, IMU
from hybrid_ins.parameters.vehicle import AIDING, VALIDITY, VEHICLE

_FRAMES = (
    Parameter("map_frame", "map", "Frame of odometry: east-north-up at the datum (REP-105)"),
    Parameter("odom_frame", "odom", "Frame of odometry/local, which is continuous (REP-105)"),
    Parameter("base_frame", "base_link", "Frame whose pose and twist are published"),
    Parameter(
        "datum",
        [],
        "Origin of the map: latitude [deg], longitude [deg], ellipsoidal height [m]; empty: the "
        "first accepted fix",
        lengths=(0, 3),
        low=-12000.0,
        high=1e6,
    ),
    Parameter(
        "publish_tf", True, "Publish the transforms map→odom→base_frame, where tf2 is installed"
    ),
    Parameter(
        "use_tf_static",
        True,
        "Use /tf_static for the place of a sensor where imu.position and imu.mount_rpy, or "
        "gnss.antenna_position, are all zero",
    ),
    Parameter(
        "use_receive_time",
        False,
        "Use the time of arrival instead of the messages' stamps: only for drivers that do not "
        "stamp, because it costs accuracy",
    ),
)

_OUTPUT = (
    Parameter(
        "state_file",
        "",
        "File that keeps biases, clock offset and pose for the next start; empty: none",
        longest=4000,
    ),
    Parameter(
        "autostart",
        True,
        "Configure and activate at the start; false: wait for a lifecycle manager to do so",
    ),
    Parameter(
        "odometry_rate",
        0.0,
        "Rate of odometry and odometry/local; 0: with every IMU sample",
        unit="Hz",
        low=0.01,
        high=10000.0,
        or_zero=True,
        runtime=True,
    ),
    Parameter(
        "covariance_interval",
        0.01,
        "Interval of the covariance propagation, which also runs before every update; 0: with "
        "every IMU sample",
        unit="s",
        low=0.0,
        high=0.05,
    ),
)

_ALIGNMENT = (
    Parameter(
        "alignment.heading_source",
        "auto",
        "Source of the initial heading. auto, motion: any motion that shows it; course: the "
        "course over ground, for vehicles that move where they point; parameter: alignment.yaw; "
        "imu: the orientation in the IMU's messages",
        choices=("auto", "motion", "parameter", "imu", "course"),
    ),
    Parameter(
        "alignment.yaw",
        0.0,
        "Initial heading of base_frame in map for heading_source parameter: 0 is east, "
        "counter-clockwise is positive",
        unit="rad",
        low=-6.3,
        high=6.3,
    ),
    Parameter(
        "alignment.yaw_std",
        0.1,
        "Standard deviation of an initial heading from parameter or IMU",
        unit="rad",
        low=1e-4,
        high=3.2,
    ),
    Parameter(
        "alignment.course_min_speed",
        1.0,
        "Lowest speed at which the course over ground is used as the heading",
        unit="m/s",
        low=0.1,
        high=50.0,
    ),
    Parameter(
        "alignment.window",
        1.0,
        "Duration of the IMU data that levelling averages",
        unit="s",
        low=0.05,
        high=5.0,
    ),
)

PARAMETERS: dict[str, Parameter] = {
    p.name: p
    for p in (
        *_FRAMES,
        *_OUTPUT,
        *IMU,
        *GNSS,
        *_ALIGNMENT,
        *VEHICLE,
        *AIDING,
        *VALIDITY,
        *NOISE,
    )
}
