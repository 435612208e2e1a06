"""What a thread looks like across: its width and darkness, where it is visible, and how well its middle is known."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.geometry.polyline import Points, arc_lengths, points_at
from magnetosuture_thread.vision.images import Picture
from magnetosuture_thread.vision.sampling import middle
from magnetosuture_thread.vision.thread.profiles import (
    integrate_across,
    middle_strengths,
    sample_across,
    usual_profile,
)

REACH_PX, STEP_PX = 16.0, 0.5  # of profiles: to both sides, and between samples
BESIDE_PX = 2.5  # from a thread's edge to the floor beside it
MIN_SHARE = 0.3  # of the usual darkness: below, the thread isn't visible
FAINTEST = 3.0  # grey levels; less is noise
SURE_STRENGTH = 2.0 * FAINTEST  # grey levels; of a fainter thread noise hides single points
FAINT_SHARE = 0.4  # of its usual strength, that it shows in the mean where it is visible
SMOOTHED_PX = 9.0  # along the thread, over which its darkness is averaged
LOCAL_PX = 4.0  # along the thread, over which its middle is averaged
UNEVEN = 1.0  # grey levels, by which light on a thread's two sides differs
MIN_DEVIATION_PX = 0.12  # of a middle: by pixels, compression, and the evening out of bends
MIN_POINTS, ENOUGH_POINTS = 8, 32  # of a thread, that its look is measured on
BEND = 0.004  # 1 / px; standard deviation of the curvature of a thread that isn't visible

Values = NDArray[np.float64]


@dataclass(frozen=True)
class Appearance:
    """How a thread looks in a picture.

    Attributes:
        pale: whether it is brighter than the floor.
        width_px: where it is half as dark as in its middle [px].
        darkness: integral across it of its share of the floor's light in the darkest and in the brightest colour,
            positive for a pale one too, shape (2,) [px].
        strength: how much darker, or brighter, its middle is than the floor beside it [grey levels].
        noise: standard deviation of a pixel [grey levels].
    """

    pale: bool
    width_px: float
    darkness: Values
    strength: float
    noise: float

    @property
    def beside_px(self) -> float:
        """Return the distance from its middle to the floor beside it [px]."""
        return 0.5 * self.width_px + BESIDE_PX

    def deviation(self, strength: Values) -> Values:
        """Return the standard deviation of its middle, where it is as strong as given [px].

        sigma^2 = n^2 / (A^2 l sqrt(pi) / (2 s)) + (g w / (2 A))^2 + sigma_0^2

        for a Gaussian profile of height A, width w and standard deviation s = w / 2.355 in noise n for each pixel,
        averaged over a length l of the thread (Cramer-Rao bound); light that differs by g = `UNEVEN` on its two sides,
        as by its shadow; and `MIN_DEVIATION_PX`.
        """
        spread = self.width_px / 2.355
        height = np.maximum(strength, FAINTEST)
        noise, uneven = self.noise / height, 0.5 * UNEVEN * self.width_px / height
        variance = noise**2 * 2.0 * spread / (LOCAL_PX * math.sqrt(math.pi)) + uneven**2 + MIN_DEVIATION_PX**2
        return np.asarray(np.sqrt(variance))


def tangents_of(points: Points) -> Points:
    """Return unit tangents at the vertices of a polyline, shape (m, 2)."""
    along = np.gradient(points, axis=0)
    return np.asarray(along / np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9))


def sampled(image: NDArray[np.uint8] | NDArray[np.float32], points: Points) -> NDArray[np.float32]:
    """Return an image at points of shape (..., 2), bilinear; outside, at the nearest point of its border."""
    return sampled_colours(image, points)[..., 0]


def sampled_colours(image: NDArray[np.uint8] | NDArray[np.float32], points: Points) -> NDArray[np.float32]:
    """Return each colour of an image at points of shape (..., 2), shape (..., colours); see `sampled`."""
    at = np.asarray(points.reshape(len(points), -1, 2), dtype=np.float32)  # no side of it longer than OpenCV can count
    u, v = np.ascontiguousarray(at[..., 0]), np.ascontiguousarray(at[..., 1])
    values = cv2.remap(image, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(values, dtype=np.float32).reshape(*points.shape[:-1], -1)


def across(points: Points, aside: Values) -> Points:
    """Return points at distances aside of the vertices of a polyline, shape (m, n, 2)."""
    along = tangents_of(points)
    normals = np.column_stack([-along[:, 1], along[:, 0]])
    return np.asarray(points[:, None] + aside[None, :, None] * normals[:, None])


def appearance_of(picture: Picture, gray: NDArray[np.uint8], points: Points, visible: NDArray[np.bool_]) -> Appearance:
    """Measure how a thread looks.

    Args:
        picture: the frame or a part of it.
        gray: its darkest colour without the needle, smoothed.
        points: along the thread, shape (m, 2) [px].
        visible: where it is visible for sure, shape (m,), or nowhere for all of it.
    """
    shown = np.flatnonzero(visible) if visible.sum() >= MIN_POINTS else np.arange(len(points))
    shown = shown[:: max(1, len(shown) // ENOUGH_POINTS)].copy()  # Compiled code is compiled anew for a view.
    aside = np.arange(-REACH_PX, REACH_PX + 1e-9, STEP_PX)
    usual = np.empty(len(aside))
    usual_profile(_profiles(gray, points, aside, shown), aside, 0.5 * REACH_PX, usual)
    centre = len(aside) // 2
    near = usual[centre - 2 : centre + 3]
    pale = bool(near.max() > -near.min())
    usual = usual if pale else -usual
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
    darkness = np.array([np.median(each) for each in _integrals(picture, points[shown], half, pale)])
    return Appearance(pale, width, darkness, max(float(usual[peak]), FAINTEST), max(noise, 0.5))


def _profiles(image: NDArray[np.uint8], points: Points, aside: Values, chosen: NDArray[np.intp]) -> Values:
    """Return an image across some vertices of a polyline, shape (vertices, distances)."""
    profiles = np.empty((len(chosen), len(aside)))
    sample_across(image, points, chosen, aside, profiles)
    return profiles


def _integrals(picture: Picture, points: Points, half: float, pale: bool) -> Values:
    """Return the integrals of `integrate_across` at each vertex, in the darkest and the brightest colour, (2, m)."""
    values = np.empty((2, len(points)))
    for layer, own in zip((picture.darkest, picture.brightest), values, strict=True):
        integrate_across(layer.pixels, points, np.arange(len(points)), half, STEP_PX, pale, own)
    return values


def looks_alike(picture: Picture, thread: Appearance, points: Points, slack: float) -> bool:
    """Say whether a line is as dark across in both colours as a thread, up to a share and the noise."""
    for values, darkness in zip(
        _integrals(picture, points, thread.beside_px, thread.pale), thread.darkness, strict=True
    ):
        usual = float(np.median(values))
        noise = 1.4826 * middle(np.abs(values - usual)) / math.sqrt(max(1.0, len(values) / SMOOTHED_PX))
        if abs(usual - darkness) > slack * float(thread.darkness.max()) + 2.0 * noise:
            return False
    return True


def strengths(
    gray: NDArray[np.uint8], points: Points, thread: Appearance, *, two_sided: bool = False
) -> NDArray[np.float64]:
    """Return how much darker, or brighter, a line's middle is than the floor on the side where it differs more.

    With `two_sided`, where it differs less: next to another strand nothing then, but nothing along an edge either.
    """
    values = np.empty(len(points))
    middle_strengths(gray, points, thread.beside_px, thread.pale, two_sided, values)
    return values


def faintly_visible(gray: NDArray[np.uint8], points: Points, thread: Appearance, spacing: float) -> NDArray[np.bool_]:
    """Return where a thread is visible of which noise hides single points: by means across and along it, shape (m,)."""
    reach = thread.beside_px
    profiles = sampled(gray, across(points, np.array([-reach, -0.5, 0.0, 0.5, reach]))).astype(float)
    differs = profiles[:, 1:-1].mean(axis=1) - 0.5 * (profiles[:, 0] + profiles[:, -1])
    mean = smoothed(differs if thread.pale else -differs, spacing)
    return np.asarray(mean > FAINT_SHARE * max(0.0, float(np.median(mean))))


def smoothed(values: Values, spacing: float) -> Values:
    """Return values along a line, averaged over `SMOOTHED_PX`."""
    width = min(len(values), max(1, round(SMOOTHED_PX / max(spacing, 1e-6))))
    count = np.convolve(np.ones_like(values), np.ones(width), "same")
    return np.asarray(np.convolve(values, np.ones(width), "same") / count)


def deviations(thread: Appearance, strength: Values, visible: NDArray[np.bool_], points: Points) -> Values:
    """Return the standard deviation across at each vertex [px].

    Where a thread isn't visible over a gap of length g, its middle at a distance t from the gap's beginning is off by
    1/2 kappa t (g - t) for a curvature that differs by kappa from that of the curve through it; see `BEND`.
    """
    at = arc_lengths(points)
    result = thread.deviation(smoothed(np.where(visible, strength, 0.0), at[-1] / max(1, len(at) - 1)))
    for first, last in runs(~visible):
        begin = at[max(0, first - 1)]
        end = at[min(len(at) - 1, last)]
        off = 0.5 * BEND * (at[first:last] - begin) * (end - at[first:last])
        result[first:last] = np.hypot(MIN_DEVIATION_PX, off)
    return np.asarray(result)


def runs(flags: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return first index and the one after the last of each run of true flags."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(np.int8)))
    return [(int(first), int(last)) for first, last in edges.reshape(-1, 2)]


def respaced(points: Points, spacing: float) -> Points:
    """Return a polyline with vertices of about equal distance."""
    length = float(arc_lengths(points)[-1])
    return points_at(points, np.linspace(0.0, length, max(2, round(length / spacing) + 1)))
