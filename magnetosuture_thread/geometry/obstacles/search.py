"""Search for the boundary features near a point, compiled."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.compiled import compiled, compiled_inline, compiled_uncounted
from magnetosuture_thread.geometry.obstacles.features import EDGE_WIDTH, FACE_MARKS, FACE_WIDTH

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


FACE, EDGE_AB, EDGE_BC, EDGE_CA, VERTEX_A, VERTEX_B, VERTEX_C = range(7)
"""Regions around a triangle in space: by the part of it that is closest."""


@compiled
def closest_in_space(p: Vector, a: Vector, b: Vector, c: Vector) -> tuple[float, float, float, int]:
    """Return the point of a triangle abc in space that is closest to p, and the region that p is in.

    The vertices' regions are told by the signs of projections onto the edges, the edges' by those of the
    barycentric coordinates. Returns q_x, q_y, q_z and one of FACE, EDGE_AB ... VERTEX_C.

    Source: C. Ericson, Real-Time Collision Detection, 2004, section 5.1.5.
    """
    px, py, pz = p
    ax, ay, az = a
    bx, by, bz = b
    cx, cy, cz = c
    ux, uy, uz = bx - ax, by - ay, bz - az
    vx, vy, vz = cx - ax, cy - ay, cz - az
    d1 = ux * (px - ax) + uy * (py - ay) + uz * (pz - az)
    d2 = vx * (px - ax) + vy * (py - ay) + vz * (pz - az)
    if d1 <= 0.0 and d2 <= 0.0:
        return ax, ay, az, VERTEX_A
    d3 = ux * (px - bx) + uy * (py - by) + uz * (pz - bz)
    d4 = vx * (px - bx) + vy * (py - by) + vz * (pz - bz)
    if d3 >= 0.0 and d4 <= d3:
        return bx, by, bz, VERTEX_B
    d5 = ux * (px - cx) + uy * (py - cy) + uz * (pz - cz)
    d6 = vx * (px - cx) + vy * (py - cy) + vz * (pz - cz)
    if d6 >= 0.0 and d5 <= d6:
        return cx, cy, cz, VERTEX_C
    weight_c = d1 * d4 - d3 * d2
    if weight_c <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        t = d1 / (d1 - d3)
        return ax + t * ux, ay + t * uy, az + t * uz, EDGE_AB
    weight_b = d5 * d2 - d1 * d6
    if weight_b <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        t = d2 / (d2 - d6)
        return ax + t * vx, ay + t * vy, az + t * vz, EDGE_CA
    weight_a = d3 * d6 - d5 * d4
    if weight_a <= 0.0 and d4 >= d3 and d5 >= d6:
        t = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        return bx + t * (cx - bx), by + t * (cy - by), bz + t * (cz - bz), EDGE_BC
    total = weight_a + weight_b + weight_c
    t, s = weight_b / total, weight_c / total
    return ax + t * ux + s * vx, ay + t * uy + s * vy, az + t * uz + s * vz, FACE


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


@compiled_uncounted
def search_faces(
    point: Vector,
    reach: float,
    table: NDArray[np.int64],
    numbers: NDArray[np.float64],
    entries: NDArray[np.int32],
    first: int,
    last: int,
    count: int,
    rows: ContactRows,
) -> Nearest:
    """Return the nearest of some faces, and write a row for each local minimum of the distance outside.

    A face gives a row when the projection falls inside of it and the point is on its outer side; an edge or
    a vertex when the closest point of all its faces is on it. Arguments are like those of `search_edges`:

    Args:
        point: coordinates [m].
        reach: greatest distance of a row; negative for no rows [m].
        table: the obstacle's row of `WorkspaceData.tables`.
        numbers: the table of features, and spokes.
        entries: entries of cells, and marks of faces.
        first: the first entry in `entries`; with `first` negative, all faces 0 ... last - 1 are searched.
        last: the one after the last entry.
        count: number of rows so far.
        rows: where rows are written from `count` on.
    """
    x, y, z = point
    start, base, marks, spokes = count, table[6], table[7], table[8]
    limit = reach * reach if reach >= 0.0 else -1.0
    best, bx, by, bz, face_normal, blunt = np.inf, 0.0, 0.0, 0.0, 0, False
    for slot in range(max(first, 0), last):
        face = entries[slot] if first >= 0 else slot
        k = base + FACE_WIDTH * face
        a = (numbers[k], numbers[k + 1], numbers[k + 2])
        b = (numbers[k + 3], numbers[k + 4], numbers[k + 5])
        c = (numbers[k + 6], numbers[k + 7], numbers[k + 8])
        qx, qy, qz, region = closest_in_space(point, a, b, c)
        # Where the normal of the region is in the row of numbers.
        if region == FACE:
            at = k + 9
            rx, ry, rz = x - a[0], y - a[1], z - a[2]
            side = rx * numbers[at] + ry * numbers[at + 1] + rz * numbers[at + 2]
            square = side * side
        else:
            at = k + 21 + 3 * (region - EDGE_AB) if region <= EDGE_CA else k + 30 + 3 * (region - VERTEX_A)
            rx, ry, rz = x - qx, y - qy, z - qz
            side = rx * numbers[at] + ry * numbers[at + 1] + rz * numbers[at + 2]
            square = rx * rx + ry * ry + rz * rz
        if square < best:
            best, bx, by, bz, face_normal, blunt = square, rx, ry, rz, at, region == FACE
        if side < 0.0 or square > limit:
            continue
        mark = marks + FACE_MARKS * face
        if EDGE_AB <= region <= EDGE_CA:
            m = k + 12 + 3 * (region - EDGE_AB)
            if (
                entries[mark + region - EDGE_AB] == 0
                or rx * numbers[m] + ry * numbers[m + 1] + rz * numbers[m + 2] > 0.0
            ):
                continue
        elif region >= VERTEX_A:
            spoke = entries[mark + 3 + region - VERTEX_A]
            if spoke < 0:
                continue
            while spoke < entries[mark + 6 + region - VERTEX_A]:
                s = spokes + 3 * spoke
                if rx * numbers[s] + ry * numbers[s + 1] + rz * numbers[s + 2] > 0.0:
                    break
                spoke += 1
            if spoke < entries[mark + 6 + region - VERTEX_A]:
                continue
        length = math.sqrt(square)
        if region == FACE or length <= MIN_DISTANCE:
            count = add_row(start, count, length, (numbers[at], numbers[at + 1], numbers[at + 2]), rows)
        else:
            count = add_row(start, count, length, (rx / length, ry / length, rz / length), rows)
    if best == np.inf:
        return Nearest(count, best, best, 0.0, 0.0, 0.0)
    length = math.sqrt(best)
    nx, ny, nz = numbers[face_normal], numbers[face_normal + 1], numbers[face_normal + 2]
    sign = 1.0 if bx * nx + by * ny + bz * nz >= 0.0 else -1.0
    if not blunt and length > MIN_DISTANCE:
        nx, ny, nz = sign * bx / length, sign * by / length, sign * bz / length
    return Nearest(count, best, sign * length, nx, ny, nz)
