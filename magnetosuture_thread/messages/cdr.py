"""CDR bytes: formats of plain CDR, little endian, each field at a multiple of its size; and headers out of them."""

from __future__ import annotations

import struct
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from magnetosuture_thread.errors import BagError
from magnetosuture_thread.interface import DISH_FRAME

BEGIN = b"\x00\x01\x00\x00"  # plain CDR, little endian; places count from behind it
KEPT = 256  # formats and texts; a run has a few
REAL = np.dtype("<f8")

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
_STAMPS = (struct.Struct(">4xiI"), struct.Struct("<4xiI"))  # by the bytes' order

Text = tuple[int, bytes]  # as a message has it: its length and its bytes
Time = tuple[int, int]  # seconds and nanoseconds


def time_of(stamp: int) -> Time:
    """Return a time [ns] as a message has it."""
    return divmod(stamp, 10**9)


@lru_cache(KEPT)
def text(value: str) -> Text:
    """Return a text as a message has it."""
    data = value.encode() + b"\0"
    return len(data), data


def numbers(values: ArrayLike, kind: np.dtype[np.generic]) -> bytes:
    """Return numbers as a sequence's bytes."""
    return np.asarray(values, kind).tobytes()


def points_of(vertices: ArrayLike) -> bytes:
    """Return points of shape (m, 2) [m] as the bytes of a sequence of Point."""
    flat = np.asarray(vertices)
    points = np.zeros((len(flat), 3), REAL)
    points[:, :2] = flat
    return points.tobytes()


def text_codes(length: int) -> tuple[str, ...]:
    """Return the codes of a text of this length."""
    return "I", f"{length}s"


def array_codes(count: int, kind: str, width: int = 1) -> tuple[str, ...]:
    """Return the codes of a sequence, whose numbers come as bytes; of an empty one only the count is there."""
    aligned = (f"0{kind}",) if count else ()
    return "I", *aligned, f"{count * width * struct.calcsize('<' + kind)}s"


def form(*codes: str) -> struct.Struct:
    """Return the format of fields behind each other, each at a multiple of its size; `0d` only goes to such a place."""
    whole = "<"
    for code in codes:
        whole += f"{-struct.calcsize(whole) % struct.calcsize('<' + code[-1])}x{code}"
    return struct.Struct(whole)


DISH, EMPTY = text(DISH_FRAME), text("")
HEADER = ("i", "I", *text_codes(DISH[0]))


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
