"""Scenes as messages."""

from __future__ import annotations

from typing import Any

from magnetosuture_thread.nodes.messages import MESSAGES
from magnetosuture_thread.scene import Scene


def scene_told(scene: Scene) -> Any:
    """Return a scene as a message."""
    return MESSAGES.scene_message(0, scene)
