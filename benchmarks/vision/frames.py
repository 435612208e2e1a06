"""Rendered frames: what the rig's camera draws, and what is drawn over its picture."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.geometry.camera import DishView
from magnetosuture_thread.geometry.needle_arc import needle_axis
from magnetosuture_thread.geometry.polyline import Points, arc_lengths, points_at
from magnetosuture_thread.rig.camera import (
    GLEAM_BGR,
    MENISCUS,
    STEEL_BGR,
    CameraScene,
    Cover,
    DishCamera,
    Lighting,
    encode_jpeg,
)
from magnetosuture_thread.vision.lens import Lens

Image = NDArray[np.uint8]
Finish = Callable[[Image, DishView], Image]

DISH_RADIUS = 0.0175  # m
ROWS, SCALE = 480, 8e-5  # of the usual image: rows, and metres of a pixel
CAMERA_DISTANCE = 0.25  # m; from the dish to a camera that is tilted
NOWHERE = np.array([0.5, 0.5])  # m; far outside of the image
SHARP_PX = 0.3  # blur of what lies in focus
OPEN_STEP = 0.25  # of a pixel of the usual image, between points of the ground truth


@dataclass(frozen=True)
class Needle:
    """A needle, with its ground truth in the dish frame.

    Attributes:
        tail: its blunt end, shape (2,) [m].
        heading: angle of its tangent there, towards the tip [rad].
        curvature: of its axis, positive to the left [1/m].
        length: along the axis [m].
        width: of the body [m].
    """

    tail: Points
    heading: float
    curvature: float = 0.0
    length: float = 0.007
    width: float = 0.0004

    def axis(self, at: NDArray[np.float64]) -> tuple[Points, Points]:
        """Return points and tangents at shares of the length; see `needle_axis`."""
        return needle_axis(self.tail, self.heading, self.length, self.curvature, at)

    def distances(self, points: Points) -> NDArray[np.float64]:
        """Return how far points are from the axis, shape (m,) [m]."""
        axis, _ = self.axis(np.linspace(0.0, 1.0, 60))
        return np.asarray(np.linalg.norm(points[:, None] - axis[None], axis=2).min(axis=1))


@dataclass(frozen=True, eq=False)
class Case:
    """What one frame shows.

    Attributes:
        needle: the needle to find.
        thread: its centreline from the tail on, shape (m, 2) [m].
        size: width and height of the image [px].
        shift: of the dish's centre from the image's [px].
        thread_px: how wide the thread looks [px].
        thread_bgr: its colour.
        lighting: light, lens and sensor.
        gain: of the exposure, beside the lighting's.
        thread_over: whether the thread lies over the needle.
        rod: whether both ends of the needle are blunt.
        beside: other needles.
        hidden_by: what hides needle and thread.
        finish: what is done to the picture, one after the other.
        quality: of the JPEG that the frame is sent as.
        length_error: share by which the tracker is told another length of the needle.
        lens: that the tracker is told of; None if it is not.
        labels: further facts, for a person.
    """

    needle: Needle
    thread: Points
    size: tuple[int, int] = (640, 480)
    shift: tuple[float, float] = (0.0, 0.0)
    thread_px: float = 0.975
    thread_bgr: tuple[float, float, float] = (132.0, 78.0, 100.0)
    lighting: Lighting = field(default_factory=Lighting)
    gain: float = 1.0
    thread_over: bool = False
    rod: bool = False
    beside: tuple[Needle, ...] = ()
    hidden_by: tuple[Cover, ...] = ()
    finish: tuple[Finish, ...] = ()
    quality: int = 92
    length_error: float = 0.0
    lens: Lens | None = None
    labels: dict[str, Any] = field(default_factory=dict)

    @property
    def view(self) -> DishView:
        """Where the dish is in the image, before tilt and distortion."""
        (width, height), (u, v) = self.size, self.shift
        return DishView((0.5 * width + u, 0.5 * height + v), SCALE * ROWS / height)

    @property
    def working_scale(self) -> float:
        """Metres of a pixel of the image, or of one of 640 columns if it has more [m]."""
        return self.view.metres_per_pixel * max(1.0, self.size[0] / 640.0)

    def visible_thread(self) -> Points:
        """Return points close together on all of the thread that nothing hides, shape (m, 2) [m]."""
        points = dense(self.thread)
        seen = self.thread_over | (self.needle.distances(points) > 0.5 * self.needle.width)
        for other in self.beside:
            seen &= other.distances(points) > 0.5 * other.width
        for cover in self.hidden_by:
            outline = (cover.outline * 1e6).astype(np.float32)
            seen &= np.array([cv2.pointPolygonTest(outline, (float(x), float(y)), False) < 0 for x, y in points * 1e6])
        u, v = self.view.to_pixels(points).T
        seen &= (u > 0.0) & (v > 0.0) & (u < self.size[0] - 1.0) & (v < self.size[1] - 1.0)
        return np.asarray(points[seen])


def dense(line: Points) -> Points:
    """Return points along a line, closer together than anything that is measured [m]."""
    length = float(arc_lengths(line)[-1])
    return points_at(line, np.linspace(0.0, length, max(2, round(length / (OPEN_STEP * SCALE)))))


def render(case: Case, seed: int) -> Image:
    """Draw a frame: BGR, shape (height, width, 3)."""
    view, needle = case.view, case.needle
    scale = view.metres_per_pixel
    scene = CameraScene(
        dish_diameter=2.0 * DISH_RADIUS,
        needle_length=needle.length,
        needle_width=needle.width,
        needle_curvature=needle.curvature,
        thread_diameter=case.thread_px * scale / MENISCUS,
        thread_bgr=case.thread_bgr,
    )
    camera = DishCamera(scene, view, case.size, seed, case.lighting, noise_fields=1)
    covers = [drawn for other in case.beside for drawn in drawn_needle(other)]
    if case.rod:
        covers += drawn_needle(needle, blunt=True)
    if case.thread_over:
        covers.append(drawn_thread(case.thread, case.thread_px * scale, case.thread_bgr))
    covers += case.hidden_by
    tail = NOWHERE if case.rod else needle.tail
    image = camera.render(tail, needle.heading, case.thread, tuple(covers), case.gain)
    for finish in case.finish:
        image = finish(image, view)
    return np.asarray(cv2.imdecode(encode_jpeg(image, case.quality), cv2.IMREAD_COLOR), dtype=np.uint8)


def drawn_needle(needle: Needle, *, blunt: bool = False) -> list[Cover]:
    """Return what draws a needle of which the camera knows nothing: its body, and the light along it."""
    at = np.concatenate([np.linspace(0.0, 0.8, 17), np.linspace(0.84, 1.0, 5)])
    points, along = needle.axis(at)
    aside = np.column_stack([-along[:, 1], along[:, 0]])
    half = 0.5 * needle.width * np.interp(at, [0.8, 1.0], [1.0, 1.0 if blunt else 0.12])[:, None]
    body = np.vstack([points - half * aside, (points + half * aside)[::-1]])
    points, aside = points[1:16], aside[1:16]
    gleam = np.vstack([points + 0.3 * half[:15] * aside, (points + 0.6 * half[:15] * aside)[::-1]])
    return [Cover(body, STEEL_BGR, SHARP_PX), Cover(gleam, GLEAM_BGR, SHARP_PX)]


def drawn_thread(thread: Points, width: float, bgr: tuple[float, float, float]) -> Cover:
    """Return what draws a thread over a needle."""
    line = dense(thread)[::4]
    along = np.gradient(line, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    aside = 0.5 * width * np.column_stack([-along[:, 1], along[:, 0]])
    return Cover(np.vstack([line - aside, (line + aside)[::-1]]), bgr, SHARP_PX)


def tilted(angle: float, about: float) -> Finish:
    """Return what turns the camera about the dish's centre.

    A point (x, y) of the dish is seen at u = u_0 + f X / Z, v = v_0 - f Y / Z with (X, Y, Z) = R (x, y, 0) + (0, 0, d).

    Args:
        angle: between the camera's axis and the dish's normal [rad].
        about: direction in the dish of the axis that it turns about [rad].
    """

    def finish(image: Image, view: DishView) -> Image:
        axis = angle * np.array([math.cos(about), math.sin(about), 0.0])
        turned = cv2.Rodrigues(axis)[0]
        pose = np.column_stack([turned[:, :2], [0.0, 0.0, CAMERA_DISTANCE]])
        u, v = view.centre_px
        focal = CAMERA_DISTANCE / view.metres_per_pixel
        seen = np.array([[focal, 0.0, u], [0.0, -focal, v], [0.0, 0.0, 1.0]]) @ pose
        inverse = 1.0 / view.metres_per_pixel
        straight = np.array([[inverse, 0.0, u], [0.0, -inverse, v], [0.0, 0.0, 1.0]])
        return _warped(image, seen @ np.linalg.inv(straight))

    return finish


def _warped(image: Image, homography: NDArray[np.float64]) -> Image:
    size = image.shape[1::-1]
    done = cv2.warpPerspective(image, homography, size, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(done, dtype=np.uint8)


def distorted(strength: float) -> Finish:
    """Return a lens that moves a point at a share r of the image's half diagonal to r (1 + strength r^2)."""

    def finish(image: Image, view: DishView) -> Image:
        rows, columns = image.shape[:2]
        middle, half = np.array([0.5 * columns, 0.5 * rows], np.float32), 0.5 * math.hypot(rows, columns)
        v, u = np.indices((rows, columns), dtype=np.float32)
        offsets = np.stack([u, v], axis=-1) - middle
        seen = np.linalg.norm(offsets, axis=2) / half
        true = seen.copy()
        for _ in range(8):
            true = seen / (1.0 + strength * true**2)
        at = (middle + offsets * (true / np.maximum(seen, 1e-6))[:, :, None]).astype(np.float32)
        done = cv2.remap(image, at, None, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(done, dtype=np.uint8)

    return finish


def lens_with(strength: float, size: tuple[int, int]) -> Lens:
    """Return the lens of `distorted`, with an arbitrary focal length f: k_1 = strength (f / half diagonal)^2."""
    width, height = size
    focal = 2.0 * height
    k1 = strength * (focal / (0.5 * math.hypot(width, height))) ** 2
    matrix = (focal, 0.0, 0.5 * width, 0.0, focal, 0.5 * height, 0.0, 0.0, 1.0)
    return Lens(size, "plumb_bob", (k1, 0.0, 0.0, 0.0, 0.0), matrix)


def dark_field(image: Image, view: DishView) -> Image:
    """Return the picture with light from the side: needle, thread and rim are bright on a dark floor."""
    return np.asarray(cv2.convertScaleAbs(255 - image, alpha=1.1, beta=4.0), dtype=np.uint8)
