"""Changes of scene and thread that a bag records, applied as `thread_model` applies them."""

from __future__ import annotations

from magnetosuture_thread.bags.reader import RecordedMessage
from magnetosuture_thread.configuration import from_mapping, to_mapping
from magnetosuture_thread.interface import MATERIAL, SCENE
from magnetosuture_thread.messages.scene import parse_scene_message
from magnetosuture_thread.model.settings import ThreadModelSettings, parse_material
from magnetosuture_thread.scene import Scene

CHANGING = (SCENE, MATERIAL)


def changed(
    settings: ThreadModelSettings, scene: Scene | None, record: RecordedMessage
) -> tuple[ThreadModelSettings, Scene | None]:
    """Return settings and scene after a recorded message on one of these channels.

    Raises:
        BagError: it cannot be decoded.
        ConfigurationError: it cannot be used.
        InvalidInputError: it is of another frame, or damaged.
    """
    if record.topic == SCENE.recorded:
        return settings, parse_scene_message(record.decode())
    values = parse_material(record.decode())
    return from_mapping(ThreadModelSettings, {**to_mapping(settings), **values}), scene
