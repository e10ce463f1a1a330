"""
Run ins_node on a robot.

ros2 launch hybrid_ins live.launch.py params_file:=my_robot.yaml imu_topic:=/imu fix_topic:=/fix
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from launch import LaunchDescription


def generate_launch_description() -> LaunchDescription:
    """Describe the node and the arguments that ``--show-args`` lists."""
    # Here, so that tools can read this file where launch is not installed.
    from launch import LaunchDescription
    from launch.actions import DeclareLaunchArgument
    from launch.conditions import IfCondition
    from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
    from launch_ros.actions import Node
    from launch_ros.substitutions import FindPackageShare

    share = FindPackageShare("hybrid_ins")
    arguments = [
        DeclareLaunchArgument(
            "params_file",
            default_value=PathJoinSubstitution([share, "config", "default.yaml"]),
            description="Parameter file, such as ins_calibrate writes",
        ),
        DeclareLaunchArgument(
            "namespace",
            default_value="",
            description="Namespace of the node and of its relative topics, one per vehicle",
        ),
        DeclareLaunchArgument(
            "use_sim_time",
            default_value="false",
            choices=["true", "false"],
            description="Follow /clock, as bags and simulators publish it",
        ),
        DeclareLaunchArgument(
            "imu_topic", default_value="imu/data", description="sensor_msgs/Imu to take in"
        ),
        DeclareLaunchArgument(
            "fix_topic", default_value="gnss/fix", description="sensor_msgs/NavSatFix to take in"
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
            description="What the node prints",
        ),
        DeclareLaunchArgument(
            "rviz",
            default_value="false",
            choices=["true", "false"],
            description="Open RViz with the track, its covariance and the fixes",
        ),
    ]
    node = Node(
        package="hybrid_ins",
        executable="ins_node",
        name="ins_node",
        namespace=LaunchConfiguration("namespace"),
        parameters=[
            LaunchConfiguration("params_file"),
            {"use_sim_time": LaunchConfiguration("use_sim_time")},
        ],
        remappings=[
            ("imu/data", LaunchConfiguration("imu_topic")),
            ("gnss/fix", LaunchConfiguration("fix_topic")),
            ("gnss/velocity", LaunchConfiguration("velocity_topic")),
        ],
        ros_arguments=["--log-level", LaunchConfiguration("log_level")],
        output="screen",
    )
    rviz = Node(
        package="rviz2",
        executable="rviz2",
        namespace=LaunchConfiguration("namespace"),
        arguments=["-d", PathJoinSubstitution([share, "config", "viewers", "ins.rviz"])],
        parameters=[{"use_sim_time": LaunchConfiguration("use_sim_time")}],
        condition=IfCondition(LaunchConfiguration("rviz")),
    )
    return LaunchDescription([*arguments, node, rviz])
