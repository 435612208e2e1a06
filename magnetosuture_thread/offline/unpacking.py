"""Reads the two messages that a bag of poses is full of, forty times faster than field by field.

What is not laid out as these readers expect is left to the bags' type store, which reads everything.
"""

from __future__ import annotations

import struct
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.bags.reader import Record
from magnetosuture_thread.errors import InvalidInputError
from magnetosuture_thread.geometry.orientation import heading_of
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.interface import DISH_FRAME, NEEDLE_POSE

LITTLE_ENDIAN = b"\x00\x01"  # what plain CDR begins with, as every ROS 2 machine of today writes it
_BEGIN = struct.Struct("<4xiII")  # stamp, and the length of the frame's name
_POSE = struct.Struct("<7d")  # position and quaternion


def stamp_of(record: Record) -> int:
    """Return the stamp of a message that begins with a header [ns]; when it was recorded, if it is too short."""
    if len(record.data) < _BEGIN.size:
        return record.time
    seconds, nanoseconds, _ = struct.unpack_from("<4xiII" if record.data[1] & 1 else ">4xiII", record.data)
    return int(seconds) * 1_000_000_000 + int(nanoseconds)


def read_pose(record: Record) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return tail and heading of a recorded needle pose, each of shape (2,), as `thread_model` gets them.

    Raises:
        BagError: it cannot be decoded.
        InvalidInputError: it is of another frame, or its orientation is none.
    """
    found = _quick_pose(record.data)
    if found is None:
        message = record.decode()
        _require_dish(message.header.frame_id, record.topic)
        p, q = message.pose.pose.position, message.pose.pose.orientation
        found = p.x, p.y, p.z, q.x, q.y, q.z, q.w
    x, y, _, qx, qy, qz, qw = found
    return np.array([x, y]), heading_of(qx, qy, qz, qw, f"{NEEDLE_POSE.name}.pose.orientation")


def read_path(record: Record) -> Points:
    """Return a recorded path as an array of shape (m, 2) [m].

    Raises:
        BagError: it cannot be decoded.
        InvalidInputError: it is of another frame.
    """
    found = _quick_path(record.data)
    if found is not None:
        return found
    message = record.decode()
    _require_dish(message.header.frame_id, record.topic)
    return np.array([[p.pose.position.x, p.pose.position.y] for p in message.poses]).reshape(-1, 2)


def _require_dish(frame: str, topic: str) -> None:
    if frame != DISH_FRAME:
        raise InvalidInputError(f"{topic}.header.frame_id", repr(frame), repr(DISH_FRAME))


def _after_header(data: bytes) -> int | None:
    """Return where a header in the dish frame ends; None if there is none in plain CDR."""
    if len(data) < _BEGIN.size or data[:2] != LITTLE_ENDIAN:
        return None
    length = _BEGIN.unpack_from(data)[2]
    end = _BEGIN.size + length
    return end if data[_BEGIN.size : end] == _NAME else None


_NAME = DISH_FRAME.encode() + b"\0"


def _aligned(at: int, to: int) -> int:
    """Return the next place of a size in CDR, which counts from behind its first four bytes."""
    return 4 + (at - 4 + to - 1) // to * to


def _quick_pose(data: bytes) -> Any:
    end = _after_header(data)
    if end is None or len(data) < _aligned(end, 8) + _POSE.size:
        return None
    return _POSE.unpack_from(data, _aligned(end, 8))


@cache
def _layout(name: int) -> np.dtype[np.void]:
    """Return the layout of one stamped pose after another, the frame's name having a given length."""
    gap = _aligned(4 + 12 + name, 8) - (4 + 12 + name)
    return np.dtype([("stamp", "<u4", 2), ("length", "<u4"), ("name", "V", name + gap), ("pose", "<f8", 7)])


def _quick_path(data: bytes) -> Points | None:
    """Return a path whose poses all have frames of one length, so that they lie at equal distances."""
    end = _after_header(data)
    if end is None:
        return None
    at = _aligned(end, 4)
    if len(data) < at + 4:
        return None
    count, at = int.from_bytes(data[at : at + 4], "little"), at + 4
    if count == 0:
        return np.empty((0, 2))
    if len(data) < at + 12:
        return None
    name = int.from_bytes(data[at + 8 : at + 12], "little")
    first = _aligned(at + 12 + name, 8) + _POSE.size  # where the second pose begins: from there all are alike
    if len(data) < first:
        return None
    points = np.empty((count, 2))
    points[0] = np.frombuffer(data, "<f8", 2, first - _POSE.size)
    if count > 1:
        layout = _layout(name)
        if name > 256 or len(data) < first + (count - 1) * layout.itemsize:
            return None
        others = np.frombuffer(data, layout, count - 1, first)
        if (others["length"] != name).any():
            return None
        points[1:] = others["pose"][:, :2]
    return points
