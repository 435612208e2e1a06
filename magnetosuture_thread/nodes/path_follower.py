"""Path follower node: needle poses in, velocity commands along a fixed path out."""

from __future__ import annotations

from typing import Any

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.duration import Duration

from magnetosuture_thread import ConfigurationError, Scene
from magnetosuture_thread.bags import reading
from magnetosuture_thread.bags.packing import packed_pose_stamped, packed_twist
from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.node import ManagedNode, SceneFollower
from magnetosuture_thread.nodes.program import DELIVERY_TIMEOUT
from magnetosuture_thread.planning.follower import PathFollowerSettings, prepare_paths


class PathFollowerNode(ManagedNode[PathFollowerSettings]):
    """Publishes a velocity command for every needle pose; without poses the coil bridge times out.

    The path begins when the node has been configured and is first active; activated again, it is continued.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__("path_follower", PathFollowerSettings, **options)
        self._blocked = ""  # reason why the path cannot be followed
        self._scene = SceneFollower(self, self.on_scene)
        self.start()

    def allocate(self, settings: PathFollowerSettings) -> None:
        """Check the path against the scene."""
        scene = self._scene.load(settings.scene)
        if scene is not None:
            settings.check_path(scene)
        prepare_paths()
        self._follower, self._blocked = settings.follower(), ""
        self._setpoints = topics.TIP_SETPOINT.publisher(self)
        topics.NEEDLE_POSE.subscribe(self, self.while_active(self.on_pose))
        self.health.note(progress=0.0)

    def activate(self) -> None:
        """Begin the path, or go on with it."""
        # While it is there a needle planner refuses to command beside it.
        self._commands = topics.NEEDLE_COMMAND.publisher(self)
        self.health.warn("no needle pose yet")

    def deactivate(self) -> None:
        """Bring the needle to rest at once, and not when the last command times out."""
        if self.is_active:
            self._command(np.zeros(2))
            self._commands.wait_for_all_acked(Duration(seconds=DELIVERY_TIMEOUT))
            self.destroy_publisher(self._commands)

    def on_scene(self, scene: Scene) -> None:
        """Check the path against a new scene; a blocked path is not followed further."""
        self._blocked = ""
        try:
            self.configured_settings.check_path(scene)
        except ConfigurationError as error:
            self._blocked = str(error)

    def on_pose(self, message: PoseWithCovarianceStamped) -> None:
        """Publish the velocity command that moves the tip along its path."""
        settings, subscribers = self.configured_settings, self._commands.get_subscription_count()
        if self._blocked:
            self.health.error(self._blocked)
            return
        if subscribers < settings.audience:
            some = f"{subscribers} of {settings.audience} subscribers to velocity commands"
            self.health.warn(some if subscribers else "no subscriber to velocity commands")
            return
        pose = reading.needle_pose(message)
        now = self.get_clock().now().nanoseconds * 1e-9
        reading.check_pose_age(pose.stamp, now, settings.pose_timeout)
        command = self._follower.compute_command(pose.stamp, pose.tail, pose.heading, max(0.0, now - pose.stamp))
        self._command(command.velocity)
        if 0.0 < command.progress < 1.0:
            self._setpoints.publish(packed_pose_stamped(message.header.stamp, command.tip, 0.0))
        text = "done" if command.progress >= 1.0 else "following" if command.progress else "settling"
        self.health.ok(text, progress=round(command.progress, 4))

    def _command(self, velocity: np.ndarray) -> None:
        self._commands.publish(packed_twist(self.get_clock().now().to_msg(), velocity))
