"""Path follower node: needle poses in, velocity commands along a fixed path out."""

from __future__ import annotations

import sys
from typing import Any

from geometry_msgs.msg import PoseWithCovarianceStamped

from magnetosuture_thread import ConfigurationError, InvalidInputError, Scene
from magnetosuture_thread.guidance.path import prepare_paths
from magnetosuture_thread.guidance.settings import PathFollowerSettings
from magnetosuture_thread.messages import reading
from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.messages import MESSAGES
from magnetosuture_thread.nodes.node import PackageNode
from magnetosuture_thread.nodes.parameter_files import node_options
from magnetosuture_thread.nodes.parameters import declare
from magnetosuture_thread.nodes.run import run
from magnetosuture_thread.nodes.scene_follower import SceneFollower, initial_scene


class PathFollowerNode(PackageNode):
    """Publishes a velocity command for every needle pose; without poses the coil bridge times out."""

    def __init__(self, **options: Any) -> None:
        super().__init__("path_follower", **node_options("path_follower", options))
        settings = declare(self, PathFollowerSettings)
        self._settings, self._follower = settings, settings.follower()
        prepare_paths()
        scene = initial_scene(settings.scene)
        if scene is not None:
            settings.check_path(scene)
        self._blocked = ""  # reason why the path cannot be followed
        self._scene = SceneFollower(self, self.health, scene, self.on_scene)
        self._commands = topics.NEEDLE_COMMAND.publisher(self)
        self._setpoints = topics.TIP_SETPOINT.publisher(self)
        topics.NEEDLE_POSE.subscribe(self, self.on_pose)
        self.health.warn("no needle pose yet", progress=0.0)

    def on_scene(self, scene: Scene) -> None:
        """Check the path against a new scene; a blocked path is not followed further."""
        try:
            self._settings.check_path(scene)
        except ConfigurationError as error:
            self._blocked = str(error)
        else:
            self._blocked = ""

    def on_pose(self, message: PoseWithCovarianceStamped) -> None:
        """Publish the velocity command that moves the tip along its path."""
        if self._blocked:
            self.health.error(self._blocked)
            return
        subscribers = self._commands.get_subscription_count()
        if subscribers < self._settings.audience:
            some = f"{subscribers} of {self._settings.audience} subscribers to velocity commands"
            self.health.warn(some if subscribers else "no subscriber to velocity commands")
            return
        try:
            pose = reading.needle_pose(message)
            now = self.get_clock().now().nanoseconds * 1e-9
            reading.check_pose_age(pose.stamp, now, self._settings.pose_timeout)
            command = self._follower.compute_command(pose.stamp, pose.tail, pose.heading)
        except InvalidInputError as error:
            self.health.refuse(error)
            return
        self._commands.publish(MESSAGES.twist_message(self.get_clock().now().to_msg(), command.velocity))
        if 0.0 < command.progress < 1.0:
            self._setpoints.publish(MESSAGES.placed(message.header.stamp, command.tip, 0.0))
        text = "done" if command.progress >= 1.0 else "following" if command.progress else "settling"
        self.health.ok(text, progress=round(command.progress, 4))


def main(arguments: list[str] | None = None) -> int:
    """Run the node as a program."""
    return run(PathFollowerNode, arguments)


if __name__ == "__main__":
    sys.exit(main())
