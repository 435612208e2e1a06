"""Images: from bytes to pixels, and what of them is measured on.

Size and orientation are read from the first bytes, before anything is decoded: a megabyte may decode to gigabytes.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import cv2
import numpy as np

from magnetosuture_thread.errors import InvalidInputError
from magnetosuture_thread.untrusted import MAX_PIXELS
from magnetosuture_thread.vision.sampling import distances, sample_inside
from magnetosuture_thread.vision.scene_mask import SceneMask
from magnetosuture_thread.vision.settings import MIN_SIDE_PX

JPEG_SIZES = (*range(0xC0, 0xC4), *range(0xC5, 0xC8), *range(0xC9, 0xCC), *range(0xCD, 0xD0))  # segments with a size
MAX_SEGMENTS = 10_000  # of a JPEG or PNG before its pixels
ORIENTATION = 274  # TIFF's tag, which EXIF has too
CHANNELS = {"bgr8": 3, "rgb8": 3, "mono8": 1}
FLOOR_FACTOR = 8  # the floor's brightness is known on a grid of this many pixels
FLOOR_CELLS = 9  # side of the median window on that grid: wider than a needle, a thread, a speck
RIM_PX = 1.0  # by which the rim's blurred edge reaches into the dish
FLOOR_DEPTH_PX = 40.0  # inside of the wall, where the floor's brightness is not mixed with the rim's
GLARE = 1.07  # of the floor's brightness: above, a pixel shows the lamp


@dataclass(frozen=True)
class Layer:
    """One brightness of each pixel, and of the floor behind it.

    Attributes:
        pixels: shape (rows, columns), uint8.
        small: the same, shrunk by area.
        floor: how bright what is behind all slender things is, in the pixels of `small`.
        cleared: the last needle that was taken out of it, and the pixels without it; see `without_needle`.
    """

    pixels: np.ndarray
    small: np.ndarray
    floor: np.ndarray
    cleared: dict[str, Any] = field(default_factory=dict, init=False, compare=False, repr=False)

    def replaced(self, pixels: np.ndarray) -> Layer:
        """Return the layer with other pixels."""
        return replace(self, pixels=pixels)


@dataclass(frozen=True)
class Picture:
    """A frame or a part of it, made ready to measure on.

    Attributes:
        brightest: the greatest of the three colours of each pixel. Steel is dark in all of them, a coloured thread in
            some only.
        darkest: the least of them. A thread of any colour is dark in one.
        factor: how much smaller `small` is.
        origin: (u, v) of the first pixel in the whole frame.
        mask: where the scene's shapes are; None if it has none.
        image: as it came, grey or BGR.
    """

    brightest: Layer
    darkest: Layer
    factor: int
    origin: tuple[int, int]
    mask: SceneMask | None
    image: np.ndarray

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        rows, columns = self.brightest.pixels.shape
        return rows, columns


def shrunk(image: np.ndarray, factor: int) -> np.ndarray:
    """Return a frame shrunk by area, whose last rows and columns may be lost."""
    if factor == 1:
        return image
    rows, columns = (size // factor for size in image.shape[:2])
    whole = image[: rows * factor, : columns * factor]
    return np.asarray(cv2.resize(whole, (columns, rows), interpolation=cv2.INTER_AREA))


def prepare(image: np.ndarray, factor: int, origin: tuple[int, int] = (0, 0), mask: SceneMask | None = None) -> Picture:
    """Make an image ready to measure on, shape (rows, columns) or (rows, columns, 3) in BGR order, uint8."""
    if image.ndim == 2:
        # Copied where need be: compiled code is compiled once more for each other layout of memory.
        both = _channel(np.ascontiguousarray(image), factor, mask)
        return Picture(both, both, factor, origin, mask, image)
    one, two, three = cv2.split(image)
    brightest = _channel(np.asarray(cv2.max(cv2.max(one, two), three)), factor, mask)
    darkest = _channel(np.asarray(cv2.min(cv2.min(one, two), three)), factor, mask)
    return Picture(brightest, darkest, factor, origin, mask, image)


def _channel(pixels: np.ndarray, factor: int, mask: SceneMask | None) -> Layer:
    """Shrink an image and estimate the floor behind what lies on it.

    The floor is the median over a window that all slender things fill by less than half, so that light that changes
    over the dish doesn't matter. What a shape of the scene covers shows no floor.
    """
    small = pixels
    if factor > 1:
        small = cv2.resize(pixels, None, fx=1.0 / factor, fy=1.0 / factor, interpolation=cv2.INTER_AREA)
    cells = (max(2, pixels.shape[1] // FLOOR_FACTOR), max(2, pixels.shape[0] // FLOOR_FACTOR))
    rough = cv2.resize(small, cells, interpolation=cv2.INTER_AREA)
    if mask is not None:
        rough = mask.show_floor(rough)
    floor = cv2.medianBlur(rough, FLOOR_CELLS)
    return Layer(pixels, small, cv2.resize(floor, small.shape[::-1], interpolation=cv2.INTER_LINEAR))


@dataclass(frozen=True)
class Wall:
    """The dish's wall in a picture.

    Attributes:
        centre: of the dish (u, v) [px].
        radius: of the dish [px].
    """

    centre: tuple[float, float]
    radius: float

    def distances(self, box: tuple[slice, slice]) -> np.ndarray:
        """Return how far the pixels of some rows and columns are from the centre [px]."""
        rows, columns = box
        result = np.empty((rows.stop - rows.start, columns.stop - columns.start), np.float32)
        distances(rows.start, columns.start, self.centre, result)
        return result

    def floor(self, channel: Layer, factor: int, box: tuple[slice, slice]) -> np.ndarray:
        """Return how bright the floor is in some rows and columns, `FLOOR_DEPTH_PX` inside of the wall and beyond.

        There the floor of a channel is mixed with the rim. What is farther out has the brightness of the place on
        the way to the centre that is so far inside.
        """
        rows, columns = box
        result = np.empty((rows.stop - rows.start, columns.stop - columns.start), np.uint8)
        depth = self.radius - FLOOR_DEPTH_PX
        sample_inside(channel.floor, factor, rows.start, columns.start, self.centre, depth, result)
        return result


def without_wall(channel: Layer, factor: int, wall: Wall, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return a channel's pixels in which all beyond the wall has the floor's brightness within a box.

    What is measured beside the wall takes its ground from both sides, and must not go on into the rim.

    Args:
        channel: of the frame.
        factor: how much smaller its floor is.
        wall: of the dish.
        low: least u and v of the box [px].
        high: greatest u and v [px].

    Returns:
        A copy, or the pixels themselves where nothing of the box is beyond.
    """
    rows, columns = channel.pixels.shape
    left, top = (max(0, int(value)) for value in low)
    right, bottom = min(columns, int(high[0]) + 1), min(rows, int(high[1]) + 1)
    box = slice(top, bottom), slice(left, right)
    beyond = wall.distances(box) > wall.radius
    if not beyond.any():
        return channel.pixels
    result = channel.pixels.copy()
    np.copyto(result[box], wall.floor(channel, factor, box), where=beyond)
    return result


def glare_mask(picture: Picture) -> np.ndarray:
    """Return where the lamp is reflected, in the pixels of `small`, uint8: 255 there."""
    bound = cv2.convertScaleAbs(picture.brightest.floor, alpha=GLARE, beta=2.0)
    return cv2.compare(cv2.medianBlur(picture.brightest.small, 3), bound, cv2.CMP_GT)


def decode_image(data: bytes | bytearray | memoryview | np.ndarray) -> np.ndarray:
    """Decode a JPEG, PNG, BMP, TIFF or WebP image to BGR, its pixels as they are stored.

    An orientation in its EXIF data is ignored, as in frames of a camera: pixels stay where the sensor has them. See
    `image_header` to know of it.

    Raises:
        InvalidInputError: the bytes are no image that can be decoded, or of more than `MAX_PIXELS`.
    """
    buffer = np.frombuffer(data, dtype=np.uint8)
    header = image_header(buffer.data)
    if header is not None and header.width * header.height > MAX_PIXELS:
        size = f"{header.width} x {header.height} pixels"
        raise InvalidInputError("image.data", size, f"at most {MAX_PIXELS} pixels")
    try:
        image = cv2.imdecode(buffer, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION) if header else None
    except cv2.error:  # some headers promise more than can be made
        image = None
    if image is None:
        raise InvalidInputError("image.data", f"{buffer.size} bytes", "a JPEG or PNG image, or BMP, TIFF, WebP")
    return image


def unpack_image(
    data: bytes | bytearray | memoryview | np.ndarray, height: int, width: int, step: int, encoding: str
) -> np.ndarray:
    """Return a raw image as BGR or grey array.

    Args:
        data: rows of `step` bytes each.
        height: rows.
        width: columns.
        step: bytes in a row, padding included.
        encoding: bgr8, rgb8 or mono8.

    Raises:
        InvalidInputError: the encoding is another, or the sizes don't fit the data.
    """
    channels = CHANNELS.get(encoding)
    if channels is None:
        raise InvalidInputError("image.encoding", repr(encoding), "bgr8, rgb8 or mono8")
    buffer = np.frombuffer(data, dtype=np.uint8)
    if height < 1 or width < 1 or step < width * channels or buffer.size != height * step:
        sizes = f"{buffer.size} bytes for {width} x {height}, step {step}"
        raise InvalidInputError("image.data", sizes, f"height times step bytes, {channels} for each pixel")
    rows = buffer.reshape(height, step)[:, : width * channels]
    if channels == 1:
        return rows
    image = rows.reshape(height, width, 3)
    return image[:, :, ::-1] if encoding == "rgb8" else image


def check_image(image: np.ndarray) -> None:
    """Raise `InvalidInputError` unless an array is an image to look at."""
    if image.dtype != np.uint8 or image.ndim not in (2, 3) or (image.ndim == 3 and image.shape[2] != 3):
        raise InvalidInputError("image", f"{image.dtype} of shape {image.shape}", "8-bit grey or BGR pixels")
    if min(image.shape[:2]) < MIN_SIDE_PX:
        raise InvalidInputError(
            "image", f"{image.shape[1]} x {image.shape[0]} pixels", f"at least {MIN_SIDE_PX} x {MIN_SIDE_PX} pixels"
        )


def measured_channel(image: np.ndarray) -> np.ndarray:
    """Return the channel to measure on: green, which a colour sensor samples twice as densely."""
    return np.ascontiguousarray(image if image.ndim == 2 else image[:, :, 1])


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
            return ImageHeader(tags[256], tags[257], tags.get(ORIENTATION, 1))
        if begin.startswith(b"RIFF") and begin[8:12] == b"WEBP":
            return _webp(view, begin[12:16])
    except (struct.error, LookupError, ValueError):
        pass
    return None


def _jpeg(view: memoryview) -> ImageHeader | None:
    at, orientation = 2, 1
    for _ in range(MAX_SEGMENTS):
        window = bytes(view[at : at + 4096])
        at += window.index(b"\xff")  # as decoders do: what is between segments is skipped
        window = window[window.index(b"\xff") :]
        at += len(window) - len(window.lstrip(b"\xff"))
        kind = view[at]
        at += 1
        if kind in (0x01, *range(0xD0, 0xD9)):  # without a length
            continue
        (length,) = struct.unpack_from(">H", view, at)
        if kind in JPEG_SIZES:
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
        return _tags(exif).get(ORIENTATION, 1)
    except (struct.error, LookupError):
        return 1


def _tags(view: memoryview) -> dict[int, int]:
    """Return the numbers in the first directory of a TIFF, by tag."""
    order = {b"II": "<", b"MM": ">"}[bytes(view[:2])]
    (start,) = struct.unpack_from(f"{order}I", view, 4)
    (count,) = struct.unpack_from(f"{order}H", view, start)
    tags = {}
    for index in range(min(count, 1000)):
        at = start + 2 + 12 * index
        tag, kind, number = struct.unpack_from(f"{order}HHI", view, at)
        if kind in (1, 3, 4) and number == 1:
            (tags[tag],) = struct.unpack_from(order + " B HI"[kind], view, at + 8)
    return tags
