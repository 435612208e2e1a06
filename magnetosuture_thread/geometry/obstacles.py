"""Obstacles in flat arrays for compiled code; distances and contacts of points, for thread, needle and planner alike.

The edges of a polygon that follow one another are kept in blocks of `BLOCK`, each in a circle, so that those far away
cost one test.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Annotated, NamedTuple

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.geometry.compiled import (
    compiled,
    compiled_inline,
    compiled_inner,
    compiled_uncounted,
    compiled_within,
)
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.geometry.shapes import MIN_EXTENT, Disc, Obstacle, Polygon, triangulate
from magnetosuture_thread.settings.configuration import bounded, checked_arguments
from magnetosuture_thread.settings.errors import ConfigurationError

__all__ = ["Disc", "Obstacle", "Polygon", "triangulate"]

Vector = NDArray[np.float64]

BLOCK = 12
EDGE_WIDTH = 14
"""Numbers of an edge: start, end, unit direction (2 each), length, unit direction of the edge before (2),
pseudo-normals at start and end (2 each), and one to fill."""
MIN_DISTANCE = 1e-12
"""At a smaller distance from a vertex or an edge, the direction away from it is lost in rounding [m]."""
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
    shapes = np.array(sorted(range(len(obstacles)), key=lambda k: isinstance(obstacles[k], Polygon)), dtype=np.int64)
    discs = [shape for shape in obstacles if isinstance(shape, Disc)]
    balls = [(*disc.centre[:2], disc.radius, *disc.centre[2:], 0.0)[:4] for disc in discs]
    tables = [edges_of(shape) for shape in obstacles if isinstance(shape, Polygon)]
    circles, ranges, blocks, edges = [np.empty((0, 3))], [np.empty((0, 2), np.int64)], [0], 0
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
    return WorkspaceData(
        max(float(reach), MIN_DISTANCE),
        float(wall_radius),
        np.array(balls).reshape(-1, 4),
        np.array([*pairwise(blocks)], dtype=np.int64).reshape(-1, 2),
        np.array([[*table[:, :2].min(axis=0), *table[:, :2].max(axis=0)] for table in tables]).reshape(-1, 4),
        shapes,
        np.argsort(shapes),
        np.concatenate(circles),
        np.concatenate(ranges),
        np.concatenate([np.empty(0), *(table.ravel() for table in tables)]),
        np.array(friction if len(friction) else np.zeros(len(obstacles) + 1), dtype=np.float64),
    )


@compiled_inline
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
    """Contacts of points or chords with obstacles or the wall: k rows, in the order of nodes, then obstacles.

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


@compiled_inner
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


@compiled_inner
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


@compiled_inline
def _nearest_of_block(
    x: float, y: float, block: int, data: WorkspaceData, square: float, edge: int
) -> tuple[float, int]:
    """Return the least squared distance of a point from the edges of a block, and which; those from before if less."""
    numbers, first = data.edges, data.ranges[block, 0]
    for at in range(first, first + data.ranges[block, 1]):
        k = at * EDGE_WIDTH
        rx, ry, dx, dy = x - numbers[k], y - numbers[k + 1], numbers[k + 4], numbers[k + 5]
        along = min(max(rx * dx + ry * dy, 0.0), numbers[k + 6])
        qx, qy = rx - along * dx, ry - along * dy
        if qx * qx + qy * qy < square:
            square, edge = qx * qx + qy * qy, k
    return square, edge


@compiled_inner
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
    numbers, first, last = data.edges, data.polygons[polygon, 0], data.polygons[polygon, 1]
    square, k, nearest = np.inf, -1, guess
    if first <= guess < last:
        square, k = _nearest_of_block(x, y, nearest, data, square, k)
    reach = math.sqrt(square)
    for block in range(first, last):
        dx, dy = x - data.circles[block, 0], y - data.circles[block, 1]
        far = reach + data.circles[block, 2]
        if block == guess or dx * dx + dy * dy >= far * far:
            continue
        less, edge = _nearest_of_block(x, y, block, data, square, k)
        if edge != k:
            square, k, nearest, reach = less, edge, block, math.sqrt(less)
    if k < 0:  # of a point that is not finite
        return Nearest(0, np.inf, np.inf, 0.0, 0.0, 0, -1)
    rx, ry, dx, dy = x - numbers[k], y - numbers[k + 1], numbers[k + 4], numbers[k + 5]
    along = rx * dx + ry * dy
    if 0.0 < along < numbers[k + 6]:
        side = rx * dy - ry * dx
        sign = 1.0 if side >= 0.0 else -1.0
        return Nearest(0, side * side, sign * abs(side), dy, -dx, k, nearest)
    # A vertex: the start or the end, whose pseudo-normal tells the side.
    nx, ny = numbers[k + 9], numbers[k + 10]
    if along > 0.0:
        rx, ry, nx, ny = x - numbers[k + 2], y - numbers[k + 3], numbers[k + 11], numbers[k + 12]
    square = rx * rx + ry * ry
    length, sign = math.sqrt(square), 1.0 if rx * nx + ry * ny >= 0.0 else -1.0
    if length > MIN_DISTANCE:
        nx, ny = sign * rx / length, sign * ry / length
    return Nearest(0, square, sign * length, nx, ny, k, nearest)


@compiled_inner
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


@compiled_uncounted
def measure(points: Points, data: WorkspaceData, distances: Points, normal: NDArray[np.float64]) -> None:
    """Write the signed distance of each point from each disc, then polygon, (m, s), and its gradient, (m, s, 2)."""
    for s in range(distances.shape[1]):
        guess = -1
        for i in range(len(points)):
            found = shape_distance(points[i, 0], points[i, 1], s, guess, data)
            distances[i, s], normal[i, s, 0], normal[i, s, 1], guess = found


WALL = -1
"""Index of the dish wall in place of an obstacle's."""
MAX_FRICTION = 2.0  # a coefficient


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


@compiled_within
def _ball_contact(x: float, y: float, z: float, s: int, data: WorkspaceData, count: int, rows: ContactRows) -> int:
    """Write the row of a disc or ball, |p - c| - r, when it is within reach; return the new count."""
    disc = data.discs[s]
    rx, ry, rz = x - disc[0], y - disc[1], z - disc[3]
    length = math.sqrt(rx * rx + ry * ry + rz * rz)
    if length - disc[2] > data.reach:
        return count
    direction = (rx / length, ry / length, rz / length) if length > 0.0 else (1.0, 0.0, 0.0)
    return add_row(count, count, length - disc[2], direction, rows)


@compiled_within
def _polygon_contacts(x: float, y: float, polygon: int, data: WorkspaceData, count: int, rows: ContactRows) -> int:
    """Write the rows of a polygon at one point; return the new count, -1 when they are too many."""
    box, reach = data.boxes[polygon], data.reach
    if not (box[0] - reach <= x <= box[2] + reach and box[1] - reach <= y <= box[3] + reach):
        return count
    start, found = count, polygon_rows(x, y, polygon, reach, data, count, rows)
    if found.square > reach * reach:
        # No edge is within reach: the point is far outside, or deep inside.
        if not (box[0] <= x <= box[2] and box[1] <= y <= box[3]):
            return count
        found = nearest_edge(x, y, polygon, found.block, data)
        return count if found.signed > 0.0 else add_row(start, start, found.signed, (found.x, found.y, 0.0), rows)
    if found.signed < 0.0:
        return add_row(start, start, found.signed, (found.x, found.y, 0.0), rows)
    if found.rows < 0:
        return found.rows
    least = np.inf
    for row in range(start, found.rows):
        least = min(least, rows.distance[row])
    if least > found.signed * (1.0 + 1e-9) + 1e-12:
        # Between two features that rounding gave to neither.
        return add_row(start, found.rows, found.signed, (found.x, found.y, 0.0), rows)
    return found.rows


@compiled_uncounted
def find_contacts(points: Points, data: WorkspaceData, to: Contacts) -> int:
    """Write the contacts of points into the caller's arrays; see `Workspace.near` for what they are.

    Args:
        points: shape (m, d) [m].
        data: `Workspace.data`.
        to: written, but for the place.

    Returns:
        The number of contacts, or -1 when there are more than the arrays have room for.
    """
    node, obstacle, distance, nearest = to.node, to.obstacle, to.distance, to.nearest
    count, rows, discs = 0, ContactRows(distance, to.normal), len(data.discs)
    # Nearer to the centre than this, a point has no contact with the wall: most points pay for one comparison.
    inner = data.wall_radius - data.reach
    inner_square = inner * inner if inner > 0.0 else -1.0
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2] if points.shape[1] == 3 else 0.0
        if inner_square <= x * x + y * y < np.inf:
            wall_distance, wall_x, wall_y = wall_contact(x, y, data.wall_radius)
            before = count
            count = add_row(count, count, wall_distance, (wall_x, wall_y, 0.0), rows)
            if count < 0:
                return -1
            node[before], obstacle[before], nearest[before] = i, WALL, True
        if not math.isfinite(x + y + z):
            continue
        for o in range(len(data.order)):
            start, s = count, data.order[o]
            if s < discs:
                count = _ball_contact(x, y, z, s, data, count, rows)
            else:
                count = _polygon_contacts(x, y, s - discs, data, count, rows)
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
            name, centre = f"workspace.shapes[{i}]", shape.centre if isinstance(shape, Disc) else ()
            if centre and len(centre) != dimension:
                raise ConfigurationError(f"{name}.centre", centre, f"{dimension} coordinates [m]")
            if not centre and dimension != 2:
                raise ConfigurationError(name, "a polygon", "a disc with three coordinates, which is a ball, in space")
        self.friction, self.wall_friction = tuple(friction) or (0.0,) * len(self.shapes), wall_friction
        if len(self.friction) != len(self.shapes):
            expected = f"one for each of {len(self.shapes)} shapes"
            raise ConfigurationError("workspace.friction", f"{len(self.friction)} values", expected)
        coefficients = (wall_friction, *self.friction)
        if dimension != 2 and max(coefficients) > 0.0:
            raise ConfigurationError("workspace.friction", coefficients, "0 in space: friction is of the plane")
        self.data = pack_obstacles(self.shapes, wall_radius, reach, coefficients)

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
        # Room at first; a point in a narrow corner has two of one shape.
        room, count = 16 * (len(points) + 1), -1
        while count < 0:  # in a scene of many shapes a point may be near all of them
            room *= 2
            contacts = Contacts.room(room, self.dimension)
            count = find_contacts(points, self.data, contacts)
        return Contacts(*(array[:count].copy() for array in contacts))


TOLERANCE = 1e-7
"""By how much a distance may be given too short; it is never too long but for rounding [m]."""


@compiled_inline
def _from_edge(x: float, y: float, k: int, edges: NDArray[np.float64]) -> float:
    """Return the distance of a point from the edge whose numbers begin at k."""
    qx, qy, _ = closest_on_segment(x, y, edges[k], edges[k + 1], edges[k + 2], edges[k + 3])
    return math.hypot(x - qx, y - qy)


@compiled
def _deepest(ax: float, ay: float, bx: float, by: float, polygon: int, data: WorkspaceData) -> float:
    """Return the least signed distance on a line ab that is inside in part, a lower bound within the tolerance.

    The depth of a point is at most its distance from any edge, which is convex, so between two points at most the
    greater of theirs; and it changes by no more than the way. Intervals are halved where this is not enough.
    """
    length, edges = math.hypot(bx - ax, by - ay), data.edges
    intervals = np.empty((64, 2))  # halved depth first
    intervals[0, 0], intervals[0, 1], pending, halvings = 0.0, 1.0, 1, 0
    best = min(nearest_edge(ax, ay, polygon, -1, data).signed, nearest_edge(bx, by, polygon, -1, data).signed)
    lowest = best
    while pending > 0:
        pending -= 1
        low, high = intervals[pending, 0], intervals[pending, 1]
        px, py, qx, qy = ax + low * (bx - ax), ay + low * (by - ay), ax + high * (bx - ax), ay + high * (by - ay)
        before, after = nearest_edge(px, py, polygon, -1, data), nearest_edge(qx, qy, polygon, -1, data)
        best = min(best, before.signed, after.signed)
        bound = 0.5 * (before.signed + after.signed - (high - low) * length)
        for k in (before.edge, after.edge):
            bound = max(bound, -max(_from_edge(px, py, k, edges), _from_edge(qx, qy, k, edges)))
        # After 500 bisections what is left of a half segment inside has its lower bound.
        if bound >= best - TOLERANCE or halvings >= 500:
            lowest = min(lowest, bound)
            continue
        middle, halvings = 0.5 * (low + high), halvings + 1
        intervals[pending, 0], intervals[pending, 1] = low, middle
        intervals[pending + 1, 0], intervals[pending + 1, 1] = middle, high
        pending += 2
    return min(lowest, best)


@compiled_within
def _from_polygon(
    ax: float, ay: float, bx: float, by: float, signed: float, polygon: int, data: WorkspaceData
) -> float:
    """Return the least signed distance on a line ab from a polygon; `signed` is that of a.

    Outside it is that of a, that of b from an edge, or that of a corner of the polygon from the line.
    """
    ux, uy, edges, least = bx - ax, by - ay, data.edges, signed * signed if signed > TOLERANCE else 0.0
    scale, nearest = 1.0 / max(ux * ux + uy * uy, 1e-300), math.sqrt(least)
    for block in range(data.polygons[polygon, 0], data.polygons[polygon, 1]):
        rx, ry, reach = data.circles[block, 0] - ax, data.circles[block, 1] - ay, data.circles[block, 2] + nearest
        t = min(max((rx * ux + ry * uy) * scale, 0.0), 1.0)
        # A block that is farther from the line than the nearest so far has no edge that is nearer.
        if least == 0.0 or (rx - t * ux) ** 2 + (ry - t * uy) ** 2 > reach * reach:
            continue
        first = data.ranges[block, 0]
        for k in range(first * EDGE_WIDTH, (first + data.ranges[block, 1]) * EDGE_WIDTH, EDGE_WIDTH):
            dx, dy = edges[k + 4], edges[k + 5]
            rx, ry, qx, qy = edges[k] - ax, edges[k + 1] - ay, bx - edges[k], by - edges[k + 1]
            t = min(max((rx * ux + ry * uy) * scale, 0.0), 1.0)
            least = min(least, (rx - t * ux) ** 2 + (ry - t * uy) ** 2)
            before, after = ry * dx - rx * dy, qx * dy - qy * dx  # how far a and b are from the edge's line, outwards
            if 0.0 < qx * dx + qy * dy < edges[k + 6]:
                least = min(least, after * after)
            if before * after < 0.0:
                sx, sy = edges[k + 2] - ax, edges[k + 3] - ay
                if (rx * uy - ry * ux) * (sx * uy - sy * ux) < 0.0:
                    least = 0.0  # they cross
        nearest = math.sqrt(least)
    return nearest if nearest > TOLERANCE else _deepest(ax, ay, bx, by, polygon, data)


@compiled_inner
def half_segment_distance(points: Points, i: int, obstacle: int, signed: float, data: WorkspaceData) -> float:
    """Return the least signed distance of a node and the half segments beside it from one shape or the wall [m].

        min sd(x_i + s (x_j - x_i) / 2)  over  0 <= s <= 1,  j = i - 1, i + 1

    Exact for discs, balls, the wall and outside of polygons, within 0.1 um below inside of them: so the least over all
    nodes is that of the whole polyline, but for shapes that no node is near.

    Args:
        points: nodes, shape (n + 1, d) [m].
        i: the node.
        obstacle: index of the shape, `WALL` for the wall.
        signed: distance of the node from it [m].
        data: `Workspace.data`.
    """
    least, discs, dimension = signed, len(data.discs), points.shape[1]
    ax, ay, az = points[i, 0], points[i, 1], points[i, 2] if dimension == 3 else 0.0
    for j in (i - 1, i + 1):
        if not 0 <= j < len(points):
            continue
        bx, by = 0.5 * (ax + points[j, 0]), 0.5 * (ay + points[j, 1])
        bz = 0.5 * (az + points[j, 2]) if dimension == 3 else 0.0
        if obstacle == WALL:
            found, _, _ = wall_contact(bx, by, data.wall_radius)
        elif data.order[obstacle] < discs:
            disc = data.discs[data.order[obstacle]]
            x, y, z, rx, ry, rz = bx - ax, by - ay, bz - az, disc[0] - ax, disc[1] - ay, disc[3] - az
            square = x * x + y * y + z * z
            s = min(max((rx * x + ry * y + rz * z) / square, 0.0), 1.0) if square > 0.0 else 0.0
            found = math.sqrt((rx - s * x) ** 2 + (ry - s * y) ** 2 + (rz - s * z) ** 2) - disc[2]
        else:
            found = _from_polygon(ax, ay, bx, by, signed, data.order[obstacle] - discs, data)
        least = min(least, found)
    return least
