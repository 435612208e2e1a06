"""A scene in flat arrays for compiled code: the dish, its discs, and the edges of its polygons in blocks."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.compiled import compiled
from magnetosuture_thread.geometry.obstacles import Disc
from magnetosuture_thread.geometry.obstacles.features import EDGE_WIDTH, edges_of
from magnetosuture_thread.geometry.obstacles.search import Nearest, search_edges
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.scene import Scene

Vector = NDArray[np.float64]

BLOCK = 12
"""Edges of a polygon that follow one another and share a bounding circle, so that those far away cost one test."""


class PackedScene(NamedTuple):
    """A scene for compiled code. Not to be written to.

    Attributes:
        radius: of the dish [m].
        discs: x, y and radius of each disc, shape (d, 3) [m].
        polygons: for each polygon its first block and the one after its last, shape (p, 2).
        shapes: index in the scene of each disc, then of each polygon, shape (d + p,).
        circles: centre and radius of the circle around each block of edges, shape (b, 3) [m].
        ranges: first edge of each block and the number of its edges, shape (b, 2).
        edges: rows of `EDGE_WIDTH` numbers, flat, see `features.edges_of`.
        cells: empty; the search of a block takes no entries of cells.
    """

    radius: float
    discs: NDArray[np.float64]
    polygons: NDArray[np.int64]
    shapes: NDArray[np.int64]
    circles: NDArray[np.float64]
    ranges: NDArray[np.int64]
    edges: NDArray[np.float64]
    cells: NDArray[np.int32]


def pack_scene(scene: Scene) -> PackedScene:
    """Return a scene for compiled code."""
    discs, polygons, of_discs, of_polygons = [], [], [], []
    circles: list[NDArray[np.float64]] = [np.empty((0, 3))]
    ranges: list[NDArray[np.int64]] = [np.empty((0, 2), np.int64)]
    numbers = [np.empty((0, EDGE_WIDTH))]
    edges = blocks = 0
    for index, obstacle in enumerate(scene.obstacles):
        if isinstance(obstacle, Disc):
            discs.append((*obstacle.centre, obstacle.radius))
            of_discs.append(index)
            continue
        found = edges_of(obstacle).numbers
        first = np.arange(0, len(found), BLOCK)
        last = np.minimum(first + BLOCK, len(found))
        corners = np.concatenate([found[:, 0:2], found[:, 2:4]])
        low = np.minimum.reduceat(np.minimum(found[:, 0:2], found[:, 2:4]), first)
        high = np.maximum.reduceat(np.maximum(found[:, 0:2], found[:, 2:4]), first)
        # Rounding must not leave a corner outside of its circle.
        radius = 0.5 * np.hypot(*(high - low).T) * (1.0 + 1e-9) + 1e-12 * float(np.abs(corners).max())
        circles.append(np.column_stack([0.5 * (low + high), radius]))
        ranges.append(np.column_stack([edges + first, last - first]))
        polygons.append((blocks, blocks + len(first)))
        of_polygons.append(index)
        numbers.append(found)
        edges, blocks = edges + len(found), blocks + len(first)
    return PackedScene(
        scene.dish.radius,
        np.array(discs, dtype=np.float64).reshape(-1, 3),
        np.array(polygons, dtype=np.int64).reshape(-1, 2),
        np.array([*of_discs, *of_polygons], dtype=np.int64),
        np.ascontiguousarray(np.concatenate(circles)),
        np.ascontiguousarray(np.concatenate(ranges)),
        np.concatenate(numbers).ravel(),
        np.empty(0, np.int32),
    )


@compiled
def search_block(
    x: float, y: float, reach: float, block: int, scene: PackedScene, count: int, distance: Vector, normal: Points
) -> Nearest:
    """Return the nearest of a block's edges, and write rows within reach from `count` on; see `search_edges`."""
    base, last = scene.ranges[block, 0] * EDGE_WIDTH, scene.ranges[block, 1]
    return search_edges(x, y, reach, scene.edges, base, scene.cells, -1, last, count, distance, normal)


@compiled
def shape_distance(x: float, y: float, s: int, guess: int, scene: PackedScene) -> tuple[float, float, float, int]:
    """Return the signed distance of a point from a shape, its gradient (2), and the block that is nearest.

    Exact however far the point is, inside and outside: the edge or corner that is nearest of all tells the side.

    Args:
        x: coordinate of the point [m].
        y: coordinate of the point [m].
        s: index in `scene.shapes`.
        guess: a block that may be near, which saves looking at others; -1 for none.
        scene: packed.
    """
    discs = len(scene.discs)
    if s < discs:
        qx, qy = x - scene.discs[s, 0], y - scene.discs[s, 1]
        away = math.hypot(qx, qy)
        gx, gy = (qx / away, qy / away) if away > 0.0 else (1.0, 0.0)
        return away - scene.discs[s, 2], gx, gy, -1
    none, nor = scene.edges[:0], scene.circles[:0]
    first, last = scene.polygons[s - discs, 0], scene.polygons[s - discs, 1]
    best, block = Nearest(0, np.inf, np.inf, 0.0, 0.0, 0.0), -1
    if first <= guess < last:
        best, block = search_block(x, y, -1.0, guess, scene, 0, none, nor), guess
    reach = math.sqrt(best.square)
    for k in range(first, last):
        dx, dy = x - scene.circles[k, 0], y - scene.circles[k, 1]
        far = reach + scene.circles[k, 2]
        if k == guess or dx * dx + dy * dy >= far * far:
            continue
        found = search_block(x, y, -1.0, k, scene, 0, none, nor)
        if found.square < best.square:
            best, block, reach = found, k, math.sqrt(found.square)
    return best.signed, best.x, best.y, block


@compiled
def measure(points: Points, scene: PackedScene, distances: NDArray[np.float64], normal: NDArray[np.float64]) -> None:
    """Write the signed distance of each point from each disc, then polygon, (m, s), and its gradient, (m, s, 2)."""
    for s in range(distances.shape[1]):
        guess = -1
        for i in range(len(points)):
            found = shape_distance(points[i, 0], points[i, 1], s, guess, scene)
            distances[i, s], normal[i, s, 0], normal[i, s, 1], guess = found
