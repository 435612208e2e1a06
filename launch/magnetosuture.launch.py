"""Starts the nodes on a robot: `ros2 launch magnetosuture_thread magnetosuture.launch.py setup:=NAME`.

The setup is one that ships with the package, by `setup:=NAME`, or a file of your own, by `setup_file:=PATH`. With
`namespace:=NAME` all nodes are in a namespace. The coil bridge goes as far as the setup says; on hardware a person
arms it. With `simulated:=true` a rig in software and a path follower come with them, and the bridge drives that rig and
arms itself, unless `autostart` is given. With `planner:=true` procedures can be executed, and no path follower starts.
With `console:=true` the operator's page is served on this machine. Where tf2_ros is installed, the dish's frame is
published as that of `parent_frame:=NAME`, on `tf_static` of the namespace; with an empty name it is left to others.
With `frame_prefix:=left/` the rig's frames are `left/dish` and `left/camera`, and the transform is on `/tf_static`.
With `enclaves:=true` each process is in the SROS2 enclave of its name, below that of its namespace: see
docs/how_to/security.md. With `autostart:=inactive` or `autostart:=unconfigured` the lifecycle nodes go no farther by
themselves, for a lifecycle manager or `ros2 lifecycle set`; else each goes as far as the setup says.

What only looks comes back when its process dies: the camera's nodes and the operator's page. What moves the needle does
not: a person arms the bridge, planner and path follower would begin anew amid a motion, and the scene server would
forget the shapes that were added since.
"""

import os
from collections.abc import Callable
from pathlib import Path

from ament_index_python.packages import get_package_share_directory, get_packages_with_prefixes
from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.conditions import IfCondition, UnlessCondition
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

PACKAGE = "magnetosuture_thread"
DEFAULT_SETUP = "petri_35mm_polyamide"
RIG_NODES = ("rig_simulator", "path_follower")
LIFECYCLE_NODES = ("scene_server", "perception", "coil_bridge", "needle_planner", "path_follower")
RESPAWNED = ("perception", "console")
RESPAWN_DELAY = 2.0  # s
SWITCHED = {
    "use_sim_time": "take the time from /clock",
    "simulated": "with a rig in software",
    "planner": "with the needle planner, in place of the path follower",
    "console": "with the operator's page",
    "enclaves": "each process in the SROS2 enclave of its name",
}
TRUTH = {"true": True, "1": True, "false": False, "0": False}  # in any case, as launch's conditions take them


def generate_launch_description() -> LaunchDescription:
    """Return the nodes with the parameters of one setup.

    A name that is none of the shipped setups, or a file that does not exist, refuses to launch: nodes that started on
    their defaults would believe in another dish and another needle.
    """
    folder = Path(get_package_share_directory(PACKAGE)) / "config"
    names = sorted(path.stem for path in folder.glob("*.yaml"))

    def argument(name: str, default: str, description: str, **options: object) -> DeclareLaunchArgument:
        return DeclareLaunchArgument(name, default_value=default, description=description, **options)

    def nodes(context: LaunchContext) -> list[Node]:
        given = LaunchConfiguration("setup_file").perform(context)
        file = Path(given).expanduser() if given else folder / f"{LaunchConfiguration('setup').perform(context)}.yaml"
        if not file.is_file():
            raise FileNotFoundError(f"setup_file: got {given!r}, expected a parameter file that exists")
        autostart = LaunchConfiguration("autostart").perform(context)
        on = {name: is_on(name, LaunchConfiguration(name).perform(context)) for name in SWITCHED}
        frame, prefix = (LaunchConfiguration(name).perform(context) for name in ("parent_frame", "frame_prefix"))
        inner = LaunchConfiguration("namespace").perform(context)
        # As launch_ros does it: what a group pushes comes before, but not before an absolute namespace.
        pushed = "" if inner.startswith("/") else context.launch_configurations.get("ros_namespace", "")
        outer = [part for part in f"{pushed}/{inner}".split("/") if part]

        def ros_arguments(name: str) -> list[str]:
            return ["--enclave", "/" + "/".join([*outer, name])] if on["enclaves"] else []

        robot = started(str(file.resolve()), autostart, on, prefix, ros_arguments)
        return [*robot, *transforms(frame, prefix, ros_arguments)]

    return LaunchDescription(
        [
            argument("setup", DEFAULT_SETUP, "name of a setup that ships with the package", choices=names),
            argument("setup_file", "", "path of a setup of your own, in place of setup"),
            argument("namespace", "", "namespace of all nodes"),
            argument(
                "autostart",
                "",
                "state that the lifecycle nodes enter by themselves; empty: as the setup says",
                choices=["", "unconfigured", "inactive", "active"],
            ),
            argument("parent_frame", "map", "frame that the dish's is in; empty if others publish it"),
            argument(
                "frame_prefix",
                os.environ.get("MAGNETOSUTURE_FRAME_PREFIX", "").lstrip("/"),
                "before the frames dish and camera, for example left/",
            ),
            *(argument(name, "false", f"{text} (true or false)") for name, text in SWITCHED.items()),
            OpaqueFunction(function=nodes),
        ]
    )


def is_on(name: str, text: str) -> bool:
    """Return the value of a switch."""
    if text.strip().lower() not in TRUTH:
        raise ValueError(f"{name}: got {text!r}, expected true or false")
    return TRUTH[text.strip().lower()]


def started(
    file: str, autostart: str, on: dict[str, bool], prefix: str, ros_arguments: Callable[[str], list[str]]
) -> list[Node]:
    """Return the nodes with a parameter file.

    Args:
        file: the setup.
        autostart: state that the lifecycle nodes enter by themselves; empty: as the setup says.
        on: the switches.
        prefix: of the rig's frames.
        ros_arguments: of a node, by its name.
    """
    with_console = IfCondition(LaunchConfiguration("console"))
    with_rig, without = (condition(LaunchConfiguration("simulated")) for condition in (IfCondition, UnlessCondition))

    def node(name: str, *more: dict[str, str], named: bool = True, **options: object) -> Node:
        if autostart and name in LIFECYCLE_NODES:
            more = (*more, {"autostart": autostart})
        return Node(
            package=PACKAGE,
            executable=name,
            name=name if named else None,
            namespace=LaunchConfiguration("namespace"),
            parameters=[file, {"use_sim_time": on["use_sim_time"]}, *more],
            ros_arguments=ros_arguments(name),
            additional_env={"MAGNETOSUTURE_FRAME_PREFIX": prefix},
            output="screen",
            respawn=name in RESPAWNED,
            respawn_delay=RESPAWN_DELAY,
            **options,
        )

    return [
        node("scene_server"),
        # Two nodes in one process: a name given here would be that of both.
        node("perception", named=False),
        node("coil_bridge", condition=without),
        node("coil_bridge", {"driver": "simulated", "autostart": "armed"}, condition=with_rig),
        # Two nodes that command the needle would be in each other's way.
        *(node(name, condition=with_rig) for name in RIG_NODES if not (on["planner"] and name == "path_follower")),
        *([node("needle_planner")] if on["planner"] else []),
        node("console", condition=with_console),
    ]


def transforms(parent_frame: str, prefix: str, ros_arguments: Callable[[str], list[str]]) -> list[Node]:
    """Return the publisher of the dish's frame in another one; none without tf2_ros, or without a name."""
    if not parent_frame or "tf2_ros" not in get_packages_with_prefixes():
        return []
    return [
        Node(
            package="tf2_ros",
            executable="static_transform_publisher",
            name="dish_transform",
            namespace=LaunchConfiguration("namespace"),
            arguments=["--frame-id", parent_frame, "--child-frame-id", f"{prefix}dish"],
            ros_arguments=ros_arguments("dish_transform"),
            # Two rigs in two namespaces have a dish each, with one name unless there is a prefix.
            remappings=[] if prefix else [("/tf_static", "tf_static")],
        )
    ]
