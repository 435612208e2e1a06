"""Between the thread model's messages and its core's own types."""

from __future__ import annotations

from typing import Any

from magnetosuture_msgs.msg import (
    ThreadMaterial,
)
from rclpy.serialization import deserialize_message

from magnetosuture_thread.errors import InvalidInputError
from magnetosuture_thread.model import changes
from magnetosuture_thread.nodes.topics import Topic


def decoded(topic: Topic, data: bytes) -> Any:
    """Return a message that came as bytes.

    Raises:
        InvalidInputError: they are cut off, or those of another definition of the type.
    """
    try:
        return deserialize_message(data, topic.message)
    except RuntimeError:  # rclpy's own kind of it is private
        wanted = f"a {topic.channel.type_name} of our definition"
        raise InvalidInputError(topic.channel.name, f"{len(data)} bytes", wanted) from None


def material_values(message: ThreadMaterial) -> dict[str, Any]:
    """Return the settings, by name, that a material changes."""
    return changes.told_material(message)
