"""Workspace: the dish wall and all obstacles, and the contacts of points with them."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.arguments import bounded, checked_arguments
from magnetosuture_thread.compiled import compiled
from magnetosuture_thread.errors import ConfigurationError
from magnetosuture_thread.geometry.obstacles.contacts import (
    BALL,
    EDGES,
    FRICTION,
    WorkspaceData,
    find_contacts,
    nearest_of,
)
from magnetosuture_thread.geometry.obstacles.features import EDGE_WIDTH, edges_of
from magnetosuture_thread.geometry.obstacles.search import MIN_DISTANCE, ContactRows, closest_on_segment
from magnetosuture_thread.geometry.obstacles.shapes import MIN_EXTENT, Disc, Obstacle
from magnetosuture_thread.geometry.polyline import Points

_MAX_CELLS = 80_000  # of all obstacles together, shared out by their numbers of features
_MIN_CELLS = 200
_MAX_OVERVIEW_CELLS = 20_000  # of the grid that tells which obstacles are near
MAX_FRICTION = 2.0  # a coefficient
_ROWS_A_POINT = 16  # contacts that `near` has room for at first; a point in a narrow corner has two of one shape


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


def fill_grid(grid: Grid, low: Points, high: Points, edges: NDArray[np.float64]) -> tuple[NDArray[np.int64], ...]:
    """Return the features near each cell: starts, shape (cells + 1,), and feature numbers, ascending.

    A feature is listed when its box, grown, meets the cell's box, and it is itself as near as that to
    the ball around the cell.

    Args:
        grid: the cells.
        low: least coordinates of each feature, shape (f, d) [m].
        high: greatest coordinates of each feature, shape (f, d) [m].
        edges: of a polygon, shape (f, EDGE_WIDTH), or (f, 0) to go by the boxes alone [m].
    """
    dimension = low.shape[1]
    first = np.zeros((len(low), 3), dtype=np.int64)
    last = np.zeros((len(low), 3), dtype=np.int64)
    base = grid.low[:dimension]
    for table, edge in ((first, low - grid.growth), (last, high + grid.growth)):
        cell = np.floor((edge - base) / grid.size)
        table[:, :dimension] = np.clip(cell, 0, grid.counts[:dimension] - 1).astype(np.int64)
    radius = grid.growth + 0.5 * grid.size * math.sqrt(dimension) * (1.0 + 1e-9)
    arguments = (first, last, grid.counts, grid.low, grid.size, radius, edges)
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
    edges: NDArray[np.float64],
    cursor: NDArray[np.int64],
    entries: NDArray[np.int64],
) -> None:
    """Count the features of each cell in `cursor`, or, with room in `entries`, write them there."""
    for feature in range(len(first)):
        for k in range(first[feature, 2], last[feature, 2] + 1):
            for j in range(first[feature, 1], last[feature, 1] + 1):
                y = low[1] + (j + 0.5) * size
                for i in range(first[feature, 0], last[feature, 0] + 1):
                    x = low[0] + (i + 0.5) * size
                    if edges.shape[1] > 0 and _distance(x, y, edges[feature]) > radius:
                        continue
                    cell = i + counts[0] * (j + counts[1] * k)
                    if len(entries) > 0:
                        entries[cursor[cell]] = feature
                    cursor[cell] += 1


@compiled
def _distance(x: float, y: float, edge: NDArray[np.float64]) -> float:
    """Return the distance of a point from an edge [m]."""
    u, v, _ = closest_on_segment(x, y, edge[0], edge[1], edge[2], edge[3])
    return float(np.hypot(x - u, y - v))


def pack_obstacles(
    shapes: Sequence[Obstacle], reach: float, dimension: int, wall_radius: float = math.inf
) -> WorkspaceData:
    """Return all obstacles with their grids in flat arrays.

    Each polygon has a grid of its own, so that its cells fit its edges; a grid over all obstacles tells which of these
    a point is in, so that the far ones cost nothing.

    Args:
        shapes: the obstacles, all of this dimension.
        reach: greatest distance of a contact; at least MIN_DISTANCE is taken [m].
        dimension: 2 or 3.
        wall_radius: inner radius of the round wall about the origin, inf without a wall [m].
    """
    # A point on the boundary is found at reach 0 too, whichever way its distance is rounded.
    reach = max(reach, MIN_DISTANCE)
    frames, tables = np.zeros((len(shapes) + 1, FRICTION + 1)), np.zeros((len(shapes) + 1, 7), dtype=np.int64)
    low, high = np.empty((len(shapes), dimension)), np.empty((len(shapes), dimension))
    numbers, cells = [np.empty((0, EDGE_WIDTH))], [np.empty(0, np.int64)]
    edges = {o: edges_of(shape).numbers for o, shape in enumerate(shapes) if not isinstance(shape, Disc)}
    total = sum(map(len, edges.values()))

    def add_grid(row: int, grid: Grid, starts: NDArray[np.int64], entries: NDArray[np.int64]) -> None:
        """Append entries and cells, none of them inside yet."""
        frames[row, :FRICTION] = [*grid.low.tolist(), 1.0 / grid.size, grid.growth, 0.0]
        begin = sum(map(len, cells))
        tables[row, 1:5] = [*grid.counts, begin + len(entries)]
        cells.extend((entries, np.stack([starts + begin, np.zeros_like(starts)], axis=1).ravel()))

    for o, shape in enumerate(shapes):
        if isinstance(shape, Disc):
            frames[o + 1, :dimension], frames[o + 1, 5] = shape.centre, shape.radius
            tables[o + 1, 0] = BALL
            grown = (shape.radius + reach) * (1.0 + 1e-9) + 1e-12
            low[o], high[o] = np.array(shape.centre) - grown, np.array(shape.centre) + grown
            continue
        ends = edges[o][:, :4].reshape(-1, 2, 2)
        least, most = ends.min(axis=1), ends.max(axis=1)
        grid = plan_grid(least, most, reach, max(_MAX_CELLS * len(ends) // total, _MIN_CELLS))
        add_grid(o + 1, grid, *fill_grid(grid, least, most, edges[o]))
        tables[o + 1, 0], tables[o + 1, 5:] = EDGES, (len(ends), sum(table.size for table in numbers))
        numbers.append(edges[o])
        low[o], high[o] = least.min(axis=0) - grid.growth, most.max(axis=0) + grid.growth
    if shapes:
        over = plan_grid(low, high, 0.0, _MAX_OVERVIEW_CELLS)
        # The boxes are grown already: only rounding is left to allow for.
        over = dataclasses.replace(over, growth=1e-6 * over.size)
        add_grid(0, over, *fill_grid(over, low, high, np.empty((len(low), 0))))
        tables[0, 0] = -1
    flat = np.concatenate(numbers).ravel(), np.concatenate(cells).astype(np.int32)
    data = WorkspaceData(reach, float(wall_radius), frames, tables, *flat)
    for o in edges:
        _mark_inside(o, data, ContactRows(np.empty(0), np.empty((0, dimension))))
    return data


@compiled
def _mark_inside(obstacle: int, data: WorkspaceData, rows: ContactRows) -> None:
    """Write into each cell whether its centre is inside.

    Near the boundary the nearest feature tells. Elsewhere the cell before tells, which is no farther away
    than the boundary; a line of cells begins outside.
    """
    frame, table, entries = data.frames[obstacle + 1], data.tables[obstacle + 1], data.entries
    size = 1.0 / frame[3]
    for j in range(table[2]):
        y = frame[1] + (j + 0.5) * size
        inside = 0
        for i in range(table[1]):
            x = frame[0] + (i + 0.5) * size
            cell = table[4] + 2 * (i + table[1] * j)
            found = nearest_of((x, y, 0.0), -1.0, obstacle, entries[cell], entries[cell + 2], data, 0, rows)
            if np.sqrt(found.square) <= frame[4]:
                inside = 1 if found.signed < 0.0 else 0
            entries[cell + 1] = inside


@dataclass(frozen=True, eq=False)
class Contacts:
    """Where points are near obstacles or the dish wall: k rows, in the order of nodes, then obstacles.

    Attributes:
        node: index of the point, shape (k,).
        obstacle: index of the obstacle, `WALL` for the dish wall, shape (k,).
        distance: signed distance, negative inside of an obstacle and beyond the wall, shape (k,) [m].
        normal: gradient of the signed distance, unit vectors, shape (k, d).
        nearest: whether the row is the nearest of its point and obstacle, one for each pair, shape (k,).
    """

    node: NDArray[np.int64]
    obstacle: NDArray[np.int64]
    distance: NDArray[np.float64]
    normal: Points
    nearest: NDArray[np.bool_]

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.node)


class Workspace:
    """Obstacles that do not move and the round wall of the dish about the origin, and what of them is near.

    Args:
        shapes: the obstacles: discs, which are balls in space, and polygons, in the plane only.
        reach: greatest distance at which a boundary is near, not negative [m].
        dimension: 2 or 3.
        wall_radius: inner radius of the wall, in space a cylinder along z; inf without a wall [m].
        friction: Coulomb's coefficient of each shape, none for no friction; in the plane only.
        wall_friction: the same of the wall.

    Attributes:
        shapes: the obstacles.
        reach: greatest distance at which a boundary is near [m].
        dimension: 2 or 3.
        wall_radius: inner radius of the wall [m].
        friction: of each shape.
        wall_friction: of the wall.
        data: the same for compiled code, see `find_contacts`.

    Raises:
        ConfigurationError: when a shape is not of this dimension, or a number is not in its bounds.
    """

    @checked_arguments("workspace")
    def __init__(
        self,
        shapes: Sequence[Obstacle],
        reach: Annotated[float, bounded("m", 0.0, 100.0)],
        dimension: Annotated[int, bounded("", 2, 3)] = 2,
        wall_radius: Annotated[float, bounded("m", MIN_EXTENT, 10.0, unlimited=True)] = math.inf,
        friction: Annotated[Sequence[float], bounded("", 0.0, MAX_FRICTION)] = (),
        wall_friction: Annotated[float, bounded("", 0.0, MAX_FRICTION)] = 0.0,
    ) -> None:
        self.shapes, self.reach, self.dimension, self.wall_radius = tuple(shapes), reach, dimension, wall_radius
        for i, shape in enumerate(self.shapes):
            _check(f"workspace.shapes[{i}]", shape, dimension)
        self.friction, self.wall_friction = tuple(friction) or (0.0,) * len(self.shapes), wall_friction
        _check_friction(self.friction, wall_friction, len(self.shapes), dimension)
        self.data = pack_obstacles(self.shapes, self.reach, dimension, self.wall_radius)
        self.data.frames[:, FRICTION] = wall_friction, *self.friction

    def near(self, points: Points) -> Contacts:
        """Return the contacts of points: every local minimum of the distance to an obstacle's boundary.

            outward = grad sd(x),    closest point = x - sd(x) outward

        A point outside has a row for every boundary point that is closer to it than the boundary around,
        within reach: one at a straight wall of many edges, two in a corner that reaches around it. A point
        inside has one row, the nearest, however deep it is. Exactly on the boundary the distance is 0 and
        the direction the normal. A point that is not a number has no row.

        The wall has one row for each point within reach, and for each beyond it, before those of the obstacles.

        Args:
            points: shape (m, d) [m].

        Raises:
            ValueError: when points are not of this dimension.

        Source: J. A. Baerentzen, H. Aanaes 2005, sign by pseudo-normals.
        """
        points = np.array(points, dtype=np.float64, order="C")
        if points.ndim != 2 or points.shape[1] != self.dimension:
            raise ValueError(f"points of shape {points.shape}, expected (m, {self.dimension})")
        room, count = _ROWS_A_POINT * (len(points) + 1), -1
        while count < 0:  # in a scene of many shapes a point may be near all of them
            room *= 2
            node, obstacle, nearest = np.empty(room, np.int64), np.empty(room, np.int64), np.empty(room, np.bool_)
            distance, normal = np.empty(room), np.empty((room, self.dimension))
            count = find_contacts(points, self.data, node, obstacle, distance, normal, nearest)
        found = [array[:count].copy() for array in (node, obstacle, distance, normal, nearest)]
        for array in found:
            array.setflags(write=False)
        return Contacts(*found)


def _check_friction(friction: tuple[float, ...], wall_friction: float, shapes: int, dimension: int) -> None:
    if len(friction) != shapes:
        raise ConfigurationError("workspace.friction", f"{len(friction)} values", f"one for each of {shapes} shapes")
    for name, value in (("wall_friction", wall_friction), *((f"friction[{i}]", mu) for i, mu in enumerate(friction))):
        if value > 0.0 and dimension != 2:
            raise ConfigurationError(f"workspace.{name}", value, "0 in space: friction is of the plane")


def _check(name: str, shape: Obstacle, dimension: int) -> None:
    if isinstance(shape, Disc):
        if len(shape.centre) != dimension:
            raise ConfigurationError(f"{name}.centre", shape.centre, f"{dimension} coordinates [m]")
    elif dimension != 2:
        raise ConfigurationError(name, "a polygon", "a disc with three coordinates, which is a ball, in space")
