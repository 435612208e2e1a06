"""Draws what does not move before the simulated camera: table, dish, rim, obstacles, glare, dust."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from magnetosuture_thread.geometry.camera import DishView
from magnetosuture_thread.geometry.obstacles import Disc, Obstacle
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.rig.camera.coverage import Box, Light, box_around, covered
from magnetosuture_thread.rig.camera.scene import SILICONE, CameraScene, Lighting, Look

# Beyond the radius, width [m]; depth. The inner edge is where independently rendered frames of a dish have it.
RIM_DEPTHS = ((0.199e-3, 0.21e-3, 145.0), (0.98e-3, 0.18e-3, 100.0))
DROP_SHADOW_PX = np.array([3.0, 4.0])
LAMP_PX = (-0.5, -0.86)  # direction towards the lamp, in the image
GLARE_ARCS = ((0.78, 102.0, 156.0, 9.0), (0.81, -40.0, -17.0, 7.0))  # share of the radius; angles [deg]; width [px]


class StillLife:
    """Draws the background once.

    Args:
        scene: what stands there.
        lighting: the light on it.
        view: where the dish is in the image.
        size: width and height of the image [px].
        random: of smears, hot spots and dust.
    """

    def __init__(
        self, scene: CameraScene, lighting: Lighting, view: DishView, size: tuple[int, int], random: np.random.Generator
    ) -> None:
        self._scene = scene
        self._lighting = lighting
        self._view = view
        self._size = size
        self._random = random

    def draw(self) -> Light:
        """Return the light that falls on the sensor before lens and exposure, shape (rows, columns, 3)."""
        width, height = self._size
        view, lighting = self._view, self._lighting
        u, v = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
        scale = view.metres_per_pixel
        radius = np.float32(0.5 * self._scene.dish_diameter)
        away = np.hypot(u - view.centre_px[0], v - view.centre_px[1]).astype(np.float32) * np.float32(scale)
        slope = (lighting.slope * (u / width + v / height - 1.0)).astype(np.float32)
        table = 176.0 - 10.0 * slope + self._smear(12.0, 80.0)
        floor = 222.0 - 9.0 * slope + self._smear(6.0, 50.0) + self._smear(2.5, 9.0)
        floor -= 16.0 * np.clip((away / radius - 0.75) / 0.25, 0.0, 1.0) ** 2
        cast = np.hypot(u - view.centre_px[0] - 5.0, v - view.centre_px[1] - 6.0).astype(np.float32) * np.float32(scale)
        shade = 0.15 - 0.15 * np.tanh((cast - radius - 1.6e-3) / (10.0 * scale))  # of the wall on the table
        table *= 1.0 - shade * (0.5 + 0.5 * np.tanh((away - radius - 1.1e-3) / (2.0 * scale)))
        inside = 0.5 - 0.5 * np.tanh((away - radius - 0.25e-3) / (0.8 * scale))
        light = table * (1.0 - inside) + floor * inside
        for beyond, spread, depth in RIM_DEPTHS:
            light -= depth * np.exp(-(((away - radius - beyond) / spread) ** 2))
        light += 22.0 * np.exp(-(((away - radius - 0.6e-3) / 0.15e-3) ** 2))
        image = np.asarray(light[:, :, None] * np.asarray(lighting.tint_bgr, dtype=np.float32), dtype=np.float32)
        looks = self._scene.looks or [SILICONE] * len(self._scene.obstacles)
        for obstacle, look in zip(self._scene.obstacles, looks, strict=True):
            self._add_obstacle(image, obstacle, look)
        self._add_glare(image)
        self._add_dust(image)
        return np.asarray(np.clip(image, 0.0, 258.0, out=image), dtype=np.float32)

    def _smear(self, depth: float, size: float) -> Light:
        """Return smooth random light of a given depth and feature size [px]."""
        width, height = self._size
        rough = self._random.standard_normal((height // 4 + 1, width // 4 + 1), dtype=np.float32)
        smooth = cv2.GaussianBlur(rough, (0, 0), size / 4.0)
        smooth *= np.float32(0.5 * depth) / np.float32(max(float(smooth.std()), 1e-9))
        return np.asarray(cv2.resize(smooth, self._size, interpolation=cv2.INTER_CUBIC), dtype=np.float32)

    def _add_obstacle(self, image: Light, obstacle: Obstacle, look: Look) -> None:
        """Add a solid: a soft shadow, its top, a highlight on a disc."""
        rings = [self._view.to_pixels(ring) for ring in still_outlines(obstacle)]
        corners = np.vstack(rings)
        box = box_around(corners, self._size, margin=24.0)
        if box is None:
            return
        region = image[box]

        def solid(of: Sequence[Points]) -> Light:
            return covered(box, lambda canvas, to: cv2.fillPoly(canvas, [to(r) for r in of], 255, cv2.LINE_8, 4))

        shade = cv2.GaussianBlur(solid([ring + DROP_SHADOW_PX for ring in rings]), (0, 0), 4.0)
        region *= 1.0 - 0.2 * shade[:, :, None]
        top = solid(rings)
        colour = self._surface(top, look) + (self._smear(look.mottle, 9.0)[box][:, :, None] if look.mottle else 0.0)
        region += top[:, :, None] * (colour - region)
        if isinstance(obstacle, Disc):
            radius = obstacle.radius / self._view.metres_per_pixel
            small = self._view.to_pixels(np.asarray(obstacle.centre)) - 0.35 * radius
            ring = small + 0.25 * radius * circle(128)
            shine = cv2.GaussianBlur(solid([ring]), (0, 0), 0.15 * radius + 0.5)
            region += shine[:, :, None] * 40.0

    def _surface(self, top: Light, look: Look) -> Light:
        """Return the colour of a solid's top, rounded at its outline, shape (rows, columns, 3) or for all (3,)."""
        colour = np.asarray(look.bgr, dtype=np.float32)
        if not look.rounding:
            return colour
        reach = np.float32(look.rounding / self._view.metres_per_pixel)
        inwards = cv2.distanceTransform((top > 0.5).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
        level = np.minimum(inwards / reach, 1.0)
        height = cv2.GaussianBlur(np.sqrt(level * (2.0 - level)).astype(np.float32), (0, 0), 0.25 * float(reach) + 0.5)
        slope = np.stack(
            [cv2.Sobel(height, cv2.CV_32F, 1, 0, scale=0.125), cv2.Sobel(height, cv2.CV_32F, 0, 1, scale=0.125)]
        )
        lit = -np.float32(look.relief) * reach * np.tensordot(np.asarray(LAMP_PX, np.float32), slope, axes=1)
        edge = np.asarray(look.edge_bgr, dtype=np.float32)
        return np.asarray(edge + height[:, :, None] * (colour - edge) + lit[:, :, None], dtype=np.float32)

    def _add_glare(self, image: Light) -> None:
        """Add two arcs of the lamp's reflection along the wall, and small hot spots."""
        radius = 0.5 * self._scene.dish_diameter / self._view.metres_per_pixel
        centre = np.asarray(self._view.centre_px)
        glare = np.zeros(image.shape[:2], np.float32)
        for share, first, last, thickness in GLARE_ARCS:
            angles = np.radians(np.arange(first, last, 0.5))
            parts = (np.degrees(angles) - first) / (last - first)
            sizes = np.maximum(np.rint(thickness * np.sin(np.pi * parts)), 1.0).astype(int) // 2
            dots = centre + share * radius * np.column_stack([np.cos(angles), -np.sin(angles)])
            box, arc, on_canvas = self._canvas(dots)
            for dot, size in zip(on_canvas, sizes.tolist(), strict=True):
                cv2.circle(arc, dot, size, 1.0, -1)
            np.maximum(glare[box], cv2.GaussianBlur(arc, (0, 0), 2.2), out=glare[box])
        for _ in range(3):
            angle, share = self._random.uniform(0.0, 2.0 * np.pi), self._random.uniform(0.2, 0.75)
            axes = (int(self._random.integers(2, 5)), int(self._random.integers(2, 4)))
            box, spot, (at,) = self._canvas(centre + share * radius * np.array([[np.cos(angle), np.sin(angle)]]))
            cv2.ellipse(spot, at, axes, 0.0, 0.0, 360.0, 1.0, -1)
            np.maximum(glare[box], cv2.GaussianBlur(spot, (0, 0), 1.2), out=glare[box])
        lit = glare > 0.0
        image[lit] += self._lighting.glare * np.minimum(glare[lit], 1.0)[:, None] * (265.0 - image[lit])

    def _add_dust(self, image: Light) -> None:
        """Add faint specks and rings."""
        width, height = self._size
        for _ in range(14):
            centre = [self._random.integers(0, width), self._random.integers(0, height)]
            size, thickness = (3, 1) if self._random.random() < 0.3 else (1, -1)
            depth = float(self._random.uniform(4.0, 16.0))
            box, speck, (at,) = self._canvas(np.array([centre]))
            cv2.circle(speck, at, size, 1.0, thickness)
            image[box] -= depth * cv2.GaussianBlur(speck, (0, 0), 0.9)[:, :, None]

    def _canvas(self, centres: Points) -> tuple[Box, Light, list[tuple[int, int]]]:
        """Return the part of the image that something small and its blur may reach, and a canvas with its centres.

        Args:
            centres: of what is drawn, shape (m, 2) [px]; with a radius of 5 px at most, and a blur of 2.2.
        """
        margin, last = 24.0, np.array(self._size) - 1  # 5 px, and twice the 9 px that the blur reaches
        left, top = np.clip(np.floor(centres.min(axis=0) - margin), 0.0, last).astype(int).tolist()
        right, bottom = np.clip(np.ceil(centres.max(axis=0) + margin), 0.0, last).astype(int).tolist()
        at = np.rint(centres).astype(int) - (left, top)
        box = slice(top, bottom + 1), slice(left, right + 1)
        return box, np.zeros((bottom + 1 - top, right + 1 - left), np.float32), [(x, y) for x, y in at.tolist()]


def circle(corners: int) -> Points:
    """Return a unit circle as a polygon, shape (corners, 2)."""
    angles = np.linspace(0.0, 2.0 * np.pi, corners, endpoint=False)
    return np.column_stack([np.cos(angles), np.sin(angles)])


def still_outlines(obstacle: Obstacle) -> list[Points]:
    """Return an obstacle's outline and those of its holes in the plane, each of shape (m, 2) [m]."""
    if isinstance(obstacle, Disc):
        return [np.asarray(obstacle.centre) + obstacle.radius * circle(256)]
    return obstacle.rings
