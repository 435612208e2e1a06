"""How much of each pixel a drawn shape covers, by drawing it larger than the image."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.geometry.polyline import Points

OVERSAMPLING = 4
TILE_PX = 60.0  # a long line is drawn in pieces of this length: a large, nearly empty canvas would be slow

Box = tuple[slice, slice]
ToCanvas = Callable[[Points], NDArray[np.int32]]


def box_around(points: Points, size: tuple[int, int], margin: float) -> Box | None:
    """Return the rows and columns of an image that hold points, with a margin; None if none does.

    Args:
        points: shape (m, 2) [px].
        size: width and height of the image [px].
        margin: [px].
    """
    points = points[np.all(np.isfinite(points), axis=1)]
    if not len(points):
        return None
    low = np.maximum(np.floor(points.min(axis=0) - margin), 0.0)
    high = np.minimum(np.ceil(points.max(axis=0) + margin), size)
    if np.any(high <= low):
        return None
    (left, top), (right, bottom) = low.astype(int), high.astype(int)
    return slice(int(top), int(bottom)), slice(int(left), int(right))


def covered(box: Box, draw: Callable[[Any, ToCanvas], Any]) -> NDArray[np.float32]:
    """Return the share of each pixel in a box that a shape covers, shape (rows, columns).

    Args:
        box: rows and columns.
        draw: called with a canvas and what turns pixels (u, v) into its coordinates, in sixteenths.
    """
    rows, columns = box[0].stop - box[0].start, box[1].stop - box[1].start
    canvas = np.zeros((rows * OVERSAMPLING, columns * OVERSAMPLING), np.uint8)

    def at(pixels: Points) -> NDArray[np.int32]:
        local = (pixels - (box[1].start, box[0].start) + 0.5) * OVERSAMPLING - 0.5
        return np.asarray(np.round(local * 16.0), dtype=np.int32)

    draw(canvas, at)
    small = cv2.resize(canvas, (columns, rows), interpolation=cv2.INTER_AREA)
    return np.asarray(small * np.float32(1.0 / 255.0), dtype=np.float32)


def line_covered(box: Box, line: Points, width_px: float) -> NDArray[np.float32]:
    """Return the share of each pixel in a box that a line of a given width covers, shape (rows, columns).

    Args:
        box: rows and columns.
        line: vertices, shape (m, 2) [px].
        width_px: of the line; less than a quarter of a pixel is drawn as that and fainter.
    """
    result = np.zeros((box[0].stop - box[0].start, box[1].stop - box[1].start), np.float32)
    wide = max(1, round(width_px * OVERSAMPLING))
    fainter = np.float32(min(1.0, width_px * OVERSAMPLING / wide))
    size = (box[1].stop, box[0].stop)
    length = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))])
    starts = np.searchsorted(length, np.arange(0.0, length[-1], TILE_PX), side="right") - 1
    ends = np.append(starts[1:], len(line) - 1)
    for first, last in zip(starts, ends, strict=True):
        piece = line[first : last + 1]
        part = box_around(piece, size, margin=2.0 + width_px)
        if part is None or part[0].start < box[0].start or part[1].start < box[1].start:
            part = box  # at the border of what is drawn
        drawn = covered(part, _stroke(piece, wide))
        inside = (
            slice(part[0].start - box[0].start, part[0].stop - box[0].start),
            slice(part[1].start - box[1].start, part[1].stop - box[1].start),
        )
        np.maximum(result[inside], drawn * fainter, out=result[inside])
    return result


def _stroke(line: Points, wide: int) -> Callable[[Any, ToCanvas], Any]:
    """Return what draws a line on a canvas."""
    return lambda canvas, to: cv2.polylines(canvas, [to(line)], False, 255, wide, cv2.LINE_8, 4)
