"""Masks of a camera frame by the scene: where neither needle nor thread can be.

Needle and thread lie outside of every shape of the scene. With d(p) the distance of a pixel p from the outlines,
positive inside of a shape, and a tolerance t for what the scene's outline and the visible one may differ by (camera
height, parallax, calibration):

    solid:    d > t              no needle, no thread
    outline:  |d| <= t + blur    a dark line may be the thread or the shape's own edge
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.geometry.camera import DishView
from magnetosuture_thread.geometry.obstacles import Disc, Polygon
from magnetosuture_thread.geometry.polyline import Points, arc_lengths, points_at
from magnetosuture_thread.scene.scene import Scene

BLUR_PX = 2.0  # beyond the tolerance, up to which an edge still looks like a dark line
OUTSIDE_DEPTH_PX = 1e4  # depth of a pixel in an image without any outline

Mask = NDArray[np.uint8]


@dataclass(frozen=True)
class SceneMask:
    """Where the shapes of a scene are in a frame or in a part of it.

    Attributes:
        solid: 255 where neither needle nor thread can be, `factor` times smaller than the frame, uint8.
        inside: the same for a tolerance of 0.
        depth: distance from the outlines, positive inside of a shape, shape (rows, columns), float32 [px].
        tolerance_px: see the module [px].
        rim: points along the outlines and the index of their shape, shape (m, 3) [px].
        factor: how much smaller `solid` and `inside` are.
        floor_cells: for each cell of the floor's grid the column and row of the nearest one that no shape covers,
            shape (rows, columns, 2), int16.
        cell: side of such a cell [px].
    """

    solid: Mask
    inside: Mask
    depth: NDArray[np.float32]
    tolerance_px: float
    rim: Points
    factor: int
    floor_cells: NDArray[np.int16]
    cell: int

    def part(self, left: int, top: int, right: int, bottom: int) -> SceneMask:
        """Return the mask of a part of the frame; left and top are multiples of `factor` and `cell` [px]."""
        full = (slice(top, bottom), slice(left, right))
        small = (
            slice(top // self.factor, -(-bottom // self.factor)),
            slice(left // self.factor, -(-right // self.factor)),
        )
        cells = (slice(top // self.cell, -(-bottom // self.cell)), slice(left // self.cell, -(-right // self.cell)))
        return SceneMask(
            self.solid[small],
            self.inside[small],
            self.depth[full],
            self.tolerance_px,
            self.rim - (left, top, 0.0),
            self.factor,
            self.floor_cells[cells] - np.array([left // self.cell, top // self.cell], np.int16),
            self.cell,
        )

    @property
    def band_px(self) -> float:
        """Distance from an outline up to which a dark line may be the shape's own edge [px]."""
        return self.tolerance_px + BLUR_PX

    def show_floor(self, cells: Mask) -> Mask:
        """Return the brightness of cells, of those that a shape covers that of the nearest one that shows the floor."""
        rows, columns = cells.shape
        floor = self.floor_cells[:rows, :columns]
        nothing = np.empty(0)
        shown = cv2.remap(cells, floor, nothing, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(shown, dtype=np.uint8)

    def deepest(self, low: Points, high: Points) -> float:
        """Return how deep the deepest pixel of a box (u, v) to (u, v) lies in a shape; negative if it touches none."""
        left, top = (max(0, int(value)) for value in low)
        box = self.depth[top : max(top, int(high[1]) + 1), left : max(left, int(high[0]) + 1)]
        return float(cv2.minMaxLoc(box)[1]) if box.size else -OUTSIDE_DEPTH_PX

    def depths(self, points: Points) -> NDArray[np.float32]:
        """Return how deep points lie in a shape, negative outside of all, shape (m,) [px]."""
        rows, columns = self.depth.shape
        at = np.round(points).astype(np.intp)
        return self.depth[np.clip(at[:, 1], 0, rows - 1), np.clip(at[:, 0], 0, columns - 1)]


def scene_mask(
    scene: Scene, view: DishView, shape: tuple[int, ...], factor: int, tolerance: float, cell: int
) -> SceneMask | None:
    """Return the mask of a frame; None for a scene without shapes.

    Args:
        scene: dish and shapes.
        view: where the dish is in the frame.
        shape: rows and columns of the frame.
        factor: how much smaller the small masks are.
        tolerance: what the scene's outline and the visible one may differ by [m].
        cell: side of a cell of the floor's grid [px].
    """
    if not scene.shapes:
        return None
    rows, columns = shape[:2]
    inside = np.zeros((rows, columns), np.uint8)
    for geometry in scene.obstacles:  # One after the other: shapes may overlap, and even-odd filling would undo it.
        own = np.zeros_like(inside)
        rings = [np.round(view.to_pixels(ring) * 16.0).astype(np.int32) for ring in mask_outlines(geometry)]
        cv2.fillPoly(own, rings, 255, cv2.LINE_8, 4)
        cv2.bitwise_or(inside, own, inside)
    # Filling takes every pixel that an edge touches: half a pixel too many, as blur makes a dark shape look too.
    depth = _distance(inside) - _distance(cv2.bitwise_not(inside))
    tolerance_px = tolerance / view.metres_per_pixel
    solid = np.where(depth > tolerance_px, 255, 0).astype(np.uint8)
    size = (math.ceil(columns / factor), math.ceil(rows / factor))
    solid = cv2.compare(_shrunk(solid, factor, size), 254, cv2.CMP_GT)
    small_inside = cv2.compare(_shrunk(inside, factor, size), 127, cv2.CMP_GT)
    cells = cv2.resize(inside, (max(2, columns // cell), max(2, rows // cell)), interpolation=cv2.INTER_AREA)
    return SceneMask(
        solid,
        small_inside,
        depth,
        tolerance_px,
        _rim(scene, view),
        factor,
        _nearest_uncovered(cells > 0.1 * 255.0),
        cell,
    )


def mask_outlines(geometry: Disc | Polygon) -> list[Points]:
    """Return the rings of a shape, a disc as a polygon, each of shape (m, 2) [m]."""
    if isinstance(geometry, Disc):
        turn = np.linspace(0.0, 2.0 * np.pi, 128, endpoint=False)
        return [np.asarray(geometry.centre) + geometry.radius * np.column_stack([np.cos(turn), np.sin(turn)])]
    return geometry.rings


def _nearest_uncovered(covered: NDArray[np.bool_]) -> NDArray[np.int16]:
    """Return column and row of the nearest uncovered cell to each, its own where all are covered."""
    rows, columns = np.indices(covered.shape).astype(np.int16)
    itself = np.stack([columns, rows], axis=-1)
    if covered.all():
        return itself
    _, labels = cv2.distanceTransformWithLabels(
        covered.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    owner = np.zeros((int(labels.max()) + 1, 2), np.int16)
    owner[labels[~covered]] = itself[~covered]
    return owner[labels]


def _rim(scene: Scene, view: DishView) -> Points:
    """Return points along all outlines, with the index of their shape, shape (m, 3) [px]."""
    parts = []
    for index, geometry in enumerate(scene.obstacles):
        for ring in mask_outlines(geometry):
            closed = view.to_pixels(np.vstack([ring, ring[:1]]))
            points = points_at(closed, np.arange(0.0, arc_lengths(closed)[-1], 4.0))
            parts.append(np.column_stack([points, np.full(len(points), float(index))]))
    return np.vstack(parts)


def _distance(inside: Mask) -> NDArray[np.float32]:
    """Return the distance of each pixel of a mask from its edge, half a pixel from the next one; 0 outside [px]."""
    if inside.all():
        return np.full(inside.shape, OUTSIDE_DEPTH_PX, np.float32)
    apart = cv2.distanceTransform(inside, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return np.asarray(np.maximum(apart - 0.5, 0.0), dtype=np.float32)


def _shrunk(mask: Mask, factor: int, size: tuple[int, int]) -> Mask:
    """Return a mask shrunk by area, the last pixels repeated to whole ones."""
    if factor == 1:
        return mask
    down, right = size[1] * factor - mask.shape[0], size[0] * factor - mask.shape[1]
    whole = cv2.copyMakeBorder(mask, 0, down, 0, right, cv2.BORDER_REPLICATE)
    return np.asarray(cv2.resize(whole, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
