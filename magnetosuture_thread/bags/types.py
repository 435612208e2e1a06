"""The message types that the bags hold, known without ROS, and messages of them."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from magnetosuture_thread.messages.building import MessageBuilder
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


def make(type_name: str, **fields: Any) -> Any:
    """Return a message; fields that are not named are zero, or empty."""
    kinds = typestore().fielddefs[type_name][1]
    if len(fields) < len(kinds):
        fields = {name: fields[name] if name in fields else _zero(kind) for name, kind in kinds}
    return typestore().types[type_name](**fields)


def _zero(kind: Any) -> Any:
    """Return what a field of a kind, as rosbags describes it, holds at first."""
    node, detail = kind
    if node is Nodetype.NAME:
        return make(detail, w=1.0) if detail == "geometry_msgs/msg/Quaternion" else make(detail)  # its definition's
    if node is Nodetype.BASE:
        return {"string": "", "bool": False}.get(detail[0], 0.0 if detail[0].startswith("float") else 0)
    (inner, element), count = detail
    count = count if node is Nodetype.ARRAY else 0
    if inner is Nodetype.BASE and element[0] != "string":
        return np.zeros(count, element[0])
    return [_zero((inner, element)) for _ in range(count)]


def _numbers(kind: str, values: Any) -> Any:
    return np.asarray(values, dtype=kind)


MESSAGES = MessageBuilder(make, _numbers)
"""Builds messages of the bags' type store."""
