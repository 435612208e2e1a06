"""Finds the next intact chunk where the records of an mcap file do not follow one another any more."""

from __future__ import annotations

import re
from typing import BinaryIO

from magnetosuture_thread.bags.mcap.chunk import unpack
from magnetosuture_thread.bags.mcap.layout import HEAD, LARGEST, BrokenError, records_in

# Kind, length of less than a terabyte, times, size and checksum, a compression that we know.
_CHUNK = re.compile(rb"\x06.{5}\0{3}.{28}(?:\x04\0{3}zstd|\x03\0{3}lz4|\0{4}).{5}\0{3}", re.DOTALL)
_WINDOW = 1 << 22
_OVERLAP = 64  # bytes, longer than what is looked for


def next_chunk(stream: BinaryIO, position: int, limit: int, before: int) -> int | None:
    """Return where the next chunk begins whose checksum is right; None if there is none.

    A chunk without a checksum is not one: nothing tells it from a message's data that looks like it.

    Args:
        stream: the file.
        position: where to begin to look.
        limit: where the data ends.
        before: the chunk must begin before this place.
    """
    while position < before:
        stream.seek(position)
        window = stream.read(min(_WINDOW, limit - position))
        at = 0
        while (match := _CHUNK.search(window, at)) is not None and position + match.start() < before:
            if is_intact(stream, position + match.start(), limit):
                return position + match.start()
            at = match.start() + 1
        if match is not None or len(window) < _WINDOW:
            return None
        position += len(window) - _OVERLAP
    return None


def is_intact(stream: BinaryIO, position: int, limit: int) -> bool:
    """Return whether a chunk with a right checksum begins at a place."""
    stream.seek(position)
    _, length = HEAD.unpack(stream.read(HEAD.size))
    if length > LARGEST or position + HEAD.size + length > limit:
        return False
    try:
        content = unpack(stream.read(length))
        for _ in records_in(content.data):
            pass
    except BrokenError:
        return False
    return content.checked
