"""Uniform grids that list the features near each cell, in compressed rows."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.compiled import compiled
from magnetosuture_thread.geometry.obstacles.closest import closest_in_space, closest_on_segment
from magnetosuture_thread.geometry.polyline import Points


@dataclass(frozen=True)
class Grid:
    """Equal cells over a box. Cell (i, j, k) has the number i + n_x (j + n_y k).

    Attributes:
        low: corner of the box, shape (3,); 0 for a third coordinate that there is not [m].
        size: edge of a cell [m].
        counts: cells along each axis, shape (3,).
        growth: how far from a cell a feature may be and still be listed for it; no less than the reach,
            nor than the diagonal of a cell [m].
    """

    low: NDArray[np.float64]
    size: float
    counts: NDArray[np.int64]
    growth: float

    @property
    def cells(self) -> int:
        """Number of cells."""
        return int(self.counts.prod())


def plan_grid(low: Points, high: Points, reach: float, budget: int) -> Grid:
    """Return a grid around boxes, of cells half as large as a box, at least a part of the reach.

    Cells are enlarged until there are at most `budget` of them: this bounds the memory.

    Args:
        low: least coordinates of each box, shape (b, d) [m].
        high: greatest coordinates of each box, shape (b, d) [m].
        reach: the distance that queries ask for [m].
        budget: greatest number of cells, some dozens at least.
    """
    dimension = low.shape[1]
    bottom, top = low.min(axis=0), high.max(axis=0)
    extent = float((top - bottom).max())
    part = 0.25 if dimension == 2 else 0.5
    size = max(part * reach, 0.5 * float(np.median((high - low).max(axis=1))), 1e-6 * extent, 1e-12)
    while True:
        # Room for rounding: a point on the limit of a cell may be found in the next one.
        growth = max(reach, size * math.sqrt(dimension)) * (1.0 + 1e-9) + 1e-12
        counts = np.ceil((top - bottom + 2.0 * growth) / size)
        if counts.prod() <= budget or size > 4.0 * extent + reach:
            break
        size *= 1.15
    padded = np.zeros(3)
    padded[:dimension] = bottom - growth
    cells = np.ones(3, dtype=np.int64)
    cells[:dimension] = np.maximum(counts, 1).astype(np.int64)
    return Grid(padded, size, cells, growth)


def fill_grid(grid: Grid, low: Points, high: Points, corners: NDArray[np.float64]) -> tuple[NDArray[np.int64], ...]:
    """Return the features near each cell: starts, shape (cells + 1,), and feature numbers, ascending.

    A feature is listed when its box, grown, meets the cell's box, and it is itself as near as that to
    the ball around the cell.

    Args:
        grid: the cells.
        low: least coordinates of each feature, shape (f, d) [m].
        high: greatest coordinates of each feature, shape (f, d) [m].
        corners: features, shape (f, 2, 2) or (f, 3, 3), or (f, 0, d) to go by the boxes alone [m].
    """
    dimension = low.shape[1]
    first = np.zeros((len(low), 3), dtype=np.int64)
    last = np.zeros((len(low), 3), dtype=np.int64)
    base = grid.low[:dimension]
    for table, edge in ((first, low - grid.growth), (last, high + grid.growth)):
        cell = np.floor((edge - base) / grid.size)
        table[:, :dimension] = np.clip(cell, 0, grid.counts[:dimension] - 1).astype(np.int64)
    radius = grid.growth + 0.5 * grid.size * math.sqrt(dimension) * (1.0 + 1e-9)
    arguments = (first, last, grid.counts, grid.low, grid.size, radius, np.ascontiguousarray(corners))
    starts = np.zeros(grid.cells + 1, dtype=np.int64)
    _visit_cells(*arguments, starts, np.empty(0, dtype=np.int64))
    starts = np.concatenate([[0], np.cumsum(starts[:-1])])
    entries = np.empty(int(starts[-1]), dtype=np.int64)
    _visit_cells(*arguments, starts.copy(), entries)
    return starts, entries


@compiled
def _visit_cells(
    first: NDArray[np.int64],
    last: NDArray[np.int64],
    counts: NDArray[np.int64],
    low: NDArray[np.float64],
    size: float,
    radius: float,
    corners: NDArray[np.float64],
    cursor: NDArray[np.int64],
    entries: NDArray[np.int64],
) -> None:
    """Count the features of each cell in `cursor`, or, with room in `entries`, write them there."""
    for feature in range(len(first)):
        for k in range(first[feature, 2], last[feature, 2] + 1):
            z = low[2] + (k + 0.5) * size
            for j in range(first[feature, 1], last[feature, 1] + 1):
                y = low[1] + (j + 0.5) * size
                for i in range(first[feature, 0], last[feature, 0] + 1):
                    x = low[0] + (i + 0.5) * size
                    if corners.shape[1] > 0 and _distance(x, y, z, corners[feature]) > radius:
                        continue
                    cell = i + counts[0] * (j + counts[1] * k)
                    if len(entries) > 0:
                        entries[cursor[cell]] = feature
                    cursor[cell] += 1


@compiled
def _distance(x: float, y: float, z: float, corner: NDArray[np.float64]) -> float:
    """Return the distance of a point from a segment in the plane, or from a triangle in space [m]."""
    if len(corner) == 2:
        u, v, _ = closest_on_segment(x, y, corner[0, 0], corner[0, 1], corner[1, 0], corner[1, 1])
        return float(np.hypot(x - u, y - v))
    a, b, c = corner[0], corner[1], corner[2]
    u, v, w, _ = closest_in_space(x, y, z, a[0], a[1], a[2], b[0], b[1], b[2], c[0], c[1], c[2])
    return float(np.sqrt((x - u) ** 2 + (y - v) ** 2 + (z - w) ** 2))
