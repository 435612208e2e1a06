"""Reads stamp and frame from the serialised bytes of a message that begins with a header."""

from __future__ import annotations

import struct

from magnetosuture_thread.errors import BagError
from magnetosuture_thread.interface import DISH_FRAME

LITTLE_ENDIAN = b"\0\1"  # first bytes of plain CDR
_BIG_ENDIAN = b"\0\0"
_STAMP, _LENGTH, _FRAME = 4, 12, 16  # offsets of the stamp, the length of the frame id, and the frame id
_FORMATS = {LITTLE_ENDIAN: struct.Struct("<iII"), _BIG_ENDIAN: struct.Struct(">iII")}
_NAME = DISH_FRAME.encode() + b"\0"
_DISH = {
    LITTLE_ENDIAN: len(_NAME).to_bytes(4, "little") + _NAME,
    _BIG_ENDIAN: len(_NAME).to_bytes(4, "big") + _NAME,
}
DISH_END = _FRAME + len(_NAME)  # where a header in the dish frame ends


def stamp_and_frame(topic: str, data: bytes) -> tuple[int, str]:
    """Return the stamp [ns] and the frame id of a message.

    Args:
        topic: for errors.
        data: CDR bytes of a message whose type begins with std_msgs/Header.

    Raises:
        BagError: the bytes do not begin with a valid header.
    """
    form = _FORMATS.get(data[:2])
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
