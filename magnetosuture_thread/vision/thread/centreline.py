"""Finds the thread's centreline: a walk along the dark ridge that starts at the needle's tail."""

from __future__ import annotations

import math

import cv2
import numpy as np

from magnetosuture_thread.vision.images import RIM_PX, Picture, glare_mask, without_wall
from magnetosuture_thread.vision.needle.body import MeasuredNeedle
from magnetosuture_thread.vision.sampling import middle
from magnetosuture_thread.vision.thread.forks import follow
from magnetosuture_thread.vision.thread.outlines import count_off_outline
from magnetosuture_thread.vision.thread.walk import refine

FAINTEST = 5.0  # grey levels; a ridge fainter than this is noise
FAINTEST_NOISES = 3.0  # and so is one fainter than so many times the median of all
BLUR_PX = 0.7  # before the ridge is looked for: as wide as the thinnest thread looks
WINDOW_PX = 7  # wider than the thread looks
COVERED_PX = 4.0  # beside and beyond the needle, where its own edge looks like a ridge
WALL_PX = 4.0  # before which the walk ends
AT_WALL_PX = 40.0  # from the wall, where its rim may look like the thread's beginning
BEHIND_TAIL_PX = 1.5  # of the needle that is not covered, so that the walk can leave
_WINDOW = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (WINDOW_PX, WINDOW_PX))


def find_centreline(
    picture: Picture, needle: MeasuredNeedle, max_length: float, centre: tuple[float, float], wall: float
) -> np.ndarray:
    """Follow the thread from the needle's tail to its end.

    The ridge strength is the black-hat transform, how much darker a pixel is than the brightest
    background within a few pixels. The walk leaves the tail along the arc that has the strongest ridge,
    and goes by steps along arcs that look some way ahead, a change of curvature having a price: so it
    goes straight through crossings and over gaps. Where the needle or the lamp's reflection hides the
    thread, nothing counts for or against a way.

    Args:
        picture: the frame or a part of it.
        needle: the needle, in the picture's pixels.
        max_length: the walk stops at this length [px].
        centre: the dish's centre [px].
        wall: the dish's radius; the walk stops before it [px].

    Returns:
        Vertices from the tail on, shape (m, 2) [px], m = 1 if no thread is seen.
    """
    reach = wall - WALL_PX
    rows, columns = picture.gray.shape
    left, top = (max(0, int(c - reach - WINDOW_PX)) for c in centre)
    right, bottom = (int(c + reach + WINDOW_PX) + 1 for c in centre)
    left, top, right, bottom = (
        min(left, columns - 1),
        min(top, rows - 1),
        max(1, min(right, columns)),
        max(1, min(bottom, rows)),
    )
    factor = picture.factor
    left, top = left // factor * factor, top // factor * factor  # a whole pixel of the small image
    gray, tail = picture.gray, needle.tail_px
    if np.hypot(*(tail - centre)) > reach - AT_WALL_PX:  # else the walk would leave along the rim
        gray = without_wall(gray, picture, centre, wall - RIM_PX, tail - AT_WALL_PX, tail + AT_WALL_PX)
    window = gray[top:bottom, left:right]
    smooth = cv2.GaussianBlur(window, (5, 5), BLUR_PX)
    ridge = cv2.morphologyEx(smooth, cv2.MORPH_BLACKHAT, _WINDOW)
    hidden = glare_mask(picture)[top // factor : -(-bottom // factor), left // factor : -(-right // factor)]
    # Copied: a slice of the mask is handed to compiled code and to drawing, which want their own memory.
    hidden = np.ascontiguousarray(hidden)
    _cover(ridge, hidden, factor, needle, (left, top))
    usual_noise = middle(ridge[::5, ::5])
    faintest = max(FAINTEST, FAINTEST_NOISES * usual_noise)
    max_shift = int(max_length) + 16  # steps are longer than a pixel
    path, strong = np.empty((max_shift, 6)), np.empty(max_shift, np.bool_)
    tail, direction = needle.tail_px - (left, top), needle.direction_px
    count = follow(
        ridge,
        hidden,
        factor,
        usual_noise,
        faintest,
        (float(tail[0]), float(tail[1]), math.atan2(direction[1], direction[0])),
        (centre[0] - left, centre[1] - top, reach),
        max_length,
        path,
        strong,
    )
    points = path[:count, :2].copy()
    if picture.mask is not None:
        count = count_off_outline(points, ridge, picture.mask, (left, top), usual_noise + faintest)
        points = points[:count]
    refine(ridge, points, strong[:count])
    return points + np.array([left, top])


def _cover(ridge: np.ndarray, hidden: np.ndarray, factor: int, needle: MeasuredNeedle, origin: tuple[int, int]) -> None:
    """Take the needle out of the ridge and mark where it hides the thread."""
    along = np.linspace(BEHIND_TAIL_PX, needle.length_px + COVERED_PX - 1.0, 24)
    axis = needle.arc.at(along) - origin
    thickness = needle.width_px + 2.0 * COVERED_PX
    whole = np.round(axis * 16.0).astype(np.int32)
    cv2.polylines(ridge, [whole], False, 0, round(thickness), cv2.LINE_8, 4)
    small = np.round((axis - 0.5 * (factor - 1)) / factor * 16.0).astype(np.int32)
    cv2.polylines(hidden, [small], False, 255, max(1, round(thickness / factor)), cv2.LINE_8, 4)
