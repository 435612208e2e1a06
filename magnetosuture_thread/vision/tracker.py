"""From a camera frame to the needle's pose and the thread's centreline, in the dish frame."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from magnetosuture_thread.errors import InvalidInputError
from magnetosuture_thread.geometry.camera import DishView
from magnetosuture_thread.vision.centreline import find_centreline
from magnetosuture_thread.vision.dish import find_dish
from magnetosuture_thread.vision.needle import INSIDE, find_needle
from magnetosuture_thread.vision.settings import VisionTrackerSettings

SEEN_SHARE = 1.1  # a walk longer than this share of the thread has left it


@dataclass(frozen=True)
class Track:
    """What one frame shows.

    Attributes:
        lost: why nothing was found; empty when the needle is tracked.
        tail: the needle's blunt end, shape (2,) [m]; empty when lost.
        tip: its point, shape (2,) [m]; empty when lost.
        heading: unit vector from tail to tip, shape (2,); empty when lost.
        centreline: the thread from the tail on, shape (m, 2) [m]; fewer than 2 points if unseen.
        view: where the dish is in the image; None when it is not found.
    """

    lost: str
    tail: np.ndarray
    tip: np.ndarray
    heading: np.ndarray
    centreline: np.ndarray
    view: DishView | None


class VisionTracker:
    """Tracks the needle and the thread, frame by frame.

    The dish is searched until it is found and then taken to stand still, until a frame of another
    size comes.

    Args:
        settings: what to look for.
    """

    def __init__(self, settings: VisionTrackerSettings) -> None:
        self._settings = settings
        self._view: DishView | None = None
        self._shape: tuple[int, ...] = ()

    def track(self, image: np.ndarray) -> Track:
        """Look at one frame.

        Args:
            image: shape (rows, columns) or (rows, columns, 3) in BGR order, uint8.

        Raises:
            InvalidInputError: the image is not of this kind.
        """
        gray = _measured_channel(image)
        if gray.shape != self._shape:
            self._view, self._shape = None, gray.shape
        settings = self._settings
        if self._view is None:
            self._view = find_dish(gray, settings.dish_diameter)
        view = self._view
        if view is None:
            return _lost("no dish in the image", None)
        needle = find_needle(gray, view, 0.5 * settings.dish_diameter, settings.needle_length, settings.needle_width)
        if needle is None:
            return _lost("no single needle in the dish", view)
        longest = SEEN_SHARE * settings.thread_length / view.metres_per_pixel
        reach = INSIDE * 0.5 * settings.dish_diameter / view.metres_per_pixel
        walk = find_centreline(gray, needle, longest, view.centre_px, reach)
        return Track(
            lost="",
            tail=view.to_dish(needle.tail_px),
            tip=view.to_dish(needle.tip_px),
            heading=needle.direction_px * (1.0, -1.0),
            centreline=view.to_dish(walk),
            view=view,
        )


def decode_image(data: bytes | bytearray | memoryview | np.ndarray) -> np.ndarray:
    """Decode a JPEG or PNG image to BGR.

    Raises:
        InvalidInputError: the bytes are no image that can be decoded.
    """
    buffer = np.frombuffer(data, dtype=np.uint8)
    image = cv2.imdecode(buffer, cv2.IMREAD_COLOR) if buffer.size else None
    if image is None:
        raise InvalidInputError("image.data", f"{buffer.size} bytes", "a JPEG or PNG image")
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
    channels = {"bgr8": 3, "rgb8": 3, "mono8": 1}.get(encoding)
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


def _measured_channel(image: np.ndarray) -> np.ndarray:
    """Return the channel to measure on: green, which a colour sensor samples twice as densely."""
    if image.dtype != np.uint8 or image.ndim not in (2, 3) or (image.ndim == 3 and image.shape[2] != 3):
        raise InvalidInputError("image", f"{image.dtype} of shape {image.shape}", "8-bit grey or BGR pixels")
    if min(image.shape[:2]) < 64:
        raise InvalidInputError("image", f"{image.shape[1]} x {image.shape[0]} pixels", "at least 64 x 64 pixels")
    return image if image.ndim == 2 else np.ascontiguousarray(image[:, :, 1])


def _lost(reason: str, view: DishView | None) -> Track:
    nothing = np.empty(0)
    return Track(reason, nothing, nothing, nothing, np.empty((0, 2)), view)
