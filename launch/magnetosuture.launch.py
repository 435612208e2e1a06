"""Starts the three nodes on a robot: `ros2 launch magnetosuture_thread magnetosuture.launch.py setup:=NAME`."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

PACKAGE = "magnetosuture_thread"
NODES = ("vision_tracker", "thread_model", "coil_bridge")


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
            *(
                Node(package=PACKAGE, executable=name, name=name, parameters=parameters, output="screen")
                for name in NODES
            ),
        ]
    )
