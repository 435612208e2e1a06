"""Topics of a bag under other names."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from difflib import get_close_matches
from pathlib import Path

from magnetosuture_thread.errors import BagError, ConfigurationError


def remapping(text: str) -> tuple[str, str]:
    """Return a topic's recorded name and the name it shall have, written as ROS does.

    >>> remapping("/camera/color/image_raw:=camera/image_raw")
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
    return recorded(names[0]), recorded(names[1])


def recorded(topic: str) -> str:
    """Return a topic's name with a leading slash."""
    return topic if topic.startswith("/") else f"/{topic}"


def renamed(path: Path, topics: Collection[str], remap: Mapping[str, str]) -> dict[str, str]:
    """Return the name of each of a bag's topics once they are remapped.

    Args:
        path: of the bag, for errors.
        topics: as they were recorded.
        remap: new name of a topic by its recorded name.

    Raises:
        BagError: the bag has no such topic, or another one has the new name already.
    """
    names = {topic: topic for topic in topics}
    for before, after in remap.items():
        known = [topic for topic in topics if recorded(topic) == recorded(before)]
        if not known:
            raise BagError(path, f"has no topic {recorded(before)} to remap{_suggestion(before, topics)}")
        names[known[0]] = recorded(after)
    together: dict[str, list[str]] = {}
    for topic, name in sorted(names.items()):
        together.setdefault(name, []).append(topic)
    for name, own in together.items():
        if len(own) > 1 and name in own:
            other = next(topic for topic in own if topic != name)
            raise BagError(path, f"has {name} itself; {other} cannot be remapped to it without mixing the two")
        if len(own) > 1:
            raise BagError(path, f"{own[0]} and {own[1]} cannot both be remapped to {name}")
    return names


def _suggestion(topic: str, topics: Collection[str]) -> str:
    close = get_close_matches(recorded(topic), topics, n=1)
    meant = f"; did you mean {close[0]}?" if close else ""
    return f"{meant}; its topics: {', '.join(sorted(topics)) or 'none'}"
