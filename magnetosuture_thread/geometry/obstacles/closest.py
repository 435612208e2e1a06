"""Closest points on segments and triangles, compiled."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.compiled import compiled
from magnetosuture_thread.geometry.polyline import Points


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


@compiled
def closest_on_triangle(
    px: float, py: float, ax: float, ay: float, bx: float, by: float, cx: float, cy: float
) -> tuple[float, float]:
    """Return the point of a triangle abc in the plane that is closest to p; p itself when inside.

    Otherwise the closest of the clamped projections onto the three edges. Either direction of abc will do.

    Source: [Forghani2025], closest point on each triangle of an obstacle.
    """
    first = (bx - ax) * (py - ay) - (by - ay) * (px - ax)
    second = (cx - bx) * (py - by) - (cy - by) * (px - bx)
    third = (ax - cx) * (py - cy) - (ay - cy) * (px - cx)
    area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
    if (area > 0.0 and first >= 0.0 and second >= 0.0 and third >= 0.0) or (
        area < 0.0 and first <= 0.0 and second <= 0.0 and third <= 0.0
    ):
        return px, py
    qx, qy, _ = closest_on_segment(px, py, ax, ay, bx, by)
    best = (px - qx) ** 2 + (py - qy) ** 2
    rx, ry, _ = closest_on_segment(px, py, bx, by, cx, cy)
    square = (px - rx) ** 2 + (py - ry) ** 2
    if square < best:
        best, qx, qy = square, rx, ry
    rx, ry, _ = closest_on_segment(px, py, cx, cy, ax, ay)
    if (px - rx) ** 2 + (py - ry) ** 2 < best:
        qx, qy = rx, ry
    return qx, qy


FACE, EDGE_AB, EDGE_BC, EDGE_CA, VERTEX_A, VERTEX_B, VERTEX_C = range(7)
"""Regions around a triangle in space: by the part of it that is closest."""


@compiled
def closest_in_space(
    px: float,
    py: float,
    pz: float,
    ax: float,
    ay: float,
    az: float,
    bx: float,
    by: float,
    bz: float,
    cx: float,
    cy: float,
    cz: float,
) -> tuple[float, float, float, int]:
    """Return the point of a triangle abc in space that is closest to p, and the region that p is in.

    The vertices' regions are told by the signs of projections onto the edges, the edges' by those of the
    barycentric coordinates. Returns q_x, q_y, q_z and one of FACE, EDGE_AB ... VERTEX_C.

    Source: C. Ericson, Real-Time Collision Detection, 2004, section 5.1.5.
    """
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


@compiled
def _closest(points: Points, vertices: Points, triangles: NDArray[np.int64], closest: Points) -> None:
    for i in range(len(points)):
        for j in range(len(triangles)):
            a, b, c = vertices[triangles[j, 0]], vertices[triangles[j, 1]], vertices[triangles[j, 2]]
            if points.shape[1] == 2:
                x, y = closest_on_triangle(points[i, 0], points[i, 1], a[0], a[1], b[0], b[1], c[0], c[1])
            else:
                x, y, z, _ = closest_in_space(
                    points[i, 0], points[i, 1], points[i, 2], a[0], a[1], a[2], b[0], b[1], b[2], c[0], c[1], c[2]
                )
                closest[i, j, 2] = z
            closest[i, j, 0] = x
            closest[i, j, 1] = y


def closest_on_triangles(points: Points, vertices: Points, triangles: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return for each point the closest point on each triangle.

    In the plane a triangle is solid: a point inside is its own closest point.

    Args:
        points: shape (m, d), d = 2 or 3 [m].
        vertices: shape (v, d) [m].
        triangles: indices of vertices, shape (t, 3).

    Returns:
        Closest points, shape (m, t, d) [m].

    Raises:
        ValueError: when the shapes do not fit, or an index is out of range.

    Source: [Forghani2025], closest point on each triangle of an obstacle.
    """
    # Copies: the compiled loop takes one kind of array, writable and contiguous.
    points, vertices, triangles = np.array(points, float), np.array(vertices, float), np.array(triangles, np.int64)
    if points.ndim != 2 or points.shape[1] not in (2, 3) or vertices.shape[1:] != points.shape[1:]:
        raise ValueError(f"points {points.shape} and vertices {vertices.shape} must be (m, d) and (v, d), d = 2 or 3")
    if triangles.ndim != 2 or triangles.shape[1] != 3 or (triangles < 0).any() or (triangles >= len(vertices)).any():
        raise ValueError("triangles must be (t, 3) indices of vertices")
    closest = np.empty((len(points), len(triangles), points.shape[1]))
    _closest(points, vertices, triangles, closest)
    return closest
