"""Starts the nodes on a robot: `ros2 launch magnetosuture_thread magnetosuture.launch.py setup:=NAME`.

With `simulated:=true` a rig in software and a path follower come with them.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

PACKAGE = "magnetosuture_thread"
NODES = ("vision_tracker", "thread_model", "coil_bridge")
RIG_NODES = ("rig_simulator", "path_follower")


def generate_launch_description() -> LaunchDescription:
    """Return the nodes with the parameters of one set-up."""
    file_name = [LaunchConfiguration("setup"), ".yaml"]
    parameters = [
        PathJoinSubstitution([FindPackageShare(PACKAGE), "config", file_name]),
        {"use_sim_time": LaunchConfiguration("use_sim_time")},
    ]
    return LaunchDescription(
        [
            DeclareLaunchArgument("setup", default_value="petri_35mm_polyamide", description="name of a set-up"),
            DeclareLaunchArgument("use_sim_time", default_value="false", description="take the time from /clock"),
            DeclareLaunchArgument("simulated", default_value="false", description="with a rig in software"),
            *(
                Node(package=PACKAGE, executable=name, name=name, parameters=parameters, output="screen")
                for name in NODES
            ),
            *(
                Node(
                    package=PACKAGE,
                    executable=name,
                    name=name,
                    parameters=parameters,
                    output="screen",
                    condition=IfCondition(LaunchConfiguration("simulated")),
                )
                for name in RIG_NODES
            ),
        ]
    )
