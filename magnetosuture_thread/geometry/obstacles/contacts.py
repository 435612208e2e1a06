"""Workspace: the dish wall and all obstacles, and the contacts of points with them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.geometry.compiled import compiled, compiled_inline, compiled_uncounted, compiled_within
from magnetosuture_thread.geometry.obstacles.distances import (
    EDGE_WIDTH,
    NO_BLOCK,
    ContactRows,
    Contacts,
    WorkspaceData,
    add_row,
    closest_on_segment,
    nearest_edge,
    pack_obstacles,
    polygon_rows,
)
from magnetosuture_thread.geometry.obstacles.shapes import MIN_EXTENT, Disc, Obstacle
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.settings.arguments import bounded, checked_arguments
from magnetosuture_thread.settings.errors import ConfigurationError

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
            _check(f"workspace.shapes[{i}]", shape, dimension)
        self.friction, self.wall_friction = tuple(friction) or (0.0,) * len(self.shapes), wall_friction
        if len(self.friction) != len(self.shapes):
            expected = f"one for each of {len(self.shapes)} shapes"
            raise ConfigurationError("workspace.friction", f"{len(self.friction)} values", expected)
        if dimension != 2 and max(wall_friction, *self.friction, 0.0) > 0.0:
            raise ConfigurationError(
                "workspace.friction", (wall_friction, *self.friction), "0 in space: friction is of the plane"
            )
        self.data = pack_obstacles(self.shapes, wall_radius, reach, (wall_friction, *self.friction))

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


def _check(name: str, shape: Obstacle, dimension: int) -> None:
    if isinstance(shape, Disc):
        if len(shape.centre) != dimension:
            raise ConfigurationError(f"{name}.centre", shape.centre, f"{dimension} coordinates [m]")
    elif dimension != 2:
        raise ConfigurationError(name, "a polygon", "a disc with three coordinates, which is a ball, in space")


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
    best = min(
        nearest_edge(ax, ay, polygon, NO_BLOCK, data).signed, nearest_edge(bx, by, polygon, NO_BLOCK, data).signed
    )
    lowest = best
    while pending > 0:
        pending -= 1
        low, high = intervals[pending, 0], intervals[pending, 1]
        px, py, qx, qy = ax + low * (bx - ax), ay + low * (by - ay), ax + high * (bx - ax), ay + high * (by - ay)
        before, after = nearest_edge(px, py, polygon, NO_BLOCK, data), nearest_edge(qx, qy, polygon, NO_BLOCK, data)
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

    Outside it is that of an end, or that of a corner of the polygon from the line.
    """
    ux, uy, edges = bx - ax, by - ay, data.edges
    least, length = min(signed, nearest_edge(bx, by, polygon, NO_BLOCK, data).signed), math.hypot(ux, uy)
    for block in range(data.polygons[polygon, 0], data.polygons[polygon, 1]):
        if least <= TOLERANCE:
            break
        far = signed + length + data.circles[block, 2]
        if math.hypot(ax - data.circles[block, 0], ay - data.circles[block, 1]) > far:
            continue
        first = data.ranges[block, 0]
        for edge in range(first, first + data.ranges[block, 1]):
            k = edge * EDGE_WIDTH
            cx, cy, dx, dy = edges[k], edges[k + 1], edges[k + 2], edges[k + 3]
            qx, qy, _ = closest_on_segment(cx, cy, ax, ay, bx, by)
            least = min(least, math.hypot(cx - qx, cy - qy))
            first_side, second_side = (cx - ax) * uy - (cy - ay) * ux, (dx - ax) * uy - (dy - ay) * ux
            third_side = (ax - cx) * (dy - cy) - (ay - cy) * (dx - cx)
            fourth_side = (bx - cx) * (dy - cy) - (by - cy) * (dx - cx)
            if first_side * second_side < 0.0 and third_side * fourth_side < 0.0:
                least = 0.0  # they cross
    return least if least > TOLERANCE else _deepest(ax, ay, bx, by, polygon, data)


@compiled_uncounted
def half_segment_distance(points: Points, i: int, obstacle: int, signed: float, data: WorkspaceData) -> float:
    """Return the least signed distance of a node and the half segments beside it from one shape or the wall [m].

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


@compiled
def half_segment_distances(points: Points, data: WorkspaceData, contacts: Contacts) -> NDArray[np.float64]:
    """Return the least signed distance of a node and the half segments beside it, for each contact, shape (k,) [m].

        min sd(x_i + s (x_j - x_i) / 2)  over  0 <= s <= 1,  j = i - 1, i + 1

    Exact for discs, balls, the wall and outside of polygons, within 0.1 um below inside of them: so the least over all
    nodes is that of the whole polyline, but for shapes that no node is near.

    Args:
        points: nodes, shape (n + 1, d) [m].
        data: `Workspace.data`.
        contacts: of these nodes with it.
    """
    distance: NDArray[np.float64] = contacts.distance.copy()
    for row in range(len(distance)):
        distance[row] = half_segment_distance(points, contacts.node[row], contacts.obstacle[row], distance[row], data)
    return distance
