"""Signed distance of a chain's half segments from obstacles and the wall: of all their points, not of nodes alone."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.compiled import compiled, compiled_inline, compiled_uncounted
from magnetosuture_thread.geometry.obstacles.contacts import WALL, Contacts, wall_contact
from magnetosuture_thread.geometry.obstacles.distances import (
    EDGE_WIDTH,
    WorkspaceData,
    closest_on_segment,
    nearest_edge,
)
from magnetosuture_thread.geometry.polyline import Points

TOLERANCE = 1e-7
"""By how much a distance may be given too short; it is never too long but for rounding [m]."""
_MAX_BISECTIONS = 500  # of a half segment that is inside; what is left then has its lower bound


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
        if bound >= best - TOLERANCE or halvings >= _MAX_BISECTIONS:
            lowest = min(lowest, bound)
            continue
        middle, halvings = 0.5 * (low + high), halvings + 1
        intervals[pending, 0], intervals[pending, 1] = low, middle
        intervals[pending + 1, 0], intervals[pending + 1, 1] = middle, high
        pending += 2
    return min(lowest, best)


@compiled_uncounted
def _from_polygon(
    ax: float, ay: float, bx: float, by: float, signed: float, polygon: int, data: WorkspaceData
) -> float:
    """Return the least signed distance on a line ab from a polygon; `signed` is that of a.

    Outside it is that of an end, or that of a corner of the polygon from the line.
    """
    ux, uy, edges = bx - ax, by - ay, data.edges
    least, length = min(signed, nearest_edge(bx, by, polygon, -1, data).signed), math.hypot(ux, uy)
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
def _lower(
    points: Points,
    data: WorkspaceData,
    node: NDArray[np.int64],
    obstacle: NDArray[np.int64],
    distance: NDArray[np.float64],
) -> None:
    """Lower the distances of nodes to those of the half segments beside them."""
    for row in range(len(node)):
        distance[row] = half_segment_distance(points, node[row], obstacle[row], distance[row], data)


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
    _lower(np.ascontiguousarray(points, dtype=np.float64), data, contacts.node, contacts.obstacle, distance)
    return distance
