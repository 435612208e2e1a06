"""Follows the scene: from a file at first, then from the topic `scene`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.node import Node

from magnetosuture_thread.errors import MagnetosutureError
from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.diagnostics import Health
from magnetosuture_thread.scene import Scene, read_scene
from magnetosuture_thread.scene.messages import scene_of


def initial_scene(name: str) -> Scene | None:
    """Return the scene of a parameter `scene`; None where it is empty.

    Raises:
        ConfigurationError: there is no such file, or it holds anything invalid.
    """
    return read_scene(name) if name else None


class SceneFollower:
    """Keeps the scene that is in force for a node.

    Args:
        node: that follows.
        scene: at first; None if it is not known yet.
        on_change: called with every other scene, before it is in force; raises a `MagnetosutureError` where it cannot
            be used, and the one before stays.
        health: where a message that is refused is reported.

    Attributes:
        scene: in force; None if none is known.
    """

    def __init__(self, node: Node, scene: Scene | None, on_change: Callable[[Scene], None], health: Health) -> None:
        self.scene = scene
        self._on_change, self._health = on_change, health
        topics.SCENE.subscribe(node, self._take, unheard=health.refuse)

    def _take(self, message: Any) -> None:
        try:
            if self.scene is not None and message.version == self.scene.version:
                return
            scene = scene_of(message)
            self._on_change(scene)
        except MagnetosutureError as error:
            self._health.refuse(error)
        else:
            self.scene = scene
