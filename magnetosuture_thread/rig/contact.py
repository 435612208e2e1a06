"""Contacts of the needle and the thread: with discs, polygons and the wall of the dish.

A contact is a gap g, at least 0 where nothing touches, and an energy k / 2 g^2 below: frictionless, stiff, and
with an exact second derivative, from the gap's gradient and curvature.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import shapely

from magnetosuture_thread.geometry.compiled import compiled_inline, compiled_uncounted
from magnetosuture_thread.geometry.obstacles import Disc, Polygon
from magnetosuture_thread.geometry.polyline import Indices, Vector

MIN_APOTHEM = 0.6  # of a disc's radius, where segments are longer than the disc
BLOCK = 8  # edges of a polygon that are passed over together where all of them are too far


class Shapes(NamedTuple):
    """A surface as kernels read it.

    Attributes:
        discs: centre, radius, shape (k, 3) [m].
        corners: of all polygons, the solid to the left of every edge, shape (c, 2) [m].
        normals: outward, of the edge that ends at each corner and of that which begins there, shape (c, 4).
        convex: 1 at corners that stick out of the solid, else 0, shape (c,).
        starts: where each polygon begins in `corners`, and the end, shape (p + 1,).
        boxes: least x, least y, greatest x, greatest y of each polygon, shape (p, 4) [m].
        blocks: the same of each `BLOCK` edges of a polygon, in the order of `corners`, shape (b, 4) [m].
        block_starts: where the blocks of each polygon begin, and the end, shape (p + 1,).
        grid: least x and y of the cells of `clearances`, and their side, shape (3,) [m].
        clearances: at the least, of all points of a cell, rows along y, shape (h, w) [m].
        wall: radius of the dish's wall around the origin, infinite if there is none [m].
        stiffness: k of every contact [N/m].
        friction: mu, of the thread on everything; the needle has none.
        self_contact: whether the thread touches itself; else it passes over itself.
    """

    discs: Vector
    corners: Vector
    normals: Vector
    convex: Vector
    starts: Indices
    boxes: Vector
    blocks: Vector
    block_starts: Indices
    grid: Vector
    clearances: Vector
    wall: float
    stiffness: float
    friction: float
    self_contact: bool


@dataclass(frozen=True)
class Surface:
    """The surfaces of what stands in the dish, and its wall.

    Attributes:
        discs: round posts.
        polygons: solid inside of their outlines, holes too.
        wall_radius: inner radius of the dish around the origin, inf without a wall [m].
        stiffness: k of a contact; a force f sinks in by f / k [N/m].
        skin: how far outside a contact begins, so that up to k times this nothing gets in at all [m]. A harder
            contact without it costs more: nodes that slide then leave and meet the surface at every step.
        friction: Coulomb's coefficient of the thread on all of it; the needle has no friction.
        self_contact: whether the thread touches itself, with the same friction; else it passes over itself.
    """

    discs: tuple[Disc, ...] = ()
    polygons: tuple[Polygon, ...] = ()
    wall_radius: float = math.inf
    stiffness: float = 500.0
    skin: float = 1.5e-6
    friction: float = 0.0
    self_contact: bool = False

    def packed(self) -> Shapes:
        """Return the arrays that kernels read."""
        discs = np.array([(*disc.centre[:2], disc.radius) for disc in self.discs], dtype=np.float64).reshape(-1, 3)
        rings = [polygon.rings[0] for polygon in self.polygons]
        boxes, normals = _boxes(rings), [_normals(ring) for ring in rings]
        ends = [np.concatenate([ring[-1:], ring]) for ring in rings]  # edge i ends at corner i
        blocks = [_boxes(end[k : k + BLOCK + 1] for k in range(0, len(end) - 1, BLOCK)) for end in ends]
        return Shapes(
            discs,
            np.concatenate([np.zeros((0, 2)), *rings]),
            np.concatenate([np.zeros((0, 4)), *normals]),
            np.concatenate([np.zeros(0), *(n[:, 0] * n[:, 3] - n[:, 1] * n[:, 2] > 0.0 for n in normals)]),
            np.cumsum([0, *map(len, rings)], dtype=np.int64),
            boxes,
            np.concatenate([np.zeros((0, 4)), *blocks]),
            np.cumsum([0, *map(len, blocks)], dtype=np.int64),
            *_clearances(discs, rings, boxes, self.wall_radius),
            float(self.wall_radius),
            float(self.stiffness),
            float(self.friction),
            bool(self.self_contact),
        )


def _boxes(parts: Iterable[Vector]) -> Vector:
    """Return least x and y, greatest x and y of sets of points, shape (k, 4)."""
    return np.array([(*part.min(axis=0), *part.max(axis=0)) for part in parts], dtype=np.float64).reshape(-1, 4)


def _normals(ring: Vector) -> Vector:
    """Return the outward normals of the two edges at each corner, shape (c, 4)."""
    along = ring - np.roll(ring, 1, axis=0)
    normal = np.column_stack([along[:, 1], -along[:, 0]]) / np.sqrt(np.sum(along**2, axis=1))[:, None]
    return np.hstack([normal, np.roll(normal, -1, axis=0)])


def _clearances(discs: Vector, rings: list[Vector], boxes: Vector, wall: float) -> tuple[Vector, Vector]:
    """Return grid and clearances of `Shapes`: 128 cells along the longer side of all that can be touched."""
    round_ones = [row for row in (*discs, (0.0, 0.0, wall)) if row[2] < np.inf]
    reached = np.array([*boxes, *((x - r, y - r, x + r, y + r) for x, y, r in round_ones)])
    if not len(reached):
        return np.array([0.0, 0.0, 1.0]), np.full((1, 1), np.inf)
    low, high = reached[:, :2].min(axis=0), reached[:, 2:].max(axis=0)
    side = float(max(high - low)) / 128
    columns, rows = np.ceil((high - low) / side).astype(int)
    x, y = np.meshgrid(low[0] + side * (np.arange(columns) + 0.5), low[1] + side * (np.arange(rows) + 0.5))
    gaps = [wall - np.hypot(x, y), *(np.hypot(x - disc[0], y - disc[1]) - disc[2] for disc in discs)]
    gaps += [shapely.distance(shapely.points(x, y), shapely.Polygon(ring)) for ring in rings]
    return np.array([*low, side]), np.min(gaps, axis=0) - 0.75 * side  # half a diagonal and more


@compiled_inline
def clear(x: float, y: float, reach: float, shapes: Shapes) -> bool:
    """Return whether nothing is within reach, as far as the grid tells; from beyond the grid all is as far or farther.

    All but the wall, that is, which is in the cells at the border already.
    """
    grid, clearances = shapes.grid, shapes.clearances
    rows, columns = clearances.shape
    i = int(min(max((y - grid[1]) / grid[2], 0.0), rows - 1.0))
    j = int(min(max((x - grid[0]) / grid[2], 0.0), columns - 1.0))
    return bool(clearances[i, j] > reach)


@compiled_inline
def write_row(rows: Vector, count: int, a: int, s: float, depth: float, nx: float, ny: float, last: float) -> int:
    """Write a row of six numbers, where there is room; return the new count."""
    if count >= rows.shape[0]:
        return count
    rows[count, 0], rows[count, 1], rows[count, 2] = a, s, depth
    rows[count, 3], rows[count, 4], rows[count, 5] = nx, ny, last
    return count + 1


@compiled_inline
def _box_square(x: float, y: float, box: Vector) -> float:
    """Return the squared distance of a point from a box, 0 within it."""
    dx, dy = max(box[0] - x, x - box[2], 0.0), max(box[1] - y, y - box[3], 0.0)
    return float(dx * dx + dy * dy)


@compiled_uncounted
def polygon_gap(x: float, y: float, shapes: Shapes, p: int) -> tuple[float, float, float, float, int, int]:
    """Return signed distance from polygon p, its gradient (n_x, n_y), its curvature [m, 1, 1, 1/m], and the edge.

    The edge is that which is nearest, as the indices of its two corners.
    """
    corners, start, end = shapes.corners, shapes.starts[p], shapes.starts[p + 1]
    first, least = shapes.block_starts[p], np.inf
    closest = first
    for k in range(first, shapes.block_starts[p + 1]):
        distance = _box_square(x, y, shapes.blocks[k])
        if distance < least:
            least, closest = distance, k
    least, nearest, last, place, inner = np.inf, 0, 0, 0.0, 0.0
    # The closest block first, then all that may be closer than what it has.
    for turn in range(first - 1, shapes.block_starts[p + 1]):
        k = closest if turn < first else turn
        if turn == closest or _box_square(x, y, shapes.blocks[k]) >= least:
            continue
        begin = start + BLOCK * (k - first)
        j = end - 1 if k == first else begin - 1
        for i in range(begin, min(begin + BLOCK, end)):
            ex, ey = corners[i, 0] - corners[j, 0], corners[i, 1] - corners[j, 1]
            dx, dy = x - corners[j, 0], y - corners[j, 1]
            s = (dx * ex + dy * ey) / (ex * ex + ey * ey)
            t = min(max(s, 0.0), 1.0)
            distance = (dx - t * ex) ** 2 + (dy - t * ey) ** 2
            if distance < least:
                least, nearest, last, place, inner = distance, i, j, t, s
            j = i
    distance, nx, ny = math.sqrt(least), shapes.normals[nearest, 0], shapes.normals[nearest, 1]
    if distance < 1e-12:
        return 0.0, nx, ny, 0.0, last, nearest
    ex, ey = corners[nearest, 0] - corners[last, 0], corners[nearest, 1] - corners[last, 1]
    dx, dy = x - corners[last, 0], y - corners[last, 1]
    # Beside an edge its side tells; off its ends whether the corner sticks out of the solid.
    beside = place == inner
    within = nx * dx + ny * dy < 0.0 if beside else shapes.convex[last if place == 0.0 else nearest] == 0.0
    gap = -distance if within else distance
    return gap, (dx - place * ex) / gap, (dy - place * ey) / gap, 0.0 if beside else 1.0 / gap, last, nearest


@compiled_uncounted
def point_contacts(a: int, x: float, y: float, radius: float, shapes: Shapes, rows: Vector, count: int) -> int:
    """Write what a round point sinks into; return the new count.

    In a corner that opens away from the solid both edges hold it. By the nearer one alone the least energy would be at
    a kink, where no force is balanced and Newton's iteration goes from one side to the other without end.

    Args:
        a: index of its first unknown.
        x: of its centre [m].
        y: the same.
        radius: of the point [m].
        shapes: the surface.
        rows: gets a, -1, depth, gradient n_x, n_y of the gap and its curvature c, where the gap's second derivative
            is c (I - n n'), shape (k, 6). What finds no row is left out.
        count: of the rows that are in use.
    """
    for i in range(shapes.discs.shape[0]):
        dx, dy = x - shapes.discs[i, 0], y - shapes.discs[i, 1]
        reach, square = shapes.discs[i, 2] + radius, dx * dx + dy * dy
        if 0.0 < square < reach * reach:
            size = math.sqrt(square)
            count = write_row(rows, count, a, -1.0, reach - size, dx / size, dy / size, 1.0 / size)
    reach, square = shapes.wall - radius, x * x + y * y
    if square > reach * reach:
        size = math.sqrt(square)
        count = write_row(rows, count, a, -1.0, size - reach, -x / size, -y / size, -1.0 / size)
    for p in range(shapes.boxes.shape[0]):
        if _box_square(x, y, shapes.boxes[p]) >= radius * radius:
            continue
        gap, nx, ny, bend, last, nearest = polygon_gap(x, y, shapes, p)
        if gap >= radius:
            continue
        count = write_row(rows, count, a, -1.0, radius - gap, nx, ny, bend)
        for k in range(2):  # the edge before, and the one behind
            corner, edge = (last, 0) if k == 0 else (nearest, 2)
            nx, ny = shapes.normals[corner, edge], shapes.normals[corner, edge + 1]
            gap = nx * (x - shapes.corners[corner, 0]) + ny * (y - shapes.corners[corner, 1])
            if shapes.convex[corner] == 0.0 and gap < radius:
                count = write_row(rows, count, a, -1.0, radius - gap, nx, ny, 0.0)
    return count


@compiled_inline
def _segment_gap(ax: float, ay: float, bx: float, by: float, cx: float, cy: float) -> tuple[float, float, float, float]:
    """Return distance of a point c from the segment from a to b, its normal away from c, and where (0 at a, 1 at b)."""
    ex, ey = bx - ax, by - ay
    s = min(max(((cx - ax) * ex + (cy - ay) * ey) / (ex * ex + ey * ey), 0.0), 1.0)
    if 0.0 < s < 1.0:
        size = math.sqrt(ex * ex + ey * ey)
        nx, ny = -ey / size, ex / size
        gap = nx * (ax - cx) + ny * (ay - cy)
        return (-gap, -nx, -ny, s) if gap < 0.0 else (gap, nx, ny, s)
    nx, ny = ax + s * ex - cx, ay + s * ey - cy
    gap = max(math.sqrt(nx * nx + ny * ny), 1e-12)
    return gap, nx / gap, ny / gap, s


@compiled_uncounted
def segment_contacts(q: Vector, a: int, length: float, radius: float, shapes: Shapes, rows: Vector, count: int) -> int:
    """Write what a segment sinks into: discs with its inner part, and corners that stick out; return the new count.

    Against a disc of reach r, a chain of chords D that all touch the circle of radius (D / 2) / tan(D / 2 r) from
    outside turns as a thread of the same length on the disc does. That is the radius a segment keeps, less than
    r; its end points keep r. A segment on both sides of a corner's solid has a negative gap to the corner.
    Beyond its ends a corner is as far from it as from its node: a corner that slides over a node meets no step in the
    energy, at which Newton's iteration would not end.

    Args:
        q: state, shape (N,).
        a: index of x of the segment's first node; its y and the second node follow.
        length: D, of the segment at rest [m].
        radius: half the thread's diameter [m].
        shapes: the surface.
        rows: gets index a, place s from the first node, depth, gradient n_x, n_y there, and the gap, shape (k, 6); or,
            of a corner beyond an end, what `point_contacts` has for the node. What finds no row is left out.
        count: of the rows that are in use.
    """
    ax, ay, bx, by = q[a], q[a + 1], q[a + 2], q[a + 3]
    ex, ey = bx - ax, by - ay
    square = ex * ex + ey * ey
    size, mx, my = math.sqrt(square), 0.5 * (ax + bx), 0.5 * (ay + by)
    for i in range(shapes.discs.shape[0]):
        x, y, reach = shapes.discs[i, 0], shapes.discs[i, 1], shapes.discs[i, 2] + radius
        if (mx - x) ** 2 + (my - y) ** 2 > (reach + 0.5 * size) ** 2:
            continue
        half = 0.5 * length / reach
        reach *= max(half / math.tan(half), MIN_APOTHEM) if half < 1.5 else MIN_APOTHEM
        gap, nx, ny, s = _segment_gap(ax, ay, bx, by, x, y)
        if 0.0 < s < 1.0 and gap < reach:
            count = write_row(rows, count, a, s, reach - gap, nx, ny, gap)
    # A chord this deep behind a corner passes beside it, not over it.
    deepest = max(radius, 0.25 * size)
    reach = 0.5 * size + deepest
    for p in range(shapes.boxes.shape[0]):
        if _box_square(mx, my, shapes.boxes[p]) >= reach * reach:
            continue
        for k in range(shapes.block_starts[p], shapes.block_starts[p + 1]):
            if _box_square(mx, my, shapes.blocks[k]) >= reach * reach:
                continue
            begin = shapes.starts[p] + BLOCK * (k - shapes.block_starts[p])
            for i in range(begin, min(begin + BLOCK, shapes.starts[p + 1])):
                x, y = shapes.corners[i, 0], shapes.corners[i, 1]
                # Most corners are beside the segment or far from its line, which takes no division to see.
                along, aside = (x - ax) * ex + (y - ay) * ey, (x - ax) * ey - (y - ay) * ex
                margin = radius * size
                if not -margin < along < square + margin or abs(aside) >= deepest * size or shapes.convex[i] == 0.0:
                    continue
                gap, nx, ny, s = _segment_gap(ax, ay, bx, by, x, y)
                normal = shapes.normals[i]  # inside where it is on the inner side of both edges of the corner
                if nx * normal[0] + ny * normal[1] < 0.0 and nx * normal[2] + ny * normal[3] < 0.0:
                    gap, nx, ny = -gap, -nx, -ny
                if gap >= radius:
                    continue
                if 0.0 < s < 1.0:
                    count = write_row(rows, count, a, s, radius - gap, nx, ny, gap)
                else:
                    count = write_row(rows, count, a if s == 0.0 else a + 2, -1.0, radius - gap, nx, ny, 1.0 / gap)
    return count
