"""Walks along the ridges of one frame from the needle's tail on: dark, faint, pale and wide threads."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np

from magnetosuture_thread.vision.images import RIM_PX, Layer, Picture, Wall, glare_mask, shrunk, without_wall
from magnetosuture_thread.vision.needle.erase import smooth_without_needle, without_needle
from magnetosuture_thread.vision.needle.measured_needle import MeasuredNeedle
from magnetosuture_thread.vision.sampling import middle
from magnetosuture_thread.vision.thread.cross_section import CrossSection, between_dark_edges, centred_between_edges
from magnetosuture_thread.vision.thread.crossings import Crossing, resolve_crossings
from magnetosuture_thread.vision.thread.forks import follow, worth
from magnetosuture_thread.vision.thread.hiding import cover_needle
from magnetosuture_thread.vision.thread.joint import joins_passing_line
from magnetosuture_thread.vision.thread.outlines import count_off_outline
from magnetosuture_thread.vision.thread.ridge import (
    DEVIATION,
    FAINT_DEVIATIONS,
    FAINTEST,
    INNER_PX,
    LEVELS,
    WINDOW_PX,
    ZERO,
    Ridge,
    black_hat,
    darker_than_around,
    faint_ridge,
    shrunk_hidden,
)
from magnetosuture_thread.vision.thread.walk import refine

MAX_BEYOND_PX = 12.0  # hidden by the needle and what is next to it, beside its length
SHADE, SHADE_PX = 0.12, 10.0  # of steel's darkness, that its shadow has, and how far beside it that lies
WALL_PX = 4.0  # before which the walk ends
AT_WALL_PX = 40.0  # from the wall, where its rim may look like the thread's beginning
ENOUGH = 0.85  # of the greatest length: so much thread seen, dark and strong, needs no other search
FAINT = 25.0  # grey levels; a black-hat fainter than this may be a pale thread's shadow
STRONG_SHARE = 0.08  # of enough, that a strong dark thread must show to be the thread: the rest of it is covered
SCALES = (1, 2)  # how much smaller the image is in which a faint, a pale or a wide thread is looked for
RIM_REACH_PX = 5.0  # by which the rim reaches into a signed ridge, at each scale
FAINT_HALF = 3  # vertices to both sides, over which a faint walk is centred
COARSE, COARSE_MEDIAN = 4, 25  # how much smaller an image shows what is wide, and the window of its surroundings [px]
BESIDE = 2.5  # of its pixels, within which they show what is beside a walk
COARSE_LEVELS = 90.0  # as which the contrast at the tail is coded there
WIDE_FAINTEST = 0.3  # of the contrast at the tail, that it shows everywhere
WIDE_STIFFNESS = 3.0  # of a wide thread, that bends in many of its widths, in the shrunk image
OVERRUN = 5.0  # price of a pixel of a wide walk beyond the thread's length, as its crossings are not judged
OTHER_COLOUR = 0.5  # weight of what a pixel has of another colour, against it
BEGINNING = 14  # vertices of a wide walk, whose colour it keeps to
MIN_CENTRED = 4  # vertices
SURE_SHARE = 0.5  # of enough, that a faint, wide or pale thread must show: a little of one may be noise
WIDER_SHARE = 1.3  # of what is seen at full size, that must be seen at half of it


@dataclass(frozen=True)
class Walk:
    """A walk along a ridge.

    Attributes:
        points: vertices in pixels of the picture, shape (m, 2).
        shown: how much thread they show [px].
        strength: median of the ridge along it [grey levels].
        ridge: that was followed.
        path: the walk in the ridge's pixels; see `walk_on`.
        strong: whether the thread is visible at each vertex of the path.
        crossings: where it could have gone on along another strand; see `ThreadSearch.resolved`.
        passes: whether a line passes the tail, and was not followed; see `joins_passing_line`.
        half_width: of the thread, where it was measured; else 0 [px].
    """

    points: np.ndarray
    shown: float
    strength: float
    ridge: Ridge
    path: np.ndarray
    strong: np.ndarray
    crossings: tuple[Crossing, ...] = ()
    passes: bool = False
    half_width: float = 0.0


def is_strong(dark: Walk, enough: float) -> bool:
    """Say whether a dark walk shows a thread beyond doubt, be it that the rest of it is covered."""
    return dark.strength > FAINT and dark.shown > STRONG_SHARE * enough


def only_tail(walk: Walk) -> Walk:
    """Return a walk's first vertex alone: no thread."""
    return replace(walk, points=walk.points[:1], path=walk.path[:1], strong=walk.strong[:1], shown=0.0)


class ThreadSearch:
    """Walks along one frame's ridges, each from the needle's tail on.

    Args:
        picture: the frame or a part of it.
        needle: in the picture's pixels.
        max_length: of a walk [px].
        centre: the dish's [px].
        reach: how far from it a walk may go [px].
    """

    def __init__(
        self,
        picture: Picture,
        needle: MeasuredNeedle,
        max_length: float,
        centre: tuple[float, float],
        reach: float,
    ) -> None:
        self._picture, self._needle, self._max_length = picture, needle, max_length
        self._centre, self._reach = centre, reach
        self._at_wall = bool(np.hypot(*(needle.tail_px - centre)) > reach - AT_WALL_PX)
        rows, columns = picture.shape
        left, top = (max(0, int(c - reach - WINDOW_PX)) for c in centre)
        right, bottom = (int(c + reach + WINDOW_PX) + 1 for c in centre)
        left, top = min(left, columns - 1), min(top, rows - 1)
        right, bottom = max(1, min(right, columns)), max(1, min(bottom, rows))
        factor = picture.factor
        left, top = left // factor * factor, top // factor * factor  # a whole pixel of the small image
        self._origin, self._box = (left, top), (slice(top, bottom), slice(left, right))
        hidden = glare_mask(picture)[top // factor : -(-bottom // factor), left // factor : -(-right // factor)]
        # Copied: a slice of the mask is handed to compiled code and to drawing, which want their own memory.
        self._hidden = np.ascontiguousarray(hidden)
        self._covered = np.zeros_like(self._hidden)
        cover_needle(self._covered, factor, needle, self._origin)
        self._hidden |= self._covered

    def dark(self) -> Walk:
        """Return the walk along the black-hat, at full size or at half of it."""
        darkest, factor = self._picture.darkest, self._picture.factor
        window = self._cleared(darkest)
        # At the wall the window is another.
        smooth = None if self._at_wall else smooth_without_needle(darkest, factor, self._needle)[self._box]
        shade = SHADE * self._needle.contrast * middle(darkest.floor)

        def at(scale: int) -> Walk:
            ridge = black_hat(window, self._hidden, factor, scale, smooth)
            self._clear_shade(ridge, shade)
            return self._walked(ridge)

        thin, enough = at(1), ENOUGH * self._max_length
        if thin.shown > enough or is_strong(thin, enough) or self._at_wall:  # The rim is wide, as covers are.
            return thin
        best = thin
        for scale in SCALES[1:]:
            wide = at(scale)
            if wide.shown > max(WIDER_SHARE * best.shown, SURE_SHARE * enough):
                best = wide
            if best.shown > enough:
                break
        return best

    def faint(self, scale: int) -> list[Walk]:
        """Return the walks along what is a little darker and along what is a little paler than its surroundings.

        Args:
            scale: how much smaller the image is in which to look: in a smaller one a thread and its shadow are one.
        """
        small = shrunk(self._luminance, scale)
        shade = SHADE * self._needle.contrast * middle(self._picture.luminance.floor)
        difference, deviation = darker_than_around(small)
        walks: list[Walk] = []
        for pale in (False, True):
            # A pale thread may be as bright as the lamp's reflection.
            hidden, factor = shrunk_hidden(self._covered if pale else self._hidden, self._picture.factor, small, scale)
            ridge = faint_ridge(difference, deviation, hidden, factor, scale, pale=pale)
            self._clear_shade(ridge, shade * LEVELS / deviation)
            self._clear_wall(ridge)
            walk = self._walked(ridge)
            strength = (-1.0 if pale else 1.0) * self._median_along(walk.points, difference, scale)
            walks.append(replace(walk, strength=strength))
        return walks

    @cached_property
    def _luminance(self) -> np.ndarray:
        """The picture's luminance in the search's window without the needle."""
        return self._cleared(self._picture.luminance)

    def centred(self, walk: Walk) -> tuple[Walk, CrossSection]:
        """Return a walk between the thread's edges up to where it ends, and how well it shows one there."""
        ridge = walk.ridge
        shift = 0.5 * (ridge.scale - 1)

        def hidden(points: np.ndarray) -> np.ndarray:
            at = np.round((points - self._origin - shift) / ridge.scale).astype(int) // ridge.factor
            rows, columns = ridge.hidden.shape
            return np.asarray(ridge.hidden[np.clip(at[:, 1], 0, rows - 1), np.clip(at[:, 0], 0, columns - 1)] > 0)

        whole = centred_between_edges(self._picture.image, self._needle, walk.points, hidden)
        found = whole.up_to_its_end()
        share = len(found.points) / len(whole.points)
        kept = max(1, round(share * len(walk.path)))
        path, strong, shown = walk.path[:kept], walk.strong[:kept], share * walk.shown
        half = found.half_width
        return replace(walk, points=found.points, shown=shown, path=path, strong=strong, half_width=half), found

    def without_passing_line(self, walk: Walk) -> Walk:
        """Return a walk, or its first vertex alone if it follows a line that passes the tail.

        Among pixels as large as those that a wide thread is followed in, needle and thread run into each other.
        """
        if walk.ridge.scale == COARSE or not joins_passing_line(walk.points, walk.ridge, self._origin, walk.half_width):
            return walk
        return replace(only_tail(walk), passes=True)

    @cached_property
    def _coarse(self) -> np.ndarray:
        """How much darker than around each colour of the shrunk image is, shape (rows, columns, 1 or 3)."""
        small = shrunk(self._picture.image[self._box], COARSE)
        around = cv2.medianBlur(small, COARSE_MEDIAN)
        return cv2.subtract(around, small, dtype=cv2.CV_32F).reshape(*small.shape[:2], -1)

    def wideness(self, walk: Walk) -> float:
        """Return how much of a walk's contrast what it runs along keeps in a shrunk image.

        What is wide keeps its contrast in a shrunk image, what is thin loses it: in the one that was walked in, too.
        Beside a shape of the scene it is the shape's; of a walk that is nowhere else, nothing tells.
        """
        mask, points, strength = self._picture.mask, walk.points, walk.strength
        if mask is not None and len(walk.path) == len(points):
            clear = mask.depths(points) < -BESIDE * COARSE
            if clear.sum() < MIN_CENTRED:
                return 0.0
            points, strength = points[clear], float(np.median(walk.path[clear, 4]))
        contrast, factor = None, self._picture.factor
        box = tuple(slice(side.start // factor, -(-side.stop // factor)) for side in self._box)
        for layer in (self._picture.darkest, self._picture.brightest):
            small = shrunk(layer.small[box], COARSE // factor)
            floor = cv2.resize(layer.floor[box], small.shape[::-1], interpolation=cv2.INTER_LINEAR)
            differs = cv2.absdiff(small, floor)
            contrast = differs if contrast is None else cv2.max(contrast, differs)
        near = cv2.dilate(contrast, np.ones((3, 3), np.uint8))
        contrast = self._median_along(points, near, COARSE) - middle(near[::3, ::3])
        return contrast / max(1e-6, strength * math.sqrt(walk.ridge.scale))

    def between_edges(self, walk: Walk) -> Walk | None:
        """Return a walk along one edge of something wide moved to its middle; None if no other edge runs beside it."""
        found = between_dark_edges(walk.points, walk.ridge, self._origin, walk.strength)
        return None if found is None else replace(walk, points=found[0], half_width=found[1])

    def wide(self) -> Walk:
        """Return the walk along what is wide and differs from around in colour as it does where it begins.

            r = d . c - k |d - (d . c) c|

        with the difference d in colour of a pixel from what is around it, and the colour c of what leaves the tail:
        first right behind it, then along a walk there.
        """
        difference = cv2.GaussianBlur(self._coarse, (0, 0), INNER_PX).reshape(self._coarse.shape)
        walk = self._along(self._same_colour(difference, self._beginning(difference)))
        if len(walk.points) < MIN_CENTRED:
            return walk
        at = ((walk.points[2:BEGINNING] - self._origin - 0.5 * (COARSE - 1)) / COARSE).astype(np.float32)
        begun = cv2.remap(difference, at[None, :, 0], at[None, :, 1], cv2.INTER_LINEAR).reshape(len(at), -1)
        return self._along(self._same_colour(difference, np.median(begun, axis=0), bounded=True))

    def _beginning(self, difference: np.ndarray) -> np.ndarray:
        """Return the difference in colour right behind the tail."""
        behind = (self._needle.tail_px - self._origin - 0.5 * (COARSE - 1)) / COARSE - self._needle.direction_px
        u, v = np.clip(np.round(behind).astype(int), 0, np.array(difference.shape[1::-1]) - 1)
        return np.asarray(difference[v, u])

    @staticmethod
    def _same_colour(difference: np.ndarray, colour: np.ndarray, *, bounded: bool = False) -> np.ndarray:
        """Return how much of a colour each pixel has, less what it has of others; bounded, more of it is another."""
        greatest = max(1e-6, float(np.linalg.norm(colour)))
        way = colour / greatest
        same = np.minimum(difference @ way, greatest if bounded else math.inf)
        return np.asarray(same - OTHER_COLOUR * np.linalg.norm(difference - same[..., None] * way, axis=2))

    def _along(self, contrast: np.ndarray) -> Walk:
        """Return the walk along a contrast in the image that is shrunk by `COARSE`."""
        tail = np.round((self._needle.tail_px - self._origin - 0.5 * (COARSE - 1)) / COARSE).astype(int)
        u, v = np.maximum(tail - 2, 0)
        strongest = float(contrast[v : v + 5, u : u + 5].max(initial=FAINTEST))
        noise = DEVIATION * middle(np.abs(contrast[::3, ::3]))
        gain = COARSE_LEVELS / max(strongest, FAINTEST)
        strength = np.clip(ZERO + gain * contrast, 0.0, 255.0).astype(np.uint8)
        hidden, factor = shrunk_hidden(self._covered, self._picture.factor, strength, COARSE)
        faintest = max(WIDE_FAINTEST * COARSE_LEVELS, gain * FAINT_DEVIATIONS * noise)
        ridge = Ridge(strength, hidden, factor, COARSE, ZERO, faintest, faintest, signed=True, stiffness=WIDE_STIFFNESS)
        ridge.strength[(hidden > 0) & (ridge.strength > ZERO)] = ZERO
        self._clear_wall(ridge)
        walk = self._walked(ridge)
        return replace(walk, strength=self._median_along(walk.points, contrast, COARSE))

    def _median_along(self, points: np.ndarray, difference: np.ndarray, scale: int) -> float:
        """Return the median along a walk of a difference that is shrunk by a scale."""
        at = ((points - self._origin - 0.5 * (scale - 1)) / scale).astype(np.float32)
        return float(np.median(cv2.remap(difference, at[None, :, 0], at[None, :, 1], cv2.INTER_LINEAR)))

    def _cleared(self, layer: Layer) -> np.ndarray:
        """Return a layer's pixels in the search's window, without the needle and what is beyond the wall beside it."""
        tail, factor = self._needle.tail_px, self._picture.factor
        pixels = without_needle(layer, factor, self._needle)
        if self._at_wall:  # else the walk would leave along the rim
            wall = Wall(self._centre, self._reach + WALL_PX - RIM_PX)
            pixels = without_wall(layer.replaced(pixels), factor, wall, tail - AT_WALL_PX, tail + AT_WALL_PX)
        return np.asarray(pixels[self._box])

    def _walked(self, ridge: Ridge) -> Walk:
        """Walk along a ridge."""
        scale = ridge.scale
        max_length = self._max_length / scale
        path, strong = self._buffers(ridge)
        path[0] = 0.0  # all that there is where nothing leaves the tail
        needle, dish = self._needle, self._dish(ridge)
        tail, direction = (needle.tail_px - self._origin - 0.5 * (scale - 1)) / scale, needle.direction_px
        start = np.array([tail[0], tail[1], math.atan2(direction[1], direction[0])])
        image, levels = (ridge.strength, ridge.hidden, ridge.factor), (ridge.noise, ridge.faintest, ridge.single)
        overrun = OVERRUN if ridge.scale == COARSE else 0.0
        lengths = max_length, (needle.length_px + MAX_BEYOND_PX) / scale
        thread = ridge.stiffness, overrun
        count, shown = follow(*image, *levels, *thread, start, dish, *lengths, self._at_wall, path, strong)
        return self._ended(ridge, path, strong, count, shown)

    def _buffers(self, ridge: Ridge) -> tuple[np.ndarray, np.ndarray]:
        """Return room for a path along a ridge; see `walk_on`."""
        max_steps = int(self._max_length / ridge.scale) + 16  # steps are longer than a pixel
        return np.empty((max_steps, 6)), np.empty(max_steps, np.bool_)

    def _dish(self, ridge: Ridge) -> tuple[float, float, float]:
        """Return the dish's centre and how far from it a walk may go, in a ridge's pixels."""
        u, v = (np.subtract(self._centre, self._origin) - 0.5 * (ridge.scale - 1)) / ridge.scale
        return float(u), float(v), self._reach / ridge.scale

    def resolved(self, walk: Walk) -> Walk:
        """Return a walk that takes the most probable way at its crossings; see `resolve_crossings`.

        One of a faint or pale thread stays as it is: noise beside it looks like strands that cross it.
        """
        ridge, count = walk.ridge, len(walk.path)
        if count < MIN_CENTRED or ridge.signed:
            return walk
        path, strong = self._buffers(ridge)
        path[:count], strong[:count] = walk.path, walk.strong
        max_length = self._max_length / ridge.scale
        count, crossings = resolve_crossings(ridge, self._dish(ridge), max_length, path, strong, count)
        if count == len(walk.path) and np.array_equal(path[:count], walk.path):
            return replace(walk, crossings=crossings)
        found = self._ended(ridge, path, strong, count, float(worth(path, strong, count)))
        return replace(found, crossings=tuple(each for each in crossings if each.first < len(found.path)))

    def _ended(self, ridge: Ridge, path: np.ndarray, strong: np.ndarray, count: int, shown: float) -> Walk:
        """Return the walk along a path up to where it shows the thread."""
        scale, origin = ridge.scale, self._origin
        shift = 0.5 * (scale - 1)
        points = path[:count, :2].copy()
        kept = count
        if self._picture.mask is not None:
            full = cv2.resize(ridge.strength, None, fx=scale, fy=scale) if scale > 1 else ridge.strength
            above = cv2.subtract(full, ridge.noise)
            kept = count_off_outline(points[:kept] * scale + shift, above, self._picture.mask, origin, ridge.faintest)
        shown = max(0.0, shown - (path[count - 1, 5] - path[kept - 1, 5]))
        points = points[:kept]
        refine(ridge.strength, ridge.noise, points, strong[:kept], FAINT_HALF if ridge.signed else 0)
        strength = float(np.median(path[1:kept, 4])) if kept > 1 else 0.0
        points = points * scale + shift + origin
        return Walk(points, shown * scale, strength, ridge, path[:kept].copy(), strong[:kept].copy())

    def _clear_wall(self, ridge: Ridge) -> None:
        """Take what the rim is mixed into out of a signed ridge, but for where the rim was taken out of the image."""
        scale, shift = ridge.scale, 0.5 * (ridge.scale - 1)
        u, v = ((np.subtract(self._centre, self._origin) - shift) / scale).tolist()
        width = (WALL_PX + RIM_PX) / scale + RIM_REACH_PX
        kept = None
        if self._at_wall:
            tail = (self._needle.tail_px - self._origin - shift) / scale
            low = np.maximum(0.0, tail - (AT_WALL_PX / scale - RIM_REACH_PX)).astype(int)
            high = np.maximum(0.0, tail + (AT_WALL_PX / scale - RIM_REACH_PX)).astype(int)
            box = slice(low[1], high[1]), slice(low[0], high[0])
            kept = ridge.strength[box].copy()
        # A ring from where the rim shows up to its outer side.
        at, radius = (round(u * 16.0), round(v * 16.0)), (self._reach + WALL_PX) / scale
        cv2.circle(ridge.strength, at, round(radius * 16.0), ridge.noise, round(2.0 * width), cv2.LINE_8, 4)
        if kept is not None:
            ridge.strength[box] = kept

    def _clear_shade(self, ridge: Ridge, shade: float) -> None:
        """Take what is no stronger than the needle's shadow out of a ridge beside the needle."""
        axis = self._needle.arc.at(np.linspace(SHADE_PX, self._needle.length_px, 24)) - self._origin
        axis = (axis - 0.5 * (ridge.scale - 1)) / ridge.scale
        thickness = round((self._needle.width_px + 2.0 * SHADE_PX) / ridge.scale)
        left, top = np.maximum(axis.min(axis=0) - thickness, 0.0).astype(int)
        right, bottom = np.maximum(axis.max(axis=0) + thickness, 0.0).astype(int)
        near = ridge.strength[top:bottom, left:right]
        if not near.size:
            return
        zone = np.zeros_like(near)
        at = np.round((axis - (left, top)) * 16.0).astype(np.int32)
        cv2.polylines(zone, [at], False, 255, thickness, cv2.LINE_8, 4)
        floor = ridge.noise if ridge.signed else 0.0
        near[(zone > 0) & (near < floor + shade)] = floor
