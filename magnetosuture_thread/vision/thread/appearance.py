"""What a thread looks like across: its width and darkness, where it is visible, and how well its middle is known."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.compiled import compiled
from magnetosuture_thread.geometry.polyline import Points, arc_lengths, points_at
from magnetosuture_thread.vision.images import Picture
from magnetosuture_thread.vision.needle.arc import MeasuredNeedle
from magnetosuture_thread.vision.sampling import middle, within

REACH_PX, STEP_PX = 16.0, 0.5  # of profiles: to both sides, and between samples
BESIDE_PX = 2.5  # from a thread's edge to the floor beside it
MIN_SHARE = 0.3  # of the usual darkness: below, the thread isn't visible
FAINTEST = 3.0  # grey levels; less is noise
SMOOTHED_PX, LOCAL_PX = 9.0, 4.0  # along the thread, over which its darkness and its middle are averaged
MIN_DEVIATION_PX = 0.12  # of a middle: by pixels, compression, and the evening out of bends
BEND = 0.004  # 1 / px; standard deviation of the curvature of a thread that isn't visible
SPACING_PX = 2.0  # of a line's vertices
GAP_PX, OBJECT_GAP_PX = 13.0, 6.0  # a piece has no gap longer than this, and below an object none longer than that
NEEDLE_PX = 2.5  # beside and beyond the needle, where its blurred edge and what is next to it hide a thread

Values = NDArray[np.float64]
Flags = NDArray[np.bool_]
Gray = NDArray[np.uint8]


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
        variance = noise**2 * 2.0 * spread / (LOCAL_PX * math.sqrt(math.pi)) + uneven**2 + MIN_DEVIATION_PX**2
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
    along = np.gradient(points, axis=0)
    return np.asarray(along / np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9))


def across(points: Points, aside: Values) -> Points:
    """Return points at distances aside of the vertices of a polyline, shape (m, n, 2)."""
    along = tangents_of(points)
    normals = np.column_stack([-along[:, 1], along[:, 0]])
    return np.asarray(points[:, None] + aside[None, :, None] * normals[:, None])


def sampled(image: NDArray[Any], points: Points) -> NDArray[np.float32]:
    """Return an image at points of shape (..., 2), bilinear; outside, at the nearest point of its border."""
    return sampled_colours(image, points)[..., 0]


def sampled_colours(image: NDArray[Any], points: Points) -> NDArray[np.float32]:
    """Return each colour of an image at points of shape (..., 2), shape (..., colours); see `sampled`."""
    at = np.asarray(points.reshape(len(points), -1, 2), dtype=np.float32)  # no side of it longer than OpenCV can count
    u, v = np.ascontiguousarray(at[..., 0]), np.ascontiguousarray(at[..., 1])
    values = cv2.remap(image, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(values, dtype=np.float32).reshape(*points.shape[:-1], -1)


def runs(flags: Flags) -> list[tuple[int, int]]:
    """Return first index and the one after the last of each run of true flags."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(np.int8)))
    return [(int(first), int(last)) for first, last in edges.reshape(-1, 2)]


def respaced(points: Points, spacing: float) -> Points:
    """Return a polyline with vertices of about equal distance."""
    length = float(arc_lengths(points)[-1])
    return points_at(points, np.linspace(0.0, length, max(2, round(length / spacing) + 1)))


def appearance_of(picture: Picture, gray: Gray, points: Points, visible: Flags) -> Appearance:
    """Measure how a thread looks.

    Args:
        picture: the frame or a part of it.
        gray: its darkest colour without the needle, smoothed.
        points: along the thread, shape (m, 2) [px].
        visible: where it is visible for sure, shape (m,), or nowhere for all of it.
    """
    shown = np.flatnonzero(visible) if visible.sum() >= 8 else np.arange(len(points))
    shown = shown[:: max(1, len(shown) // 32)].copy()  # Compiled code is compiled anew for a view.
    aside = np.arange(-REACH_PX, REACH_PX + 1e-9, STEP_PX)
    profiles = _profiles(gray, points, aside, shown)
    floors = np.median(profiles[:, np.abs(aside) > 0.5 * REACH_PX], axis=1)
    usual = -np.median(profiles - floors[:, None], axis=0)
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
    raw = np.rint(_profiles(picture.darkest.pixels, points, floor, shown))  # Between pixels there is less noise.
    noise = 1.4826 * middle(np.abs(np.diff(raw, axis=1))) / math.sqrt(2.0)
    half = 0.5 * width + BESIDE_PX
    darkness = np.array([np.median(each) for each in _integrals(picture, points[shown], half)])
    return Appearance(width, darkness, max(float(usual[peak]), FAINTEST), max(noise, 0.5))


def _profiles(image: Gray, points: Points, aside: Values, chosen: NDArray[np.intp]) -> Values:
    """Return an image across some vertices of a polyline, shape (vertices, distances)."""
    profiles = np.empty((len(chosen), len(aside)))
    sample_across(image, points, chosen, aside, profiles)
    return profiles


def _integrals(picture: Picture, points: Points, half: float) -> Values:
    """Return the integrals of `integrate_across` at each vertex, in the darkest and the brightest colour, (2, m)."""
    values = np.empty((2, len(points)))
    for layer, own in zip((picture.darkest, picture.brightest), values, strict=True):
        integrate_across(layer.pixels, points, half, STEP_PX, own)
    return values


def looks_alike(picture: Picture, thread: Appearance, points: Points, slack: float) -> bool:
    """Say whether a line is as dark across in both colours as a thread, up to a share and the noise."""
    for values, darkness in zip(_integrals(picture, points, thread.beside_px), thread.darkness, strict=True):
        usual = float(np.median(values))
        noise = 1.4826 * middle(np.abs(values - usual)) / math.sqrt(max(1.0, len(values) / SMOOTHED_PX))
        if abs(usual - darkness) > slack * float(thread.darkness.max()) + 2.0 * noise:
            return False
    return True


def strengths(gray: Gray, points: Points, thread: Appearance, *, two_sided: bool = False) -> Values:
    """Return how much darker a line's middle is than the floor on the side where it differs more.

    With `two_sided`, where it differs less: next to another strand nothing then, but nothing along an edge either.
    """
    values = np.empty(len(points))
    middle_strengths(gray, points, thread.beside_px, two_sided, values)
    return values


def strand_along(gray: Gray, thread: Appearance, points: Points, below: Flags | None = None) -> Strand:
    """Return a line with where the thread is visible; it is not where `below` is true."""
    strength = strengths(gray, points, thread)
    shown = strength > max(FAINTEST, MIN_SHARE * thread.strength)
    return Strand(points, strength, shown if below is None else shown & ~below)


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
    along, aside = needle.arc.coordinates(walk)
    near = (along > -NEEDLE_PX) & (along < needle.length_px + NEEDLE_PX)
    near &= np.abs(aside) < 0.5 * needle.width_px + 2.0 * NEEDLE_PX
    return len(near) if near.all() else max(1, int(np.argmin(near)))


def below_needle(needle: MeasuredNeedle, points: Points) -> Flags:
    """Return which points the needle hides, with its blurred edge."""
    along, aside = needle.arc.coordinates(points)
    inside = (along > 1.0) & (along < needle.length_px + NEEDLE_PX)
    return np.asarray(inside & (np.abs(aside) < 0.5 * needle.width_px + 1.0))


@compiled
def _normal(points, index):
    """Return the unit normal of a polyline at a vertex, by the two vertices beside it."""
    before, after = max(0, index - 1), min(len(points) - 1, index + 1)
    x, y = points[after, 0] - points[before, 0], points[after, 1] - points[before, 1]
    length = max(math.hypot(x, y), 1e-9)
    return -y / length, x / length


@compiled
def sample_across(image, points, chosen, aside, profiles):
    """Fill in an image at distances aside of some vertices of a polyline, bilinear; see `within`.

    Args:
        image: shape (rows, columns).
        points: of the polyline, shape (m, 2) [px].
        chosen: numbers of the vertices, shape (k,).
        aside: distances, positive to the right of the way along it as v goes down, shape (n,) [px].
        profiles: filled, shape (k, n).
    """
    for row in range(len(chosen)):
        index = chosen[row]
        x, y = _normal(points, index)
        for place in range(len(aside)):
            u, v = points[index, 0] + aside[place] * x, points[index, 1] + aside[place] * y
            profiles[row, place] = within(image, u, v)


@compiled
def integrate_across(pixels, points, half, step, values):
    """Fill in the integral across of the share that a thread takes of the floor's light [px].

    Args:
        pixels: shape (rows, columns), uint8.
        points: of a polyline, shape (m, 2) [px].
        half: distance up to which is integrated [px].
        step: between samples [px].
        values: filled, shape (m,).
    """
    count = int(2.0 * half / step + 1e-9) + 1
    profile = np.empty(count)
    for index in range(len(points)):
        x, y = _normal(points, index)
        total = 0.0
        for place in range(count):
            aside = place * step - half
            profile[place] = within(pixels, points[index, 0] + aside * x, points[index, 1] + aside * y)
            total += profile[place]
        ground = max(0.25 * (profile[0] + profile[1] + profile[count - 2] + profile[count - 1]), 1.0)
        values[index] = step * (count - total / ground)


@compiled
def middle_strengths(gray, points, reach, two_sided, values):
    """Fill in how much darker the middle of a line is than what is a distance beside it.

    Args:
        gray: shape (rows, columns), uint8.
        points: of the line, shape (m, 2) [px].
        reach: the distance [px].
        two_sided: whether the side counts that differs less.
        values: filled, shape (m,) [grey levels].
    """
    for index in range(len(points)):
        x, y = _normal(points, index)
        u, v = points[index, 0], points[index, 1]
        one = within(gray, u - reach * x, v - reach * y)
        other = within(gray, u + reach * x, v + reach * y)
        darkest = np.inf
        for place in range(-2, 3):
            aside = 0.5 * place
            darkest = min(darkest, within(gray, u + aside * x, v + aside * y))
        values[index] = (min(one, other) if two_sided else max(one, other)) - darkest
