"""Editing of the active scene, as the services of the scene server do, without ROS."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

from magnetosuture_thread.configuration import Configuration, autostart_parameter
from magnetosuture_thread.scene.files import parse_yaml, read_scene
from magnetosuture_thread.scene.mapping import shape_from_mapping
from magnetosuture_thread.scene.scene import MAX_NAME_CHARS, Scene, SceneShape, scene_error
from magnetosuture_thread.shared_parameters import shared_parameter


@dataclass(frozen=True)
class SceneServerSettings(Configuration):
    """The scene that is published first."""

    GROUP: ClassVar[str] = "scene_server"

    autostart: str = autostart_parameter()
    scene: str = shared_parameter("scene")


MAX_SHAPE_CHARS = 300_000  # 10,000 vertices in full precision
MAX_PATH_CHARS = 4096


class SceneEditor:
    """Holds the active scene and edits it; an invalid edit leaves it unchanged.

    Args:
        scene: the initial scene; None until one is loaded.

    Attributes:
        scene: the active scene.

    Each edit raises `ConfigurationError` where it is invalid, whatever the text.
    """

    def __init__(self, scene: Scene | None = None) -> None:
        self.scene = scene

    def load(self, file: str) -> None:
        """Load the scene of a file, given as a path or as the name of one that ships with the package."""
        _require_length("file", file, MAX_PATH_CHARS)
        self.scene = read_scene(file)

    def add(self, name: str, shape: str) -> None:
        """Append a shape; the text is its description as in a scene file."""
        self.scene = self._require_scene().add(_parse_shape(name, shape))

    def replace(self, name: str, shape: str) -> None:
        """Replace the shape of the same name."""
        self.scene = self._require_scene().replace(_parse_shape(name, shape))

    def remove(self, name: str) -> None:
        """Remove a shape."""
        self.scene = self._require_scene().remove(name)

    def _require_scene(self) -> Scene:
        if self.scene is None:
            expectation = "a scene that is loaded first, of which the dish is known"
            raise scene_error("scene", "a change of a shape", expectation)
        return self.scene


def _parse_shape(name: str, text: str) -> SceneShape:
    _require_length("name", name, MAX_NAME_CHARS)
    _require_length("shape", text, MAX_SHAPE_CHARS)
    description: Any = parse_yaml(text, what="shape")
    return shape_from_mapping(name, description)


def _require_length(field: str, text: str, max_chars: int) -> None:
    if len(text) > max_chars:
        raise scene_error(field, f"{len(text)} characters", f"at most {max_chars}")
