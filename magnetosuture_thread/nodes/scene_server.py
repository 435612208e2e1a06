"""Publishes the scene of a file: a stand-in for the real server, which has services besides."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from importlib import import_module
from typing import Any, ClassVar

from rclpy.node import Node
from std_msgs.msg import Header

from magnetosuture_thread.configuration import Configuration
from magnetosuture_thread.interface import DISH_FRAME
from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.diagnostics import Health
from magnetosuture_thread.nodes.parameter_files import node_options
from magnetosuture_thread.nodes.parameters import declare
from magnetosuture_thread.nodes.run import run
from magnetosuture_thread.scene import read_scene
from magnetosuture_thread.scene.messages import scene_message
from magnetosuture_thread.shared_parameters import shared


@dataclass(frozen=True)
class SceneServerSettings(Configuration):
    """Which scene is published."""

    GROUP: ClassVar[str] = "scene_server"

    scene: str = shared("scene")


def make(type_name: str, **fields: Any) -> Any:
    """Return a message of a type."""
    package, _, name = type_name.split("/")
    return getattr(import_module(f"{package}.msg"), name)(**fields)


class SceneServerNode(Node):
    """Publishes the scene once."""

    def __init__(self, **options: Any) -> None:
        super().__init__("scene_server", **node_options("scene_server", options))
        settings = declare(self, SceneServerSettings)
        self._scenes, self._markers = topics.SCENE.publisher(self), topics.SCENE_MARKERS.publisher(self)
        header = Header(frame_id=DISH_FRAME, stamp=self.get_clock().now().to_msg())
        self._scenes.publish(scene_message(read_scene(settings.scene), header, make))
        Health(self).ok("serving")


def main(arguments: list[str] | None = None) -> int:
    """Run the node as a program."""
    return run(SceneServerNode, arguments)


if __name__ == "__main__":
    sys.exit(main())
