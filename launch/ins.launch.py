"""Start ins_node on a robot: ``ros2 launch hybrid_ins ins.launch.py``."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare


def generate_launch_description() -> LaunchDescription:
    """Describe the node and the arguments that ``--show-args`` lists."""
    default_parameters = PathJoinSubstitution(
        [FindPackageShare("hybrid_ins"), "config", "default.yaml"]
    )
    arguments = [
        DeclareLaunchArgument(
            "params_file",
            default_value=default_parameters,
            description="Parameter file, such as ins_calibrate writes",
        ),
        DeclareLaunchArgument(
            "namespace",
            default_value="",
            description="Namespace of the node and of its relative topics",
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
        ],
        output="screen",
    )
    return LaunchDescription([*arguments, node])
