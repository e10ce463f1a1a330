"""
Fly without a robot: simulate a flight, play it into ins_node, watch it in RViz.

ros2 launch hybrid_ins demo.launch.py
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from launch import LaunchContext, LaunchDescription
    from launch.events.process import ProcessExited


def generate_launch_description() -> LaunchDescription:
    """Describe the simulation, what follows it, and the arguments that ``--show-args`` lists."""
    # Here, so that tools can read this file where launch is not installed.
    from launch import LaunchDescription
    from launch.actions import (
        DeclareLaunchArgument,
        ExecuteProcess,
        IncludeLaunchDescription,
        RegisterEventHandler,
        Shutdown,
    )
    from launch.event_handlers import OnProcessExit
    from launch.launch_description_sources import PythonLaunchDescriptionSource
    from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
    from launch_ros.substitutions import ExecutableInPackage, FindPackageShare

    arguments = [
        DeclareLaunchArgument(
            "flight",
            default_value="demo_flight",
            description="Bag to write the simulation to; an existing one is replaced",
        ),
        DeclareLaunchArgument(
            "record", default_value="demo_estimate", description="Bag of what the node publishes"
        ),
        DeclareLaunchArgument(
            "trajectory",
            default_value="quadrotor",
            choices=["quadrotor", "car", "aircraft", "random", "static"],
            description="How the vehicle moves",
        ),
        DeclareLaunchArgument(
            "noise_schedule",
            default_value="0:1",
            description="Factor on the IMU's noise from each time [s] on, as in 0:1,20:5,40:1",
        ),
        DeclareLaunchArgument("seed", default_value="0", description="Seed of the simulated noise"),
        DeclareLaunchArgument("rate", default_value="1.0", description="Times real time"),
        DeclareLaunchArgument(
            "rviz", default_value="true", choices=["true", "false"], description="Open RViz"
        ),
    ]
    # Not a launch_ros Node: that adds --ros-args, which is not for this program.
    simulation = ExecuteProcess(
        cmd=[
            ExecutableInPackage("ins_simulate", "hybrid_ins"),
            *(LaunchConfiguration("flight"), "--overwrite"),
            *("--trajectory", LaunchConfiguration("trajectory")),
            *("--noise-schedule", LaunchConfiguration("noise_schedule")),
            *("--seed", LaunchConfiguration("seed")),
        ],
        output="screen",
    )
    replay = PathJoinSubstitution([FindPackageShare("hybrid_ins"), "launch", "replay.launch.py"])
    flight = IncludeLaunchDescription(
        PythonLaunchDescriptionSource(replay),
        launch_arguments={
            "bag": LaunchConfiguration("flight"),
            "record": LaunchConfiguration("record"),
            "rate": LaunchConfiguration("rate"),
            "rviz": LaunchConfiguration("rviz"),
        }.items(),
    )

    def after_simulation(event: ProcessExited, _context: LaunchContext) -> Any:
        return flight if event.returncode == 0 else Shutdown(reason="ins_simulate has failed")

    then = RegisterEventHandler(OnProcessExit(target_action=simulation, on_exit=after_simulation))
    return LaunchDescription([*arguments, simulation, then])
