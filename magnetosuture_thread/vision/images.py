"""Images: from bytes to pixels, what of them is measured on, and samples between pixels."""

from __future__ import annotations

import io
import math
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from magnetosuture_thread.compiled import compiled
from magnetosuture_thread.errors import InvalidInputError
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.untrusted import MAX_PIXELS
from magnetosuture_thread.vision.scene_mask import SceneMask
from magnetosuture_thread.vision.settings import MIN_SIDE_PX

CHANNELS = {"bgr8": 3, "rgb8": 3, "mono8": 1}
FLOOR_FACTOR = 8  # the floor's brightness is known on a grid of this many pixels
RIM_PX = 1.0  # by which the rim's blurred edge reaches into the dish
FLOOR_DEPTH_PX = 40.0  # inside of the wall, where the floor's brightness is not mixed with the rim's
GLARE = 1.07  # of the floor's brightness: above, a pixel shows the lamp
NEXT = np.uint64(1)  # Indices without a sign save compiled code the check for negative ones, which count from the end.

Gray = NDArray[np.uint8]


@dataclass(frozen=True)
class Layer:
    """One brightness of each pixel, and of the floor behind it.

    Attributes:
        pixels: shape (rows, columns), uint8.
        small: the same, shrunk by area.
        floor: how bright what is behind all slender things is, in the pixels of `small`.
    """

    pixels: np.ndarray
    small: np.ndarray
    floor: np.ndarray


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
    floor = cv2.medianBlur(rough, 9)  # cells: wider than a needle, a thread, a speck
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
        v = np.arange(rows.start, rows.stop)[:, None] - self.centre[1]
        return np.hypot(np.arange(columns.start, columns.stop) - self.centre[0], v)

    def floor(self, channel: Layer, factor: int, box: tuple[slice, slice]) -> np.ndarray:
        """Return how bright the floor is in some rows and columns, `FLOOR_DEPTH_PX` inside of the wall and beyond.

        There the floor of a channel is mixed with the rim. What is farther out has the brightness of the place on
        the way to the centre that is so far inside.
        """
        rows, columns = box
        floor = np.empty((rows.stop - rows.start, columns.stop - columns.start), np.uint8)
        inside = max(0.0, self.radius - FLOOR_DEPTH_PX)
        _fill_floor(channel.floor, float(factor), self.centre, inside, (columns.start, rows.start), floor)
        return floor


def without_wall(channel: Layer, pixels: Gray, factor: int, wall: Wall, around: Points, reach: float) -> Gray:
    """Return pixels of a channel in which all beyond the wall has the floor's brightness around a point.

    What is measured beside the wall takes its ground from both sides, and must not go on into the rim.

    Args:
        channel: of the frame.
        pixels: of it, without the needle.
        factor: how much smaller the channel's floor is.
        wall: of the dish.
        around: the point, shape (2,) [px].
        reach: half of the side of the square around it [px].
    """
    rows, columns = pixels.shape
    left, top = np.maximum(around - reach, 0.0).astype(int)
    right, bottom = np.minimum(around + reach + 1.0, (columns, rows)).astype(int)
    box = slice(top, max(top, bottom)), slice(left, max(left, right))
    result = pixels.copy()
    np.copyto(result[box], wall.floor(channel, factor, box), where=wall.distances(box) > wall.radius)
    return result


def glare_mask(picture: Picture) -> np.ndarray:
    """Return where the lamp is reflected, in the pixels of `small`, uint8: 255 there."""
    bound = cv2.convertScaleAbs(picture.brightest.floor, alpha=GLARE, beta=2.0)
    return cv2.compare(cv2.medianBlur(picture.brightest.small, 3), bound, cv2.CMP_GT)


def decode_image(data: bytes | bytearray | memoryview | np.ndarray) -> np.ndarray:
    """Decode a JPEG, PNG, BMP, TIFF or WebP image to BGR, its pixels as they are stored.

    An orientation in its EXIF data is ignored, as in frames of a camera: pixels stay where the sensor has them. Size
    and kind are read from the header before any pixel is decoded: a megabyte may decode to gigabytes.

    Raises:
        InvalidInputError: the bytes are no image that can be decoded, or of more than `MAX_PIXELS`.
    """
    buffer = np.frombuffer(data, dtype=np.uint8)
    width, height = _size_of(buffer)
    if width * height > MAX_PIXELS:
        raise InvalidInputError("image.data", f"{width} x {height} pixels", f"at most {MAX_PIXELS} pixels")
    try:
        image = cv2.imdecode(buffer, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION) if width else None
    except cv2.error:  # some headers promise more than can be made
        image = None
    if image is None:
        raise InvalidInputError("image.data", f"{buffer.size} bytes", "a JPEG or PNG image, or BMP, TIFF, WebP")
    return image


def _size_of(buffer: np.ndarray) -> tuple[int, int]:
    """Return width and height by a picture's header, 0 and 0 where the bytes are none."""
    try:
        with Image.open(io.BytesIO(buffer.tobytes()), formats=("JPEG", "PNG", "BMP", "TIFF", "WEBP")) as picture:
            return picture.size
    except (Image.DecompressionBombError, Image.DecompressionBombWarning) as error:  # far more pixels than we take
        raise InvalidInputError("image.data", str(error), f"at most {MAX_PIXELS} pixels") from None
    except Exception:  # a damaged picture raises whatever its reader did not expect
        return 0, 0


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


def middle(values: np.ndarray) -> float:
    """Return the median of values of any shape, the upper one of two; numpy's own takes ten times as long."""
    half = values.size // 2
    return float(np.partition(values, half, axis=None)[half])


def runs(flags: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return first index and the one after the last of each run of true flags."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(np.int8)))
    return [(int(first), int(last)) for first, last in edges.reshape(-1, 2)]


def sampled(image: NDArray[Any], points: Points) -> NDArray[np.float64]:
    """Return an image at points of shape (..., 2), bilinear; outside, at the nearest point of its border.

    Its shape is (...), for an image with colours (..., colours).
    """
    if image.ndim == 3:  # of few points
        left, top = np.maximum(np.floor(points.reshape(-1, 2).min(axis=0)), 0.0).astype(int)
        right, bottom = np.ceil(points.reshape(-1, 2).max(axis=0)).astype(int) + 2
        near = cv2.split(image[top : max(top + 2, bottom), left : max(left + 2, right)])
        return np.stack([sampled(colour, points - (left, top)) for colour in near], axis=-1)
    values = np.empty(points.shape[:-1])
    sample_all(np.ascontiguousarray(image), np.ascontiguousarray(points).reshape(-1, 2), values.reshape(-1))
    return values


def straightened(
    image: NDArray[Any], axis: tuple[float, float, float, float], along: NDArray[Any], aside: NDArray[Any]
) -> Points:
    """Return an image along and aside of an arc, shape (m, n); see `straighten`."""
    strip = np.empty((len(along), len(aside)))
    straighten(image, axis, along, aside, strip)
    return strip


@compiled
def sample(image, u, v):
    """Return an image at a point, bilinear; 0 outside."""
    column, row = int(np.floor(u)), int(np.floor(v))
    if column < 0 or row < 0 or column >= image.shape[1] - 1 or row >= image.shape[0] - 1:
        return 0.0
    x, y = u - column, v - row
    upper = image[row, column] * (1.0 - x) + image[row, column + 1] * x
    lower = image[row + 1, column] * (1.0 - x) + image[row + 1, column + 1] * x
    return upper * (1.0 - y) + lower * y


@compiled
def within(image, u, v):
    """Return an image at a point, bilinear; outside, at the nearest point of its border."""
    u = min(max(u, 0.0), image.shape[1] - 1.001)
    v = min(max(v, 0.0), image.shape[0] - 1.001)
    return sample(image, u, v)


@compiled
def _fill_floor(image, factor, centre, inside, corner, floor):
    """Fill in the floor of a box whose first pixel is the corner; see `Wall.floor`."""
    for row in range(floor.shape[0]):
        for column in range(floor.shape[1]):
            u, v = corner[0] + column - centre[0], corner[1] + row - centre[1]
            share = min(1.0, inside / max(math.hypot(u, v), 1.0))
            x = (share * u + centre[0] - 0.5 * (factor - 1.0)) / factor
            y = (share * v + centre[1] - 0.5 * (factor - 1.0)) / factor
            floor[row, column] = np.uint8(within(image, x, y) + 0.5)


@compiled
def sample_all(image, points, values):
    """Fill in an image at points, shape (m, 2); see `within`."""
    for index in range(len(points)):
        values[index] = within(image, points[index, 0], points[index, 1])


@compiled
def straighten(gray, start, along, aside, strip):
    """Fill a strip with the image along an arc; see `Arc.at`.

    Args:
        gray: shape (rows, columns), uint8.
        start: u, v, angle and curvature of the arc [px, px, rad, 1/px].
        along: lengths along the arc, shape (n,) [px].
        aside: distances aside of it, shape (m,) [px].
        strip: filled, shape (n, m).
    """
    u, v, angle, curvature = start
    for row in range(len(along)):
        s = along[row]
        half = 0.5 * curvature * s
        chord = s if abs(half) < 1e-9 else s * math.sin(half) / half
        x, y = u + chord * math.cos(angle + half), v + chord * math.sin(angle + half)
        across, down = -math.sin(angle + 2.0 * half), math.cos(angle + 2.0 * half)
        for column in range(len(aside)):
            strip[row, column] = within(gray, x + aside[column] * across, y + aside[column] * down)


@compiled
def straighten_both(one, other, start, first, aside, strip, other_strip):
    """Fill two strips with two images along an arc at steps of a pixel, as `straighten` does.

    The arc's direction is turned on from row to row, and both images are sampled at once: half the time.

    Args:
        one: shape (rows, columns).
        other: of the same shape.
        start: u, v, angle and curvature of the arc [px, px, rad, 1/px].
        first: length along the arc of the first row [px].
        aside: distances aside of it, shape (m,) [px].
        strip: filled, shape (n, m).
        other_strip: filled, of the same shape.
    """
    u, v, angle, curvature = start
    rows, columns = one.shape
    last_u, last_v = columns - 1.001, rows - 1.001
    half = 0.5 * curvature * first
    chord = first if abs(half) < 1e-9 else first * math.sin(half) / half
    x, y = u + chord * math.cos(angle + half), v + chord * math.sin(angle + half)
    ahead, down = math.cos(angle + 2.0 * half), math.sin(angle + 2.0 * half)
    half = 0.5 * curvature
    cosine, sine = math.cos(half), math.sin(half)
    chord = 1.0 if abs(half) < 1e-9 else sine / half
    for index in range(len(strip)):
        for place in range(len(aside)):
            at_u = min(max(x - aside[place] * down, 0.0), last_u)
            at_v = min(max(y + aside[place] * ahead, 0.0), last_v)
            column, row = np.uint64(int(at_u)), np.uint64(int(at_v))
            right, below = at_u - column, at_v - row
            left, above = 1.0 - right, 1.0 - below
            upper = left * one[row, column] + right * one[row, column + NEXT]
            lower = left * one[row + NEXT, column] + right * one[row + NEXT, column + NEXT]
            strip[index, place] = above * upper + below * lower
            upper = left * other[row, column] + right * other[row, column + NEXT]
            lower = left * other[row + NEXT, column] + right * other[row + NEXT, column + NEXT]
            other_strip[index, place] = above * upper + below * lower
        # A chord of an arc is turned by half of the arc's turn, what follows it by the other half.
        ahead, down = ahead * cosine - down * sine, down * cosine + ahead * sine
        x, y = x + chord * ahead, y + chord * down
        ahead, down = ahead * cosine - down * sine, down * cosine + ahead * sine
