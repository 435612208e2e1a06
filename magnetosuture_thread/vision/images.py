"""Images: from bytes to pixels, and what of them is measured on."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from magnetosuture_thread.errors import InvalidInputError
from magnetosuture_thread.untrusted import MAX_PIXELS
from magnetosuture_thread.vision.image_header import image_header
from magnetosuture_thread.vision.scene_mask import SceneMask

CHANNELS = {"bgr8": 3, "rgb8": 3, "mono8": 1}
FLOOR_FACTOR = 8  # the floor's brightness is known on a grid of this many pixels
FLOOR_CELLS = 9  # side of the median window on that grid: wider than a needle, a thread, a speck
RIM_PX = 1.0  # by which the rim's blurred edge reaches into the dish
FLOOR_DEPTH_PX = 40.0  # inside of the wall, where the floor's brightness is not mixed with the rim's
GLARE = 1.07  # of the floor's brightness: above, a pixel shows the lamp


@dataclass(frozen=True)
class Picture:
    """A frame or a part of it, made ready to measure on.

    Attributes:
        gray: the measured channel, shape (rows, columns), uint8.
        factor: how much smaller `small` is.
        small: the same, shrunk by area.
        floor: brightness of what is behind all slender things, in the pixels of `small`.
        origin: (u, v) of the first pixel in the whole frame.
        mask: where the scene's shapes are; None if it has none.
    """

    gray: np.ndarray
    factor: int
    small: np.ndarray
    floor: np.ndarray
    origin: tuple[int, int] = (0, 0)
    mask: SceneMask | None = None


def prepare(gray: np.ndarray, factor: int, origin: tuple[int, int] = (0, 0), mask: SceneMask | None = None) -> Picture:
    """Shrink a grey image and estimate the floor behind what lies on it.

    The floor is the median over a window that all slender things fill by less than half, so that light
    that changes over the dish doesn't matter. What a shape of the scene covers shows no floor.
    """
    small = gray
    if factor > 1:
        small = cv2.resize(gray, None, fx=1.0 / factor, fy=1.0 / factor, interpolation=cv2.INTER_AREA)
    cells = (max(2, gray.shape[1] // FLOOR_FACTOR), max(2, gray.shape[0] // FLOOR_FACTOR))
    rough = cv2.resize(small, cells, interpolation=cv2.INTER_AREA)
    if mask is not None:
        rough = mask.show_floor(rough)
    rough = cv2.medianBlur(rough, FLOOR_CELLS)
    floor = cv2.resize(rough, small.shape[::-1], interpolation=cv2.INTER_LINEAR)
    return Picture(gray, factor, small, floor, origin, mask)


def without_wall(
    gray: np.ndarray,
    picture: Picture,
    centre: tuple[float, float],
    radius: float,
    low: np.ndarray,
    high: np.ndarray,
) -> np.ndarray:
    """Return a frame in which all beyond a circle has the floor's brightness within a box.

    What is measured beside the wall takes its ground from both sides, and must not go on into the rim.

    Args:
        gray: the frame, shape (rows, columns), uint8.
        picture: with the floor of it.
        centre: of the circle (u, v) [px].
        radius: of the circle [px].
        low: least u and v of the box [px].
        high: greatest u and v [px].

    Returns:
        A copy, or the frame itself where nothing of the box is beyond.
    """
    rows, columns = gray.shape
    left, top = (max(0, int(value)) for value in low)
    right, bottom = min(columns, int(high[0]) + 1), min(rows, int(high[1]) + 1)
    across, down = np.arange(left, right) - centre[0], np.arange(top, bottom) - centre[1]
    distance = np.hypot(across[None, :], down[:, None]).astype(np.float32)
    beyond = distance > radius
    if not beyond.any():
        return gray
    # Along the ray from the centre, where there is floor.
    shrink = np.minimum(1.0, (radius - FLOOR_DEPTH_PX) / np.maximum(distance, 1.0))
    shift = 0.5 * (picture.factor - 1)
    at_u, at_v = (
        ((shrink * offset + middle - shift) / picture.factor).astype(np.float32)
        for offset, middle in zip((across[None, :], down[:, None]), centre, strict=True)
    )
    floor = cv2.remap(picture.floor, at_u, at_v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    result = gray.copy()
    np.copyto(result[top:bottom, left:right], floor, where=beyond)
    return result


def glare_mask(picture: Picture) -> np.ndarray:
    """Return where the lamp is reflected, in the pixels of `small`, uint8: 255 there."""
    bound = cv2.convertScaleAbs(picture.floor, alpha=GLARE, beta=2.0)
    return cv2.compare(cv2.medianBlur(picture.small, 3), bound, cv2.CMP_GT)


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
    if min(image.shape[:2]) < 64:
        raise InvalidInputError("image", f"{image.shape[1]} x {image.shape[0]} pixels", "at least 64 x 64 pixels")


def measured_channel(image: np.ndarray) -> np.ndarray:
    """Return the channel to measure on: green, which a colour sensor samples twice as densely."""
    return np.ascontiguousarray(image if image.ndim == 2 else image[:, :, 1])
