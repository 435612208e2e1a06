"""Takes the needle out of an image, so that a thread beside it stands alone."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.compiled import compiled
from magnetosuture_thread.vision.images import Layer
from magnetosuture_thread.vision.needle.measured_needle import MeasuredNeedle
from magnetosuture_thread.vision.needle.template import BLOOM_PX, BLUR_PX, TAPER, THIN, edge

SMOOTH_PX = 0.7  # before threads are looked for
BESIDE_PX = 2.0 * BLUR_PX  # of the drawn outline, up to which light of the needle is mixed in


def without_needle(channel: Layer, factor: int, needle: MeasuredNeedle) -> np.ndarray:
    """Return a channel's pixels in which a needle has the floor's brightness.

        I' = min(I + F c share, F)

    with the floor F, the needle's contrast c, and the share of each pixel that a drawn needle covers. It is kept with
    the channel, as the walk and the pieces need the same: it must not be changed.

    Args:
        channel: of the picture.
        factor: how much smaller its floor is.
        needle: in the picture's pixels.
    """
    if channel.cleared.get("needle") is needle:
        return np.asarray(channel.cleared["pixels"])
    half = 0.5 * needle.width_px + BLOOM_PX
    outline = needle.arc.at(np.linspace(0.0, needle.length_px, 24))
    rows, columns = channel.pixels.shape
    left, top = np.maximum(outline.min(axis=0) - half - 2.0 * BESIDE_PX, 0.0).astype(int)
    right, bottom = np.minimum(outline.max(axis=0) + half + 2.0 * BESIDE_PX, (columns - 1, rows - 1)).astype(int)
    result = channel.pixels.copy()
    arc = needle.arc
    start = np.array([arc.start[0], arc.start[1], arc.angle, arc.curvature])
    shape = np.array([needle.length_px, half, needle.contrast])
    _erase(result, np.ascontiguousarray(channel.floor), factor, start, shape, (left, top, right, bottom))
    channel.cleared.clear()
    channel.cleared.update(needle=needle, pixels=result)
    return result


def smooth_without_needle(channel: Layer, factor: int, needle: MeasuredNeedle) -> NDArray[np.uint8]:
    """Return `without_needle` smoothed by `SMOOTH_PX`, as wide as the thinnest thread looks; kept like it."""
    pixels = without_needle(channel, factor, needle)
    if "smooth" not in channel.cleared:
        channel.cleared["smooth"] = cv2.GaussianBlur(pixels, (5, 5), SMOOTH_PX)
    return np.asarray(channel.cleared["smooth"])


@compiled
def _erase(pixels, floor, factor, start, shape, box):
    """Brighten the pixels of a box by what a drawn needle takes of the floor's light."""
    length, half, contrast = shape[0], shape[1], shape[2]
    cosine, sine, curvature = math.cos(start[2]), math.sin(start[2]), start[3]
    # Off the tangent by more than the arc itself is, nothing is near the needle.
    farthest = half + BESIDE_PX + 0.5 * abs(curvature) * (length + BESIDE_PX + half) ** 2
    for row in range(box[1], box[3] + 1):
        for column in range(box[0], box[2] + 1):
            u, v = column - start[0], row - start[1]
            s, d = u * cosine + v * sine, v * cosine - u * sine
            if abs(d) > farthest:
                continue
            if abs(curvature) > 1e-6:
                turned = math.atan2(curvature * s, 1.0 - curvature * d)
                d = (1.0 - math.hypot(curvature * s, 1.0 - curvature * d)) / curvature
                s = turned / curvature
            if abs(d) > half + BESIDE_PX or not -BESIDE_PX < s < length + BESIDE_PX:
                continue  # Four edges for each pixel of the box would take longer than all else.
            part = min(max((s - (1.0 - TAPER) * length) / (TAPER * length), 0.0), 1.0)
            own = half * (1.0 - (1.0 - THIN) * part)
            share = (edge(own - d) - edge(-own - d)) * edge(s) * edge(length - s)
            if share > 0.01:
                ground = float(floor[min(row // factor, len(floor) - 1), min(column // factor, floor.shape[1] - 1)])
                value = pixels[row, column] + ground * contrast * share
                pixels[row, column] = max(pixels[row, column], int(min(value, ground)))
