"""CDR bytes: messages packed field by field, and the headers of messages read back."""

from __future__ import annotations

import struct
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from magnetosuture_thread.settings.errors import BagError
from magnetosuture_thread.settings.interface import DISH_FRAME

BEGIN = b"\x00\x01\x00\x00"  # plain CDR, little endian, as every ROS 2 machine of today writes it
_DISH = struct.pack("<I", len(DISH_FRAME.encode()) + 1) + DISH_FRAME.encode() + b"\0"
DISH_END = len(BEGIN) + 8 + len(_DISH)  # where a header in the dish frame ends, behind its stamp
_COUNT = struct.Struct("<I")

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
            data += _DISH
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
    formats = {"bool": "?", "uint8": "B", "int32": "i", "uint32": "I", "float32": "f", "float64": "d"}
    for word in layout.split():
        name, bracket, count = word.partition("[")
        if name not in formats:
            fields.append((name, np.dtype("<f8"), 8))
        elif not bracket:
            number = struct.Struct("<" + formats[name])
            fields.append(("number", number, number.size))
        else:
            dtype = np.dtype("<" + formats[name])
            fields.append(("array" if count != "]" else "sequence", dtype, dtype.itemsize))
    return tuple(fields)


def _put_time(data: bytearray, stamp: Stamp) -> None:
    data += bytes(-len(data) % 4)
    data += struct.pack("<iI", *(divmod(stamp, 10**9) if isinstance(stamp, int) else (stamp.sec, stamp.nanosec)))


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
    if len(data) < 12:
        return None
    whole, rest = struct.unpack_from("<iI" if data[1] & 1 else ">iI", data, len(BEGIN))
    return int(whole) * 1_000_000_000 + int(rest)


def stamp_and_frame(topic: str, data: bytes) -> tuple[int, str]:
    """Return when a message was stamped [ns], and in which frame it is.

    Args:
        topic: for errors.
        data: CDR bytes of a message whose type begins with std_msgs/Header.

    Raises:
        BagError: no header can be read there.
    """
    stamp, orders = header_stamp(data), {BEGIN[:2]: "<I", b"\0\0": ">I"}
    if stamp is not None and data[:2] in orders and len(data) >= 16:
        (length,) = struct.unpack_from(orders[data[:2]], data, 12)
        frame = data[16 : 16 + length]
        if 0 < length == len(frame) and frame.endswith(b"\0"):
            try:
                return stamp, frame[:-1].decode()
            except UnicodeDecodeError:
                pass
    raise BagError(topic, "a message has no header that can be read")


def is_in_dish_frame(data: bytes) -> bool:
    """Return whether a message that begins with a header is in the dish frame, and written as our machines write it."""
    return data[:2] == BEGIN[:2] and data[12:DISH_END] == _DISH


def aligned(at: int, to: int) -> int:
    """Return the next place of a size, which counts from behind the first four bytes."""
    return 4 + (at - 4 + to - 1) // to * to
