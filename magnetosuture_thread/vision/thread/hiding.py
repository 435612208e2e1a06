"""Finds what may hide the thread: areas of the dish that don't look like its floor, and what is known to lie there.

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

from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.vision.images import Picture, Wall, glare_mask
from magnetosuture_thread.vision.needle.arc import MeasuredNeedle
from magnetosuture_thread.vision.sampling import middle
from magnetosuture_thread.vision.thread.appearance import NEEDLE_PX

SHRUNK = 3  # how much smaller the image is in which objects are looked for
MIN_CONTRAST, MIN_COLOUR = 0.05, 0.03  # of the floor's light, by which an object differs in brightness, in colour
MIN_AREA = 1e-6  # m^2; of an object
WALL_PX = 6.0  # before which nothing is told

Mask = NDArray[np.uint8]


@dataclass(frozen=True)
class Hiding:
    """Areas of a picture where a thread can't be seen.

    Attributes:
        solid: 255 there, shape (rows, columns), uint8.
        areas: number of the connected area at each pixel, 0 for bare floor, shape (rows, columns), int32.
        inside: whether a pixel is farther than `WALL_PX` from the wall, shape (rows, columns).
        floor: brightness of the bare floor in the darkest colour, shape (rows, columns), float32 [grey levels].
        wall: of the dish; beyond it, less `WALL_PX`, nothing is told.
    """

    solid: Mask
    areas: NDArray[np.int32]
    inside: NDArray[np.bool_]
    floor: NDArray[np.float32]
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


def find_hiding(picture: Picture, needle: MeasuredNeedle, wall: Wall, metres_per_pixel: float) -> Hiding:
    """Find what may hide a thread in a picture.

    Args:
        picture: the frame or a part of it.
        needle: in the picture's pixels.
        wall: of the dish, in the picture's pixels.
        metres_per_pixel: of the picture [m].
    """
    rows, columns = picture.shape
    glare = cv2.morphologyEx(glare_mask(picture), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    solid = cv2.resize(glare, (columns, rows), interpolation=cv2.INTER_NEAREST)
    within = np.zeros((rows, columns), np.uint8)
    u, v, reach = (round(16.0 * value) for value in (*wall.centre, wall.radius - WALL_PX))
    cv2.circle(within, (u, v), reach, 1, -1, cv2.LINE_8, 4)
    inside = within.view(np.bool_)
    cv2.multiply(solid, within, solid)
    objects, floor = _objects(picture, wall, MIN_AREA / metres_per_pixel**2)
    cv2.bitwise_or(solid, objects, solid)
    if picture.mask is not None:
        cv2.bitwise_or(solid, cv2.compare(picture.mask.depth, -picture.mask.tolerance_px, cv2.CMP_GT), solid)
    axis = needle.arc.at(np.linspace(0.0, needle.length_px + NEEDLE_PX, 24))
    at = np.round(axis * 16.0).astype(np.int32)
    cv2.polylines(solid, [at], False, 255, max(1, round(needle.width_px + 2.0 * NEEDLE_PX)), cv2.LINE_8, 4)
    _, areas = cv2.connectedComponents(solid, connectivity=8, ltype=cv2.CV_32S)
    return Hiding(solid, np.asarray(areas, dtype=np.int32), inside, floor, wall)


def _objects(picture: Picture, wall: Wall, min_area: float) -> tuple[Mask, NDArray[np.float32]]:
    """Return where objects are, and the floor's brightness in the darkest colour."""
    rows, columns = picture.shape
    size = (-(-columns // SHRUNK), -(-rows // SHRUNK))
    small = cv2.resize(picture.image, size, interpolation=cv2.INTER_AREA)
    small = cv2.medianBlur(small, 5)  # wider than twice a needle, narrower than an object
    cells = (max(4, columns // 8), max(4, rows // 8))  # to whose means the light is fitted
    near = Wall(wall.centre, wall.radius - WALL_PX)
    places = _places(cells, picture.shape, near)
    means = np.atleast_3d(cv2.resize(small, cells, interpolation=cv2.INTER_AREA)).reshape(len(places), -1)
    inside = np.hypot(places[:, 1], places[:, 2]) < 1.0
    if inside.sum() < 4 * places.shape[1]:
        return np.zeros((rows, columns), np.uint8), np.full((rows, columns), 1.0, np.float32)
    some = np.zeros(cells[::-1], np.bool_)
    some[::2, ::2] = True  # far more than enough for so few weights
    fitted = inside & some.ravel()
    light = np.maximum(places @ _fit_light(places[fitted], means[fitted].astype(float)), 1.0)
    ratios = np.ascontiguousarray((means[inside] / light[inside] - 1.0).T)  # numpy is slow along a short last axis
    bounds = _bound(ratios.mean(axis=0), MIN_CONTRAST), _bound(np.ptp(ratios, axis=0), MIN_COLOUR)
    light = light.reshape(cells[1], cells[0], -1).astype(np.float32)
    at_small = cv2.resize(light, size).reshape(size[1], size[0], -1)
    found = _unlike(small.reshape(at_small.shape), at_small, bounds, near)
    opened = cv2.morphologyEx(found.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    _, labels, stats, _ = cv2.connectedComponentsWithStats(opened, connectivity=8)
    large = stats[:, cv2.CC_STAT_AREA] * SHRUNK**2 >= min_area
    large[0] = False
    objects = cv2.resize(np.where(large, 255, 0).astype(np.uint8)[labels], (columns, rows))
    objects = cv2.dilate(objects, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (3, 3)))
    darkest = reduce(np.minimum, np.moveaxis(light, 2, 0))
    return cv2.compare(objects, 127, cv2.CMP_GT), cv2.resize(darkest, (columns, rows))


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
        own[0] = np.median(light)
        for _ in range(8):
            residuals = light - basis @ own
            bound = 4.0 * max(0.5, 1.4826 * float(np.median(np.abs(residuals))))
            weighted = np.maximum(1.0 - (residuals / bound) ** 2, 0.0)[:, None] ** 2 * basis
            before = own
            own = np.linalg.solve(weighted.T @ basis + 1e-6 * np.eye(len(own)), weighted.T @ light)
            if np.abs(own - before).max() < 0.1:  # grey levels
                break
        weights[:, colour] = own
    return weights


def _unlike(small: Mask, light: NDArray[np.float32], bounds: tuple[float, float], dish: Wall) -> NDArray[np.bool_]:
    """Return where the mean of q_c, or the greatest less the least, is beyond its bound, within a dish.

    Args:
        small: the shrunk image, shape (rows, columns, colours), uint8.
        light: of the floor there, of the same shape [grey levels].
        bounds: of the mean and of the range.
        dish: in pixels of the image that is not shrunk.
    """
    rows, columns = small.shape[:2]
    v, u = SHRUNK * np.arange(rows)[:, None] - dish.centre[1], SHRUNK * np.arange(columns) - dish.centre[0]
    ratios = [small[..., colour] / light[..., colour] - np.float32(1.0) for colour in range(small.shape[2])]
    apart = reduce(np.maximum, ratios) - reduce(np.minimum, ratios)
    beyond = (np.abs(sum(ratios)) > bounds[0] * len(ratios)) | (apart > bounds[1])
    return np.asarray(beyond & (u * u + v * v < dish.radius**2))


def _bound(values: NDArray[np.float64], minimum: float) -> float:
    """Return beyond what a value is not the floor's, by the spread of those of cells."""
    usual = middle(values)
    return max(minimum, abs(usual) + 3.5 * 1.4826 * middle(np.abs(values - usual)))
