"""Stamp and frame of a message that begins with a header, out of its bytes."""

from __future__ import annotations

import struct

from magnetosuture_thread.errors import BagError

_FORMS = {b"\0\1": struct.Struct("<iII"), b"\0\0": struct.Struct(">iII")}  # by the bytes' order


def stamp_and_frame(topic: str, data: bytes) -> tuple[int, str]:
    """Return when a message was stamped [ns], and in which frame it is.

    Args:
        topic: for errors.
        data: CDR bytes of a message whose type begins with std_msgs/Header.

    Raises:
        BagError: no header can be read there.
    """
    form = _FORMS.get(data[:2])
    start = 4 + 12
    if form is not None and len(data) >= start:
        seconds, nanoseconds, length = form.unpack_from(data, 4)
        frame = data[start : start + length]
        if 0 < length == len(frame) and frame.endswith(b"\0"):
            try:
                return seconds * 10**9 + nanoseconds, frame[:-1].decode()
            except UnicodeDecodeError:
                pass
    raise BagError(topic, "a message has no header that can be read")
