"""The simulated overhead camera: draws the dish, the needle and the thread as a lens would see them.

Everything here is simulated. The look was set beside sample frames: a double dark rim, glare arcs and
hot spots, dust, soft shadows, a tapered steel needle, a thread about one pixel wide, sensor noise.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.geometry.camera import DishView
from magnetosuture_thread.geometry.obstacles import Disc
from magnetosuture_thread.geometry.polyline import Points

Image = NDArray[np.uint8]
Light = NDArray[np.float32]
ToCanvas = Callable[[Points], NDArray[np.int32]]

OVERSAMPLING = 4
RIM_DEPTHS = ((0.22e-3, 0.21e-3, 145.0), (0.98e-3, 0.18e-3, 100.0))  # beyond the radius, width [m]; depth
STEEL_BGR = (52.0, 48.0, 44.0)
GLEAM_BGR = (88.0, 84.0, 78.0)
LAMP = (-0.5, 0.86)  # direction towards the lamp, in the dish frame
POST_BGR = (168.0, 176.0, 205.0)
SHADOW_SHIFT_PX = (2.5, 3.5)
LENS_BLUR_PX = 0.75
MENISCUS = 1.3  # a floating thread looks wider, by the liquid's edge along it


@dataclass(frozen=True)
class Scene:
    """What stands before the camera, all in the dish frame [m].

    Attributes:
        dish_diameter: inner diameter of the dish.
        needle_length: length of the needle.
        needle_width: width of its body.
        thread_diameter: diameter of the thread.
        thread_bgr: the thread's colour, blue, green, red from 0 to 255.
        posts: obstacles, seen from above.
    """

    dish_diameter: float = 0.035
    needle_length: float = 0.007
    needle_width: float = 0.0004
    thread_diameter: float = 60e-6
    thread_bgr: tuple[float, float, float] = (132.0, 78.0, 100.0)
    posts: Sequence[Disc] = ()


def encode_jpeg(image: Image, quality: int) -> NDArray[np.uint8]:
    """Return a BGR image as the bytes of a JPEG file, shape (bytes,); quality from 1 to 100."""
    done, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not done:
        raise ValueError(f"an image of shape {image.shape} cannot be encoded")
    return np.asarray(data, dtype=np.uint8).ravel()


def _colour(bgr: tuple[float, float, float]) -> Light:
    return np.asarray(bgr, dtype=np.float32)


class DishCamera:
    """Renders frames of a scene.

    Args:
        scene: what stands before the camera.
        view: where the dish is in the image.
        size: width and height of the image [px].
        seed: of the dust, the smears and the sensor noise; the same seed gives the same frames.
    """

    def __init__(self, scene: Scene, view: DishView, size: tuple[int, int] = (640, 480), seed: int = 0) -> None:
        self._scene = scene
        self.view = view
        self.size = size
        self._random = np.random.default_rng(seed)
        self._background = self._still_life()

    def render(self, tail: Points, heading: float, thread: Points) -> Image:
        """Draw one frame.

        Args:
            tail: the needle's blunt end, shape (2,) [m].
            heading: angle of the needle, from tail to tip, against the x axis [rad].
            thread: centreline from the tail on, shape (m, 2) [m].

        Returns:
            BGR image, shape (height, width, 3).
        """
        outline = self._needle_outline(tail, heading)
        line = self.view.to_pixels(thread)
        light = self._background.copy()
        box = self._box(np.vstack([outline, line]), margin=24.0)
        region = light[box]
        needle = self._coverage(box, lambda canvas, at: cv2.fillPoly(canvas, [at(outline)], 255, cv2.LINE_8, 4))
        width = max(1, round(MENISCUS * self._scene.thread_diameter / self.view.metres_per_pixel * OVERSAMPLING))
        strand = self._coverage(
            box, lambda canvas, at: cv2.polylines(canvas, [at(line)], False, 255, width, cv2.LINE_8, 4)
        )
        shift = np.array([[1.0, 0.0, SHADOW_SHIFT_PX[0]], [0.0, 1.0, SHADOW_SHIFT_PX[1]]])
        shade = cv2.warpAffine(np.maximum(needle, 0.35 * strand), shift, (needle.shape[1], needle.shape[0]))
        region *= 1.0 - 0.16 * cv2.GaussianBlur(shade, (0, 0), 3.0)[:, :, None]
        region += strand[:, :, None] * (_colour(self._scene.thread_bgr) - region)
        region += needle[:, :, None] * (_colour(STEEL_BGR) - region)
        gleam = self.view.to_pixels(self._gleam(tail, heading))
        shine = self._coverage(
            box, lambda canvas, at: cv2.polylines(canvas, [at(gleam)], False, 255, OVERSAMPLING, cv2.LINE_8, 4)
        )
        region += shine[:, :, None] * (_colour(GLEAM_BGR) - region)
        return self._expose(light)

    def _needle_outline(self, tail: Points, heading: float) -> Points:
        """Return the needle's outline in pixels: a straight body, the last fifth tapering to a fine point."""
        along = np.array([np.cos(heading), np.sin(heading)])
        across = np.array([-along[1], along[0]])
        length, half = self._scene.needle_length, 0.5 * self._scene.needle_width
        body = (
            (0.0, -half),
            (0.8 * length, -half),
            (length, -0.12 * half),
            (length, 0.12 * half),
            (0.8 * length, half),
            (0.0, half),
        )
        return self.view.to_pixels(np.array([tail + a * along + b * across for a, b in body]))

    def _gleam(self, tail: Points, heading: float) -> Points:
        """Return the line along which the body reflects the lamp: on the side that faces it."""
        along = np.array([np.cos(heading), np.sin(heading)])
        across = np.array([-along[1], along[0]]) * (0.22 * self._scene.needle_width)
        side = across * np.tanh(2.0 * float(across @ LAMP) / (0.22 * self._scene.needle_width))
        reach = np.array([[0.07], [0.77]]) * self._scene.needle_length
        return np.asarray(tail + reach * along + side)

    def _box(self, points: Points, margin: float) -> tuple[slice, slice]:
        """Return the slices of rows and columns that hold points, with a margin."""
        low = np.maximum(np.floor(points.min(axis=0) - margin), 0).astype(int)
        high = np.minimum(np.ceil(points.max(axis=0) + margin), self.size).astype(int)
        low = np.minimum(low, np.array(self.size) - 1)
        high = np.maximum(high, low + 1)
        return slice(int(low[1]), int(high[1])), slice(int(low[0]), int(high[0]))

    def _coverage(self, box: tuple[slice, slice], draw: Callable[[Any, ToCanvas], Any]) -> Light:
        """Return how much of each pixel in the box a drawn shape covers, 0 to 1."""
        rows, columns = box[0].stop - box[0].start, box[1].stop - box[1].start
        canvas = np.zeros((rows * OVERSAMPLING, columns * OVERSAMPLING), np.uint8)

        def at(pixels: Points) -> NDArray[np.int32]:
            local = (pixels - (box[1].start, box[0].start) + 0.5) * OVERSAMPLING - 0.5
            return np.asarray(np.round(local * 16.0), dtype=np.int32)

        draw(canvas, at)
        small = cv2.resize(canvas, (columns, rows), interpolation=cv2.INTER_AREA)
        return np.asarray(small / np.float32(255.0), dtype=np.float32)

    def _expose(self, light: Light) -> Image:
        """Blur by the lens, add the sensor's noise, and round to 8 bits."""
        image = cv2.GaussianBlur(light, (0, 0), LENS_BLUR_PX)
        # Shot noise grows with the light; the sensor's colour interpolation spreads it a little.
        noise = self._random.standard_normal(image.shape, dtype=np.float32)
        noise = cv2.GaussianBlur(noise, (0, 0), 0.55) * np.float32(1.6)
        image += noise * np.sqrt(np.maximum(image, 0.0) / 90.0)
        return np.asarray(np.clip(np.rint(image), 0, 255), dtype=np.uint8)

    def _still_life(self) -> Light:
        """Draw all that doesn't move: table, dish, rim, posts, glare, dust."""
        width, height = self.size
        u, v = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
        scale = self.view.metres_per_pixel
        radius = np.float32(0.5 * self._scene.dish_diameter)
        distance = np.hypot(u - self.view.centre_px[0], v - self.view.centre_px[1]).astype(np.float32) * np.float32(
            scale
        )
        slope = (u / width + v / height - 1.0).astype(np.float32)
        table = 176.0 - 10.0 * slope + self._smear(12.0, 80.0)
        floor = 230.0 - 9.0 * slope + self._smear(6.0, 50.0) + self._smear(2.5, 9.0)
        floor -= 16.0 * np.clip((distance / radius - 0.75) / 0.25, 0.0, 1.0) ** 2
        inside = 0.5 - 0.5 * np.tanh((distance - radius - 0.25e-3) / (0.8 * scale))
        light = table * (1.0 - inside) + floor * inside
        for beyond, spread, depth in RIM_DEPTHS:
            light -= depth * np.exp(-(((distance - radius - beyond) / spread) ** 2))
        light += 22.0 * np.exp(-(((distance - radius - 0.6e-3) / 0.15e-3) ** 2))
        image = np.repeat(light[:, :, None], 3, axis=2) * _colour((0.955, 0.985, 1.0))
        image = image.astype(np.float32)
        for post in self._scene.posts:
            self._add_post(image, post)
        self._add_glare(image)
        self._add_dust(image)
        return np.asarray(np.clip(image, 0.0, 252.0), dtype=np.float32)

    def _smear(self, depth: float, size: float) -> Light:
        """Return smooth random light of a given depth and feature size [px]."""
        rough = self._random.standard_normal((self.size[1] // 4 + 1, self.size[0] // 4 + 1), dtype=np.float32)
        smooth = cv2.GaussianBlur(rough, (0, 0), size / 4.0)
        smooth *= np.float32(0.5 * depth) / np.float32(max(float(smooth.std()), 1e-9))
        return np.asarray(cv2.resize(smooth, self.size, interpolation=cv2.INTER_CUBIC), dtype=np.float32)

    def _add_post(self, image: Light, post: Disc) -> None:
        """Add a post of pale silicone: a soft shadow, a matt top, a highlight."""
        centre = self.view.to_pixels(np.asarray(post.centre))
        radius = post.radius / self.view.metres_per_pixel
        box = self._box(np.array([centre - radius, centre + radius]), margin=24.0)
        region = image[box]

        def disc(at: Points, size: float) -> Light:
            angles = np.linspace(0.0, 2.0 * np.pi, 256, endpoint=False)
            ring = at + size * np.column_stack([np.cos(angles), np.sin(angles)])
            return self._coverage(box, lambda canvas, to: cv2.fillPoly(canvas, [to(ring)], 255, cv2.LINE_8, 4))

        shade = cv2.GaussianBlur(disc(centre + np.array([3.0, 4.0]), radius), (0, 0), 4.0)
        region *= 1.0 - 0.2 * shade[:, :, None]
        top = disc(centre, radius)[:, :, None]
        region += top * (_colour(POST_BGR) - region)
        shine = cv2.GaussianBlur(disc(centre - 0.35 * radius, 0.25 * radius), (0, 0), 0.15 * radius + 0.5)
        region += shine[:, :, None] * 40.0

    def _add_glare(self, image: Light) -> None:
        """Add two arcs of the lamp's reflection along the wall, and small hot spots."""
        radius = 0.5 * self._scene.dish_diameter / self.view.metres_per_pixel
        centre = np.asarray(self.view.centre_px)
        glare = np.zeros(image.shape[:2], np.float32)
        for share, first, last, thickness in ((0.78, 102.0, 156.0, 7.0), (0.81, -40.0, -17.0, 5.0)):
            arc = np.zeros_like(glare)
            for angle in np.radians(np.arange(first, last, 0.5)):
                part = (np.degrees(angle) - first) / (last - first)
                size = max(1, round(thickness * np.sin(np.pi * part)))
                at = centre + share * radius * np.array([np.cos(angle), -np.sin(angle)])
                cv2.circle(arc, (round(at[0]), round(at[1])), size // 2, 1.0, -1)
            glare = np.maximum(glare, cv2.GaussianBlur(arc, (0, 0), 2.2))
        for _ in range(3):
            angle, share = self._random.uniform(0.0, 2.0 * np.pi), self._random.uniform(0.2, 0.75)
            at = centre + share * radius * np.array([np.cos(angle), np.sin(angle)])
            spot = np.zeros_like(glare)
            axes = (int(self._random.integers(2, 5)), int(self._random.integers(2, 4)))
            cv2.ellipse(spot, (round(at[0]), round(at[1])), axes, 0.0, 0.0, 360.0, 1.0, -1)
            glare = np.maximum(glare, cv2.GaussianBlur(spot, (0, 0), 1.2))
        image += np.clip(glare, 0.0, 1.0)[:, :, None] * (250.0 - image)

    def _add_dust(self, image: Light) -> None:
        """Add faint specks and rings."""
        width, height = self.size
        for _ in range(14):
            at = (int(self._random.integers(0, width)), int(self._random.integers(0, height)))
            speck = np.zeros(image.shape[:2], np.float32)
            size, thickness = (3, 1) if self._random.random() < 0.3 else (1, -1)
            cv2.circle(speck, at, size, 1.0, thickness)
            image -= float(self._random.uniform(4.0, 16.0)) * cv2.GaussianBlur(speck, (0, 0), 0.9)[:, :, None]
