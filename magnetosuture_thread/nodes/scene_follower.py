"""Follows the scene: at first that of a file, then whatever comes on the topic `scene`."""

from __future__ import annotations

from collections.abc import Callable

from magnetosuture_thread import MagnetosutureError, Scene, read_scene
from magnetosuture_thread.messages.scene import parse_scene_message
from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.node import GuardedNode
from magnetosuture_thread.texts import shortened


class SceneFollower:
    """The scene that a node goes by.

    Of a message that is damaged, or whose scene the node cannot use, the reason is reported to the node's health and
    kept in `problem` until a good one comes; the scene before stays in force.

    Args:
        node: that subscribes.
        changed: called with a scene of the topic that is another than the one in force, before it is; raises a
            `MagnetosutureError`, for example a `ConfigurationError`, where the node cannot use it.
        scene: in force at first; None if it is not known yet.

    Attributes:
        scene: in force; None until one is known.
        problem: why the scene that came last is not in force; empty where it is, or none came.
    """

    def __init__(self, node: GuardedNode, changed: Callable[[Scene], None], scene: Scene | None = None) -> None:
        self.scene, self.problem = scene, ""
        self._heard: Scene | None = None  # the last of the topic, also where it was refused; None if it was damaged
        self._node, self._changed = node, changed
        topics.SCENE.subscribe(node, self.on_scene, raw=True)

    @property
    def version(self) -> str:
        """Version of the scene in force; empty for none."""
        return "" if self.scene is None else self.scene.version

    def load(self, name: str) -> Scene | None:
        """Return the scene for a node that is configured now: the topic's if one has come, else that of a parameter.

        Raises:
            ConfigurationError: there is no such file, or it holds anything invalid.
        """
        if self._heard is None:
            self.scene = read_scene(name) if name else None
        else:
            self.scene, self.problem = self._heard, ""
            if name:
                self._node.get_logger().info(f"scene {self.version} of the topic, and not that of the parameter")
        return self.scene

    def on_scene(self, data: bytes) -> None:
        """Handle the bytes of a published scene."""
        self._heard = None
        try:
            self._heard = scene = parse_scene_message(topics.SCENE.decode(data))
            if scene.version != self.version:
                self._changed(scene)
        except MagnetosutureError as error:
            self.problem = f"scene refused: {shortened(str(error))}"
            self._node.health.refuse(error, **{"scene problem": self.problem})
        else:
            self.scene, self.problem = scene, ""
            self._node.health.note(**{"scene problem": "none"})
