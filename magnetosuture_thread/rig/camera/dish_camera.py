"""The simulated overhead camera: draws the dish, the needle and the thread as a lens would see them.

Everything here is simulated. The look was set beside sample frames: a double dark rim, glare arcs and
hot spots, dust, soft shadows, a tapered steel needle, a thread about one pixel wide, sensor noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.geometry.camera import DishView
from magnetosuture_thread.geometry.needle_arc import needle_axis
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.rig.camera.coverage import Box, Light, blurred, box_around, covered, lay, line_covered
from magnetosuture_thread.rig.camera.scene import CameraScene, Lighting
from magnetosuture_thread.rig.camera.still_life import StillLife

Image = NDArray[np.uint8]

STEEL_BGR = (52.0, 48.0, 44.0)
GLEAM_BGR = (88.0, 84.0, 78.0)
LAMP = (-0.5, 0.86)  # direction towards the lamp, in the dish frame
SHADOW = np.convolve(cv2.getGaussianKernel(25, 3.0, cv2.CV_32F).ravel(), (0.5, 0.5)).astype(np.float32)
SHADOW_BEGIN_PX = (-10, -9)  # shifted by 2.5 and 3.5 px, less 12.5 of the blur
MENISCUS = 1.3  # a floating thread looks wider, by the liquid's edge along it
NOISE_FIELDS = 12
NOISE_LEVEL = 1.6  # of white light of level 90, before the sensor's interpolation spreads it
REACH_PX = 24.0  # of shadows and blur around what moves


@dataclass(frozen=True)
class Cover:
    """Something between the dish and the camera.

    Attributes:
        outline: closed, shape (m, 2) [m].
        bgr: its colour.
        blur_px: its edge is out of focus by this.
        opacity: 1 hides what is below; glare has less at its edge by its blur.
    """

    outline: Points
    bgr: tuple[float, float, float]
    blur_px: float = 1.5
    opacity: float = 1.0


def encode_jpeg(image: Image, quality: int) -> NDArray[np.uint8]:
    """Return a BGR image as the bytes of a JPEG file, shape (bytes,); quality from 1 to 100."""
    done, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not done:
        raise ValueError(f"an image of shape {image.shape} cannot be encoded")
    return np.asarray(data, dtype=np.uint8).ravel()


class DishCamera:
    """Renders frames of a scene.

    What stands still is drawn and exposed once, with several fields of noise; a frame takes one of these
    pictures and draws the region of what moves anew. There the field is shifted, each colour by itself, to where it was
    never used: as of a sensor, no two frames are equal, also of a needle at rest.

    Args:
        scene: what stands before the camera.
        view: where the dish is in the image.
        size: width and height of the image [px].
        seed: of the dust, the smears and the sensor noise; the same seed gives the same frames.
        lighting: light, lens and sensor.
        noise_fields: drawn once; a frame takes one of them.
    """

    def __init__(
        self,
        scene: CameraScene,
        view: DishView,
        size: tuple[int, int] = (640, 480),
        seed: int = 0,
        lighting: Lighting | None = None,
        noise_fields: int = NOISE_FIELDS,
    ) -> None:
        self._scene = scene
        self.view = view
        self.size = size
        self._lighting = lighting or Lighting()
        self._random = np.random.default_rng(seed)
        self._background = StillLife(scene, self._lighting, view, size, self._random).draw()
        self._still = self._through_lens(self._background)
        self._noise = [self._noise_field() for _ in range(noise_fields)]
        self._exposed = [self._expose(self._still, noise, 1.0) for noise in self._noise]
        self._shifts, self._shifting = np.zeros((noise_fields, 3, 2), np.int64), np.random.default_rng(seed)

    def render(
        self, tail: Points, heading: float, thread: Points, covers: tuple[Cover, ...] = (), gain: float = 1.0
    ) -> Image:
        """Draw one frame.

        Args:
            tail: the needle's blunt end, shape (2,) [m].
            heading: angle of the needle at its tail against the x axis [rad].
            thread: centreline from the tail on, shape (m, 2) [m].
            covers: what is between dish and camera in this frame.
            gain: of this frame's exposure, beside the lighting's.

        Returns:
            BGR image, shape (height, width, 3).
        """
        outline = self._needle_outline(tail, heading)
        line = self.view.to_pixels(thread)
        edges = [self.view.to_pixels(cover.outline) for cover in covers]
        box = box_around(np.vstack([outline, line, *edges]), self.size, REACH_PX)
        chosen = int(self._random.integers(len(self._noise)))
        noise = self._noise[chosen]
        image = self._exposed[chosen].copy() if gain == 1.0 else self._expose(self._still, noise, gain)
        if box is not None:
            region = self._background[box].copy()
            self._add_strand_and_needle(region, box, line, outline, tail, heading)
            for cover, edge in zip(covers, edges, strict=True):
                self._add_cover(region, box, cover, edge)
            image[box] = self._expose(self._through_lens(region), self._noise_in(box, chosen), gain)
        return image

    def _add_strand_and_needle(
        self, region: Light, box: Box, line: Points, outline: Points, tail: Points, heading: float
    ) -> None:
        scene, scale = self._scene, self.view.metres_per_pixel
        strand = line_covered(box, line, MENISCUS * scene.thread_diameter / scale)
        shade = np.float32(0.35) * strand
        near = box_around(outline, self.size, REACH_PX)
        needle = None
        if near is not None:
            needle = covered(near, lambda canvas, at: cv2.fillPoly(canvas, [at(outline)], 255, cv2.LINE_8, 4))
            inside = _within(near, box)
            np.maximum(shade[inside], needle, out=shade[inside])
        lay(region, blurred(shade, SHADOW, *SHADOW_BEGIN_PX), 0.16, (0.0, 0.0, 0.0))
        lay(region, strand, 1.0, scene.thread_bgr)
        if near is not None and needle is not None:
            lay(region[inside], needle, 1.0, STEEL_BGR)
            lay(
                region[inside], line_covered(near, self.view.to_pixels(self._gleam(tail, heading)), 1.0), 1.0, GLEAM_BGR
            )

    def _add_cover(self, region: Light, box: Box, cover: Cover, edge: Points) -> None:
        hidden = covered(box, lambda canvas, at: cv2.fillPoly(canvas, [at(edge)], 255, cv2.LINE_8, 4))
        lay(region, cv2.GaussianBlur(hidden, (0, 0), cover.blur_px), cover.opacity, cover.bgr)

    def _needle_outline(self, tail: Points, heading: float) -> Points:
        """Return the needle's outline in pixels: a body of one width, the last fifth tapering to a fine point."""
        at = np.concatenate([np.linspace(0.0, 0.8, 17), np.linspace(0.84, 1.0, 5)])
        half = 0.5 * self._scene.needle_width * np.interp(at, [0.8, 1.0], [1.0, 0.12])
        points, along = needle_axis(tail, heading, self._scene.needle_length, self._scene.needle_curvature, at)
        aside = half[:, None] * np.column_stack([-along[:, 1], along[:, 0]])
        return self.view.to_pixels(np.vstack([points - aside, (points + aside)[::-1]]))

    def _gleam(self, tail: Points, heading: float) -> Points:
        """Return the line along which the body reflects the lamp: on the side that faces it."""
        scene = self._scene
        at = np.linspace(0.07, 0.77, 15)
        points, along = needle_axis(tail, heading, scene.needle_length, scene.needle_curvature, at)
        aside = np.column_stack([-along[:, 1], along[:, 0]])
        return np.asarray(points + 0.22 * scene.needle_width * np.tanh(2.0 * aside @ LAMP)[:, None] * aside)

    def _through_lens(self, light: Light) -> Light:
        return np.asarray(cv2.GaussianBlur(light, (0, 0), self._lighting.blur_px), dtype=np.float32)

    def _noise_field(self) -> Light:
        """Return noise for white light of level 1; the sensor's colour interpolation spreads it a little."""
        width, height = self.size
        noise = self._random.standard_normal((height, width, 3), dtype=np.float32)
        level = np.float32(self._lighting.noise * NOISE_LEVEL / np.sqrt(90.0))
        return np.asarray(cv2.GaussianBlur(noise, (0, 0), 0.55) * level, dtype=np.float32)

    def _noise_in(self, box: Box, chosen: int) -> Light:
        """Return a field's noise in a region, shifted as at no use before; fields go on beyond their borders."""
        field, noise = self._noise[chosen], []
        for colour, shift in enumerate(self._shifts[chosen]):
            rows, columns = (np.arange(part.start, part.stop) + by for part, by in zip(box, shift, strict=True))
            noise.append(field[:, :, colour].take(rows, axis=0, mode="wrap").take(columns, axis=1, mode="wrap"))
        self._shifts[chosen] = self._shifting.integers(field.shape[:2], size=(3, 2))
        return np.dstack(noise)

    def _expose(self, light: Light, noise: Light, gain: float) -> Image:
        """Expose the sensor, add its noise, which grows with the root of the light, and round to 8 bits."""
        light = light * np.float32(gain * self._lighting.gain)
        return np.asarray(cv2.add(light, cv2.multiply(cv2.sqrt(light), noise), dtype=cv2.CV_8U), dtype=np.uint8)


def _within(inner: Box, outer: Box) -> Box:
    """Return a box in the coordinates of one that holds it."""
    rows, columns = (slice(i.start - o.start, i.stop - o.start) for i, o in zip(inner, outer, strict=True))
    return rows, columns
