"""The message types that the bags hold, known without ROS."""

from __future__ import annotations

from functools import cache

from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from magnetosuture_thread.resources import share


@cache
def typestore() -> Typestore:
    """Return the types of ROS 2 Jazzy and of magnetosuture_msgs."""
    store = get_typestore(Stores.ROS2_JAZZY)
    own = {}
    for path in sorted((share("magnetosuture_msgs") / "msg").glob("*.msg")):
        own.update(get_types_from_msg(path.read_text(encoding="utf-8"), f"magnetosuture_msgs/msg/{path.stem}"))
    store.register(own)
    return store
