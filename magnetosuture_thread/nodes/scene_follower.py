"""Which scene a node is in: at its start that of its parameter, then that of the topic `scene`."""

from __future__ import annotations

from collections.abc import Callable

from magnetosuture_msgs.msg import Scene as SceneMessage
from rclpy.node import Node

from magnetosuture_thread.errors import InvalidInputError, MagnetosutureError
from magnetosuture_thread.interface import DISH_FRAME
from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.diagnostics import Health
from magnetosuture_thread.scene import Scene, read_scene
from magnetosuture_thread.scene.messages import scene_of


class SceneFollower:
    """Follows the scene.

    Args:
        node: has the subscription.
        name: of the scene to begin with, as its parameter; empty to wait for the topic.
        health: where a scene is said to be refused.

    Attributes:
        scene: in force; None as long as there is none.

    Raises:
        ConfigurationError: the parameter names no scene.
    """

    def __init__(self, node: Node, name: str, health: Health) -> None:
        self._node, self._health = node, health
        self._change: Callable[[Scene], None] = lambda scene: None
        self.scene = read_scene(name) if name else None

    def follow(self, change: Callable[[Scene], None]) -> None:
        """Subscribe to the topic.

        Args:
            change: called with each scene that is another than the one in force; where it raises one of our errors,
                that one stays in force.
        """
        self._change = change
        topics.SCENE.subscribe(self._node, self.on_scene, unheard=self._health.refuse)

    def on_scene(self, message: SceneMessage) -> None:
        """Take a scene, or say why that cannot be."""
        try:
            if message.header.frame_id != DISH_FRAME:
                raise InvalidInputError("scene.header.frame_id", repr(message.header.frame_id), repr(DISH_FRAME))
            scene = scene_of(message)
            if scene != self.scene:
                self._change(scene)
                self.scene = scene
                self._node.get_logger().info(f"scene {scene.version}: {len(scene.shapes)} shapes")
        except MagnetosutureError as error:
            self._health.refuse(error)
