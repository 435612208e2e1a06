"""Checks messages for which no checksum vouches: that they decode, and hold values that can be.

Altered values that are plausible pass; a bag that was salvaged by these checks stays unverified for good.
"""

from __future__ import annotations

import math
from array import array
from bisect import bisect_right
from collections import Counter
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np

from magnetosuture_thread.bags.conversion import CONVERSIONS
from magnetosuture_thread.bags.reader import Bag, RecordedMessage
from magnetosuture_thread.bags.storage import CDR, Connection, StoredMessage
from magnetosuture_thread.errors import BagError, InvalidInputError
from magnetosuture_thread.interface import DISH_FRAME, SCENE
from magnetosuture_thread.messages.cdr import stamp_and_frame
from magnetosuture_thread.messages.scene import parse_scene_message

MAX_REACH = 1.0  # m from the frame's origin, where the bag has no scene, or in another frame than the dish's
DISH_REACH = 1.5  # radii of the dish; a needle that is being laid into it may be beside it
QUATERNION_TOLERANCE = 0.1  # of the length of a quaternion
_SECOND = 10**9  # ns
_PLACED = {name for own in CONVERSIONS.values() for name in own}  # types that say where needle or thread are
_POINTS = ("geometry_msgs/msg/Point", "geometry_msgs/msg/Point32")


class SanityCheck:
    """Tells which messages of a bag may be believed as far as anybody can tell.

    Args:
        bag: it is read once, for the stamps and the scene.
    """

    def __init__(self, bag: Bag) -> None:
        self._bag = bag
        self._dish_reach = MAX_REACH
        stamps: dict[Connection, array[int]] = {}
        for item in bag.stored():
            record = self._record(item)
            if record is None:
                continue
            if (stamp := _stamp(record)) is not None:
                stamps.setdefault(item.connection, array("q")).append(stamp)
            if record.type_name == SCENE.type_name and self._dish_reach == MAX_REACH:
                self._dish_reach = _reach_of(record)
        self._in_order = {connection: rising(found) for connection, found in stamps.items()}
        self._next: Counter[Connection] = Counter()

    def problem(self, item: StoredMessage) -> str:
        """Return what is wrong with a message; empty if nothing is. To be called for all messages, in their order."""
        record = self._record(item)
        if record is None:
            return "a message that cannot be unpacked"
        is_late = False
        if _stamp(record) is not None:
            is_late = not self._in_order[item.connection][self._next[item.connection]]
            self._next[item.connection] += 1
        if item.connection.serialization != CDR:
            return f"a message written as {item.connection.serialization}, which is not checked"
        try:
            message = record.decode()
        except BagError:
            return "a message that does not decode as its type"
        if problem := _value_problem(message):
            return problem
        if record.type_name in _PLACED:
            frame = _frame(message)
            reach = self._dish_reach if frame.lstrip("/") == DISH_FRAME else MAX_REACH
            if problem := _place_problem(message, reach):
                return problem
        return "a stamp out of order" if is_late else ""

    def _record(self, item: StoredMessage) -> RecordedMessage | None:
        try:
            data = self._bag.load(item)
        except BagError:
            return None
        connection = item.connection
        return RecordedMessage(
            connection.topic, connection.type_name, item.time, data, connection.definition, self._bag.decoders
        )


def rising(values: array[int]) -> list[bool]:
    """Return which values are part of the longest run that never falls: those out of order are left out of it."""
    ends, at, before = list[int](), list[int](), [-1] * len(values)
    for index, value in enumerate(values):
        place = bisect_right(ends, value)
        before[index] = at[place - 1] if place else -1
        ends[place : place + 1], at[place : place + 1] = [value], [index]
    kept, index = [False] * len(values), at[-1] if at else -1
    while index >= 0:
        kept[index], index = True, before[index]
    return kept


def _stamp(record: RecordedMessage) -> int | None:
    """Return the stamp of a message with a header [ns]; None where it has none that can be read."""
    try:
        if not record.decoder.has_header():
            return None
        stamp = stamp_and_frame(record.topic, record.data)[0]
    except BagError:
        return None
    return stamp if -(2**63) <= stamp < 2**63 else None


def _frame(message: Any) -> str:
    return str(getattr(getattr(message, "header", None), "frame_id", ""))


def _reach_of(record: RecordedMessage) -> float:
    try:
        radius = parse_scene_message(record.decode()).dish.radius
    except (BagError, InvalidInputError):
        return MAX_REACH
    return min(MAX_REACH, DISH_REACH * radius)


def _value_problem(part: Any) -> str:
    """Return which value of a message cannot be; empty if all can."""
    if isinstance(part, float):
        return "" if np.isfinite(part) else "a value that is not finite"
    if isinstance(part, np.ndarray):
        is_finite = part.dtype.kind != "f" or bool(np.isfinite(part).all())
        return "" if is_finite else "a value that is not finite"
    if _type(part) == "builtin_interfaces/msg/Time" and not (part.sec >= 0 and part.nanosec < _SECOND):
        return "a time that cannot be"
    return next((problem for each in _parts(part) if (problem := _value_problem(each))), "")


def _place_problem(part: Any, reach: float) -> str:
    """Return whether a point is out of reach or an orientation none; empty if not."""
    kind = _type(part)
    place = part.translation if kind == "geometry_msgs/msg/Transform" else part if kind in _POINTS else None
    if place is not None and not max(abs(place.x), abs(place.y), abs(place.z)) <= reach:
        return f"a point more than {reach:g} m away"
    if kind == "geometry_msgs/msg/Quaternion":
        length = math.hypot(part.x, part.y, part.z, part.w)
        return "" if length == 0.0 or abs(length - 1.0) <= QUATERNION_TOLERANCE else "an orientation that is none"
    return next((problem for each in _parts(part) if (problem := _place_problem(each, reach))), "")


def _type(part: Any) -> str:
    return str(getattr(part, "__msgtype__", ""))


def _parts(part: Any) -> list[Any]:
    """Return the parts of a message or list; none of anything else."""
    if isinstance(part, list):
        return part
    return [getattr(part, field.name) for field in fields(part)] if is_dataclass(part) else []
