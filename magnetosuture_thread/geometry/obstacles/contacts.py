"""Contacts of points with all obstacles and the wall, compiled."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.compiled import compiled_inline, compiled_uncounted
from magnetosuture_thread.geometry.obstacles.search import ContactRows, Nearest, Vector, add_row, search_edges
from magnetosuture_thread.geometry.polyline import Points

FRICTION = 6
"""Column of `WorkspaceData.frames` with the coefficient of friction."""
BALL, EDGES = range(2)
"""Kinds of obstacles."""
WALL = -1
"""Index of the dish wall in place of an obstacle's."""


class WorkspaceData(NamedTuple):
    """All obstacles, packed into few arrays: each costs time when compiled code is entered. Not to be written to.

    Row 0 of `frames` and `tables` is the grid over all obstacles; row o + 1 belongs to obstacle o.

    Attributes:
        reach: greatest distance of a contact [m].
        wall_radius: inner radius of the round wall about the origin, inf without a wall [m].
        frames: shape (o + 1, 7): low corner of the grid (3) [m], 1 / cell size [1/m], growth [m], 0; of a
            ball its centre (3) [m], 0, 0, its radius [m]; then the coefficient of friction, in row 0 the wall's.
        tables: shape (o + 1, 7): kind, n_x, n_y, n_z of the grid, where its cells begin in `entries`, number of
            edges, where they begin in `numbers`.
        numbers: edges, flat.
        entries: cells and their entries, flat. A cell is two integers: where its entries begin (they end where those of
            the next cell begin), and whether it is inside where no edge is near.
    """

    reach: float
    wall_radius: float
    frames: NDArray[np.float64]
    tables: NDArray[np.int64]
    numbers: NDArray[np.float64]
    entries: NDArray[np.int32]


@compiled_inline
def cell_of(point: Vector, row: int, data: WorkspaceData) -> int:
    """Return where the cell of a point is in `entries`, or -1 when it is outside of the grid, or not a number."""
    x, y, z = point
    frame, table = data.frames[row], data.tables[row]
    i, j, k = (x - frame[0]) * frame[3], (y - frame[1]) * frame[3], (z - frame[2]) * frame[3]
    if not (0.0 <= i < table[1] and 0.0 <= j < table[2] and 0.0 <= k < table[3]):
        return -1
    return int(table[4] + 2 * (int(i) + table[1] * (int(j) + table[2] * int(k))))


@compiled_inline
def nearest_of(
    point: Vector,
    reach: float,
    obstacle: int,
    first: int,
    last: int,
    data: WorkspaceData,
    count: int,
    rows: ContactRows,
) -> Nearest:
    """Return the nearest boundary point of a polygon; see `search_edges` for the arguments."""
    base = data.tables[obstacle + 1, 6]
    x, y, _ = point
    return search_edges(x, y, reach, data.numbers, base, data.entries, first, last, count, rows.distance, rows.normal)


@compiled_inline
def _ball_contact(point: Vector, obstacle: int, data: WorkspaceData, count: int, rows: ContactRows) -> int:
    """Write the row of a disc or ball, |p - c| - r, when it is within reach; return the new count."""
    frame = data.frames[obstacle + 1]
    rx, ry, rz = point[0] - frame[0], point[1] - frame[1], point[2] - frame[2]
    length = math.sqrt(rx * rx + ry * ry + rz * rz)
    if length - frame[5] > data.reach:
        return count
    direction = (rx / length, ry / length, rz / length) if length > 0.0 else (1.0, 0.0, 0.0)
    return add_row(count, count, length - frame[5], direction, rows)


@compiled_inline
def wall_contact(x: float, y: float, radius: float) -> tuple[float, float, float]:
    """Return the distance of a point from a round wall about the origin, positive inside, and its gradient.

        sd(x) = R - |x|,    grad sd = -x / |x|

    In space the wall is a cylinder along z. At its centre every direction is as good; there it is -x.
    """
    away = math.sqrt(x * x + y * y)
    if away > 0.0:
        return radius - away, -x / away, -y / away
    return radius, -1.0, 0.0


@compiled_inline
def _shape_contacts(point: Vector, obstacle: int, data: WorkspaceData, count: int, rows: ContactRows) -> int:
    """Write the rows of a polygon at one point; return the new count, -1 when they are too many."""
    cell = cell_of(point, obstacle + 1, data)
    if cell < 0:
        return count
    first, last, inside = data.entries[cell], data.entries[cell + 2], data.entries[cell + 1]
    if first == last and inside == 0:
        return count
    start = count
    found = nearest_of(point, data.reach, obstacle, first, last, data, count, rows)
    if math.sqrt(found.square) > data.frames[obstacle + 1, 4]:
        # Nothing of the boundary within the growth, so none within the cell: all of it is on one side.
        if inside == 0:
            return count
        features = int(data.tables[obstacle + 1, 5])
        found = nearest_of(point, -1.0, obstacle, -1, features, data, count, rows)
        return add_row(start, start, -math.sqrt(found.square), (found.x, found.y, found.z), rows)
    if found.signed < 0.0:
        return add_row(start, start, found.signed, (found.x, found.y, found.z), rows)
    if found.rows < 0 or found.signed > data.reach:
        return found.rows
    least = np.inf
    for row in range(start, found.rows):
        least = min(least, rows.distance[row])
    if least > found.signed * (1.0 + 1e-9) + 1e-12:
        # Between two features that rounding gave to neither.
        return add_row(start, found.rows, found.signed, (found.x, found.y, found.z), rows)
    return found.rows


@compiled_uncounted
def find_contacts(
    points: Points,
    data: WorkspaceData,
    node: NDArray[np.int64],
    obstacle: NDArray[np.int64],
    distance: NDArray[np.float64],
    normal: NDArray[np.float64],
    nearest: NDArray[np.bool_],
) -> int:
    """Write the contacts of points into the caller's arrays; see `Workspace.near` for what they are.

    Args:
        points: shape (m, d) [m].
        data: `Workspace.data`.
        node: index of the point, shape (c,), c rows of room.
        obstacle: index of the obstacle, `WALL` for the wall, shape (c,).
        distance: signed distance, shape (c,) [m].
        normal: gradient of the signed distance, shape (c, d).
        nearest: whether the row is the nearest of its point and obstacle, shape (c,).

    Returns:
        The number of contacts, or -1 when there are more than the arrays have room for.
    """
    count, rows = 0, ContactRows(distance, normal)
    # Nearer to the centre than this, a point has no contact with the wall: most points pay for one comparison.
    inner = data.wall_radius - data.reach
    inner_square = inner * inner if inner > 0.0 else -1.0
    for i in range(len(points)):
        x, y = points[i, 0], points[i, 1]
        point = (x, y, points[i, 2] if points.shape[1] == 3 else 0.0)
        if inner_square <= x * x + y * y < np.inf:
            wall_distance, wall_x, wall_y = wall_contact(x, y, data.wall_radius)
            before = count
            count = add_row(count, count, wall_distance, (wall_x, wall_y, 0.0), rows)
            if count < 0:
                return -1
            node[before], obstacle[before], nearest[before] = i, WALL, True
        cell = cell_of(point, 0, data)
        if cell < 0:
            continue
        for slot in range(data.entries[cell], data.entries[cell + 2]):
            o = int(data.entries[slot])
            start = count
            if data.tables[o + 1, 0] == BALL:
                count = _ball_contact(point, o, data, count, rows)
            else:
                count = _shape_contacts(point, o, data, count, rows)
            if count < 0:
                return -1
            best = start
            for row in range(start, count):
                node[row], obstacle[row], nearest[row] = i, o, False
                if distance[row] < distance[best]:
                    best = row
            if count > start:
                nearest[best] = True
    return count
