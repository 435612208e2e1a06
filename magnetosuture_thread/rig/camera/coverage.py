"""How much of each pixel a drawn shape covers, by drawing it larger than the image."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.compiled import compiled
from magnetosuture_thread.geometry.polyline import Points

OVERSAMPLING = 4
TILE_PX = 60.0  # a long line is drawn in pieces of this length: a large, nearly empty canvas would be slow

Light = NDArray[np.float32]
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


def covered(box: Box, draw: Callable[[Any, ToCanvas], Any]) -> Light:
    """Return the share of each pixel in a box that a shape covers, shape (rows, columns).

    Args:
        box: rows and columns.
        draw: called with a canvas and what turns pixels (u, v) into its coordinates, in sixteenths.
    """
    rows, columns = box[0].stop - box[0].start, box[1].stop - box[1].start
    canvas = np.zeros((rows * OVERSAMPLING, columns * OVERSAMPLING), np.uint8)

    draw(canvas, lambda pixels: _on_canvas(pixels - (box[1].start, box[0].start)))
    small = cv2.resize(canvas, (columns, rows), interpolation=cv2.INTER_AREA)
    return np.asarray(small * np.float32(1.0 / 255.0), dtype=np.float32)


def line_covered(box: Box, line: Points, width_px: float) -> Light:
    """Return the share of each pixel in a box that a line of a given width covers, shape (rows, columns).

    Args:
        box: rows and columns.
        line: vertices, shape (m, 2) [px].
        width_px: of the line; less than a quarter of a pixel is drawn as that and fainter.
    """
    rows, columns = box
    result = np.zeros((rows.stop - rows.start, columns.stop - columns.start), np.uint8)
    wide = max(1, round(width_px * OVERSAMPLING))
    fainter = min(1.0, width_px * OVERSAMPLING / wide)
    line = line - (columns.start, rows.start)
    length = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))])
    starts = np.searchsorted(length, np.arange(0.0, length[-1], TILE_PX), side="right") - 1
    ends = np.append(starts[1:], len(line) - 1)
    low = np.minimum(np.minimum.reduceat(line, starts), line[ends]) - (2.0 + width_px)
    high = np.maximum(np.maximum.reduceat(line, starts), line[ends]) + (3.0 + width_px)
    parts = np.clip(np.column_stack([low, high]), 0.0, [*result.shape[::-1]] * 2).astype(int).tolist()
    at = _on_canvas(line)
    for first, last, (left, top, right, bottom) in zip(starts, ends, parts, strict=True):
        if left < right and top < bottom:
            canvas = np.zeros(((bottom - top) * OVERSAMPLING, (right - left) * OVERSAMPLING), np.uint8)
            piece = at[first : last + 1] - (left * OVERSAMPLING * 16, top * OVERSAMPLING * 16)
            cv2.polylines(canvas, [piece], False, 255, wide, cv2.LINE_8, 4)
            part = result[top:bottom, left:right]
            small = cv2.resize(canvas, part.shape[::-1], interpolation=cv2.INTER_AREA)
            np.maximum(part, small, out=part)
    return np.asarray(result * np.float32(fainter / 255.0), dtype=np.float32)


def _on_canvas(pixels: Points) -> NDArray[np.int32]:
    """Return pixels (u, v) in the coordinates of a canvas that begins with (0, 0), in sixteenths."""
    return np.asarray(np.round(((pixels + 0.5) * OVERSAMPLING - 0.5) * 16.0), dtype=np.int32)


@compiled
def lay(region: Light, share: Light, strength: float, bgr: tuple[float, float, float]) -> None:
    """Cover a region with a colour by a share of each pixel, times a strength, where the share is not zero."""
    scale = np.float32(strength)
    b, g, r = np.float32(bgr[0]), np.float32(bgr[1]), np.float32(bgr[2])
    for i in range(share.shape[0]):
        for j in range(share.shape[1]):
            if share[i, j] != 0.0:
                part = scale * share[i, j]
                region[i, j, 0] += part * (b - region[i, j, 0])
                region[i, j, 1] += part * (g - region[i, j, 1])
                region[i, j, 2] += part * (r - region[i, j, 2])


@compiled
def blurred(sparse: Light, kernel: Light, right: int, down: int) -> Light:
    """Return the convolution of a mostly empty image with a kernel along rows and columns, zeros around it.

    Args:
        sparse: shape (rows, columns).
        kernel: shape (k,); its first value is for the pixel `right` and `down` of one that is not zero.
        right: see there.
        down: the same.
    """
    rows, columns = sparse.shape
    size = kernel.shape[0]
    result = np.zeros_like(sparse)
    line = np.zeros(columns, np.float32)
    for i in range(rows):
        low, high = columns, 0
        for j in range(columns):
            if sparse[i, j] != 0.0:
                begin, end = max(j + right, 0), min(j + right + size, columns)
                low, high = min(low, begin), max(high, end)
                for n in range(begin, end):
                    line[n] += sparse[i, j] * kernel[n - j - right]
        if low < high:
            spread = line[low:high]
            for n in range(max(i + down, 0), min(i + down + size, rows)):
                target, weight = result[n, low:high], kernel[n - i - down]
                for j in range(spread.shape[0]):
                    target[j] += weight * spread[j]
            spread[:] = 0.0
    return result
