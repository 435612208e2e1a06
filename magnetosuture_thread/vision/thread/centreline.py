"""Follows the thread's centreline: a walk along its dark ridge that starts at the needle's tail."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.geometry.polyline import Points, arc_lengths
from magnetosuture_thread.vision.images import RIM_PX, Gray, Layer, Picture, Wall, glare_mask, middle, without_wall
from magnetosuture_thread.vision.needle.arc import MeasuredNeedle
from magnetosuture_thread.vision.needle.template import BLOOM_PX, BLUR_PX, STEEPNESS, TAPER, THIN
from magnetosuture_thread.vision.scene_mask import SceneMask
from magnetosuture_thread.vision.thread.crossings import Crossing, resolve_crossings
from magnetosuture_thread.vision.thread.walk import Ridge, black_hat, follow, refine, worth

WALL_PX = 4.0  # before which the walk ends
AT_WALL_PX = 40.0  # from the wall, where its rim may look like the thread's beginning
SHADE_PX = 10.0  # beside a needle, where its shadow lies
BESIDE_PX = 2.0 * BLUR_PX  # of the drawn outline, up to which light of the needle is mixed in


@dataclass(frozen=True)
class Walk:
    """A walk along a ridge.

    Attributes:
        points: vertices in pixels of the picture, shape (m, 2); m = 1 if no thread leaves the tail.
        shown: how much thread they show [px].
        ridge: that was followed.
        path: the walk in the ridge's pixels; see `walk_on`.
        strong: whether the thread is visible at each vertex of the path.
        crossings: where it could have gone on along another strand.
    """

    points: Points
    shown: float
    ridge: Ridge
    path: NDArray[np.float64]
    strong: NDArray[np.bool_]
    crossings: tuple[Crossing, ...] = ()

    @property
    def certain_points(self) -> Points:
        """The vertices up to the first crossing where it is in doubt how the thread goes on."""
        for crossing in self.crossings:
            if crossing.confidence < 0.9:
                at = arc_lengths(self.points)
                share = self.path[min(crossing.first, len(self.path) - 1), 5] / self.path[-1, 5]
                return self.points[: max(2, int(np.searchsorted(at, share * at[-1])))]
        return self.points


def find_centreline(picture: Picture, gray: Gray, needle: MeasuredNeedle, max_length: float, wall: Wall) -> Points:
    """Follow the thread from the needle's tail to its end.

    The ridge strength is the black-hat transform of the darkest colour without the needle: how much darker a pixel is
    than the brightest background within a few pixels. The walk leaves the tail along the arc that shows most of the
    thread, below the needle where it must, and goes by steps along arcs that look some way ahead, a change of curvature
    having a price: so it goes straight over gaps. At crossings the smoothest of all pairings of the strands that meet
    decides. Where the needle or the lamp's reflection hides the thread, nothing counts for or against a way. A thread
    wider than the transform's window is followed at half the size.

    Args:
        picture: the frame or a part of it.
        gray: its darkest colour without the needle.
        needle: the needle, in the picture's pixels.
        max_length: the walk stops at this length [px].
        wall: of the dish, before which the walk stops.

    Returns:
        Vertices from the tail on, up to the first crossing where it is in doubt how the thread goes on, shape (m, 2)
        [px]; m = 1 if no thread is visible.
    """
    search = _Search(picture, gray, needle, max_length, wall)
    return search.resolved(search.best_walk()).certain_points


class _Search:
    """Walks along one frame's ridges from the needle's tail on; see `find_centreline`."""

    def __init__(self, picture: Picture, gray: Gray, needle: MeasuredNeedle, max_length: float, wall: Wall) -> None:
        self._picture, self._gray, self._needle = picture, gray, needle
        self._max_length, self._wall = max_length, wall
        self._reach = wall.radius - WALL_PX
        self._at_wall = bool(np.hypot(*(needle.tail_px - wall.centre)) > self._reach - AT_WALL_PX)
        self._hidden = glare_mask(picture)
        _cover_needle(self._hidden, picture.factor, needle)

    def best_walk(self) -> Walk:
        """Return the walk along the black-hat at full size, or at half of it where that shows more."""
        gray, enough = self._gray, 0.85 * self._max_length  # so much thread needs no other search
        if self._at_wall:  # else the walk would leave along the rim
            wall = Wall(self._wall.centre, self._wall.radius - RIM_PX)
            picture = self._picture
            gray = without_wall(picture.darkest, gray, picture.factor, wall, self._needle.tail_px, AT_WALL_PX)
        thin = self._walked(black_hat(gray, self._hidden, 1))
        strength = float(np.median(thin.path[1:, 4])) if len(thin.path) > 1 else 0.0
        # Grey levels, and a share of the length, of a thread that is dark beyond doubt.
        is_strong = strength > 25.0 and thin.shown > 0.068 * self._max_length  # the rest may be covered
        if thin.shown > enough or is_strong or self._at_wall:  # The rim is wide.
            return thin
        wide = self._walked(black_hat(gray, self._hidden, 2))
        return wide if wide.shown > max(1.3 * thin.shown, 0.5 * enough) else thin

    def resolved(self, walk: Walk) -> Walk:
        """Return a walk that takes the most probable way at its crossings; see `resolve_crossings`."""
        ridge, count = walk.ridge, len(walk.path)
        if count < 4:
            return walk
        path, strong = self._buffers(ridge)
        path[:count], strong[:count] = walk.path, walk.strong
        max_length = self._max_length / ridge.scale
        count, crossings = resolve_crossings(ridge, self._dish(ridge), max_length, path, strong, count)
        if count == len(walk.path) and np.array_equal(path[:count], walk.path):
            return replace(walk, crossings=crossings)
        found = self._ended(ridge, path, strong, count, float(worth(path, strong, count)))
        return replace(found, crossings=tuple(each for each in crossings if each.first < len(found.path)))

    def _walked(self, ridge: Ridge) -> Walk:
        """Walk along a ridge, from which the needle's shadow is taken."""
        self._clear_shade(ridge)
        scale, needle = ridge.scale, self._needle
        path, strong = self._buffers(ridge)
        path[0] = 0.0  # all that there is where nothing leaves the tail
        tail, direction = (needle.tail_px - 0.5 * (scale - 1)) / scale, needle.direction_px
        start = np.array([tail[0], tail[1], math.atan2(direction[1], direction[0])])
        max_hidden = (needle.length_px + 12.0) / scale  # by the needle and what is next to it
        lengths = self._max_length / scale, max_hidden
        count, shown = follow(ridge, start, self._dish(ridge), *lengths, self._at_wall, path, strong)
        return self._ended(ridge, path, strong, count, shown)

    def _buffers(self, ridge: Ridge) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Return room for a path along a ridge; see `walk_on`."""
        max_steps = int(self._max_length / ridge.scale) + 16  # steps are longer than a pixel
        return np.empty((max_steps, 6)), np.empty(max_steps, np.bool_)

    def _dish(self, ridge: Ridge) -> tuple[float, float, float]:
        """Return the dish's centre and how far from it a walk may go, in a ridge's pixels."""
        u, v = (np.array(self._wall.centre) - 0.5 * (ridge.scale - 1)) / ridge.scale
        return float(u), float(v), self._reach / ridge.scale

    def _ended(
        self, ridge: Ridge, path: NDArray[np.float64], strong: NDArray[np.bool_], count: int, shown: float
    ) -> Walk:
        """Return the walk along a path up to where it shows the thread."""
        scale, shift = ridge.scale, 0.5 * (ridge.scale - 1)
        points, kept = path[:count, :2].copy(), count
        if self._picture.mask is not None:
            full = cv2.resize(ridge.strength, None, fx=scale, fy=scale) if scale > 1 else ridge.strength
            above = cv2.subtract(full, ridge.noise)
            at = points * scale + shift
            kept = count_off_outline(at, above, self._picture.mask, ridge.faintest)
        shown = max(0.0, shown - (path[count - 1, 5] - path[kept - 1, 5]))
        points = points[:kept]
        refine(ridge, points, strong[:kept])
        points = points * scale + shift
        return Walk(points, shown * scale, ridge, path[:kept].copy(), strong[:kept].copy())

    def _clear_shade(self, ridge: Ridge) -> None:
        """Take what is no stronger than the needle's shadow out of a ridge beside the needle."""
        # A shadow has 12 % of steel's darkness.
        shade = 0.12 * self._needle.contrast * middle(self._picture.darkest.floor)
        axis = self._needle.arc.at(np.linspace(SHADE_PX, self._needle.length_px, 24))
        axis = (axis - 0.5 * (ridge.scale - 1)) / ridge.scale
        thickness = round((self._needle.width_px + 2.0 * SHADE_PX) / ridge.scale)
        left, top = np.maximum(axis.min(axis=0) - thickness, 0.0).astype(int)
        right, bottom = np.maximum(axis.max(axis=0) + thickness, 0.0).astype(int)
        near = ridge.strength[top:bottom, left:right]
        if near.size:
            zone = np.zeros_like(near)
            at = np.round((axis - (left, top)) * 16.0).astype(np.int32)
            cv2.polylines(zone, [at], False, 255, thickness, cv2.LINE_8, 4)
            near[(zone > 0) & (near < shade)] = 0


def count_off_outline(points: Points, ridge: NDArray[np.uint8], mask: SceneMask, faintest: float) -> int:
    """Return how many vertices of a walk show the thread, where it may have gone on along a bare outline.

    A walk ends before it enters a shape. A ridge along an outline is the thread's or the shape's own edge. The last
    vertices along an outline count only as long as their ridge is stronger than that of the same outline away from
    the walk, or that one shows none.

    Args:
        points: vertices of the walk, shape (m, 2) [px].
        ridge: ridge strength in grey levels, uint8.
        mask: of the picture.
        faintest: a strength that is no noise.
    """
    depths = mask.depths(points)
    inside = depths > mask.tolerance_px
    if inside.any():  # Whatever was followed from here on, it is no thread.
        first = max(1, int(np.argmax(inside)))
        points, depths = points[:first], depths[:first]
    near = np.abs(depths) <= mask.band_px
    run = len(near) if near.all() else int(np.argmin(near[::-1]))
    if run < 5 or not len(mask.rim):  # vertices along an outline
        return len(points)
    rim = mask.rim[:, :2]
    last = mask.rim[np.argmin(((rim - points[-1]) ** 2).sum(axis=1)), 2]
    rim = rim[mask.rim[:, 2] == last]
    apart = ((rim[:, None] - points[None, ::3]) ** 2).sum(axis=2).min(axis=1)
    rows, columns = ridge.shape
    reach = int(mask.band_px) + 1
    bare = (apart > (2.0 * mask.band_px) ** 2) & (rim.min(axis=1) > reach)
    bare &= (rim < (columns - 1 - reach, rows - 1 - reach)).all(axis=1)
    if bare.sum() < 8:
        return len(points)
    usual = middle(_strongest(ridge, rim[bare], reach))
    if usual < faintest:
        return len(points)
    # The thread ends where the sum of what speaks for it and against it is greatest: single strong pixels count little.
    surplus = np.cumsum(np.minimum(_strongest(ridge, points[-run:], 1) / (1.3 * usual) - 1.0, 0.5))
    shown = int(np.argmax(surplus)) + 1 if surplus.max() > 0.0 else 0
    return max(1, len(points) - run + shown)


def _strongest(ridge: NDArray[np.uint8], points: Points, reach: int) -> NDArray[np.uint8]:
    """Return the strongest ridge in a square around each point, shape (m,)."""
    step = np.arange(-reach, reach + 1)
    at = np.round(points).astype(np.intp)
    rows = np.clip(at[:, 1, None] + step, 0, ridge.shape[0] - 1)
    columns = np.clip(at[:, 0, None] + step, 0, ridge.shape[1] - 1)
    return np.asarray(ridge[rows[:, :, None], columns[:, None, :]].max(axis=(1, 2)), dtype=np.uint8)


def _cover_needle(hidden: Gray, factor: int, needle: MeasuredNeedle) -> None:
    """Mark where a needle hides the thread, in a mask `factor` times smaller than the picture.

    At the tail the mask begins 1.5 px inside of the needle, so that the walk can leave.
    """
    axis = needle.arc.at(np.linspace(1.5, needle.length_px + 3.0, 24))
    small = np.round((axis - 0.5 * (factor - 1)) / factor * 16.0).astype(np.int32)
    cv2.polylines(hidden, [small], False, 255, max(1, round((needle.width_px + 3.0) / factor)), cv2.LINE_8, 4)


def without_needle(channel: Layer, factor: int, needle: MeasuredNeedle) -> Gray:
    """Return a channel's pixels in which a needle has the floor's brightness.

        I' = min(I + F c share, F)

    with the floor F, the needle's contrast c, and the share of each pixel that a drawn needle covers.

    Args:
        channel: of the picture.
        factor: how much smaller its floor is.
        needle: in the picture's pixels.
    """
    half, length = 0.5 * needle.width_px + BLOOM_PX, needle.length_px
    outline = needle.arc.at(np.linspace(0.0, length, 24))
    breadth, (rows, columns) = math.ceil(half + BESIDE_PX + 1.0), channel.pixels.shape
    left, top = np.maximum(outline.min(axis=0) - breadth, 0.0).astype(int)
    right, bottom = np.minimum(outline.max(axis=0) + breadth + 1.0, (columns, rows)).astype(int)
    near = np.zeros((max(0, bottom - top), max(0, right - left)), np.uint8)
    at = [np.round((outline - (left, top)) * 16.0).astype(np.int32)]
    cv2.polylines(near, at, False, 255, 2 * breadth, cv2.LINE_8, 4)
    v, u = np.nonzero(near)
    v, u = v + top, u + left
    s, d = needle.arc.coordinates(np.column_stack([u, v]).astype(float))
    own = half * (1.0 - (1.0 - THIN) * np.clip((s - (1.0 - TAPER) * length) / (TAPER * length), 0.0, 1.0))
    share = (_edge(own - d) - _edge(-own - d)) * _edge(s) * _edge(length - s)
    share[share <= 0.01] = 0.0
    ground = channel.floor[
        np.minimum(v // factor, len(channel.floor) - 1), np.minimum(u // factor, channel.floor.shape[1] - 1)
    ]
    result = channel.pixels.copy()
    own_light = result[v, u]
    result[v, u] = np.maximum(
        own_light, np.minimum(own_light + ground * needle.contrast * share, ground).astype(np.uint8)
    )
    return result


def _edge(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return how much of a blurred edge is covered at distances inside of it; see `template`."""
    return np.asarray(1.0 / (1.0 + np.exp(-STEEPNESS * x)))
