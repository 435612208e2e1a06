"""What a thread and what hides it look like: width and darkness across a thread, and areas that are not the floor.

The floor's light is a smooth function of the place, fitted robustly to each colour c,

    F_c(x, y) = sum_i a_ci b_i(x, y),    b = 1, x, y, x^2, x y, y^2, r^4, r^8

with x, y and r as shares of the dish's radius. With q_c = I_c / F_c - 1, where slender things are taken out of I by a
median, a pixel shows no floor where the mean of q_c, or the greatest less the least of them, is larger than noise and
smears of the liquid explain. Brighter areas show the lamp, others an object; a thread may lie below both.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import reduce

import cv2
import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.geometry.polyline import Points, arc_lengths, points_at
from magnetosuture_thread.vision.arc import MeasuredNeedle
from magnetosuture_thread.vision.images import Gray, Picture, Wall, glare_mask, median, middle, runs, sample_across

REACH_PX, STEP_PX = 16.0, 0.5  # of profiles: to both sides, and between samples
BESIDE_PX = 2.5  # from a thread's edge to the floor beside it
MIN_SHARE = 0.3  # of the usual darkness: below, the thread isn't visible
FAINTEST = 3.0  # grey levels; less is noise
SMOOTHED_PX = 9.0  # along the thread, over which its darkness is averaged; its middle over 4 px
MIN_DEVIATION_PX = 0.12  # of a middle: by pixels, compression, and the evening out of bends
BEND = 0.004  # 1 / px; standard deviation of the curvature of a thread that isn't visible
SPACING_PX = 2.0  # of a line's vertices
GAP_PX, OBJECT_GAP_PX = 13.0, 6.0  # a piece has no gap longer than this, and below an object none longer than that
NEEDLE_PX = 2.5  # beside and beyond the needle, where its blurred edge and what is next to it hide a thread
SHRUNK = 3  # how much smaller the image is in which objects are looked for
WALL_PX = 6.0  # before which nothing is told

Values = NDArray[np.float64]
Flags = NDArray[np.bool_]


@dataclass(frozen=True)
class Appearance:
    """How a thread looks in a picture.

    Attributes:
        width_px: where it is half as dark as in its middle [px].
        darkness: integral across it of its share of the floor's light, in the darkest and in the brightest colour,
            shape (2,) [px].
        strength: how much darker its middle is than the floor beside it [grey levels].
        noise: standard deviation of a pixel [grey levels].
    """

    width_px: float
    darkness: Values
    strength: float
    noise: float

    @property
    def beside_px(self) -> float:
        """Distance from its middle to the floor beside it [px]."""
        return 0.5 * self.width_px + BESIDE_PX

    def deviation(self, strength: Values) -> Values:
        """Return the standard deviation of its middle, where it is as strong as given [px].

        sigma^2 = n^2 / (A^2 l sqrt(pi) / (2 s)) + (g w / (2 A))^2 + sigma_0^2

        for a Gaussian profile of height A, width w and standard deviation s = w / 2.355 in noise n for each pixel,
        averaged over a length l of the thread (Cramer-Rao bound); light that differs by g = 1 grey level on its two
        sides, as by its shadow; and `MIN_DEVIATION_PX`.
        """
        spread = self.width_px / 2.355
        height = np.maximum(strength, FAINTEST)
        noise, uneven = self.noise / height, 0.5 * self.width_px / height
        variance = noise**2 * 2.0 * spread / (4.0 * math.sqrt(math.pi)) + uneven**2 + MIN_DEVIATION_PX**2
        return np.asarray(np.sqrt(variance))


@dataclass(frozen=True)
class Strand:
    """A line along a thread.

    Attributes:
        points: its vertices, shape (m, 2) [px].
        strength: how much darker each is than the floor beside it, shape (m,) [grey levels].
        visible: where the thread is visible, shape (m,).
    """

    points: Points
    strength: Values
    visible: Flags

    def turned(self) -> Strand:
        """Return it from its other end."""
        return Strand(self.points[::-1], self.strength[::-1], self.visible[::-1])

    def part(self, first: int, last: int) -> Strand:
        """Return the vertices from one to before another."""
        return Strand(self.points[first:last], self.strength[first:last], self.visible[first:last])


def tangents_of(points: Points) -> Points:
    """Return unit tangents at the vertices of a polyline, shape (m, 2)."""
    along = np.empty_like(points)
    along[1:-1] = points[2:] - points[:-2]
    along[0], along[-1] = points[1] - points[0], points[-1] - points[-2]
    return np.asarray(along / np.maximum(np.hypot(along[:, 0], along[:, 1]), 1e-9)[:, None])


def profiles(gray: Gray, points: Points, aside: Values, tangents: Points | None = None) -> Values:
    """Return an image at distances aside of the vertices of a polyline, shape (m, n).

    Args:
        gray: shape (rows, columns), uint8.
        points: the vertices, shape (m, 2) [px].
        aside: from u towards v, shape (n,) [px].
        tangents: of the polyline at them; None to take them from the vertices.
    """
    values = np.empty((len(points), len(aside)))
    sample_across(gray, points, tangents_of(points) if tangents is None else tangents, aside, values)
    return values


def respaced(points: Points, spacing: float) -> Points:
    """Return a polyline with vertices of about equal distance."""
    length = float(arc_lengths(points)[-1])
    steps = max(1, round(length / spacing))
    return points_at(points, np.asarray(length / steps * np.arange(steps + 1), np.float64))


def appearance_of(picture: Picture, gray: Gray, points: Points, visible: Flags) -> Appearance:
    """Measure how a thread looks.

    Args:
        picture: the frame or a part of it.
        gray: its darkest colour without the needle, smoothed.
        points: along the thread, shape (m, 2) [px].
        visible: where it is visible for sure, shape (m,), or nowhere for all of it.
    """
    shown = np.flatnonzero(visible) if visible.sum() >= 8 else np.arange(len(points))
    shown = shown[:: max(1, len(shown) // 32)]
    tangents, points = tangents_of(points)[shown], points[shown]
    aside = np.arange(-REACH_PX, REACH_PX + 1e-9, STEP_PX)
    values = profiles(gray, points, aside, tangents)
    floors = median(values[:, np.abs(aside) > 0.5 * REACH_PX])
    usual = -median(values - floors[:, None], axis=0)
    centre = len(aside) // 2
    peak = centre - 2 + int(np.argmax(usual[centre - 2 : centre + 3]))
    left = right = peak
    while left > 0 and usual[left - 1] > 0.5 * usual[peak]:
        left -= 1
    while right < len(aside) - 1 and usual[right + 1] > 0.5 * usual[peak]:
        right += 1
    width = STEP_PX * (right - left + 1)
    floor = aside[:: round(1.0 / STEP_PX)]
    floor = floor[np.abs(floor) > 0.5 * width + 3.0]
    raw = np.rint(profiles(picture.darkest.pixels, points, floor, tangents))  # Between pixels there is less noise.
    noise = 1.4826 * middle(np.abs(np.diff(raw, axis=1))) / math.sqrt(2.0)
    half = 0.5 * width + BESIDE_PX
    darkness = median(_integrals(picture, points, half))
    return Appearance(width, darkness, max(float(usual[peak]), FAINTEST), max(noise, 0.5))


def _integrals(picture: Picture, points: Points, half: float) -> Values:
    """Return the integrals across of the share that a thread takes of the floor's light, shape (2, m) [px].

    Args:
        picture: whose darkest and brightest colour are measured.
        points: of a polyline, shape (m, 2) [px].
        half: distance up to which is integrated [px].
    """
    aside, tangents = np.arange(-half, half + 1e-9, STEP_PX), tangents_of(points)
    layers = (picture.darkest, picture.brightest)
    light = np.stack([profiles(layer.pixels, points, aside, tangents) for layer in layers])
    ground = np.maximum(light[..., [0, 1, -2, -1]].mean(axis=-1, keepdims=True), 1.0)
    return np.asarray(STEP_PX * (1.0 - light / ground).sum(axis=-1))


def looks_alike(picture: Picture, thread: Appearance, points: Points, slack: float) -> bool:
    """Say whether a line is as dark across in both colours as a thread, up to a share and the noise."""
    for values, darkness in zip(_integrals(picture, points, thread.beside_px), thread.darkness, strict=True):
        usual = float(median(values))
        noise = 1.4826 * middle(np.abs(values - usual)) / math.sqrt(max(1.0, len(values) / SMOOTHED_PX))
        if abs(usual - darkness) > slack * float(thread.darkness.max()) + 2.0 * noise:
            return False
    return True


def strand_along(gray: Gray, thread: Appearance, points: Points) -> tuple[Strand, Flags]:
    """Return a line with where the thread is visible on one side at least, and where it is on both.

    The strength is how much darker the line's middle is than the floor on the side where it differs more. Where it
    differs less there is nothing next to another strand, but nothing along an edge either.
    """
    reach = thread.beside_px
    values = profiles(gray, points, np.array([-reach, reach, -1.0, -0.5, 0.0, 0.5, 1.0]))
    beside = values[:, :2] - values[:, 2:].min(axis=1)[:, None]
    shown = beside > max(FAINTEST, MIN_SHARE * thread.strength)
    return Strand(points, beside.max(axis=1), shown.any(axis=1)), shown.all(axis=1)


def deviations(thread: Appearance, strand: Strand) -> Values:
    """Return the standard deviation across at each vertex [px].

    Where a thread isn't visible over a gap of length g, its middle at a distance t from the gap's beginning is off by
    1/2 kappa t (g - t) for a curvature that differs by kappa from that of the curve through it; see `BEND`.
    """
    at = arc_lengths(strand.points)
    values = np.where(strand.visible, strand.strength, 0.0)
    width = min(len(values), max(1, round(SMOOTHED_PX / max(at[-1] / max(1, len(at) - 1), 1e-6))))
    count = np.convolve(np.ones_like(values), np.ones(width), "same")
    result = thread.deviation(np.asarray(np.convolve(values, np.ones(width), "same") / count))
    for first, last in runs(~strand.visible):
        begin, end = at[max(0, first - 1)], at[min(len(at) - 1, last)]
        off = 0.5 * BEND * (at[first:last] - begin) * (end - at[first:last])
        result[first:last] = np.hypot(MIN_DEVIATION_PX, off)
    return np.asarray(result)


def gaps_of(shown: Flags, max_gap: float, begin: int) -> Flags:
    """Return where a walk isn't visible for more than a length [px], in gaps that begin at a vertex or later."""
    gone = np.zeros_like(shown)
    for first, last in runs(~shown):
        gone[first:last] = first >= begin and last < len(shown) and (last - first) * SPACING_PX > max_gap
    return gone


def parts_without(line: Strand, gone: Flags) -> list[Strand]:
    """Return what is left of a walk, the part that leaves the needle first."""
    return [line.part(first, last) for first, last in runs(~gone) if last - first > 1]


def first_clear_of(needle: MeasuredNeedle, walk: Points) -> int:
    """Return the first vertex of a walk that lies clear of the needle."""
    near = needle.near(walk, NEEDLE_PX, NEEDLE_PX, 0.5 * needle.width_px + 2.0 * NEEDLE_PX)
    return len(near) if near.all() else max(1, int(np.argmin(near)))


def below_needle(needle: MeasuredNeedle, points: Points) -> Flags:
    """Return which points the needle hides, with its blurred edge."""
    return needle.near(points, -1.0, NEEDLE_PX, 0.5 * needle.width_px + 1.0)


@dataclass(frozen=True)
class Hiding:
    """Areas of a picture where a thread can't be seen.

    Attributes:
        solid: 255 there, shape (rows, columns), uint8.
        areas: number of the connected area at each pixel, 0 for bare floor, shape (rows, columns), int32.
        inside: whether a pixel is farther than `WALL_PX` from the wall, shape (rows, columns).
        wall: of the dish; beyond it, less `WALL_PX`, nothing is told.
    """

    solid: Gray
    areas: NDArray[np.int32]
    inside: NDArray[np.bool_]
    wall: Wall

    def area_at(self, point: Points) -> int:
        """Return the number of the area at a point, 0 on bare floor, -1 outside of the picture or at the wall."""
        rows, columns = self.areas.shape
        u, v = round(float(point[0])), round(float(point[1]))
        if not (0 <= u < columns and 0 <= v < rows):
            return -1
        if math.dist((u, v), self.wall.centre) > self.wall.radius - WALL_PX:
            return -1
        return int(self.areas[v, u])

    def outlines(self) -> list[Points]:
        """Return the outlines of the largest areas, each of shape (m, 2) [px]."""
        found, _ = cv2.findContours(self.solid, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
        found = sorted(found, key=cv2.contourArea, reverse=True)[:64]
        simple = [cv2.approxPolyDP(outline, 1.0, True)[:, 0].astype(float) for outline in found]
        return [outline for outline in simple if len(outline) > 2]


def find_hiding(picture: Picture, needle: MeasuredNeedle) -> Hiding:
    """Find what may hide a thread in a picture; the needle is in its pixels."""
    wall = picture.wall
    solid = cv2.morphologyEx(glare_mask(picture), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    inside = wall.inside(picture.shape, WALL_PX)
    cv2.bitwise_and(solid, inside, solid)
    cv2.bitwise_or(solid, _objects(picture, 1e-6 / picture.view.metres_per_pixel**2), solid)  # m^2
    if picture.mask is not None:
        cv2.bitwise_or(solid, cv2.compare(picture.mask.depth, -picture.mask.tolerance_px, cv2.CMP_GT), solid)
    box, covered = needle.area(picture.shape, 0.0, needle.length_px + NEEDLE_PX, needle.width_px + 2.0 * NEEDLE_PX)
    solid[box][covered] = 255
    _, areas = cv2.connectedComponents(solid, connectivity=8, ltype=cv2.CV_32S)
    return Hiding(solid, np.asarray(areas, dtype=np.int32), inside > 0, wall)


def _objects(picture: Picture, min_area: float) -> Gray:
    """Return where objects of at least an area [px^2] are, 255 there."""
    rows, columns = picture.shape
    size = (-(-columns // SHRUNK), -(-rows // SHRUNK))
    small = cv2.resize(picture.image, size, interpolation=cv2.INTER_AREA)
    small = cv2.medianBlur(small, 5)  # wider than twice a needle, narrower than an object
    cells = (max(4, columns // 8), max(4, rows // 8))  # to whose means the light is fitted
    wall = picture.wall
    near = Wall(wall.centre, wall.radius - WALL_PX)
    places = _places(cells, picture.shape, near)
    means = np.atleast_3d(cv2.resize(small, cells, interpolation=cv2.INTER_AREA)).reshape(len(places), -1)
    inside = np.hypot(places[:, 1], places[:, 2]) < 1.0
    if inside.sum() < 4 * places.shape[1]:
        return np.zeros((rows, columns), np.uint8)
    some = np.zeros(cells[::-1], np.bool_)
    some[::2, ::2] = True  # far more than enough for so few weights
    fitted = inside & some.ravel()
    light = np.maximum(places @ _fit_light(places[fitted], means[fitted].astype(float)), 1.0)
    ratios = np.ascontiguousarray((means[inside] / light[inside] - 1.0).T)  # numpy is slow along a short last axis
    # An object differs from the floor's light by 5 % in brightness, or by 3 % in colour.
    bounds = _bound(ratios.mean(axis=0), 0.05), _bound(np.ptp(ratios, axis=0), 0.03)
    light = light.reshape(cells[1], cells[0], -1).astype(np.float32)
    at_small = cv2.resize(light, size).reshape(size[1], size[0], -1)
    v, u = SHRUNK * np.arange(size[1])[:, None] - wall.centre[1], SHRUNK * np.arange(size[0]) - wall.centre[0]
    # Colour by colour: numpy is slow along a short last axis.
    unlike = [one / other - 1.0 for one, other in zip(cv2.split(small), cv2.split(at_small), strict=True)]
    apart = reduce(np.maximum, unlike) - reduce(np.minimum, unlike)
    found = (np.abs(sum(unlike)) > bounds[0] * len(unlike)) | (apart > bounds[1])
    found &= u * u + v * v < near.radius**2
    opened = cv2.morphologyEx(found.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    _, labels, stats, _ = cv2.connectedComponentsWithStats(opened, connectivity=8)
    large = stats[:, cv2.CC_STAT_AREA] * SHRUNK**2 >= min_area
    large[0] = False
    objects = cv2.resize(np.where(large, 255, 0).astype(np.uint8)[labels], (columns, rows))
    objects = cv2.dilate(objects, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (3, 3)))
    return np.asarray(cv2.compare(objects, 127, cv2.CMP_GT))


def _places(size: tuple[int, int], shape: tuple[int, int], wall: Wall) -> NDArray[np.float64]:
    """Return the functions that the floor's light is a sum of at each cell of a grid, shape (cells, 8)."""
    (columns, rows), (height, width) = size, shape
    u = ((np.arange(columns) + 0.5) * width / columns - 0.5 - wall.centre[0]) / wall.radius
    v = ((np.arange(rows) + 0.5) * height / rows - 0.5 - wall.centre[1]) / wall.radius
    x, y = (values.ravel() for values in np.meshgrid(u, v))
    far = np.minimum(x * x + y * y, 1.2) ** 2
    return np.column_stack([np.ones_like(x), x, y, x * x, x * y, y * y, far, far * far])


def _fit_light(basis: NDArray[np.float64], values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return for each colour the weights of a sum of functions near most values: least squares, Tukey's biweight.

    Args:
        basis: the functions, shape (cells, functions).
        values: of the colours, shape (cells, colours) [grey levels].

    Returns:
        Weights, shape (functions, colours).
    """
    weights = np.zeros((basis.shape[1], values.shape[1]))
    for colour, light in enumerate(values.T):
        own = np.zeros(basis.shape[1])
        own[0] = median(light)
        for _ in range(8):
            residuals = light - basis @ own
            bound = 4.0 * max(0.5, 1.4826 * float(median(np.abs(residuals))))
            weighted = np.maximum(1.0 - (residuals / bound) ** 2, 0.0)[:, None] ** 2 * basis
            before = own
            own = np.linalg.solve(weighted.T @ basis + 1e-6 * np.eye(len(own)), weighted.T @ light)
            if np.abs(own - before).max() < 0.1:  # grey levels
                break
        weights[:, colour] = own
    return weights


def _bound(values: NDArray[np.float64], minimum: float) -> float:
    """Return beyond what a value is not the floor's, by the spread of those of cells."""
    usual = middle(values)
    return max(minimum, abs(usual) + 3.5 * 1.4826 * middle(np.abs(values - usual)))
