"""Search for the edges of a polygon near a point, compiled."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.compiled import compiled, compiled_inline, compiled_uncounted
from magnetosuture_thread.geometry.obstacles.features import EDGE_WIDTH

Vector = tuple[float, float, float]
"""A point or a direction in compiled code; its third coordinate is 0 in the plane."""


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


MIN_DISTANCE = 1e-12
"""At a smaller distance from a vertex or an edge, the direction away from it is lost in rounding [m]."""
_SAME_POINT = 1e-7  # two rows of one obstacle that differ by less are one point of its boundary


class Nearest(NamedTuple):
    """The nearest boundary point of an obstacle, and where in the rows the next one goes.

    Attributes:
        rows: number of rows so far; -1 when they were too many for the arrays.
        square: square of the distance; infinity when no feature was searched [m^2].
        signed: signed distance [m].
        x: outward direction there.
        y: outward direction there.
        z: outward direction there.
    """

    rows: int
    square: float
    signed: float
    x: float
    y: float
    z: float


class ContactRows(NamedTuple):
    """Arrays that contacts are written to, row by row.

    Attributes:
        distance: signed distance, shape (c,) [m].
        normal: outward direction, shape (c, d).
    """

    distance: NDArray[np.float64]
    normal: NDArray[np.float64]


@compiled_inline
def add_row(start: int, count: int, length: float, direction: Vector, rows: ContactRows) -> int:
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
def search_edges(
    x: float,
    y: float,
    reach: float,
    numbers: NDArray[np.float64],
    base: int,
    index: NDArray[np.int32],
    first: int,
    last: int,
    count: int,
    distance: NDArray[np.float64],
    normal: NDArray[np.float64],
) -> Nearest:
    """Return the nearest of some edges, and write a row for each local minimum of the distance outside.

    An edge gives a row when the projection falls inside of it and the point is on its outer side; a vertex
    when the projections onto both its edges clamp to it.

    Args:
        x: coordinate of the point [m].
        y: coordinate of the point [m].
        reach: greatest distance of a row; negative for no rows [m].
        numbers: the table of features.
        base: where the edges of this obstacle begin in it.
        index: entries of cells.
        first: the first entry in `index`; with `first` negative, all edges 0 ... last - 1 are searched.
        last: the one after the last entry.
        count: number of rows so far.
        distance: rows' signed distance, written from `count` on [m].
        normal: rows' outward direction.
    """
    start, rows = count, ContactRows(distance, normal)
    limit = reach * reach if reach >= 0.0 else -1.0
    best = np.inf
    # Of the best: whether a vertex; the vector from it to the point; its normal or pseudo-normal.
    corner, bx, by, nx, ny = False, 0.0, 0.0, 0.0, 0.0
    for slot in range(max(first, 0), last):
        k = base + EDGE_WIDTH * (index[slot] if first >= 0 else slot)
        rx, ry = x - numbers[k], y - numbers[k + 1]
        dx, dy = numbers[k + 4], numbers[k + 5]
        along = rx * dx + ry * dy
        if along <= 0.0:
            square = rx * rx + ry * ry
            if square < best:
                best, corner, bx, by, nx, ny = square, True, rx, ry, numbers[k + 9], numbers[k + 10]
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
                best, corner, bx, by, nx, ny = square, True, rx, ry, numbers[k + 11], numbers[k + 12]
        else:
            side = rx * dy - ry * dx
            square = side * side
            if square < best:
                best, corner, bx, by, nx, ny = square, False, rx, ry, dy, -dx
            if side >= 0.0 and square <= limit:
                count = add_row(start, count, side, (dy, -dx, 0.0), rows)
    if best == np.inf:
        return Nearest(count, best, best, 0.0, 0.0, 0.0)
    length = math.sqrt(best)
    sign = 1.0 if bx * nx + by * ny >= 0.0 else -1.0
    if corner and length > MIN_DISTANCE:
        nx, ny = sign * bx / length, sign * by / length
    return Nearest(count, best, sign * length, nx, ny, 0.0)
