"""Masks of a camera frame by the scene: where neither needle nor thread can be.

Needle and thread lie outside of every shape of the scene. With d(p) the distance of a pixel p from the outlines,
positive inside of a shape, and a tolerance t for what the scene's outline and the visible one may differ by (camera
height, parallax, calibration):

    solid:    d > t              no needle, no thread
    outline:  |d| <= t + blur    a dark line may be the thread or the shape's own edge
"""

from __future__ import annotations

from dataclasses import dataclass, replace

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
        depth: distance from the outlines, positive inside of a shape, shape (rows, columns), float32 [px].
        tolerance_px: see the module [px].
        rim: points along the outlines and the index of their shape, shape (m, 3) [px].
        floor_cells: for each cell of the floor's grid the column and row of the nearest one that no shape covers,
            shape (rows, columns, 2), int16.
        cell: side of such a cell [px].
    """

    depth: NDArray[np.float32]
    tolerance_px: float
    rim: Points
    floor_cells: NDArray[np.int16]
    cell: int

    def part(self, left: int, top: int, right: int, bottom: int) -> SceneMask:
        """Return the mask of a part of the frame; left and top are multiples of `cell` [px]."""
        cell = self.cell
        cells = self.floor_cells[top // cell : -(-bottom // cell), left // cell : -(-right // cell)]
        return replace(
            self,
            depth=self.depth[top:bottom, left:right],
            rim=self.rim - (left, top, 0.0),
            floor_cells=cells - np.array([left // cell, top // cell], np.int16),
        )

    def solid(self, size: tuple[int, int], tolerance_px: float) -> Mask:
        """Return where neither needle nor thread can be by a tolerance, 255 there, in a mask of a smaller size."""
        depth = cv2.resize(self.depth, size, interpolation=cv2.INTER_AREA)
        return np.asarray(cv2.compare(depth, tolerance_px, cv2.CMP_GT), dtype=np.uint8)

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


def scene_mask(scene: Scene, view: DishView, shape: tuple[int, ...], tolerance: float, cell: int) -> SceneMask | None:
    """Return the mask of a frame; None for a scene without shapes.

    Args:
        scene: dish and shapes.
        view: where the dish is in the frame.
        shape: rows and columns of the frame.
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
    cells = cv2.resize(inside, (max(2, columns // cell), max(2, rows // cell)), interpolation=cv2.INTER_AREA)
    floor_cells = _nearest_uncovered(cells > 0.1 * 255.0)
    return SceneMask(depth, tolerance / view.metres_per_pixel, _rim(scene, view), floor_cells, cell)


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
