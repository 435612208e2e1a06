"""Reads size and orientation of a picture from its first bytes: a megabyte may decode to gigabytes."""

from __future__ import annotations

import struct
from typing import NamedTuple

MAX_SEGMENTS = 10_000  # of a JPEG before its pixels
MAX_GAP = 4096  # bytes between two of them
MAX_ENTRIES = 1000  # of a TIFF's first directory
_SIZES = (*range(0xC0, 0xC4), *range(0xC5, 0xC8), *range(0xC9, 0xCC), *range(0xCD, 0xD0))  # JPEG segments with a size
_ALONE = (0x01, *range(0xD0, 0xD9))  # JPEG segments without a length
_WIDTH, _HEIGHT, _ORIENTATION = 256, 257, 274  # TIFF tags, which EXIF has too
_NUMBERS = {1: "B", 3: "H", 4: "I"}  # of TIFF, by type


class ImageHeader(NamedTuple):
    """What a picture says of itself.

    Attributes:
        width: columns.
        height: rows.
        orientation: by EXIF, 1 to 8; 1 is upright, and what a picture without any has.
    """

    width: int
    height: int
    orientation: int = 1


def image_header(data: bytes | memoryview) -> ImageHeader | None:
    """Return size and orientation of a JPEG, PNG, BMP, TIFF or WebP; None where the bytes are none of them."""
    view = memoryview(data)
    begin = bytes(view[:32])
    try:
        if begin.startswith(b"\xff\xd8"):
            return _jpeg(view)
        if begin.startswith(b"\x89PNG\r\n\x1a\n"):
            width, height = struct.unpack_from(">II", view, 16)
            return ImageHeader(width, height, _png_orientation(view))
        if begin.startswith(b"BM"):
            width, height = struct.unpack_from("<ii", view, 18)
            return ImageHeader(abs(width), abs(height))
        if begin[:4] in (b"II*\0", b"MM\0*"):
            tags = _tags(view)
            return ImageHeader(tags[_WIDTH], tags[_HEIGHT], tags.get(_ORIENTATION, 1))
        if begin.startswith(b"RIFF") and begin[8:12] == b"WEBP":
            return _webp(view, begin[12:16])
    except (struct.error, LookupError, ValueError):
        pass
    return None


def _jpeg(view: memoryview) -> ImageHeader | None:
    at, orientation = 2, 1
    for _ in range(MAX_SEGMENTS):
        window = bytes(view[at : at + MAX_GAP])
        at += window.index(b"\xff")  # as decoders do: what is between segments is skipped
        window = window[window.index(b"\xff") :]
        at += len(window) - len(window.lstrip(b"\xff"))
        kind = view[at]
        at += 1
        if kind in _ALONE:
            continue
        (length,) = struct.unpack_from(">H", view, at)
        if kind in _SIZES:
            height, width = struct.unpack_from(">HH", view, at + 3)
            return ImageHeader(width, height, orientation)
        if kind == 0xE1 and bytes(view[at + 2 : at + 8]) == b"Exif\0\0":
            orientation = _exif_orientation(view[at + 8 : at + length])
        if kind == 0xDA:
            return None
        at += max(length, 2)
    return None


def _png_orientation(view: memoryview) -> int:
    at = 8
    for _ in range(MAX_SEGMENTS):
        if at + 8 > len(view):
            break
        length, kind = struct.unpack_from(">I4s", view, at)
        if kind == b"eXIf":
            return _exif_orientation(view[at + 8 : at + 8 + length])
        at += 12 + length
    return 1


def _webp(view: memoryview, kind: bytes) -> ImageHeader | None:
    if kind == b"VP8X":
        width, height = (int.from_bytes(view[at : at + 3], "little") + 1 for at in (24, 27))
        return ImageHeader(width, height)
    if kind == b"VP8L":
        (bits,) = struct.unpack_from("<I", view, 21)
        return ImageHeader((bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1)
    if kind == b"VP8 ":
        width, height = struct.unpack_from("<HH", view, 26)
        return ImageHeader(width & 0x3FFF, height & 0x3FFF)
    return None


def _exif_orientation(exif: memoryview) -> int:
    try:
        return _tags(exif).get(_ORIENTATION, 1)
    except (struct.error, LookupError):
        return 1


def _tags(view: memoryview) -> dict[int, int]:
    """Return the numbers in the first directory of a TIFF, by tag."""
    order = {b"II": "<", b"MM": ">"}[bytes(view[:2])]
    (start,) = struct.unpack_from(f"{order}I", view, 4)
    (count,) = struct.unpack_from(f"{order}H", view, start)
    tags = {}
    for index in range(min(count, MAX_ENTRIES)):
        at = start + 2 + 12 * index
        tag, kind, number = struct.unpack_from(f"{order}HHI", view, at)
        if kind in _NUMBERS and number == 1:
            (tags[tag],) = struct.unpack_from(order + _NUMBERS[kind], view, at + 8)
    return tags
