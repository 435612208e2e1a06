"""Packs obstacles and their grids into the flat arrays of the compiled contact query."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.compiled import compiled
from magnetosuture_thread.geometry.obstacles.contacts import BALL, EDGES, FACES, WorkspaceData, nearest_of
from magnetosuture_thread.geometry.obstacles.disc import Disc
from magnetosuture_thread.geometry.obstacles.features import Features, edges_of, faces_of
from magnetosuture_thread.geometry.obstacles.grid import Grid, fill_grid, plan_grid
from magnetosuture_thread.geometry.obstacles.mesh import Mesh
from magnetosuture_thread.geometry.obstacles.polygon import Polygon
from magnetosuture_thread.geometry.obstacles.search import MIN_DISTANCE

Obstacle = Disc | Polygon | Mesh
"""Any shape that `Workspace` takes."""

_MAX_CELLS = 80_000  # of all obstacles together, shared out by their numbers of features
_MIN_CELLS = 200
_MAX_OVERVIEW_CELLS = 20_000  # of the grid that tells which obstacles are near


class _FlatArray:
    """Concatenates arrays and keeps the offset of each."""

    def __init__(self) -> None:
        self._parts: list[NDArray[np.generic]] = []
        self.length = 0

    def add(self, array: NDArray[np.generic]) -> int:
        """Append an array; return where it begins."""
        begin = self.length
        self._parts.append(array.ravel())
        self.length += array.size
        return begin

    def array(self, kind: type[np.generic]) -> NDArray[np.generic]:
        """Return all in one array."""
        if kind is np.int32 and self.length > np.iinfo(np.int32).max:
            raise MemoryError(f"{self.length} entries of obstacles' grids")
        return np.concatenate([np.empty(0, kind), *self._parts]).astype(kind)


def pack_obstacles(
    shapes: Sequence[Obstacle], reach: float, dimension: int, wall_radius: float = math.inf
) -> WorkspaceData:
    """Return all obstacles with their grids in flat arrays.

    Each obstacle has a grid of its own over its workspace, so that its cells fit its features; a grid over
    all obstacles tells which of these a point is in, so that the far ones cost nothing.

    Args:
        shapes: the obstacles, all of this dimension.
        reach: greatest distance of a contact; at least MIN_DISTANCE is taken [m].
        dimension: 2 or 3.
        wall_radius: inner radius of the round wall about the origin, inf without a wall [m].
    """
    # A point on the boundary is found at reach 0 too, whichever way its distance is rounded.
    reach = max(reach, MIN_DISTANCE)
    frames, tables = np.zeros((len(shapes) + 1, 6)), np.zeros((len(shapes) + 1, 8), dtype=np.int64)
    spokes = np.zeros(len(shapes) + 1, dtype=np.int64)
    index, numbers = _FlatArray(), _FlatArray()
    low, high = np.empty((len(shapes), dimension)), np.empty((len(shapes), dimension))
    features: dict[int, Features] = {}
    for o, shape in enumerate(shapes):
        if isinstance(shape, Disc):
            frames[o + 1, :dimension], frames[o + 1, 5] = shape.centre, shape.radius
            tables[o + 1, 0] = BALL
            grown = (shape.radius + reach) * (1.0 + 1e-9) + 1e-12
            low[o], high[o] = np.array(shape.centre) - grown, np.array(shape.centre) + grown
        else:
            features[o] = edges_of(shape) if isinstance(shape, Polygon) else faces_of(shape)
    total = sum(len(found.corners) for found in features.values())
    for o, found in features.items():
        least, most = found.corners.min(axis=1), found.corners.max(axis=1)
        grid = plan_grid(least, most, reach, max(_MAX_CELLS * len(least) // total, _MIN_CELLS))
        frames[o + 1] = _frame(grid)
        kind = EDGES if isinstance(shapes[o], Polygon) else FACES
        cells = _add_cells(index, *fill_grid(grid, least, most, found.corners))
        tables[o + 1] = [kind, *grid.counts, cells, len(least), numbers.add(found.numbers), index.add(found.marks)]
        spokes[o + 1] = numbers.add(found.spokes)
        low[o], high[o] = least.min(axis=0) - grid.growth, most.max(axis=0) + grid.growth
    if shapes:
        over = plan_grid(low, high, 0.0, _MAX_OVERVIEW_CELLS)
        # The boxes are grown already: only rounding is left to allow for.
        over = dataclasses.replace(over, growth=1e-6 * over.size)
        frames[0] = _frame(over)
        tables[0, :5] = [
            -1,
            *over.counts,
            _add_cells(index, *fill_grid(over, low, high, np.empty((len(low), 0, dimension)))),
        ]
    data = WorkspaceData(
        reach,
        float(wall_radius),
        frames,
        tables,
        spokes,
        np.asarray(numbers.array(np.float64)),
        np.asarray(index.array(np.int32)),
    )
    for o in features:
        _mark_inside(o, data, data.entries, np.empty(0), np.empty((0, dimension)))
    return data


def _frame(grid: Grid) -> list[float]:
    return [*grid.low.tolist(), 1.0 / grid.size, grid.growth, 0.0]


def _add_cells(index: _FlatArray, starts: NDArray[np.int64], entries: NDArray[np.int64]) -> int:
    """Append entries and cells, none of them inside yet; return where the cells begin."""
    begin = index.add(entries)
    return index.add(np.stack([starts + begin, np.zeros_like(starts)], axis=1))


@compiled
def _mark_inside(
    obstacle: int,
    data: WorkspaceData,
    index: NDArray[np.int32],
    distance: NDArray[np.float64],
    normal: NDArray[np.float64],
) -> None:
    """Write into each cell whether its centre is inside.

    Near the boundary the nearest feature tells. Elsewhere the cell before tells, which is no farther away
    than the boundary; a line of cells begins outside.
    """
    frame, table = data.frames[obstacle + 1], data.tables[obstacle + 1]
    size = 1.0 / frame[3]
    for k in range(table[3]):
        z = frame[2] + (k + 0.5) * size if normal.shape[1] == 3 else 0.0
        for j in range(table[2]):
            y = frame[1] + (j + 0.5) * size
            inside = 0
            for i in range(table[1]):
                x = frame[0] + (i + 0.5) * size
                cell = table[4] + 2 * (i + table[1] * (j + table[2] * k))
                found = nearest_of(x, y, z, -1.0, obstacle, index[cell], index[cell + 2], data, 0, distance, normal)
                if np.sqrt(found.square) <= frame[4]:
                    inside = 1 if found.signed < 0.0 else 0
                index[cell + 1] = inside
