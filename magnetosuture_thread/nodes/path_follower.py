"""The path follower node: needle poses in, velocity commands for a fixed path out."""

from __future__ import annotations

import sys
from typing import Any

from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.node import Node

from magnetosuture_thread.errors import ConfigurationError, InvalidInputError
from magnetosuture_thread.guidance.settings import PathFollowerSettings
from magnetosuture_thread.messages import reading
from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.diagnostics import Health
from magnetosuture_thread.nodes.messages import MESSAGES
from magnetosuture_thread.nodes.parameter_files import node_options
from magnetosuture_thread.nodes.parameters import declare
from magnetosuture_thread.nodes.run import run
from magnetosuture_thread.nodes.scene_follower import SceneFollower, initial_scene
from magnetosuture_thread.scene import Scene


class PathFollowerNode(Node):
    """Asks for a velocity at every needle pose; without a pose it is silent, and the coil bridge stops."""

    def __init__(self, **options: Any) -> None:
        super().__init__("path_follower", **node_options("path_follower", options))
        settings = declare(self, PathFollowerSettings)
        self._settings, self._follower = settings, settings.follower()
        scene = initial_scene(settings.scene)
        if scene is not None:
            settings.check_path(scene)
        self._blocked = ""  # why the path cannot be followed
        self._health = Health(self)
        self._scene = SceneFollower(self, self._health, scene, self.on_scene)
        self._commands = topics.NEEDLE_COMMAND.publisher(self)
        self._setpoints = topics.TIP_SETPOINT.publisher(self)
        topics.NEEDLE_POSE.subscribe(self, self.on_pose)
        self._health.warn("no needle pose yet", progress=0.0)

    def on_scene(self, scene: Scene) -> None:
        """Check the path against another scene; one that is blocked is not followed any farther."""
        try:
            self._settings.check_path(scene)
        except ConfigurationError as error:
            self._blocked = str(error)
        else:
            self._blocked = ""

    def on_pose(self, message: PoseWithCovarianceStamped) -> None:
        """Ask for the velocity that takes the tip along its path."""
        if self._blocked:
            self._health.error(self._blocked)
            return
        audience = self._commands.get_subscription_count()
        if audience < self._settings.audience:
            some = f"{audience} of {self._settings.audience} take velocity commands"
            self._health.warn(some if audience else "nobody takes velocity commands")
            return
        try:
            pose = reading.needle_pose(message)
            wish = self._follower.follow(pose.stamp, pose.tail, pose.heading)
        except InvalidInputError as error:
            self._health.refuse(error)
            return
        self._commands.publish(MESSAGES.twist_message(self.get_clock().now().to_msg(), wish.velocity))
        if 0.0 < wish.progress < 1.0:
            self._setpoints.publish(MESSAGES.placed(message.header.stamp, wish.tip, 0.0))
        text = "done" if wish.progress >= 1.0 else "following" if wish.progress else "settling"
        self._health.ok(text, progress=round(wish.progress, 4))


def main(arguments: list[str] | None = None) -> int:
    """Run the node as a program."""
    return run(PathFollowerNode, arguments)


if __name__ == "__main__":
    sys.exit(main())
