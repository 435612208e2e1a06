"""Scenes as messages."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from std_msgs.msg import Header

from magnetosuture_thread.interface import DISH_FRAME
from magnetosuture_thread.scene import Scene
from magnetosuture_thread.scene.messages import build_scene_message


def scene_told(scene: Scene) -> Any:
    """Return a scene as a message."""

    def make(type_name: str, **fields: Any) -> Any:
        package, _, name = type_name.split("/")
        return getattr(import_module(f"{package}.msg"), name)(**fields)

    return build_scene_message(scene, Header(frame_id=DISH_FRAME), make)
