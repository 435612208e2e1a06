"""Settings of the scene server."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from magnetosuture_thread.configuration import Configuration
from magnetosuture_thread.shared_parameters import shared_parameter


@dataclass(frozen=True)
class SceneServerSettings(Configuration):
    """The scene that is published first."""

    GROUP: ClassVar[str] = "scene_server"

    scene: str = shared_parameter("scene")
