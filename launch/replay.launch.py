"""
Play a recording into ins_node over DDS, in its own time, and record what the node publishes.

ros2 launch hybrid_ins replay.launch.py bag:=flight.mcap record:=estimate.mcap

Faster than real time and without DDS: ins_replay.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from launch import LaunchContext, LaunchDescription
    from launch.actions import Shutdown
    from launch.events.process import ProcessExited


def generate_launch_description() -> LaunchDescription:
    """Describe the node, the player, and the arguments that ``--show-args`` lists."""
    # Here, so that tools can read this file where launch is not installed.
    from launch import LaunchDescription
    from launch.actions import (
        DeclareLaunchArgument,
        ExecuteProcess,
        IncludeLaunchDescription,
        RegisterEventHandler,
    )
    from launch.event_handlers import OnProcessExit
    from launch.launch_description_sources import PythonLaunchDescriptionSource
    from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
    from launch_ros.substitutions import ExecutableInPackage, FindPackageShare

    share = FindPackageShare("hybrid_ins")
    arguments = [
        DeclareLaunchArgument(
            "bag", description="Recording with Imu and NavSatFix: rosbag2, .mcap, .db3, ROS 1 .bag"
        ),
        DeclareLaunchArgument(
            "record",
            default_value="estimate",
            description="Bag to write; an existing one is replaced",
        ),
        DeclareLaunchArgument("rate", default_value="1.0", description="Times real time"),
        DeclareLaunchArgument(
            "params_file",
            default_value=PathJoinSubstitution([share, "config", "default.yaml"]),
            description="Parameter file, such as ins_calibrate writes",
        ),
        DeclareLaunchArgument(
            "imu_topic", default_value="/imu/data", description="sensor_msgs/Imu in the bag"
        ),
        DeclareLaunchArgument(
            "fix_topic", default_value="/gnss/fix", description="sensor_msgs/NavSatFix in the bag"
        ),
        DeclareLaunchArgument(
            "rviz",
            default_value="false",
            choices=["true", "false"],
            description="Open RViz with the track, its covariance and the fixes",
        ),
    ]
    live = IncludeLaunchDescription(
        PythonLaunchDescriptionSource(PathJoinSubstitution([share, "launch", "live.launch.py"])),
        launch_arguments={
            "params_file": LaunchConfiguration("params_file"),
            "imu_topic": LaunchConfiguration("imu_topic"),
            "fix_topic": LaunchConfiguration("fix_topic"),
            "rviz": LaunchConfiguration("rviz"),
            "use_sim_time": "true",
        }.items(),
    )
    # Not a launch_ros Node: that adds --ros-args, which is not for this program.
    player = ExecuteProcess(
        cmd=[
            ExecutableInPackage("ins_play", "hybrid_ins"),
            LaunchConfiguration("bag"),
            *("--record", LaunchConfiguration("record"), "--overwrite"),
            *("--rate", LaunchConfiguration("rate")),
            *("--wait", "60"),  # the node compiles its filter on its first start
        ],
        output="screen",
    )
    at_the_end = RegisterEventHandler(OnProcessExit(on_exit=shut_down))
    return LaunchDescription([*arguments, at_the_end, live, player])


def shut_down(event: ProcessExited, _context: LaunchContext | Any) -> Shutdown | None:
    """Return the end of the launch when the player or the node has ended; RViz may be closed."""
    from launch.actions import Shutdown

    if event.process_name.startswith("rviz2"):
        return None
    return Shutdown(reason=f"{event.process_name} has ended")
