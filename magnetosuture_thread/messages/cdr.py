"""CDR bytes: messages packed field by field, and the headers of messages read back."""

from __future__ import annotations

import struct
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from magnetosuture_thread.errors import BagError
from magnetosuture_thread.interface import DISH_FRAME

BEGIN = b"\x00\x01\x00\x00"  # plain CDR, little endian; positions count from behind it
LITTLE_ENDIAN = b"\0\1"  # what plain CDR begins with, as every ROS 2 machine of today writes it
_BIG_ENDIAN = b"\0\0"
_STAMP, _LENGTH, _FRAME = 4, 12, 16  # where the stamp begins, the length of the frame's name, and the name
_FORMS = {LITTLE_ENDIAN: struct.Struct("<iII"), _BIG_ENDIAN: struct.Struct(">iII")}
_NAME = DISH_FRAME.encode() + b"\0"
_DISH = {
    LITTLE_ENDIAN: len(_NAME).to_bytes(4, "little") + _NAME,
    _BIG_ENDIAN: len(_NAME).to_bytes(4, "big") + _NAME,
}
DISH_END = _FRAME + len(_NAME)  # where a header in the dish frame ends
_STAMPS = (struct.Struct(">4xiI"), struct.Struct("<4xiI"))  # by the byte order
_TIME, _COUNT = struct.Struct("<iI"), struct.Struct("<I")
_NUMBERS = {"bool": "?", "uint8": "B", "int32": "i", "uint32": "I", "float32": "f", "float64": "d"}

Stamp = Any  # nanoseconds as int, or a time message of any library


def pack(layout: str, *values: Any) -> bytes:
    """Return the CDR bytes of a message.

    Args:
        layout: the kinds of its fields in their order, with those of nested messages in their place, separated by
            spaces. `header` is a stamp in the dish frame and `time` a stamp, both of type `Stamp`; `text` is a string;
            numbers have their names in ROS. `float64[]` is a sequence of numbers, `float64[9]` an array, whose numbers
            stand without a count; `points` is an array of shape (m, 2) as a sequence of points or vectors with z = 0;
            `texts` is a sequence of strings; `raw` is bytes that are in place as they are.
        values: of the fields.
    """
    data = bytearray(BEGIN)
    for (kind, number, size), value in zip(_fields(layout), values, strict=True):
        if kind == "number":
            data += bytes((4 - len(data)) % size)
            data += number.pack(value)
        elif kind == "header":
            _put_time(data, value)
            data += _DISH[LITTLE_ENDIAN]
        elif kind == "text":
            _put_text(data, value)
        elif kind == "time":
            _put_time(data, value)
        elif kind == "texts":
            data += bytes(-len(data) % 4) + _COUNT.pack(len(value))
            for text in value:
                _put_text(data, text)
        elif kind == "raw":
            data += value
        else:
            _put_numbers(data, kind, number, value)
    return bytes(data)


@cache
def _fields(layout: str) -> tuple[tuple[str, Any, int], ...]:
    """Return for each field what it is, its format or type, and its size [bytes]."""
    fields: list[tuple[str, Any, int]] = []
    for word in layout.split():
        name, bracket, count = word.partition("[")
        if name not in _NUMBERS:
            fields.append((name, np.dtype("<f8"), 8))
        elif not bracket:
            number = struct.Struct("<" + _NUMBERS[name])
            fields.append(("number", number, number.size))
        else:
            dtype = np.dtype("<" + _NUMBERS[name])
            fields.append(("array" if count != "]" else "sequence", dtype, dtype.itemsize))
    return tuple(fields)


def _put_time(data: bytearray, stamp: Stamp) -> None:
    data += bytes(-len(data) % 4)
    data += _TIME.pack(*(divmod(stamp, 10**9) if isinstance(stamp, int) else (stamp.sec, stamp.nanosec)))


def _put_text(data: bytearray, text: str) -> None:
    content = text.encode() + b"\0"
    data += bytes(-len(data) % 4) + _COUNT.pack(len(content)) + content


def _put_numbers(data: bytearray, kind: str, dtype: np.dtype[Any], values: ArrayLike) -> None:
    numbers = np.asarray(values, dtype)
    if kind == "points":
        numbers = np.zeros((len(numbers), 3))
        if len(numbers):
            numbers[:, :2] = values
    if kind != "array":
        data += bytes(-len(data) % 4) + _COUNT.pack(len(numbers))
    if numbers.size:  # an empty sequence is not aligned
        data += bytes((4 - len(data)) % dtype.itemsize) + numbers.tobytes()


def header_stamp(data: bytes) -> int | None:
    """Return the stamp of CDR bytes that begin with a header [ns]; None if there are too few."""
    if len(data) < _LENGTH:
        return None
    whole, rest = _STAMPS[data[1] & 1].unpack_from(data)
    return int(whole) * 1_000_000_000 + int(rest)


def stamp_and_frame(topic: str, data: bytes) -> tuple[int, str]:
    """Return when a message was stamped [ns], and in which frame it is.

    Args:
        topic: for errors.
        data: CDR bytes of a message whose type begins with std_msgs/Header.

    Raises:
        BagError: no header can be read there.
    """
    form = _FORMS.get(data[:2])
    if form is not None and len(data) >= _FRAME:
        seconds, nanoseconds, length = form.unpack_from(data, _STAMP)
        frame = data[_FRAME : _FRAME + length]
        if 0 < length == len(frame) and frame.endswith(b"\0"):
            try:
                return seconds * 10**9 + nanoseconds, frame[:-1].decode()
            except UnicodeDecodeError:
                pass
    raise BagError(topic, "a message has no header that can be read")


def is_in_dish_frame(data: bytes) -> bool:
    """Return whether a message that begins with a header is in the dish frame, as `stamp_and_frame` would say."""
    return data[_LENGTH:DISH_END] == _DISH.get(data[:2])


def aligned(at: int, to: int) -> int:
    """Return the next place of a size, which counts from behind the first four bytes."""
    return 4 + (at - 4 + to - 1) // to * to
