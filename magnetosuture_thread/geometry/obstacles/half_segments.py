"""Signed distance of a chain's half segments from obstacles and the wall: of all their points, not of nodes alone."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.compiled import compiled, compiled_inline, compiled_uncounted
from magnetosuture_thread.geometry.obstacles.contacts import (
    BALL,
    WALL,
    WorkspaceData,
    cell_of,
    nearest_of,
    wall_contact,
)
from magnetosuture_thread.geometry.obstacles.features import EDGE_WIDTH
from magnetosuture_thread.geometry.obstacles.search import ContactRows, Vector, closest_on_segment
from magnetosuture_thread.geometry.obstacles.workspace import Contacts
from magnetosuture_thread.geometry.polyline import Points

TOLERANCE = 1e-7
"""By how much a distance may be given too short; it is never too long but for rounding [m]."""

_MAX_BISECTIONS = 500  # of a half segment that is inside; what is left then has its lower bound
_NO_ROWS = -1.0  # in place of a reach


@compiled_inline
def _along(start: Vector, end: Vector, s: float) -> Vector:
    return (
        start[0] + s * (end[0] - start[0]),
        start[1] + s * (end[1] - start[1]),
        start[2] + s * (end[2] - start[2]),
    )


@compiled_inline
def _from_edge(point: Vector, k: int, numbers: NDArray[np.float64]) -> float:
    """Return the distance of a point from the edge whose numbers begin at k."""
    x, y, _ = closest_on_segment(point[0], point[1], numbers[k], numbers[k + 1], numbers[k + 2], numbers[k + 3])
    return math.hypot(point[0] - x, point[1] - y)


@compiled_uncounted
def _between(start: Vector, end: Vector, k: int, numbers: NDArray[np.float64]) -> float:
    """Return the distance of a straight line from an edge: 0 where they cross, else that of one of the four ends."""
    ax, ay, bx, by = numbers[k], numbers[k + 1], numbers[k + 2], numbers[k + 3]
    ux, uy, dx, dy = end[0] - start[0], end[1] - start[1], bx - ax, by - ay
    first, second = (ax - start[0]) * uy - (ay - start[1]) * ux, (bx - start[0]) * uy - (by - start[1]) * ux
    third, fourth = (start[0] - ax) * dy - (start[1] - ay) * dx, (end[0] - ax) * dy - (end[1] - ay) * dx
    if first * second < 0.0 and third * fourth < 0.0:
        return 0.0
    least = min(_from_edge(start, k, numbers), _from_edge(end, k, numbers))
    for x, y in ((ax, ay), (bx, by)):
        qx, qy, _ = closest_on_segment(x, y, start[0], start[1], end[0], end[1])
        least = min(least, math.hypot(x - qx, y - qy))
    return least


@compiled_uncounted
def _nearest_edge(point: Vector, base: int, first: int, last: int, data: WorkspaceData) -> int:
    """Return where the numbers of the nearest of some edges begin."""
    best, at = np.inf, base
    for slot in range(max(first, 0), last):
        k = base + EDGE_WIDTH * (data.entries[slot] if first >= 0 else slot)
        distance = _from_edge(point, k, data.numbers)
        if distance < best:
            best, at = distance, k
    return at


@compiled
def _deepest(start: Vector, end: Vector, obstacle: int, first: int, last: int, data: WorkspaceData) -> float:
    """Return the least signed distance on a line that is inside in part, a lower bound within the tolerance.

    The depth of a point is at most its distance from any edge, which is convex, so between two points at most the
    greater of theirs; and it changes by no more than the way. Intervals are halved where this is not enough.
    """
    rows, base = ContactRows(np.empty(0), np.empty((0, 2))), int(data.tables[obstacle + 1, 6])
    length = math.hypot(end[0] - start[0], end[1] - start[1])
    lows, highs = np.empty(64), np.empty(64)
    lows[0], highs[0], pending = 0.0, 1.0, 1
    best = min(
        nearest_of(start, _NO_ROWS, obstacle, first, last, data, 0, rows).signed,
        nearest_of(end, _NO_ROWS, obstacle, first, last, data, 0, rows).signed,
    )
    lowest, halvings = best, 0
    while pending > 0:
        pending -= 1
        low, high = lows[pending], highs[pending]
        p, q = _along(start, end, low), _along(start, end, high)
        before = nearest_of(p, _NO_ROWS, obstacle, first, last, data, 0, rows).signed
        after = nearest_of(q, _NO_ROWS, obstacle, first, last, data, 0, rows).signed
        best = min(best, before, after)
        bound = 0.5 * (before + after - (high - low) * length)
        if bound < best - TOLERANCE:
            for point in (p, q):
                k = _nearest_edge(point, base, first, last, data)
                bound = max(bound, -max(_from_edge(p, k, data.numbers), _from_edge(q, k, data.numbers)))
        if bound >= best - TOLERANCE or halvings >= _MAX_BISECTIONS or pending + 2 > len(lows):
            lowest = min(lowest, bound)
            continue
        middle, halvings = 0.5 * (low + high), halvings + 1
        lows[pending], highs[pending] = low, middle
        lows[pending + 1], highs[pending + 1] = middle, high
        pending += 2
    return min(lowest, best)


@compiled_uncounted
def _from_polygon(start: Vector, end: Vector, signed: float, obstacle: int, data: WorkspaceData) -> float:
    """Return the least signed distance on a line from a polygon; `signed` is that of its start."""
    table = data.tables[obstacle + 1]
    length = math.hypot(end[0] - start[0], end[1] - start[1])
    cell, first, last = cell_of(start, obstacle + 1, data), -1, int(table[5])
    if cell >= 0 and abs(signed) + 2.0 * length <= data.frames[obstacle + 1, 4]:
        first, last = int(data.entries[cell]), int(data.entries[cell + 2])  # what is near to any point of the line
    best = abs(signed)
    for slot in range(max(first, 0), last):
        k = int(table[6]) + EDGE_WIDTH * (data.entries[slot] if first >= 0 else slot)
        if _from_edge(start, k, data.numbers) < best + length:
            best = min(best, _between(start, end, k, data.numbers))
    if signed > 0.0 and best > TOLERANCE:
        return best
    return _deepest(start, end, obstacle, first, last, data)


@compiled_inline
def _from_ball(start: Vector, end: Vector, centre: NDArray[np.float64], radius: float) -> float:
    x, y, z = end[0] - start[0], end[1] - start[1], end[2] - start[2]
    rx, ry, rz = centre[0] - start[0], centre[1] - start[1], centre[2] - start[2]
    square = x * x + y * y + z * z
    s = min(max((rx * x + ry * y + rz * z) / square, 0.0), 1.0) if square > 0.0 else 0.0
    return math.sqrt((rx - s * x) ** 2 + (ry - s * y) ** 2 + (rz - s * z) ** 2) - radius


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
    space, least = points.shape[1] == 3, signed
    start = (points[i, 0], points[i, 1], points[i, 2] if space else 0.0)
    for j in (i - 1, i + 1):
        if not 0 <= j < len(points):
            continue
        end = _along(start, (points[j, 0], points[j, 1], points[j, 2] if space else 0.0), 0.5)
        if obstacle == WALL:
            found, _, _ = wall_contact(end[0], end[1], data.wall_radius)
        elif data.tables[obstacle + 1, 0] == BALL:
            found = _from_ball(start, end, data.frames[obstacle + 1], data.frames[obstacle + 1, 5])
        else:
            found = _from_polygon(start, end, signed, obstacle, data)
        least = min(least, found)
    return least


@compiled
def _write(
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
    _write(np.ascontiguousarray(points, dtype=np.float64), data, contacts.node, contacts.obstacle, distance)
    return distance
