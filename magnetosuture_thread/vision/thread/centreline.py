"""Finds the thread's centreline: a walk along the dark ridge that starts at the needle's tail."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.vision.images import Picture, glare_mask, middle
from magnetosuture_thread.vision.needle.body import MeasuredNeedle
from magnetosuture_thread.vision.scene_mask import SceneMask
from magnetosuture_thread.vision.thread.walk import Ridge, follow_ridge, refine

FAINTEST = 5.0  # grey levels; a ridge fainter than this is noise
FAINTEST_NOISES = 3.0  # and so is one fainter than so many times the median of all
BLUR_PX = 0.7  # before the ridge is looked for: as wide as the thinnest thread looks
WINDOW_PX = 7  # wider than the thread looks
COVERED_PX = 4.0  # beside and beyond the needle, where its own edge looks like a ridge
BEHIND_TAIL_PX = 1.5  # of the needle that is not covered, so that the walk can leave
MIN_RUN = 5  # vertices along an outline, below which nothing is judged
MIN_SAMPLES = 8  # of the outline away from the thread
STRONGER = 1.3  # than the bare outline must a ridge be to show a thread on it
_WINDOW = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (WINDOW_PX, WINDOW_PX))


def find_centreline(
    picture: Picture, needle: MeasuredNeedle, max_length: float, centre: tuple[float, float], reach: float
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
        reach: the walk stops this far from the centre, before the wall [px].

    Returns:
        Vertices from the tail on, shape (m, 2) [px], m = 1 if no thread is seen.
    """
    factor, size = picture.factor, np.array(picture.gray.shape[::-1])
    low = np.clip((np.array(centre) - reach - WINDOW_PX).astype(int), 0, size - 1)
    left, top = low // factor * factor  # a whole pixel of the small image
    right, bottom = np.clip((np.array(centre) + reach + WINDOW_PX).astype(int) + 1, 1, size)
    smooth = cv2.GaussianBlur(picture.gray[top:bottom, left:right], (5, 5), BLUR_PX)
    strength = cv2.morphologyEx(smooth, cv2.MORPH_BLACKHAT, _WINDOW)
    hidden = glare_mask(picture)[top // factor : -(-bottom // factor), left // factor : -(-right // factor)]
    # Copied: a slice of the mask is handed to compiled code and to drawing, which want their own memory.
    hidden = np.ascontiguousarray(hidden)
    _cover(strength, hidden, factor, needle, (left, top))
    noise = middle(strength[::5, ::5])
    ridge = Ridge(strength, hidden, factor, noise, max(FAINTEST, FAINTEST_NOISES * noise))
    (u, v), direction = needle.tail_px - (left, top), needle.direction_px
    start = (float(u), float(v), math.atan2(direction[1], direction[0]))
    path = follow_ridge(ridge, start, (float(centre[0] - left), float(centre[1] - top), reach), max_length)
    points = path[:, :2].copy()
    if picture.mask is not None:
        points = points[: count_off_outline(points, strength, picture.mask, (left, top), noise + ridge.faintest)]
    refine(strength, points, path[: len(points), 6] > 0.0)
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


def count_off_outline(
    points: Points, ridge: NDArray[np.uint8], mask: SceneMask, origin: tuple[int, int], faintest: float
) -> int:
    """Return how many vertices of a walk show the thread, where it may have gone on along a bare outline.

    A walk ends before it enters a shape. A ridge along an outline is the thread's or the shape's own edge. The last
    vertices along an outline count only as long as their ridge is stronger than that of the same outline away from
    the walk, or that one shows none.

    Args:
        points: vertices of the walk in the ridge's pixels, shape (m, 2) [px].
        ridge: ridge strength in grey levels, uint8.
        mask: of the picture.
        origin: (u, v) of the ridge's first pixel in the picture [px].
        faintest: a strength that is no noise.
    """
    depths = mask.depths(points + origin)
    inside = depths > mask.tolerance_px
    if inside.any():  # Whatever was followed from here on, it is no thread.
        first = max(1, int(np.argmax(inside)))
        points, depths = points[:first], depths[:first]
    near = np.abs(depths) <= mask.band_px
    run = len(near) if near.all() else int(np.argmin(near[::-1]))
    if run < MIN_RUN or not len(mask.rim):
        return len(points)
    rim = mask.rim[:, :2] - origin
    last = mask.rim[np.argmin(((rim - points[-1]) ** 2).sum(axis=1)), 2]
    rim = rim[mask.rim[:, 2] == last]
    apart = ((rim[:, None] - points[None, ::3]) ** 2).sum(axis=2).min(axis=1)
    rows, columns = ridge.shape
    reach = int(mask.band_px) + 1
    seen = (apart > (2.0 * mask.band_px) ** 2) & (rim.min(axis=1) > reach)
    seen &= (rim < (columns - 1 - reach, rows - 1 - reach)).all(axis=1)
    if seen.sum() < MIN_SAMPLES:
        return len(points)
    bare = middle(_strongest(ridge, rim[seen], reach))
    if bare < faintest:
        return len(points)
    # The thread ends where the sum of what speaks for it and against it is greatest: single strong pixels count little.
    surplus = np.cumsum(np.minimum(_strongest(ridge, points[-run:], 1) / (STRONGER * bare) - 1.0, 0.5))
    shown = int(np.argmax(surplus)) + 1 if surplus.max() > 0.0 else 0
    return max(1, len(points) - run + shown)


def _strongest(ridge: NDArray[np.uint8], points: Points, reach: int) -> NDArray[np.uint8]:
    """Return the strongest ridge in a square around each point, shape (m,)."""
    step = np.arange(-reach, reach + 1)
    at = np.round(points).astype(np.intp)
    rows = np.clip(at[:, 1, None] + step, 0, ridge.shape[0] - 1)
    columns = np.clip(at[:, 0, None] + step, 0, ridge.shape[1] - 1)
    return np.asarray(ridge[rows[:, :, None], columns[:, None, :]].max(axis=(1, 2)), dtype=np.uint8)
