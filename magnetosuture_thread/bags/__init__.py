"""Bags: the only subpackage that imports mcap and rosbags."""

from __future__ import annotations

from magnetosuture_thread.settings.errors import ConfigurationError


def parse_remap(text: str) -> tuple[str, str]:
    """Return the recorded and the new name of a topic from a ROS remapping rule.

    >>> parse_remap("/camera/color/image_raw:=camera/image_raw")
    ('/camera/color/image_raw', '/camera/image_raw')

    Args:
        text: `FROM:=TO`; a name without its leading slash gets one.

    Raises:
        ConfigurationError: it is not of that form.
    """
    before, sign, after = text.partition(":=")
    names = [part.strip() for part in (before, after)]
    if not sign or not all(name.strip("/") for name in names) or any(set(name) & set(" :=") for name in names):
        raise ConfigurationError("remap", text, "FROM:=TO, two topics, for example /cam/image:=/camera/image_raw")
    return absolute_topic(names[0]), absolute_topic(names[1])


def absolute_topic(topic: str) -> str:
    """Return the name of a topic with a leading slash."""
    return topic if topic.startswith("/") else f"/{topic}"
