"""The scene server node: publishes the scene in force, and changes it by services."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from magnetosuture_msgs.srv import EditShape, LoadScene, RemoveShape

from magnetosuture_thread import MagnetosutureError, Scene
from magnetosuture_thread.interface import ADD_SHAPE, LOAD_SCENE, REMOVE_SHAPE, REPLACE_SHAPE, SCENE_SERVER
from magnetosuture_thread.messages.markers import packed_scene_markers
from magnetosuture_thread.messages.scene import packed_scene
from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.lifecycle import StandbyNode
from magnetosuture_thread.nodes.scene_follower import initial_scene
from magnetosuture_thread.scene.editing import SceneEditor, SceneServerSettings


class SceneServerNode(StandbyNode[SceneServerSettings]):
    """Publishes the scene whenever it changes; an invalid change is refused with its reason and changes nothing.

    Configured, it reads the scene of its parameter; activated again, it publishes the scene that is in force.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__(SCENE_SERVER, SceneServerSettings, **options)
        self._editor = SceneEditor(None)
        self.start()

    def allocate(self, settings: SceneServerSettings) -> None:
        """Read the scene."""
        self._editor = SceneEditor(initial_scene(settings.scene))
        self._scenes = self.held(topics.SCENE.publisher(self))
        self._markers = self.held(topics.SCENE_MARKERS.publisher(self))
        self._offer(LoadScene, LOAD_SCENE, lambda asked: self._editor.load(asked.file))
        self._offer(EditShape, ADD_SHAPE, lambda asked: self._editor.add(asked.name, asked.shape))
        self._offer(EditShape, REPLACE_SHAPE, lambda asked: self._editor.replace(asked.name, asked.shape))
        self._offer(RemoveShape, REMOVE_SHAPE, lambda asked: self._editor.remove(asked.name))

    def activate(self) -> None:
        """Publish the scene."""
        if self._editor.scene is None:
            self.health.warn(f"no scene yet: the parameter scene is empty, and nobody has called {LOAD_SCENE}")
        else:
            self._publish(self._editor.scene)

    def deactivate(self) -> None:
        """Publish no more; others go on by what they have."""

    def release(self) -> None:
        """Forget the scene, and the shapes that were added."""
        self._editor = SceneEditor(None)
        super().release()

    def _offer(self, service: Any, name: str, change: Callable[[Any], None]) -> None:
        self.held(self.create_service(service, name, lambda asked, answer: self._change(answer, lambda: change(asked))))

    def _change(self, answer: Any, change: Callable[[], None]) -> Any:
        """Change the scene, and say what became of it."""
        self.require_active()
        before = self._editor.scene
        try:
            change()
        except MagnetosutureError as error:
            answer.success, answer.message = False, str(error)
            self.health.refuse(error)
        else:
            answer.success = True
        after = self._editor.scene
        if after is not None:
            answer.version = after.version
            if answer.success and (before is None or before.version != after.version):
                self._publish(after)
        return answer

    def _publish(self, scene: Scene) -> None:
        stamp = self.get_clock().now().to_msg()
        self._scenes.publish(packed_scene(stamp, scene))
        self._markers.publish(packed_scene_markers(stamp, scene))
        count = len(scene.shapes)
        text = f"scene {scene.version}: dish of {1e3 * scene.dish.diameter:g} mm, {count} shape{'s' * (count != 1)}"
        self.health.ok(text, version=scene.version, shapes=", ".join(scene.names) or "none")
        self.get_logger().info(text)
