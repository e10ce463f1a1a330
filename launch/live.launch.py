"""
Run ins_node on a robot.

ros2 launch hybrid_ins live.launch.py params_file:=my_robot.yaml imu_topic:=/imu fix_topic:=/fix
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from launch import LaunchContext, LaunchDescription


def generate_launch_description() -> LaunchDescription:
    """Describe the node and the arguments that ``--show-args`` lists."""
    # Here, so that tools can read this file where launch is not installed.
    from launch import LaunchDescription
    from launch.actions import DeclareLaunchArgument, OpaqueFunction
    from launch.substitutions import PathJoinSubstitution
    from launch_ros.substitutions import FindPackageShare

    return LaunchDescription(
        [
            DeclareLaunchArgument(
                "params_file",
                default_value=PathJoinSubstitution(
                    [FindPackageShare("hybrid_ins"), "config", "default.yaml"]
                ),
                description="Parameter file, such as ins_calibrate writes",
            ),
            DeclareLaunchArgument(
                "namespace",
                default_value="",
                description="Namespace of the node and of its relative topics, one per vehicle",
            ),
            DeclareLaunchArgument("name", default_value="ins_node", description="Name of the node"),
            DeclareLaunchArgument(
                "frame_prefix",
                default_value="",
                description="Put before the frames map, odom and base_link, one per vehicle",
            ),
            DeclareLaunchArgument(
                "autostart",
                default_value="true",
                choices=["true", "false"],
                description="Activate it at the start; false: leave that to a lifecycle manager",
            ),
            DeclareLaunchArgument(
                "use_sim_time",
                default_value="",
                choices=["", "true", "false"],
                description="Follow /clock, as bags and simulators publish it; by default as the "
                "parameter file says",
            ),
            DeclareLaunchArgument(
                "imu_topic", default_value="imu/data", description="sensor_msgs/Imu to subscribe to"
            ),
            DeclareLaunchArgument(
                "fix_topic",
                default_value="gnss/fix",
                description="sensor_msgs/NavSatFix to subscribe to",
            ),
            DeclareLaunchArgument(
                "velocity_topic",
                default_value="gnss/velocity",
                description="TwistWithCovarianceStamped with the antenna's velocity, ENU; optional",
            ),
            DeclareLaunchArgument(
                "log_level",
                default_value="info",
                choices=["debug", "info", "warn", "error"],
                description="Lowest severity that the node logs",
            ),
            DeclareLaunchArgument(
                "respawn",
                default_value="false",
                choices=["true", "false"],
                description="Start the node again 2 s after it has ended",
            ),
            DeclareLaunchArgument(
                "rviz",
                default_value="false",
                choices=["true", "false"],
                description="Open RViz with the track, its covariance and the fixes",
            ),
            OpaqueFunction(function=start),
        ]
    )


def start(context: LaunchContext) -> list[Any]:
    """
    Return the node, and RViz where it is wanted and installed.

    Raises
    ------
    RuntimeError
        There is no such parameter file: without it the vehicle would run uncalibrated.
    """
    from launch.substitutions import LaunchConfiguration
    from launch_ros.actions import Node

    def given(name: str) -> str:
        return str(LaunchConfiguration(name).perform(context))

    if not Path(given("params_file")).is_file():
        raise RuntimeError(f"params_file:={given('params_file')}: no such file")
    clock = given("use_sim_time")
    use_sim_time = [{"use_sim_time": clock == "true"}] if clock else []
    managed = [{"autostart": False}] if given("autostart") == "false" else []
    prefix = given("frame_prefix")
    frames = {
        f"{frame.partition('_')[0]}_frame": prefix + frame
        for frame in ("map", "odom", "base_link")
        if prefix
    }
    node = Node(
        package="hybrid_ins",
        executable="ins_node",
        name=given("name"),
        namespace=given("namespace"),
        parameters=[
            given("params_file"),
            *use_sim_time,
            *managed,
            *([frames] if frames else []),
        ],
        remappings=[
            ("imu/data", given("imu_topic")),
            ("gnss/fix", given("fix_topic")),
            ("gnss/velocity", given("velocity_topic")),
        ],
        ros_arguments=["--log-level", given("log_level")],
        respawn=given("respawn") == "true",
        respawn_delay=2.0,
        output="screen",
    )
    return [
        node,
        *(rviz(given("namespace"), prefix, use_sim_time) if given("rviz") == "true" else []),
    ]


def rviz(namespace: str, prefix: str, use_sim_time: list[dict[str, bool]]) -> list[Any]:
    """Return RViz, or a log line where it is not installed: the vehicle does not depend on it."""
    from ament_index_python.packages import (
        PackageNotFoundError,
        get_package_prefix,
        get_package_share_directory,
    )
    from launch.actions import LogInfo
    from launch_ros.actions import Node

    try:
        get_package_prefix("rviz2")
    except PackageNotFoundError:
        return [LogInfo(msg="rviz:=true: rviz2 is not installed; continuing without it")]
    layout = Path(get_package_share_directory("hybrid_ins"), "config", "viewers", "ins.rviz")
    return [
        Node(
            package="rviz2",
            executable="rviz2",
            namespace=namespace,
            arguments=["-d", str(layout), "-f", f"{prefix}map"],
            parameters=use_sim_time,
        )
    ]
