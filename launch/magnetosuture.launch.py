"""Starts the nodes on a robot: `ros2 launch magnetosuture_thread magnetosuture.launch.py setup:=NAME`.

The coil bridge goes as far as the set-up says; on hardware a person arms it. With `simulated:=true` a rig in
software and a path follower come with them, and the bridge drives that rig and arms itself. With `console:=true`
the operator's page is served on this machine.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition, UnlessCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

PACKAGE = "magnetosuture_thread"
RIG_NODES = ("rig_simulator", "path_follower")


def generate_launch_description() -> LaunchDescription:
    """Return the nodes with the parameters of one set-up."""
    file_name = [LaunchConfiguration("setup"), ".yaml"]
    parameters = [
        PathJoinSubstitution([FindPackageShare(PACKAGE), "config", file_name]),
        {"use_sim_time": LaunchConfiguration("use_sim_time")},
    ]
    with_console = IfCondition(LaunchConfiguration("console"))
    with_rig, without = (condition(LaunchConfiguration("simulated")) for condition in (IfCondition, UnlessCondition))

    def node(name: str, *more: dict[str, str], **options: object) -> Node:
        given = [*parameters, *more]
        return Node(package=PACKAGE, executable=name, name=name, parameters=given, output="screen", **options)

    # Two nodes in one process: a name given here would be that of both.
    perception = Node(package=PACKAGE, executable="perception", parameters=parameters, output="screen")
    return LaunchDescription(
        [
            DeclareLaunchArgument("setup", default_value="petri_35mm_polyamide", description="name of a set-up"),
            DeclareLaunchArgument("use_sim_time", default_value="false", description="take the time from /clock"),
            DeclareLaunchArgument("simulated", default_value="false", description="with a rig in software"),
            DeclareLaunchArgument("console", default_value="false", description="with the operator's page"),
            perception,
            node("coil_bridge", condition=without),
            node("coil_bridge", {"driver": "simulated", "autostart": "armed"}, condition=with_rig),
            *(node(name, condition=with_rig) for name in RIG_NODES),
            node("console", condition=with_console),
        ]
    )
