"""Obstacles in flat arrays for compiled code, and signed distances from them: for thread, needle and planner alike.

The edges of a polygon that follow one another are kept in blocks of `BLOCK`, each in a circle, so that those far away
cost one test.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.geometry.compiled import compiled, compiled_inline, compiled_uncounted
from magnetosuture_thread.geometry.obstacles.shapes import Disc, Obstacle, Polygon
from magnetosuture_thread.geometry.polyline import Points

Vector = NDArray[np.float64]

BLOCK = 12
EDGE_WIDTH = 14
"""Numbers of an edge: start, end, unit direction (2 each), length, unit direction of the edge before (2),
pseudo-normals at start and end (2 each), and one to fill."""
MIN_DISTANCE = 1e-12
"""At a smaller distance from a vertex or an edge, the direction away from it is lost in rounding [m]."""
NO_BLOCK, NO_ROW = np.int64(-1), np.int64(0)  # typed: a kernel is compiled again for each number that is written out
_SAME_POINT = 1e-7  # two rows of one obstacle that differ by less are one point of its boundary


class WorkspaceData(NamedTuple):
    """Obstacles and wall for compiled code. Not to be written to.

    Discs, which are balls in space, come first, then polygons; `shapes` says which obstacle each of these is.

    Attributes:
        reach: greatest distance of a contact [m].
        wall_radius: inner radius of the round wall about the origin, inf without a wall [m].
        discs: x, y, radius and z of each disc; z is 0 in the plane, shape (d, 4) [m].
        polygons: for each polygon its first block and the one after its last, shape (p, 2).
        boxes: least x and y and greatest x and y of each polygon, shape (p, 4) [m].
        shapes: index of each disc, then of each polygon, among the obstacles, shape (d + p,).
        order: the inverse: where each obstacle is among discs and polygons, shape (d + p,).
        circles: centre and radius of the circle around each block of edges, shape (b, 3) [m].
        ranges: first edge of each block and the number of its edges, shape (b, 2).
        edges: rows of `EDGE_WIDTH` numbers, flat, see `edges_of`.
        friction: Coulomb's coefficient of the wall, then of each obstacle, shape (d + p + 1,).
    """

    reach: float
    wall_radius: float
    discs: Points
    polygons: NDArray[np.int64]
    boxes: Points
    shapes: NDArray[np.int64]
    order: NDArray[np.int64]
    circles: Points
    ranges: NDArray[np.int64]
    edges: Vector
    friction: Vector


def edges_of(polygon: Polygon) -> Points:
    """Return the edges of a polygon, shape (e, EDGE_WIDTH).

        n = (d_y, -d_x)    outward normal of an edge with direction d, as the solid is to the left

    A vertex's pseudo-normal is the mean of the normals of its two edges.

    Source: J. A. Baerentzen, H. Aanaes 2005, the plane's counterpart of angle-weighted normals.
    """
    tables = []
    for start in polygon.rings:
        end = np.roll(start, -1, axis=0)
        length = np.hypot(*(end - start).T)[:, None]
        along = (end - start) / length
        before = np.roll(along, 1, axis=0)
        pseudo = np.stack([along[:, 1] + before[:, 1], -along[:, 0] - before[:, 0]], axis=1)
        # At a needle's tip the two normals nearly cancel; the way there points out of the tip as well, or
        # at the tip of a needle-shaped notch into it.
        left = before[:, 0] * along[:, 1] - before[:, 1] * along[:, 0] > 0.0
        tip = np.linalg.norm(pseudo, axis=1) < 1e-6
        pseudo[tip] = np.where(left[tip, None], 1.0, -1.0) * (before - along)[tip]
        pseudo /= np.linalg.norm(pseudo, axis=1)[:, None]
        tables.append(np.hstack([start, end, along, length, before, pseudo, np.roll(pseudo, -1, axis=0), 0.0 * length]))
    return np.vstack(tables)


def pack_obstacles(
    obstacles: Sequence[Obstacle], wall_radius: float = math.inf, reach: float = 0.0, friction: Sequence[float] = ()
) -> WorkspaceData:
    """Return obstacles and wall for compiled code.

    Args:
        obstacles: discs or balls, and polygons.
        wall_radius: inner radius of the wall, inf without one [m].
        reach: greatest distance of a contact; at least MIN_DISTANCE is taken [m].
        friction: coefficients of the wall, then of each obstacle; none for no friction.
    """
    discs = [k for k, obstacle in enumerate(obstacles) if isinstance(obstacle, Disc)]
    polygons = [k for k, obstacle in enumerate(obstacles) if isinstance(obstacle, Polygon)]
    balls = [(shape.centre, shape.radius) for shape in obstacles if isinstance(shape, Disc)]
    tables = [edges_of(shape) for shape in obstacles if isinstance(shape, Polygon)]
    circles, ranges, blocks = [np.empty((0, 3))], [np.empty((0, 2), np.int64)], [0]
    edges = 0
    for table in tables:
        first = np.arange(0, len(table), BLOCK)
        low = np.minimum.reduceat(np.minimum(table[:, 0:2], table[:, 2:4]), first)
        high = np.maximum.reduceat(np.maximum(table[:, 0:2], table[:, 2:4]), first)
        # Rounding must not leave a corner outside of its circle.
        radius = 0.5 * np.hypot(*(high - low).T) * (1.0 + 1e-9) + 1e-12 * float(np.abs(table[:, :4]).max())
        circles.append(np.column_stack([0.5 * (low + high), radius]))
        ranges.append(np.column_stack([edges + first, np.minimum(BLOCK, len(table) - first)]))
        blocks.append(blocks[-1] + len(first))
        edges += len(table)
    shapes = np.array([*discs, *polygons], dtype=np.int64)
    return WorkspaceData(
        max(float(reach), MIN_DISTANCE),
        float(wall_radius),
        np.array([(*centre[:2], radius, *centre[2:], 0.0)[:4] for centre, radius in balls]).reshape(-1, 4),
        np.array([*pairwise(blocks)], dtype=np.int64).reshape(-1, 2),
        np.array([[*table[:, :2].min(axis=0), *table[:, :2].max(axis=0)] for table in tables]).reshape(-1, 4),
        shapes,
        np.argsort(shapes),
        np.concatenate(circles),
        np.concatenate(ranges),
        np.concatenate([np.empty(0), *(table.ravel() for table in tables)]),
        np.array(friction if len(friction) else np.zeros(len(obstacles) + 1), dtype=np.float64),
    )


@compiled
def closest_on_segment(px: float, py: float, ax: float, ay: float, bx: float, by: float) -> tuple[float, float, float]:
    """Return the point of a segment ab that is closest to p, and where it is on the segment.

        q = a + t (b - a),    t = clamp((p - a) . (b - a) / |b - a|^2, 0, 1)

    A segment without length is the point a. Returns q_x, q_y, t; q is a or b itself at t = 0 and 1.
    """
    dx, dy = bx - ax, by - ay
    along = (px - ax) * dx + (py - ay) * dy
    square = dx * dx + dy * dy
    if not along > 0.0:
        return ax, ay, 0.0
    if along >= square:
        return bx, by, 1.0
    t = along / square
    return ax + t * dx, ay + t * dy, t


class Nearest(NamedTuple):
    """The nearest boundary point of a polygon, and where in the rows the next one goes.

    Attributes:
        rows: number of rows so far; -1 when they were too many for the arrays.
        square: square of the distance; infinity when no edge was near enough to be searched [m^2].
        signed: signed distance [m].
        x: outward direction there.
        y: outward direction there.
        edge: where its numbers begin in `WorkspaceData.edges`.
        block: its block; -1 for none.
    """

    rows: int
    square: float
    signed: float
    x: float
    y: float
    edge: int
    block: int


class Contacts(NamedTuple):
    """Where points or chords are near obstacles or the wall: k rows, in the order of nodes, then obstacles.

    Attributes:
        node: index of the point, or of the chord's first node, shape (k,).
        obstacle: index of the obstacle, `WALL` for the dish wall, shape (k,).
        distance: signed distance, negative inside of an obstacle and beyond the wall, shape (k,) [m].
        normal: gradient of the signed distance, unit vectors, shape (k, d).
        nearest: whether the row is the nearest of its point and obstacle, one for each pair, shape (k,).
        place: where on the segment from the node on, 0 at the node itself, shape (k,).
    """

    node: NDArray[np.int64]
    obstacle: NDArray[np.int64]
    distance: Vector
    normal: Points
    nearest: NDArray[np.bool_]
    place: Vector

    @classmethod
    def room(cls, count: int, dimension: int) -> Contacts:
        """Return arrays for a number of rows."""
        (node, obstacle), (distance, place) = np.zeros((2, count), np.int64), np.zeros((2, count))
        return cls(node, obstacle, distance, np.zeros((count, dimension)), np.zeros(count, np.bool_), place)


class ContactRows(NamedTuple):
    """Arrays that contacts are written to, row by row.

    Attributes:
        distance: signed distance, shape (c,) [m].
        normal: outward direction, shape (c, d).
    """

    distance: Vector
    normal: Points


@compiled_inline
def add_row(start: int, count: int, length: float, direction: tuple[float, float, float], rows: ContactRows) -> int:
    """Write a row unless it is the same boundary point as a row since `start`; return the new count.

    Where neighbouring edges are in line, rounding may give the point between them to both.
    """
    if count < 0:
        return count
    distance, normal = rows.distance, rows.normal
    x, y, z = direction
    dimension = normal.shape[1]
    for row in range(start, count):
        if (
            abs(distance[row] - length) <= _SAME_POINT * length + MIN_DISTANCE
            and abs(normal[row, 0] - x) <= _SAME_POINT
            and abs(normal[row, 1] - y) <= _SAME_POINT
            and (dimension == 2 or abs(normal[row, 2] - z) <= _SAME_POINT)
        ):
            return count
    if count >= len(distance):
        return -1
    distance[count] = length
    normal[count, 0] = x
    normal[count, 1] = y
    if dimension == 3:
        normal[count, 2] = z
    return count + 1


@compiled_uncounted
def search_block(
    x: float, y: float, reach: float, block: int, data: WorkspaceData, start: int, count: int, rows: ContactRows
) -> Nearest:
    """Return the nearest of a block's edges, and write a row for each local minimum of the distance outside.

    An edge gives a row when the projection falls inside of it and the point is on its outer side; a vertex
    when the projections onto both its edges clamp to it.

    Args:
        x: coordinate of the point [m].
        y: coordinate of the point [m].
        reach: greatest distance of a row; negative for no rows [m].
        block: index of the block.
        data: packed obstacles.
        start: the first row of this polygon.
        count: number of rows so far.
        rows: written from `count` on.
    """
    numbers, limit, best, edge = data.edges, reach * reach if reach >= 0.0 else -1.0, np.inf, 0
    # Of the best: whether a vertex; the vector from it to the point; its normal or pseudo-normal.
    corner, bx, by, nx, ny = False, 0.0, 0.0, 0.0, 0.0
    first = data.ranges[block, 0]
    for at in range(first, first + data.ranges[block, 1]):
        k = at * EDGE_WIDTH
        rx, ry = x - numbers[k], y - numbers[k + 1]
        dx, dy = numbers[k + 4], numbers[k + 5]
        along = rx * dx + ry * dy
        if along <= 0.0:
            square = rx * rx + ry * ry
            if square < best:
                best, edge, corner, bx, by, nx, ny = square, k, True, rx, ry, numbers[k + 9], numbers[k + 10]
            if (
                square <= limit
                and rx * numbers[k + 7] + ry * numbers[k + 8] >= 0.0
                and rx * numbers[k + 9] + ry * numbers[k + 10] >= 0.0
            ):
                length = math.sqrt(square)
                if length > MIN_DISTANCE:
                    count = add_row(start, count, length, (rx / length, ry / length, 0.0), rows)
                else:
                    count = add_row(start, count, length, (numbers[k + 9], numbers[k + 10], 0.0), rows)
        elif along >= numbers[k + 6]:
            rx, ry = x - numbers[k + 2], y - numbers[k + 3]
            square = rx * rx + ry * ry
            if square < best:
                best, edge, corner, bx, by, nx, ny = square, k, True, rx, ry, numbers[k + 11], numbers[k + 12]
        else:
            side = rx * dy - ry * dx
            square = side * side
            if square < best:
                best, edge, corner, bx, by, nx, ny = square, k, False, rx, ry, dy, -dx
            if side >= 0.0 and square <= limit:
                count = add_row(start, count, side, (dy, -dx, 0.0), rows)
    length = math.sqrt(best)
    sign = 1.0 if bx * nx + by * ny >= 0.0 else -1.0
    if corner and length > MIN_DISTANCE:
        nx, ny = sign * bx / length, sign * by / length
    return Nearest(count, best, sign * length, nx, ny, edge, block)


@compiled_uncounted
def polygon_rows(
    x: float, y: float, polygon: int, reach: float, data: WorkspaceData, count: int, rows: ContactRows
) -> Nearest:
    """Write the rows of a polygon within reach, see `search_block`, and return the nearest of them.

    Edges of a block that is in part within reach count too. Where no block is, the square is infinite, and the block
    the one whose middle is nearest.
    """
    start, closest = count, np.inf
    best = Nearest(count, np.inf, np.inf, 0.0, 0.0, 0, -1)
    for block in range(data.polygons[polygon, 0], data.polygons[polygon, 1]):
        dx, dy = x - data.circles[block, 0], y - data.circles[block, 1]
        far, square = reach + data.circles[block, 2], dx * dx + dy * dy
        if square > far * far:
            if square < closest and best.square == np.inf:
                closest = square
                best = Nearest(count, np.inf, np.inf, 0.0, 0.0, 0, block)
            continue
        found = search_block(x, y, reach, block, data, start, count, rows)
        count = found.rows
        if found.square < best.square:
            best = found
    return Nearest(count, best.square, best.signed, best.x, best.y, best.edge, best.block)


@compiled_uncounted
def nearest_edge(x: float, y: float, polygon: int, guess: int, data: WorkspaceData) -> Nearest:
    """Return the nearest boundary point of a polygon.

    Exact however far the point is, inside and outside: the edge or corner that is nearest of all tells the side.

    Args:
        x: coordinate of the point [m].
        y: coordinate of the point [m].
        polygon: its index in `data.polygons`.
        guess: a block that may be near, which saves looking at others; -1 for none.
        data: packed obstacles.
    """
    no_rows = ContactRows(data.edges, data.circles)  # of which none is written
    first, last = data.polygons[polygon, 0], data.polygons[polygon, 1]
    best = Nearest(0, np.inf, np.inf, 0.0, 0.0, 0, -1)
    if first <= guess < last:
        best = search_block(x, y, -1.0, guess, data, NO_ROW, NO_ROW, no_rows)
    reach = math.sqrt(best.square)
    for block in range(first, last):
        dx, dy = x - data.circles[block, 0], y - data.circles[block, 1]
        far = reach + data.circles[block, 2]
        if block == guess or dx * dx + dy * dy >= far * far:
            continue
        found = search_block(x, y, -1.0, block, data, NO_ROW, NO_ROW, no_rows)
        if found.square < best.square:
            best, reach = found, math.sqrt(found.square)
    return best


@compiled_uncounted
def shape_distance(x: float, y: float, s: int, guess: int, data: WorkspaceData) -> tuple[float, float, float, int]:
    """Return the signed distance of a point in the plane from a shape, its gradient (2), and the block that is nearest.

    Args:
        x: coordinate of the point [m].
        y: coordinate of the point [m].
        s: index in `data.shapes`.
        guess: see `nearest_edge`.
        data: packed obstacles.
    """
    discs = len(data.discs)
    if s < discs:
        qx, qy = x - data.discs[s, 0], y - data.discs[s, 1]
        away = math.hypot(qx, qy)
        gx, gy = (qx / away, qy / away) if away > 0.0 else (1.0, 0.0)
        return away - data.discs[s, 2], gx, gy, -1
    found = nearest_edge(x, y, s - discs, guess, data)
    return found.signed, found.x, found.y, found.block


@compiled
def measure(points: Points, data: WorkspaceData, distances: Points, normal: NDArray[np.float64]) -> None:
    """Write the signed distance of each point from each disc, then polygon, (m, s), and its gradient, (m, s, 2)."""
    for s in range(distances.shape[1]):
        guess = -1
        for i in range(len(points)):
            found = shape_distance(points[i, 0], points[i, 1], s, guess, data)
            distances[i, s], normal[i, s, 0], normal[i, s, 1], guess = found
