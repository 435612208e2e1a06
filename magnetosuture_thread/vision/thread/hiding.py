"""Finds what may hide the thread: areas of the dish that don't look like its floor, and what is known to lie there.

The floor's light is a smooth function of the place, fitted robustly to each colour c,

    F_c(x, y) = sum_i a_ci b_i(x, y),    b = 1, x, y, x^2, x y, y^2, r^4, r^8

with x, y and r as shares of the dish's radius. With q_c = I_c / F_c - 1, where slender things are taken out of I by a
median, a pixel shows no floor where the mean of q_c, or the greatest less the least of them, is larger than noise and
smears of the liquid explain. Brighter areas show the lamp, others an object; a thread may lie below both.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.vision.images import Picture, Wall, glare_mask
from magnetosuture_thread.vision.needle.measured_needle import MeasuredNeedle
from magnetosuture_thread.vision.sampling import middle

SHRUNK = 3  # how much smaller the image is in which objects are looked for
SLENDER_CELLS = 5  # side of the median window there: wider than twice a needle, narrower than an object
FIT_CELL_PX = 8  # the floor's light is fitted to means of cells of this size
COVERED_PX = 1.5  # beside and beyond the needle, that is not seen: its outline is not known better
BEYOND_PX = 3.0  # its tip, that is not seen either
BEHIND_TAIL_PX = 1.5  # of the needle that is not covered, so that the walk can leave
ROUNDS, TUKEY = 8, 4.0  # of the robust fit, and standard deviations beyond which a cell counts nothing
SETTLED = 0.1  # grey levels; weights that change by less in a round are the fit's
MIN_CONTRAST, MIN_COLOUR = 0.05, 0.03  # of the floor's light, by which an object differs in brightness, in colour
CONTRAST_DEVIATIONS = 3.5  # and in both by so many standard deviations of the floor
MIN_AREA = 1e-6  # m^2; of an object
WALL_PX = 6.0  # before which nothing is told
NEEDLE_PX = 2.5  # beside and beyond the needle, where its blurred edge and what is next to it hide a thread
OUTLINE_TOLERANCE_PX = 1.0  # of published outlines, which keeps them short
MAX_OUTLINES = 64

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
        if np.hypot(u - self.wall.centre[0], v - self.wall.centre[1]) > self.wall.radius - WALL_PX:
            return -1
        return int(self.areas[v, u])

    def outlines(self) -> list[Points]:
        """Return the outlines of the largest areas, each of shape (m, 2) [px]."""
        found, _ = cv2.findContours(self.solid, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
        found = sorted(found, key=cv2.contourArea, reverse=True)[:MAX_OUTLINES]
        simple = [cv2.approxPolyDP(outline, OUTLINE_TOLERANCE_PX, True)[:, 0].astype(float) for outline in found]
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
    inside = wall.distances((slice(0, rows), slice(0, columns))) < wall.radius - WALL_PX
    solid[~inside] = 0
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
    small = cv2.medianBlur(cv2.resize(picture.image, size, interpolation=cv2.INTER_AREA), SLENDER_CELLS)
    cells = (max(4, columns // FIT_CELL_PX), max(4, rows // FIT_CELL_PX))
    near = Wall(wall.centre, wall.radius - WALL_PX)
    places = _places(cells, picture.shape, near)
    means = np.atleast_3d(cv2.resize(small, cells, interpolation=cv2.INTER_AREA)).reshape(len(places), -1)
    inside = np.hypot(places[:, 1], places[:, 2]) < 1.0
    if inside.sum() < 4 * places.shape[1]:
        return np.zeros((rows, columns), np.uint8), np.full((rows, columns), 1.0, np.float32)
    weights = np.stack([_fitted(places[inside], channel) for channel in means[inside].T.astype(float)], axis=1)
    light = np.maximum(places @ weights, 1.0)
    ratios = means[inside] / light[inside] - 1.0
    light = light.reshape(cells[1], cells[0], -1).astype(np.float32)
    seen = [
        cv2.divide(channel, cv2.resize(floor, size), dtype=cv2.CV_32F) - 1.0
        for channel, floor in zip(cv2.split(small), cv2.split(light), strict=True)
    ]
    mean = sum(seen) / len(seen)
    found = np.abs(mean) > _bound(ratios.mean(axis=1), MIN_CONTRAST)
    if len(seen) > 1:
        most, least = cv2.max(cv2.max(*seen[:2]), seen[2]), cv2.min(cv2.min(*seen[:2]), seen[2])
        found |= most - least > _bound(np.ptp(ratios, axis=1), MIN_COLOUR)
    found &= near.distances((slice(0, rows, SHRUNK), slice(0, columns, SHRUNK)))[: size[1], : size[0]] < near.radius
    opened = cv2.morphologyEx(found.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    _, labels, stats, _ = cv2.connectedComponentsWithStats(opened, connectivity=8)
    large = stats[:, cv2.CC_STAT_AREA] * SHRUNK**2 >= min_area
    large[0] = False
    objects = cv2.resize(np.where(large, 255, 0).astype(np.uint8)[labels], (columns, rows))
    objects = cv2.dilate(objects, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (3, 3)))
    floor = cv2.resize(np.ascontiguousarray(light.min(axis=2)), (columns, rows))
    return cv2.compare(objects, 127, cv2.CMP_GT), floor


def _places(size: tuple[int, int], shape: tuple[int, int], wall: Wall) -> NDArray[np.float64]:
    """Return the functions that the floor's light is a sum of at each cell of a grid, shape (cells, 8)."""
    (columns, rows), (height, width) = size, shape
    u = ((np.arange(columns) + 0.5) * width / columns - 0.5 - wall.centre[0]) / wall.radius
    v = ((np.arange(rows) + 0.5) * height / rows - 0.5 - wall.centre[1]) / wall.radius
    x, y = (values.ravel() for values in np.meshgrid(u, v))
    far = np.minimum(x * x + y * y, 1.2) ** 2
    return np.column_stack([np.ones_like(x), x, y, x * x, x * y, y * y, far, far * far])


def _fitted(basis: NDArray[np.float64], values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the weights of a sum of functions that is near most values: least squares with Tukey's biweight."""
    weights = np.zeros(basis.shape[1])
    weights[0] = middle(values)
    for _ in range(ROUNDS):
        residuals = values - basis @ weights
        bound = TUKEY * max(0.5, 1.4826 * middle(np.abs(residuals)))
        share = np.maximum(1.0 - (residuals / bound) ** 2, 0.0)[:, None] ** 2
        normal = basis.T @ (share * basis) + 1e-6 * np.eye(len(weights))
        before, weights = weights, np.linalg.solve(normal, basis.T @ (share[:, 0] * values))
        if np.abs(weights - before).max() < SETTLED:
            break
    return weights


def _bound(values: NDArray[np.float64], minimum: float) -> float:
    """Return beyond what a value is not the floor's, by the spread of those of cells."""
    usual = middle(values)
    return max(minimum, abs(usual) + CONTRAST_DEVIATIONS * 1.4826 * middle(np.abs(values - usual)))


def cover_needle(hidden: NDArray[np.uint8], factor: int, needle: MeasuredNeedle, origin: tuple[int, int]) -> None:
    """Mark where a needle hides the thread, in a mask `factor` times smaller than the picture from `origin` on."""
    axis = needle.arc.at(np.linspace(BEHIND_TAIL_PX, needle.length_px + BEYOND_PX, 24)) - origin
    small = np.round((axis - 0.5 * (factor - 1)) / factor * 16.0).astype(np.int32)
    thickness = needle.width_px + 2.0 * COVERED_PX
    cv2.polylines(hidden, [small], False, 255, max(1, round(thickness / factor)), cv2.LINE_8, 4)
