"""Finds the thread's centreline: a walk along its ridge, dark or pale, that starts at the needle's tail."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from magnetosuture_thread.vision.images import RIM_PX, Picture, Wall, glare_mask, without_wall
from magnetosuture_thread.vision.needle.erase import without_needle
from magnetosuture_thread.vision.needle.measured_needle import MeasuredNeedle
from magnetosuture_thread.vision.sampling import middle
from magnetosuture_thread.vision.thread.forks import follow
from magnetosuture_thread.vision.thread.outlines import count_off_outline
from magnetosuture_thread.vision.thread.walk import refine

FAINTEST = 3.0  # grey levels; a ridge fainter than this is noise
FAINTEST_NOISES = 3.0  # and so is one fainter than so many times the median of all
BLUR_PX = 0.7  # before the ridge is looked for: as wide as the thinnest thread looks
WINDOW_PX = 7  # wider than the thread looks
COVERED_PX = 1.5  # beside and beyond the needle, that is not seen: its outline is not known better
BEYOND_PX = 3.0  # its tip, that is not seen either
MAX_BEYOND_PX = 12.0  # hidden by the needle and what is next to it, beside its length
SHADE, SHADE_PX = 0.12, 10.0  # of steel's darkness, that its shadow has, and how far beside it that lies
WALL_PX = 4.0  # before which the walk ends
AT_WALL_PX = 40.0  # from the wall, where its rim may look like the thread's beginning
BEHIND_TAIL_PX = 1.5  # of the needle that is not covered, so that the walk can leave
ENOUGH = 0.85  # of the greatest length: so much thread seen, dark and strong, needs no other search
FAINT = 25.0  # grey levels; a dark ridge fainter than this may be a pale thread's shadow
PALE_SHARE = 0.6  # of what the dark ridge shows, that a pale one must show to be the thread
SURE_SHARE = 0.5  # of enough, that a wide or a pale thread must show: a little of one may be noise
WIDER_SHARE = 1.3  # of what is seen at full size, that must be seen at half of it
_WINDOW = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (WINDOW_PX, WINDOW_PX))


@dataclass(frozen=True)
class _Ridge:
    """How much darker, or brighter, each pixel is than what is near it.

    Attributes:
        strength: in grey levels, uint8.
        hidden: where nothing can be seen, 255 there, `factor` times smaller.
        factor: see `hidden`.
        noise: strength where nothing is.
    """

    strength: np.ndarray
    hidden: np.ndarray
    factor: int
    noise: float

    @property
    def faintest(self) -> float:
        """A strength above noise that is no noise."""
        return max(FAINTEST, FAINTEST_NOISES * self.noise)


@dataclass(frozen=True)
class _Walk:
    """A walk in pixels of the picture, shape (m, 2), how much thread it shows [px] and its strength [grey levels]."""

    points: np.ndarray
    shown: float
    strength: float


def find_centreline(
    picture: Picture, needle: MeasuredNeedle, max_length: float, centre: tuple[float, float], wall: float
) -> np.ndarray:
    """Follow the thread from the needle's tail to its end.

    The ridge strength of a dark thread is the black-hat transform, how much darker a pixel is than the brightest
    background within a few pixels, of the image without the needle; that of a pale thread is the same of the negative.
    The walk leaves the tail along the arc that shows most of the thread, below the needle where it must, and goes by
    steps along arcs that look some way ahead, a change of curvature having a price: so it goes straight through
    crossings and over gaps. Where the needle or the lamp's reflection hides the thread, nothing counts for or against
    a way. A thread wider than the window is looked for at half the size.

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
    rows, columns = picture.shape
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
    gray, tail = without_needle(picture.darkest, factor, needle), needle.tail_px
    at_wall = bool(np.hypot(*(tail - centre)) > reach - AT_WALL_PX)
    if at_wall:  # else the walk would leave along the rim
        near = Wall(centre, wall - RIM_PX)
        gray = without_wall(picture.darkest.replaced(gray), factor, near, tail - AT_WALL_PX, tail + AT_WALL_PX)
    window = gray[top:bottom, left:right]
    hidden = glare_mask(picture)[top // factor : -(-bottom // factor), left // factor : -(-right // factor)]
    # Copied: a slice of the mask is handed to compiled code and to drawing, which want their own memory.
    hidden = np.ascontiguousarray(hidden)
    _cover(hidden, factor, needle, (left, top))
    shade = SHADE * needle.contrast * middle(picture.darkest.floor)

    def search(scale: int, *, pale: bool) -> _Walk:
        ridge = _ridge(window, hidden, factor, scale, pale)
        _clear_shade(ridge.strength, scale, needle, (left, top), shade)
        dish = (centre[0] - left, centre[1] - top, reach)
        return _walked(ridge, scale, needle, (left, top), dish, max_length, at_wall, picture)

    if at_wall:  # Its rim is wide and pale, as threads may be.
        return search(1, pale=False).points
    return _best_of(search, ENOUGH * max_length).points


def _best_of(search: Callable[..., _Walk], enough: float) -> _Walk:
    """Return what shows most of the thread: dark or pale, thin or wide; each is looked for where it may be needed."""

    def at_both_sizes(*, pale: bool) -> _Walk:
        thin = search(1, pale=pale)
        if thin.shown > enough:
            return thin
        wide = search(2, pale=pale)
        return wide if wide.shown > max(WIDER_SHARE * thin.shown, SURE_SHARE * enough) else thin

    dark = at_both_sizes(pale=False)
    if dark.shown > enough and dark.strength > FAINT:
        return dark
    pale = at_both_sizes(pale=True)
    if pale.shown < max(PALE_SHARE * dark.shown, SURE_SHARE * enough):
        return dark
    return pale if dark.shown < SURE_SHARE * enough or pale.strength > PALE_SHARE * dark.strength else dark


def _ridge(window: np.ndarray, hidden: np.ndarray, factor: int, scale: int, pale: bool) -> _Ridge:
    """Return the ridge of a window, shrunk by a scale."""
    if scale > 1:
        size = (window.shape[1] // scale, window.shape[0] // scale)
        window = cv2.resize(window, size, interpolation=cv2.INTER_AREA)
        hidden, factor = cv2.resize(hidden, size, interpolation=cv2.INTER_NEAREST), 1
    smooth = cv2.GaussianBlur(window, (5, 5), BLUR_PX)
    strength = cv2.morphologyEx(smooth, cv2.MORPH_TOPHAT if pale else cv2.MORPH_BLACKHAT, _WINDOW)
    return _Ridge(strength, hidden, factor, middle(strength[::5, ::5]))


def _walked(
    ridge: _Ridge,
    scale: int,
    needle: MeasuredNeedle,
    origin: tuple[int, int],
    dish: tuple[float, float, float],
    max_length: float,
    at_wall: bool,
    picture: Picture,
) -> _Walk:
    """Walk along a ridge that is shrunk by a scale; `dish` is its centre and how far a walk may go from it [px]."""
    shift = 0.5 * (scale - 1)
    max_length /= scale
    max_steps = int(max_length) + 16  # steps are longer than a pixel
    path, strong = np.empty((max_steps, 6)), np.empty(max_steps, np.bool_)
    tail, direction = (needle.tail_px - origin - shift) / scale, needle.direction_px
    count, shown = follow(
        ridge.strength,
        ridge.hidden,
        ridge.factor,
        ridge.noise,
        ridge.faintest,
        np.array([tail[0], tail[1], math.atan2(direction[1], direction[0])]),
        ((dish[0] - shift) / scale, (dish[1] - shift) / scale, dish[2] / scale),
        max_length,
        (needle.length_px + MAX_BEYOND_PX) / scale,
        at_wall,
        path,
        strong,
    )
    points = path[:count, :2].copy()
    if picture.mask is not None:
        full = cv2.resize(ridge.strength, None, fx=scale, fy=scale) if scale > 1 else ridge.strength
        kept = count_off_outline(points * scale + shift, full, picture.mask, origin, ridge.noise + ridge.faintest)
        shown = max(0.0, shown - (path[count - 1, 5] - path[kept - 1, 5]))
        count, points = kept, points[:kept]
    refine(ridge.strength, points, strong[:count])
    strength = float(np.median(path[1:count, 4])) if count > 1 else 0.0
    return _Walk(points * scale + shift + origin, shown * scale, strength)


def _cover(hidden: np.ndarray, factor: int, needle: MeasuredNeedle, origin: tuple[int, int]) -> None:
    """Mark where the needle hides the thread."""
    axis = needle.arc.at(np.linspace(BEHIND_TAIL_PX, needle.length_px + BEYOND_PX, 24)) - origin
    small = np.round((axis - 0.5 * (factor - 1)) / factor * 16.0).astype(np.int32)
    thickness = needle.width_px + 2.0 * COVERED_PX
    cv2.polylines(hidden, [small], False, 255, max(1, round(thickness / factor)), cv2.LINE_8, 4)


def _clear_shade(
    strength: np.ndarray, scale: int, needle: MeasuredNeedle, origin: tuple[int, int], shade: float
) -> None:
    """Take what is no stronger than a needle's shadow out of a ridge beside the needle."""
    axis = needle.arc.at(np.linspace(SHADE_PX, needle.length_px, 24)) - origin
    at = np.round((axis - 0.5 * (scale - 1)) / scale * 16.0).astype(np.int32)
    zone = np.zeros_like(strength)
    thickness = round((needle.width_px + 2.0 * SHADE_PX) / scale)
    cv2.polylines(zone, [at], False, 255, thickness, cv2.LINE_8, 4)
    strength[(zone > 0) & (strength < shade)] = 0
