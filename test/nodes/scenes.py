"""Scenes as messages."""

from __future__ import annotations

from typing import Any

from magnetosuture_thread.scene import Scene
from test.nodes import wire


def scene_told(scene: Scene) -> Any:
    """Return a scene as a message."""
    return wire.scene_message(0, scene)
