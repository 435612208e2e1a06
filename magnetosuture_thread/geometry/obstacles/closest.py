"""Closest points on segments and triangles, compiled."""

from __future__ import annotations

from magnetosuture_thread.compiled import compiled

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
