"""Reads the two messages that a bag of poses is full of, forty times faster than field by field.

What is not laid out as these readers expect is left to the bags' type store, which reads everything.
"""

from __future__ import annotations

import struct

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.bags.headers import DISH_END, LITTLE_ENDIAN, is_in_dish_frame
from magnetosuture_thread.bags.reader import RecordedMessage
from magnetosuture_thread.errors import InvalidInputError
from magnetosuture_thread.geometry.orientation import heading_from_quaternion
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.interface import DISH_FRAME, NEEDLE_POSE

_STAMPS = (struct.Struct(">4xiI"), struct.Struct("<4xiI"))  # by the bytes' order
_SHORTEST = _STAMPS[0].size + 4  # of a header, where the length of the frame's name ends
_POSE = struct.Struct("<7d")  # position and quaternion
_COUNT = struct.Struct("<I")
_LONGEST = 256  # bytes of the names of frames that are passed over in a path


def stamp_of(record: RecordedMessage) -> int:
    """Return the stamp of a message that begins with a header [ns]; when it was recorded, if it is too short."""
    if len(record.data) < _SHORTEST:
        return record.time
    seconds, nanoseconds = _STAMPS[record.data[1] & 1].unpack_from(record.data)
    return int(seconds) * 1_000_000_000 + int(nanoseconds)


def read_pose(record: RecordedMessage) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
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
    return np.array([x, y]), heading_from_quaternion(qx, qy, qz, qw, f"{NEEDLE_POSE.name}.pose.orientation")


def read_path(record: RecordedMessage) -> Points:
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


def _aligned(at: int, to: int) -> int:
    """Return the next place of a size in CDR, which counts from behind its first four bytes."""
    return 4 + (at - 4 + to - 1) // to * to


_POSE_AT, _COUNT_AT = _aligned(DISH_END, 8), _aligned(DISH_END, 4)
_PATH_AT = _COUNT_AT + _COUNT.size
_NAME_AT = _PATH_AT + 8  # the length of the frame's name in a path's first pose


def _is_plain(data: bytes) -> bool:
    """Return whether a message is in the dish frame, and written as our machines write it."""
    return data[:2] == LITTLE_ENDIAN and is_in_dish_frame(data)


def _quick_pose(data: bytes) -> tuple[float, ...] | None:
    if not _is_plain(data) or len(data) < _POSE_AT + _POSE.size:
        return None
    return _POSE.unpack_from(data, _POSE_AT)


def _quick_path(data: bytes) -> Points | None:
    """Return a path whose poses all have frames of one length, so that they lie at equal distances."""
    if not _is_plain(data) or len(data) < _PATH_AT:
        return None
    (count,) = _COUNT.unpack_from(data, _COUNT_AT)
    if count == 0:
        return np.empty((0, 2))
    if len(data) < _NAME_AT + _COUNT.size:
        return None
    (name,) = _COUNT.unpack_from(data, _NAME_AT)
    first = _aligned(_NAME_AT + _COUNT.size + name, 8)
    stride = first + _POSE.size - _PATH_AT
    if len(data) < _PATH_AT + count * stride or (count > 1 and name > _LONGEST):
        return None
    names = np.ndarray((count,), "<u4", data, _NAME_AT, (stride,))
    if names.tobytes() != data[_NAME_AT : _NAME_AT + _COUNT.size] * count:
        return None
    return np.array(np.ndarray((count, 2), "<f8", data, first, (stride, 8)), np.float64)
