"""Changes of a scene while it is in force: what the scene server's services do, without ROS."""

from __future__ import annotations

from typing import Any

from magnetosuture_thread.scene.definitions import shape_from_mapping
from magnetosuture_thread.scene.files import read_scene
from magnetosuture_thread.scene.refusal import refusal
from magnetosuture_thread.scene.scene import MAX_NAME_CHARS, Scene, SceneShape
from magnetosuture_thread.scene.text import parse_yaml

MAX_SHAPE_CHARS = 300_000  # 10,000 vertices in full precision
MAX_PATH_CHARS = 4096


class SceneEditor:
    """Keeps the scene in force and changes it; a change that is refused leaves it as it is.

    Args:
        scene: in force at first; None for none, until one is loaded.

    Attributes:
        scene: in force.

    Each change raises `ConfigurationError` where it is refused, whatever the text that came.
    """

    def __init__(self, scene: Scene | None = None) -> None:
        self.scene = scene

    def load(self, file: str) -> None:
        """Take the scene of a file, given as a path or as the name of one that ships with the package."""
        _require_length("file", file, MAX_PATH_CHARS)
        self.scene = read_scene(file)

    def add(self, name: str, shape: str) -> None:
        """Add a shape at the end; the text is what a scene file has behind its name."""
        self.scene = self._present().add(_parsed(name, shape))

    def replace(self, name: str, shape: str) -> None:
        """Put another shape in the place of the one of the same name."""
        self.scene = self._present().replace(_parsed(name, shape))

    def remove(self, name: str) -> None:
        """Remove a shape."""
        self.scene = self._present().remove(name)

    def _present(self) -> Scene:
        if self.scene is None:
            raise refusal("scene", "a change of a shape", "a scene that is loaded first, of which the dish is known")
        return self.scene


def _parsed(name: str, text: str) -> SceneShape:
    _require_length("name", name, MAX_NAME_CHARS)
    _require_length("shape", text, MAX_SHAPE_CHARS)
    description: Any = parse_yaml(text, what="shape")
    return shape_from_mapping(name, description)


def _require_length(field: str, text: str, most: int) -> None:
    if len(text) > most:
        raise refusal(field, f"{len(text)} characters", f"at most {most}")
