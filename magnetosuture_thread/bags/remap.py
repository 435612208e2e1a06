"""Remapping of topic names, as in ROS."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from difflib import get_close_matches
from pathlib import Path

from magnetosuture_thread.errors import BagError, ConfigurationError


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


def apply_remap(path: Path, topics: Collection[str], remap: Mapping[str, str]) -> dict[str, str]:
    """Return the remapped name of each topic of a bag.

    Args:
        path: of the bag, for errors.
        topics: as they were recorded.
        remap: new name of a topic by its recorded name.

    Raises:
        BagError: the bag has no such topic, or another one has the new name already.
    """
    names = {topic: topic for topic in topics}
    for before, after in remap.items():
        known = [topic for topic in topics if absolute_topic(topic) == absolute_topic(before)]
        if not known:
            raise BagError(path, f"has no topic {absolute_topic(before)} to remap{_suggestion(before, topics)}")
        names[known[0]] = absolute_topic(after)
    sources: dict[str, list[str]] = {}
    for topic, name in sorted(names.items()):
        sources.setdefault(name, []).append(topic)
    for name, own in sources.items():
        if len(own) > 1 and name in own:
            other = next(topic for topic in own if topic != name)
            raise BagError(path, f"has {name} itself; {other} cannot be remapped to it without mixing the two")
        if len(own) > 1:
            raise BagError(path, f"{own[0]} and {own[1]} cannot both be remapped to {name}")
    return names


def _suggestion(topic: str, topics: Collection[str]) -> str:
    close = get_close_matches(absolute_topic(topic), topics, n=1)
    meant = f"; did you mean {close[0]}?" if close else ""
    return f"{meant}; its topics: {', '.join(sorted(topics)) or 'none'}"
