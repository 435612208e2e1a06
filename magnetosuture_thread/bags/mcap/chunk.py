"""A chunk: many records, packed, under one checksum."""

from __future__ import annotations

import struct
import zlib
from importlib import import_module
from typing import NamedTuple

import zstandard

from magnetosuture_thread.bags.mcap.layout import LARGEST, BrokenError

_HEAD = struct.Struct("<QQQII")  # first and last time, size unpacked, its checksum, length of the compression's name
_LENGTH = struct.Struct("<Q")
_PIECE = 1 << 20  # bytes unpacked at a time where nothing tells how many will come
_lz4 = import_module("lz4.frame")  # which has no types


class Content(NamedTuple):
    """What is in a chunk.

    Attributes:
        data: its records, unpacked.
        crc: their checksum, calculated.
        checked: whether the chunk has a checksum; if so, it is this.
        compression: `zstd`, `lz4` or empty.
    """

    data: bytes
    crc: int
    checked: bool
    compression: str


def unpack(body: bytes) -> Content:
    """Take a chunk apart and check it.

    Args:
        body: the chunk's record without its head.

    Raises:
        BrokenError: it is no chunk, cannot be unpacked, or its checksum is wrong.
    """
    if len(body) < _HEAD.size:
        raise BrokenError("a broken chunk")
    _, _, size, crc, name_length = _HEAD.unpack_from(body)
    start = _HEAD.size + name_length + _LENGTH.size
    if start > len(body) or start + _LENGTH.unpack_from(body, start - _LENGTH.size)[0] != len(body):
        raise BrokenError("a broken chunk")
    compression = body[_HEAD.size : _HEAD.size + name_length]
    if size > LARGEST:
        raise BrokenError(f"a chunk that says it holds {size} bytes")
    data = _decompressed(compression, body[start:], size)
    if len(data) != size:
        raise BrokenError("a chunk of a wrong size")
    found = zlib.crc32(data)
    if crc and found != crc:
        raise BrokenError("a chunk with a wrong checksum")
    return Content(data, found, bool(crc), compression.decode())


def _decompressed(compression: bytes, packed: bytes, size: int) -> bytes:
    """Return what is packed, but no more than a byte above the size that the chunk says it has."""
    if not compression:
        return packed
    try:
        if compression == b"lz4":
            data: bytes = _lz4.LZ4FrameDecompressor().decompress(packed, max_length=size + 1)
            return data
        if compression == b"zstd":
            if zstandard.frame_content_size(packed) == size:
                return zstandard.ZstdDecompressor().decompress(packed)
            pieces, taken = [], 0
            with zstandard.ZstdDecompressor().stream_reader(packed) as stream:
                while taken <= size and (piece := stream.read(_PIECE)):
                    pieces.append(piece)
                    taken += len(piece)
            return b"".join(pieces)
    except (zstandard.ZstdError, RuntimeError, ValueError, EOFError, MemoryError):
        raise BrokenError("a chunk that cannot be unpacked") from None
    raise BrokenError("a chunk of an unknown compression")
