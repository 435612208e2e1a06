"""The simulated overhead camera: draws the dish, the needle and the thread as a lens would see them.

Everything here is simulated. The look was set beside sample frames: a double dark rim, glare arcs and
hot spots, dust, soft shadows, a tapered steel needle, a thread about one pixel wide, sensor noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.geometry.camera import DishView
from magnetosuture_thread.geometry.compiled import compiled
from magnetosuture_thread.geometry.needle_arc import needle_axis
from magnetosuture_thread.geometry.obstacles import Disc, Obstacle
from magnetosuture_thread.geometry.polyline import Points

Image = NDArray[np.uint8]
Light = NDArray[np.float32]
Box = tuple[slice, slice]

OVERSAMPLING = 4
STEEL_BGR = (52.0, 48.0, 44.0)
GLEAM_BGR = (88.0, 84.0, 78.0)
SHADOW = np.convolve(cv2.getGaussianKernel(25, 3.0, cv2.CV_32F).ravel(), (0.5, 0.5)).astype(np.float32)
MENISCUS = 1.3  # a floating thread looks wider, by the liquid's edge along it
REACH_PX = 24.0  # of shadows and blur around what moves
SHIFTS = 64  # px by which noise is shifted at the most, along rows and columns: 64^6 ways, of three colours


@dataclass(frozen=True)
class Look:
    """The look of an obstacle. A tracker measures on green, so that soft tissue differs from the floor in the others.

    Attributes:
        bgr: its colour, blue, green, red from 0 to 255.
        edge_bgr: the colour at its outline, into which the other fades.
        rounding: how far inwards that reaches, and the edge is rounded [m].
        relief: how much brighter the rounded edge is towards the lamp, and darker away from it.
        mottle: depth of its light and dark patches.
    """

    bgr: tuple[float, float, float]
    edge_bgr: tuple[float, float, float]
    rounding: float = 0.0
    relief: float = 0.0
    mottle: float = 0.0


LOOKS = {
    "silicone": Look((168.0, 176.0, 205.0), (168.0, 176.0, 205.0)),
    "tissue": Look((196.0, 194.0, 242.0), (178.0, 184.0, 236.0), 0.7e-3, 9.0, 8.0),
    "hernia": Look((164.0, 166.0, 226.0), (150.0, 162.0, 212.0), 0.5e-3, 6.0, 4.0),
}


@dataclass(frozen=True)
class CameraScene:
    """The things before the camera, all in the dish frame [m].

    Attributes:
        dish_diameter: inner diameter of the dish.
        needle_length: length of the needle along its body.
        needle_width: width of its body.
        needle_curvature: of its arc, positive to the left of the heading [1/m].
        thread_diameter: diameter of the thread.
        thread_bgr: the thread's colour, blue, green, red from 0 to 255.
        obstacles: seen from above.
        looks: of each of them; none given: pale silicone.
    """

    dish_diameter: float = 0.035
    needle_length: float = 0.007
    needle_width: float = 0.0004
    needle_curvature: float = 0.0
    thread_diameter: float = 60e-6
    thread_bgr: tuple[float, float, float] = (132.0, 78.0, 100.0)
    obstacles: Sequence[Obstacle] = ()
    looks: Sequence[Look] = ()


@dataclass(frozen=True)
class Lighting:
    """The light, the lens and the sensor.

    Attributes:
        gain: of the exposure; 1 is well exposed.
        slope: how much darker one corner is than the opposite one, in units of the usual.
        glare: strength of the lamp's reflections in the liquid, 0 for none.
        noise: standard deviation of the sensor's noise, in units of the usual.
        blur_px: the lens's, as the standard deviation of a Gaussian.
    """

    gain: float = 1.0
    slope: float = 1.0
    glare: float = 1.0
    noise: float = 1.0
    blur_px: float = 0.75


@dataclass(frozen=True)
class Cover:
    """Something between the dish and the camera.

    Attributes:
        outline: closed, shape (m, 2) [m].
        bgr: its colour.
        blur_px: its edge is out of focus by this.
        opacity: 1 hides what is below.
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
        noise_fields: int = 12,
    ) -> None:
        self._scene = scene
        self.view = view
        self.size = size
        self._lighting = lighting or Lighting()
        self._random = np.random.default_rng(seed)
        self._background = self._still_life()
        self._still = self._through_lens(self._background)
        self._noise = [self._noise_field() for _ in range(noise_fields)]
        self._whole = slice(0, size[1]), slice(0, size[0])
        unshifted, self._shifting = np.zeros((noise_fields, 3, 2), np.int64), np.random.default_rng(seed)
        self._shifts = unshifted.copy()
        self._exposed = [self._expose(self._still, self._noise_in(self._whole, k), 1.0) for k in range(noise_fields)]
        self._shifts = unshifted  # what moves fits into these pictures at first

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
        image: Image = self._exposed[chosen].copy()
        if gain != 1.0:
            image = self._expose(self._still, self._noise_in(self._whole, chosen), gain)
        if box is not None:
            region = self._background[box].copy()
            self._add_strand_and_needle(region, box, line, outline, tail, heading)
            for cover, edge in zip(covers, edges, strict=True):
                hidden = cv2.GaussianBlur(covered(box, [edge]), (0, 0), cover.blur_px)
                lay(region, hidden, cover.opacity, cover.bgr)
            image[box] = self._expose(self._through_lens(region), self._noise_in(box, chosen), gain)
        return image

    def _add_strand_and_needle(
        self, region: Light, box: Box, line: Points, outline: Points, tail: Points, heading: float
    ) -> None:
        scene, scale = self._scene, self.view.metres_per_pixel
        strand = line_covered(box, line, MENISCUS * scene.thread_diameter / scale)
        shade = np.float32(0.35) * strand
        near = box_around(outline, self.size, REACH_PX)
        if near is not None:
            needle, inside = covered(near, [outline]), _within(near, box)
            np.maximum(shade[inside], needle, out=shade[inside])
        # Shifted to the right and down by 2.5 and 3.5 px, from the middle of the kernel's 26 values.
        cast = cv2.sepFilter2D(shade, cv2.CV_32F, SHADOW, SHADOW, anchor=(15, 16), borderType=cv2.BORDER_CONSTANT)
        lay(region, cast, 0.16, (0.0, 0.0, 0.0))
        lay(region, strand, 1.0, scene.thread_bgr)
        if near is not None:
            lay(region[inside], needle, 1.0, STEEL_BGR)
            lay(region[inside], line_covered(near, self._gleam(tail, heading), 1.0), 1.0, GLEAM_BGR)

    def _needle_outline(self, tail: Points, heading: float) -> Points:
        """Return the needle's outline in pixels: a body of one width, the last fifth tapering to a fine point."""
        at = np.concatenate([np.linspace(0.0, 0.8, 17), np.linspace(0.84, 1.0, 5)])
        half = 0.5 * self._scene.needle_width * np.interp(at, [0.8, 1.0], [1.0, 0.12])
        points, left = self._axis(tail, heading, at)
        return self.view.to_pixels(np.vstack([points - half[:, None] * left, (points + half[:, None] * left)[::-1]]))

    def _gleam(self, tail: Points, heading: float) -> Points:
        """Return the line along which the body reflects the lamp, in pixels: on the side that faces it."""
        points, left = self._axis(tail, heading, np.linspace(0.07, 0.77, 15))
        facing = np.tanh(2.0 * left @ (-0.5, 0.86))  # towards the lamp, in the dish frame
        return self.view.to_pixels(points + 0.22 * self._scene.needle_width * facing[:, None] * left)

    def _axis(self, tail: Points, heading: float, at: Points) -> tuple[Points, Points]:
        """Return points of the needle's axis, and unit vectors to its left."""
        points, along = needle_axis(tail, heading, self._scene.needle_length, self._scene.needle_curvature, at)
        return points, np.column_stack([-along[:, 1], along[:, 0]])

    def _through_lens(self, light: Light) -> Light:
        return np.asarray(cv2.GaussianBlur(light, (0, 0), self._lighting.blur_px), dtype=np.float32)

    def _noise_field(self) -> Light:
        """Return noise for white light of level 1; the sensor's colour interpolation spreads it a little.

        Its shape is (3, height + SHIFTS, width + SHIFTS): it goes on beyond its borders, by as much as it is shifted.
        """
        width, height = self.size
        noise = self._random.standard_normal((height, width, 3), dtype=np.float32)
        # 1.6 at a light of level 90, before the sensor's interpolation spreads it.
        level = np.float32(self._lighting.noise * 1.6 / np.sqrt(90.0))
        field = np.asarray(cv2.GaussianBlur(noise, (0, 0), 0.55) * level, dtype=np.float32)
        return np.pad(field.transpose(2, 0, 1), ((0, 0), (0, SHIFTS), (0, SHIFTS)), mode="wrap")

    def _noise_in(self, box: Box, chosen: int) -> Light:
        """Return a field's noise in a region, shifted as at no use before, shape (rows, columns, 3)."""
        rows, columns = box
        planes = [
            plane[rows.start + down : rows.stop + down, columns.start + right : columns.stop + right]
            for plane, (down, right) in zip(self._noise[chosen], self._shifts[chosen], strict=True)
        ]
        self._shifts[chosen] = self._shifting.integers(SHIFTS, size=(3, 2))
        return np.asarray(cv2.merge(planes), dtype=np.float32)

    def _expose(self, light: Light, noise: Light, gain: float) -> Image:
        """Expose the sensor, add its noise, which grows with the root of the light, and round to 8 bits."""
        light = light * np.float32(gain * self._lighting.gain)
        return np.asarray(cv2.add(light, cv2.multiply(cv2.sqrt(light), noise), dtype=cv2.CV_8U), dtype=np.uint8)

    def _still_life(self) -> Light:
        """Return the light that falls on the sensor before lens and exposure, shape (rows, columns, 3)."""
        width, height = self.size
        view, lighting, scene = self.view, self._lighting, self._scene
        u, v = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
        scale = view.metres_per_pixel
        radius = np.float32(0.5 * scene.dish_diameter)
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
        # The two edges of the rim, and the light between them; the inner one is where other frames of a dish have it.
        for beyond, spread, depth in ((0.199e-3, 0.21e-3, -145.0), (0.98e-3, 0.18e-3, -100.0), (0.6e-3, 0.15e-3, 22.0)):
            light += depth * np.exp(-(((away - radius - beyond) / spread) ** 2))
        lamp = np.array((0.955, 0.985, 1.0), np.float32)  # its colour
        image = np.asarray(light[:, :, None] * lamp, dtype=np.float32)
        looks = scene.looks or [LOOKS["silicone"]] * len(scene.obstacles)
        for obstacle, look in zip(scene.obstacles, looks, strict=True):
            self._add_obstacle(image, obstacle, look)
        self._add_glare(image)
        dust = np.zeros((height, width), np.float32)
        for _ in range(14):  # specks and rings
            centre = np.array([self._random.integers(0, width), self._random.integers(0, height)])
            size, thickness = (3, 1) if self._random.random() < 0.3 else (1, -1)
            depth, box = float(self._random.uniform(4.0, 16.0)), box_around(centre[None], self.size, REACH_PX)
            assert box is not None  # the centre is in the image
            speck = np.zeros_like(dust[box])
            cv2.circle(speck, (centre - (box[1].start, box[0].start)).tolist(), size, 1.0, thickness)
            dust[box] += depth * cv2.GaussianBlur(speck, (0, 0), 0.9)
        image -= dust[:, :, None]
        return np.asarray(np.clip(image, 0.0, 258.0, out=image), dtype=np.float32)

    def _smear(self, depth: float, size: float) -> Light:
        """Return smooth random light of a given depth and feature size [px]."""
        width, height = self.size
        rough = self._random.standard_normal((height // 4 + 1, width // 4 + 1), dtype=np.float32)
        smooth = cv2.GaussianBlur(rough, (0, 0), size / 4.0)
        smooth *= np.float32(0.5 * depth) / np.float32(max(float(smooth.std()), 1e-9))
        return np.asarray(cv2.resize(smooth, self.size, interpolation=cv2.INTER_CUBIC), dtype=np.float32)

    def _add_obstacle(self, image: Light, obstacle: Obstacle, look: Look) -> None:
        """Add a solid: a soft shadow, its top, a highlight on a disc."""
        if isinstance(obstacle, Disc):
            outlines = [np.asarray(obstacle.centre) + obstacle.radius * _circle(256)]
        else:
            outlines = obstacle.rings
        rings = [self.view.to_pixels(ring) for ring in outlines]
        box = box_around(np.vstack(rings), self.size, margin=24.0)
        if box is None:
            return
        region = image[box]
        shade = cv2.GaussianBlur(covered(box, [ring + np.array([3.0, 4.0]) for ring in rings]), (0, 0), 4.0)
        region *= 1.0 - 0.2 * shade[:, :, None]
        top = covered(box, rings)
        colour = self._surface(top, look) + (self._smear(look.mottle, 9.0)[box][:, :, None] if look.mottle else 0.0)
        region += top[:, :, None] * (colour - region)
        if isinstance(obstacle, Disc):
            radius = obstacle.radius / self.view.metres_per_pixel
            small = self.view.to_pixels(np.asarray(obstacle.centre)) - 0.35 * radius
            shine = cv2.GaussianBlur(covered(box, [small + 0.25 * radius * _circle(128)]), (0, 0), 0.15 * radius + 0.5)
            region += shine[:, :, None] * 40.0

    def _surface(self, top: Light, look: Look) -> Light:
        """Return the colour of a solid's top, rounded at its outline, shape (rows, columns, 3) or for all (3,)."""
        colour, edge = np.asarray(look.bgr, dtype=np.float32), np.asarray(look.edge_bgr, dtype=np.float32)
        if not look.rounding:
            return colour
        reach = np.float32(look.rounding / self.view.metres_per_pixel)
        inwards = cv2.distanceTransform((top > 0.5).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
        level = np.minimum(inwards / reach, 1.0)
        height = cv2.GaussianBlur(np.sqrt(level * (2.0 - level)).astype(np.float32), (0, 0), 0.25 * float(reach) + 0.5)
        slope = np.stack([cv2.Sobel(height, cv2.CV_32F, *axis, scale=0.125) for axis in ((1, 0), (0, 1))])
        # Direction towards the lamp, in the image.
        lit = -np.float32(look.relief) * reach * np.tensordot(np.asarray((-0.5, -0.86), np.float32), slope, axes=1)
        return np.asarray(edge + height[:, :, None] * (colour - edge) + lit[:, :, None], dtype=np.float32)

    def _add_glare(self, image: Light) -> None:
        """Add two arcs of the lamp's reflection along the wall, and small hot spots."""
        radius, centre = 0.5 * self._scene.dish_diameter / self.view.metres_per_pixel, np.asarray(self.view.centre_px)
        glare, random = np.zeros(image.shape[:2], np.float32), self._random
        # Share of the radius, first and last angle [deg], width [px].
        for share, first, last, thickness in ((0.78, 102.0, 156.0, 9.0), (0.81, -40.0, -17.0, 7.0)):
            degrees = np.degrees(angles := np.radians(np.arange(first, last, 0.5)))
            sizes = np.rint(thickness * np.sin(np.pi * (degrees - first) / (last - first)))
            dots = np.rint(centre + share * radius * np.column_stack([np.cos(angles), -np.sin(angles)])).astype(int)
            arc = np.zeros_like(glare)
            for dot, size in zip(dots.tolist(), (np.maximum(sizes, 1.0).astype(int) // 2).tolist(), strict=True):
                cv2.circle(arc, dot, size, 1.0, -1)
            np.maximum(glare, cv2.GaussianBlur(arc, (0, 0), 2.2), out=glare)
        for _ in range(3):
            angle, share = random.uniform(0.0, 2.0 * np.pi), random.uniform(0.2, 0.75)
            axes = (int(random.integers(2, 5)), int(random.integers(2, 4)))
            at = np.rint(centre + share * radius * np.array([np.cos(angle), np.sin(angle)])).astype(int).tolist()
            spot = cv2.ellipse(np.zeros_like(glare), at, axes, 0.0, 0.0, 360.0, 1.0, -1)
            np.maximum(glare, cv2.GaussianBlur(spot, (0, 0), 1.2), out=glare)
        lit = glare > 0.0
        image[lit] += self._lighting.glare * np.minimum(glare[lit], 1.0)[:, None] * (265.0 - image[lit])


def _within(inner: Box, outer: Box) -> Box:
    """Return a box in the coordinates of one that holds it."""
    rows, columns = (slice(i.start - o.start, i.stop - o.start) for i, o in zip(inner, outer, strict=True))
    return rows, columns


def _circle(corners: int) -> Points:
    """Return a unit circle as a polygon, shape (corners, 2)."""
    angles = np.linspace(0.0, 2.0 * np.pi, corners, endpoint=False)
    return np.column_stack([np.cos(angles), np.sin(angles)])


def box_around(points: Points, size: tuple[int, int], margin: float) -> Box | None:
    """Return the rows and columns of an image that hold points, with a margin; None if none does.

    Args:
        points: shape (m, 2) [px].
        size: width and height of the image [px].
        margin: [px].
    """
    points = points[np.all(np.isfinite(points), axis=1)]
    if not len(points):
        return None
    low = np.maximum(np.floor(points.min(axis=0) - margin), 0.0)
    high = np.minimum(np.ceil(points.max(axis=0) + margin), size)
    if np.any(high <= low):
        return None
    (left, top), (right, bottom) = low.astype(int), high.astype(int)
    return slice(int(top), int(bottom)), slice(int(left), int(right))


def covered(box: Box, lines: Sequence[Points], wide: int = 0) -> Light:
    """Return the share of each pixel in a box that polygons cover, shape (rows, columns).

    Args:
        box: rows and columns.
        lines: outlines of the polygons and of their holes, each of shape (m, 2) [px].
        wide: 0, or the width of lines that are drawn in their place, in pixels over `OVERSAMPLING`.
    """
    rows, columns = box[0].stop - box[0].start, box[1].stop - box[1].start
    canvas, origin = np.zeros((rows * OVERSAMPLING, columns * OVERSAMPLING), np.uint8), (box[1].start, box[0].start)
    # In sixteenths.
    at = [np.round(16.0 * ((line - origin + 0.5) * OVERSAMPLING - 0.5)).astype(np.int32) for line in lines]
    if wide:
        cv2.polylines(canvas, at, False, 255, wide, cv2.LINE_8, 4)
    else:
        cv2.fillPoly(canvas, at, 255, cv2.LINE_8, 4)
    small = cv2.resize(canvas, (columns, rows), interpolation=cv2.INTER_AREA)
    return np.asarray(small * np.float32(1.0 / 255.0), dtype=np.float32)


def line_covered(box: Box, line: Points, width_px: float) -> Light:
    """Return the share of each pixel in a box that a line of a given width covers, shape (rows, columns).

    A long line is drawn in pieces of about 60 px: a large, nearly empty canvas would be slow.

    Args:
        box: rows and columns, in which the line is with all its pieces' margins; see `box_around`.
        line: vertices, shape (m, 2) [px].
        width_px: of the line; less than a quarter of a pixel is drawn as that and fainter.
    """
    origin, end = np.array([box[1].start, box[0].start]), np.array([box[1].stop, box[0].stop])
    result = np.zeros(end[::-1] - origin[::-1], np.float32)
    wide = max(1, round(width_px * OVERSAMPLING))
    length = float(np.hypot(*np.diff(line, axis=0).T).sum())
    count = max(1, round(60.0 * (len(line) - 1) / max(length, 60.0)))
    firsts = np.arange(0, len(line) - 1, count)
    lasts, margin = np.minimum(firsts + count, len(line) - 1), 3.0 + width_px
    low = np.minimum(np.minimum.reduceat(line, firsts), line[lasts]) - margin
    high = np.maximum(np.maximum.reduceat(line, firsts), line[lasts]) + margin
    low, high = np.maximum(np.floor(low), origin).astype(int), np.minimum(np.ceil(high), end).astype(int)
    corners = zip(firsts.tolist(), lasts.tolist(), low.tolist(), high.tolist(), strict=True)
    for first, last, (left, top), (right, bottom) in corners:
        if left < right and top < bottom:
            part = slice(top, bottom), slice(left, right)
            inside = result[_within(part, box)]
            np.maximum(inside, covered(part, [line[first : last + 1]], wide), out=inside)
    return np.asarray(result * np.float32(min(1.0, width_px * OVERSAMPLING / wide)))


@compiled
def lay(region: Light, share: Light, strength: float, bgr: tuple[float, float, float]) -> None:
    """Cover a region with a colour by a share of each pixel, times a strength, where the share is not zero."""
    scale = np.float32(strength)
    b, g, r = np.float32(bgr[0]), np.float32(bgr[1]), np.float32(bgr[2])
    for i in range(share.shape[0]):
        for j in range(share.shape[1]):
            if share[i, j] != 0.0:
                part = scale * share[i, j]
                region[i, j, 0] += part * (b - region[i, j, 0])
                region[i, j, 1] += part * (g - region[i, j, 1])
                region[i, j, 2] += part * (r - region[i, j, 2])
