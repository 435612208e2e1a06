"""Learns from one frame on which a person marked both ends of the needle how it looks and how large it is.

The colours are weighted by how far they tell the needle from the floor beside it over how they vary in the dish,

    w_c ~ |n_c - f_c| / s_c^2,    sum w_c = 1

with the needle's colour n and the floor's f, as medians along the needle, and the standard deviation s of the dish. The
marks may be off by an eighth of the length: the axis climbs to where the matched filter of `candidates` answers most,
and ends where the darkness crosses half.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.geometry.camera import DishView
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.settings.errors import InvalidInputError
from magnetosuture_thread.vision.arc import Arc, NeedleSize
from magnetosuture_thread.vision.candidates import climb, darkness, find_candidates
from magnetosuture_thread.vision.images import prepare
from magnetosuture_thread.vision.settings import VisionTrackerSettings

MIN_MARKED_PX = 12.0  # between the marks: of a shorter needle nothing is measured
MIN_CONTRAST = 0.08  # of the floor's light, that needle and floor differ by at least
BEYOND = 0.4  # of the length, that an end is looked for so far out
EDGE = 64  # darkness, 0 to 255, of an end


@dataclass(frozen=True)
class Taught:
    """What one marked frame taught.

    Attributes:
        settings: with which the needle is looked for.
        ends: its tail and tip as they were measured, shape (2, 2) [px].
        contrast: share of the floor's light that it is darker by.
        answers: places of the filter's answers, ends of shape (2, 2) [px], and their scores, the greatest first.
        dark: what the filter looked at, shape (rows, columns), uint8; 0 beyond the wall.
    """

    settings: VisionTrackerSettings
    ends: Points
    contrast: float
    answers: list[tuple[Points, float]]
    dark: NDArray[np.uint8]


def teach(
    image: np.ndarray, view: DishView, dish_radius: float, marks: Points, settings: VisionTrackerSettings
) -> Taught:
    """Learn from a marked frame.

    Args:
        image: without the lens's distortion, BGR or grey, uint8.
        view: of its dish.
        dish_radius: [m].
        marks: tail and tip, each off by an eighth of the length at most, shape (2, 2) [px].
        settings: all of which is kept but what is learnt.

    Raises:
        InvalidInputError: no needle lies between the marks.
    """
    apart = math.dist(*marks)
    if apart < MIN_MARKED_PX:
        raise InvalidInputError("marks", f"{apart:.0f} px apart", f"tail and tip at least {MIN_MARKED_PX:.0f} px apart")
    away = view.metres_per_pixel * float(np.hypot(*(marks - view.centre_px).T).max())
    if away > 1.1 * dish_radius:
        raise InvalidInputError("marks", f"{1e3 * away:.1f} mm from the dish's centre", "tail and tip in the dish")
    colours = image.reshape(*image.shape[:2], -1)
    axis = Arc(np.array(marks[0], float), math.atan2(*(marks[1] - marks[0])[::-1]), 0.0)
    for reach in (0.25, 0.12):  # of the length, to both sides of the marks, within which the needle is
        axis = _centred(colours, axis, apart, reach)
    width = 0.05 * apart  # of most needles, as long as it is not measured
    for _ in range(2):  # the second time along the axis, and within the width, as the first one measured it
        weights, ratio, width = _look_of(colours, axis, NeedleSize(apart, width), view, dish_radius)
        limit = min(0.95, max(0.1, ratio + 0.3 * (1.0 - ratio)))  # It may be brighter in other frames.
        picture = prepare(image, view, dish_radius, weights=weights)
        size = NeedleSize(apart, width, max_brightness=limit)
        dark = darkness(picture, size)
        axis, apart = _measured(dark, axis, size)
    size = replace(size, length_px=apart)
    answers = [(each.arc.at(np.array([0.0, apart])), each.score) for each in find_candidates(picture, size)]
    scale = view.metres_per_pixel
    bend = min(abs(axis.curvature) * apart + 0.05, size.max_bend)  # rad; it may be more bent than it is measured
    told = replace(
        settings,
        needle_length=apart * scale,
        needle_width=width * scale,
        max_needle_brightness=limit,
        needle_colour=weights,
        needle_is_blunt=_is_blunt(dark, axis, size),
        max_needle_bend=bend,
    )
    return Taught(told, axis.at(np.array([0.0, apart])), 1.0 - ratio, answers, dark)


def _strip(colours: NDArray[np.uint8], axis: Arc, along: Points, aside: Points) -> NDArray[np.float64]:
    """Return the colours at lengths along an axis and distances aside of it, shape (n, m, colours)."""
    parts = [axis.strip(np.ascontiguousarray(colour), along, aside) for colour in np.moveaxis(colours, -1, 0)]
    return np.stack(parts, axis=-1)


def _centred(colours: NDArray[np.uint8], axis: Arc, length: float, reach: float) -> Arc:
    """Return the axis through the middles of what differs from the floor beside it, row by row."""
    along, aside = np.linspace(0.2, 0.8, 40) * length, np.arange(-0.5 * length, 0.5 * length, 0.5)
    strip = _strip(colours, axis, along, aside)
    apart = np.linalg.norm(strip - np.median(strip, axis=1, keepdims=True), axis=2)
    near = apart[:, np.abs(aside) < reach * length]
    weight = np.maximum(near - 0.6 * near.max(axis=1, keepdims=True), 1e-9)
    middles = weight @ aside[np.abs(aside) < reach * length] / weight.sum(axis=1)
    first, last = np.triu_indices(len(along), 12)  # of rows far enough from each other
    slope = float(np.median((middles[last] - middles[first]) / (along[last] - along[first])))
    offset = float(np.median(middles - slope * along))
    return axis.moved(0.0, offset, slope, 0.0)


def _look_of(
    colours: NDArray[np.uint8], axis: Arc, size: NeedleSize, view: DishView, dish_radius: float
) -> tuple[tuple[float, ...], float, float]:
    """Return the weights of the colours, none of a grey image, the needle's light over the floor's, and its width [px].

    Raises:
        InvalidInputError: what lies along the axis is no darker than what is beside it.
    """
    length = size.length_px
    aside = np.arange(-0.5 * length, 0.5 * length, 0.5)
    strip = _strip(colours, axis, np.linspace(0.15, 0.85, 60) * length, aside)
    across, body = np.median(strip, axis=0), strip[:, np.abs(aside) < max(1.0, 0.4 * size.width_px)]
    needle = across[np.abs(aside) < max(1.0, 0.02 * length)].mean(axis=0)
    floor = np.median(across[np.abs(aside) > 0.25 * length], axis=0)
    rows, columns = colours.shape[:2]
    v, u = np.mgrid[0:rows:4, 0:columns:4]
    inside = np.hypot(u - view.centre_px[0], v - view.centre_px[1]) < 0.95 * dish_radius / view.metres_per_pixel
    low, high = np.percentile(colours[::4, ::4][inside], (16.0, 84.0), axis=0)  # which a needle in the dish is not in
    variance = (0.5 * (high - low)) ** 2 + body.var(axis=(0, 1)) + 3.0**2  # grey levels
    weights = np.maximum(floor - needle, 0.0) / variance
    weights = weights / max(weights.sum(), 1e-9)
    ratio = float(needle @ weights / max(float(floor @ weights), 1.0)) if weights.any() else 1.0
    if ratio > 1.0 - MIN_CONTRAST:
        expected = f"a needle darker than the floor by {MIN_CONTRAST:.0%}: mark its ends on it"
        raise InvalidInputError("marks", f"{ratio:.0%} of the light of the floor beside it", expected)
    half = 0.5 * (needle + floor) @ weights
    is_needle = across @ weights < half
    middle = len(aside) // 2
    left = middle - int(np.argmin(is_needle[middle::-1]))
    right = middle + int(np.argmin(is_needle[middle:]))
    width = 0.5 * (right - left - 1)
    if not 1.0 <= width < 0.5 * length:
        expected = "something slender between the marks"
        raise InvalidInputError("marks", f"{width:.0f} px wide and {length:.0f} px long", expected)
    return tuple(weights.tolist()) if len(weights) == 3 else (), ratio, width


def _measured(dark: NDArray[np.uint8], axis: Arc, size: NeedleSize) -> tuple[Arc, float]:
    """Return the axis where the filter answers most nearby, from end to end, and its length [px]."""
    middle = axis.moved(0.5 * size.length_px, 0.0, 0.0, 0.0)
    state = np.array([*middle.start, middle.angle, middle.curvature])
    # Of a part of the length, which lies on the needle wherever its ends are.
    climb(dark, state, 0.8 * size.length_px, size.width_px, size.max_bend, 0.0)
    middle = Arc(state[:2], float(state[2]), float(state[3]))
    along = np.arange(-(0.5 + BEYOND) * size.length_px, (0.5 + BEYOND) * size.length_px, 0.5)
    shown = middle.strip(dark, along, np.array([-0.2, 0.0, 0.2]) * size.width_px).mean(axis=1) > EDGE
    gap = int(0.1 * size.length_px / 0.5)  # A reflection on a needle is shorter.
    ends = []
    for part in (shown[len(along) // 2 :], shown[len(along) // 2 :: -1]):
        light = np.convolve(~part, np.ones(gap), "valid") == gap  # from where on it is light for longer than a gap
        ends.append(0.5 * (int(np.argmax(light)) if light.any() else len(part)))
    return middle.moved(-ends[1], 0.0, 0.0, 0.0), ends[0] + ends[1]


def _is_blunt(dark: NDArray[np.uint8], axis: Arc, size: NeedleSize) -> bool:
    """Say whether both ends are as wide as the middle; a point is ground from the last fifth on."""
    aside = np.arange(-size.width_px, size.width_px, 0.25)
    middle, *ends = (
        float((axis.strip(dark, np.linspace(*part, 8) * size.length_px, aside) > EDGE).sum(axis=1).mean())
        for part in ((0.3, 0.7), (0.04, 0.12), (0.88, 0.96))
    )
    return min(ends) > 0.75 * middle
