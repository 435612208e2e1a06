"""The scene server node: publishes the scene in force, and changes it by services."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from magnetosuture_thread import ConfigurationError, MagnetosutureError, Scene, read_scene
from magnetosuture_thread.bags.packing import packed_scene, packed_scene_markers
from magnetosuture_thread.bags.reading import parse_shape_message
from magnetosuture_thread.geometry.scene_files import SceneServerSettings
from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.node import ManagedNode
from magnetosuture_thread.settings.interface import SCENE_SERVER, Service


class SceneServerNode(ManagedNode[SceneServerSettings]):
    """Publishes the scene whenever it changes; an invalid change is refused with its reason and changes nothing.

    Configured, it reads the scene of its parameter; activated again, it publishes the scene that is in force, with the
    shapes that were added.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__(SCENE_SERVER, SceneServerSettings, **options)
        self.start()

    def allocate(self, settings: SceneServerSettings) -> None:
        """Read the scene."""
        self._scene = read_scene(settings.scene) if settings.scene else None
        self._scenes = topics.SCENE.publisher(self)
        self._markers = topics.SCENE_MARKERS.publisher(self)
        for service, change in (
            (Service.LOAD_SCENE, lambda request: _read(request.file)),
            (Service.ADD_SHAPE, lambda request: self._loaded().add(parse_shape_message(request.shape))),
            (Service.REPLACE_SHAPE, lambda request: self._loaded().replace(parse_shape_message(request.shape))),
            (Service.REMOVE_SHAPE, lambda request: self._loaded().remove(request.name)),
        ):
            self.serve(service, partial(self._change, change))

    def activate(self) -> None:
        """Publish the scene; inactive, others go on by what they have."""
        if self._scene is None:
            self.health.warn(f"no scene yet: the parameter scene is empty, and nobody has called {Service.LOAD_SCENE}")
        else:
            self._publish(self._scene)

    def _loaded(self) -> Scene:
        if self._scene is None:
            expectation = "a scene that is loaded first, of which the dish is known"
            raise ConfigurationError("scene", "a change of a shape", expectation)
        return self._scene

    def _change(self, change: Callable[[Any], Scene], request: Any) -> dict[str, Any]:
        """Change the scene; return what became of it."""
        self.require_active()
        answer, before = dict[str, Any](), self._scene
        try:
            self._scene = change(request)
        except MagnetosutureError as error:
            answer |= {"success": False, "message": str(error)}
            self.health.refuse(error)
        if self._scene is not None:
            answer["version"] = self._scene.version
            if before is None or before.version != self._scene.version:
                self._publish(self._scene)
        return answer

    def _publish(self, scene: Scene) -> None:
        stamp = self.get_clock().now().to_msg()
        self._scenes.publish(packed_scene(stamp, scene))
        self._markers.publish(packed_scene_markers(stamp, scene))
        count = len(scene.shapes)
        text = f"scene {scene.version}: dish of {1e3 * scene.dish.diameter:g} mm, {count} shape{'s' * (count != 1)}"
        self.health.ok(text, version=scene.version, shapes=", ".join(scene.names) or "none")
        self.get_logger().info(text)


def _read(file: str) -> Scene:
    """Return the scene of a file, given as a path or as the name of one that ships with the package."""
    if len(file) > 4096:  # more than a path may have
        raise ConfigurationError("file", f"{len(file)} characters", "at most 4096")
    return read_scene(file)
