"""What the needle and the thread can touch: discs, polygons and the wall of the dish.

A contact is a gap g, at least 0 where nothing touches, and an energy k / 2 g^2 below: frictionless, stiff, and
with an exact second derivative, from the gap's gradient and curvature.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.geometry.compiled import compiled, compiled_inline, compiled_uncounted
from magnetosuture_thread.geometry.obstacles import Disc
from magnetosuture_thread.settings.errors import ConfigurationError

Vector = NDArray[np.float64]

MIN_APOTHEM = 0.6  # of a disc's radius, where segments are longer than the disc
GRID = 128  # cells along the longer side of all that can be touched
BLOCK = 8  # edges of a polygon that are passed over together where all of them are too far


class Shapes(NamedTuple):
    """A surface as kernels read it.

    Attributes:
        discs: centre, radius, shape (k, 3) [m].
        corners: of all polygons, the solid to the left of every edge, shape (c, 2) [m].
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
    convex: Vector
    starts: NDArray[np.int64]
    boxes: Vector
    blocks: Vector
    block_starts: NDArray[np.int64]
    grid: Vector
    clearances: Vector
    wall: float
    stiffness: float
    friction: float
    self_contact: bool


@dataclass(frozen=True)
class Surface:
    """What stands in the dish, and its wall.

    Attributes:
        discs: round posts.
        polygons: corners of simple polygons, solid inside, in either direction, each of shape (m, 2) [m].
        wall_radius: inner radius of the dish around the origin, None without a wall [m].
        stiffness: k of a contact; a force f sinks in by f / k [N/m].
        skin: how far outside a contact begins, so that up to k times this nothing gets in at all [m]. A harder
            contact without it costs more: nodes that slide then leave and meet the surface at every step.
        friction: Coulomb's coefficient of the thread on all of it; the needle has no friction.
        self_contact: whether the thread touches itself, with the same friction; else it passes over itself.
    """

    discs: tuple[Disc, ...] = ()
    polygons: tuple[Vector, ...] = ()
    wall_radius: float | None = None
    stiffness: float = 500.0
    skin: float = 1.5e-6
    friction: float = 0.0
    self_contact: bool = False

    def packed(self) -> Shapes:
        """Return the arrays that kernels read.

        Raises:
            ConfigurationError: a polygon bounds no area.
        """
        wall = math.inf if self.wall_radius is None else self.wall_radius
        discs = np.array([(*disc.centre[:2], disc.radius) for disc in self.discs], dtype=np.float64).reshape(-1, 3)
        rings = [_directed(ring) for ring in self.polygons]
        boxes, blocks = _boxes(rings), [_boxes(_edge_blocks(ring)) for ring in rings]
        reached = [*boxes, *((x - r, y - r, x + r, y + r) for x, y, r in [*discs, (0.0, 0.0, wall)] if r < math.inf)]
        grid, cells = np.array([0.0, 0.0, 1.0]), np.full((1, 1), np.inf)
        if reached:
            low, high = np.min(reached, axis=0)[:2], np.max(reached, axis=0)[2:]
            grid = np.array([*low, float(max(high - low)) / GRID])
            cells = np.full(np.ceil((high - low)[::-1] / grid[2]).astype(int), np.inf)
        shapes = Shapes(
            discs=discs,
            corners=np.concatenate([np.zeros((0, 2)), *rings]),
            convex=np.concatenate([np.zeros(0), *(_convex(ring) for ring in rings)]),
            starts=np.cumsum([0, *(len(ring) for ring in rings)]).astype(np.int64),
            boxes=boxes,
            blocks=np.concatenate([np.zeros((0, 4)), *blocks]),
            block_starts=np.cumsum([0, *map(len, blocks)]).astype(np.int64),
            grid=grid,
            clearances=cells,
            wall=float(wall),
            stiffness=float(self.stiffness),
            friction=float(self.friction),
            self_contact=bool(self.self_contact),
        )
        _find_clearances(shapes)
        return shapes


def _directed(given: Vector) -> Vector:
    """Return a ring counter-clockwise and open."""
    ring = np.array(given, dtype=np.float64)
    ring = ring[:-1] if (ring[0] == ring[-1]).all() else ring
    x, y = (ring - ring[:1]).T
    area = 0.5 * float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y))
    if not abs(area) > 0.0:
        raise ConfigurationError("surface.polygons", ring.tolist(), "at least three distinct corners around an area")
    return ring if area > 0.0 else np.ascontiguousarray(ring[::-1])


def _convex(ring: Vector) -> Vector:
    before, after = ring - np.roll(ring, 1, axis=0), np.roll(ring, -1, axis=0) - ring
    return np.where(before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0] > 0.0, 1.0, 0.0)


def _boxes(parts: list[Vector]) -> Vector:
    """Return least x and y, greatest x and y of sets of points, shape (k, 4)."""
    return np.array([(*part.min(axis=0), *part.max(axis=0)) for part in parts], dtype=np.float64).reshape(-1, 4)


def _edge_blocks(ring: Vector) -> list[Vector]:
    """Return the corners of each `BLOCK` edges of a ring; edge i ends at corner i."""
    ends = np.concatenate([ring[-1:], ring])
    return [ends[first : first + BLOCK + 1] for first in range(0, len(ring), BLOCK)]


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
    ex, ey = corners[nearest, 0] - corners[last, 0], corners[nearest, 1] - corners[last, 1]
    dx, dy = x - corners[last, 0], y - corners[last, 1]
    distance = math.sqrt(least)
    if distance < 1e-12:
        size = math.sqrt(ex * ex + ey * ey)
        return 0.0, ey / size, -ex / size, 0.0, last, nearest
    # Beside an edge its side tells; off its ends whether the corner sticks out of the solid.
    beside = place == inner
    within = ex * dy - ey * dx > 0.0 if beside else shapes.convex[last if place == 0.0 else nearest] == 0.0
    gap = -distance if within else distance
    return gap, (dx - place * ex) / gap, (dy - place * ey) / gap, 0.0 if beside else 1.0 / gap, last, nearest


@compiled
def _find_clearances(shapes: Shapes) -> None:
    # Clearances are not found beyond 8 cells.
    most, side = 8.0 * shapes.grid[2], shapes.grid[2]
    for i in range(shapes.clearances.shape[0]):
        for j in range(shapes.clearances.shape[1]):
            x, y = shapes.grid[0] + (j + 0.5) * side, shapes.grid[1] + (i + 0.5) * side
            gap = min(most, shapes.wall - math.sqrt(x * x + y * y))
            for disc in shapes.discs:
                gap = min(gap, math.sqrt((x - disc[0]) ** 2 + (y - disc[1]) ** 2) - disc[2])
            for p in range(shapes.boxes.shape[0]):
                box = shapes.boxes[p]
                if box[0] - gap < x < box[2] + gap and box[1] - gap < y < box[3] + gap:
                    gap = min(gap, polygon_gap(x, y, shapes, p)[0])
            shapes.clearances[i, j] = gap - 0.75 * side  # half a diagonal and more


@compiled_uncounted
def point_contacts(x: float, y: float, radius: float, shapes: Shapes, rows: Vector) -> int:
    """Write what a round point sinks into; return how many.

    In a corner that opens away from the solid both edges hold it. By the nearer one alone the least energy would be at
    a kink, where no force is balanced and Newton's iteration goes from one side to the other without end.

    Args:
        x: of its centre [m].
        y: the same.
        radius: of the point [m].
        shapes: the surface.
        rows: gets depth, gradient n_x, n_y of the gap and its curvature c, where the gap's second derivative
            is c (I - n n'), shape (k, 6); the first two columns are left to the caller. What finds no row is left out.
    """
    count, most = 0, rows.shape[0]
    for i in range(shapes.discs.shape[0]):
        dx, dy = x - shapes.discs[i, 0], y - shapes.discs[i, 1]
        reach = shapes.discs[i, 2] + radius
        square = dx * dx + dy * dy
        if 0.0 < square < reach * reach and count < most:
            size = math.sqrt(square)
            rows[count, 2], rows[count, 3], rows[count, 4] = reach - size, dx / size, dy / size
            rows[count, 5] = 1.0 / size
            count += 1
    square = x * x + y * y
    reach = shapes.wall - radius
    if square > reach * reach and count < most:
        size = math.sqrt(square)
        rows[count, 2], rows[count, 3], rows[count, 4] = size - reach, -x / size, -y / size
        rows[count, 5] = -1.0 / size
        count += 1
    for p in range(shapes.boxes.shape[0]):
        box = shapes.boxes[p]
        if box[0] - radius < x < box[2] + radius and box[1] - radius < y < box[3] + radius and count < most:
            gap, nx, ny, bend, last, nearest = polygon_gap(x, y, shapes, p)
            if gap >= radius:
                continue
            rows[count, 2], rows[count, 3], rows[count, 4], rows[count, 5] = radius - gap, nx, ny, bend
            count += 1
            start, end, corners = shapes.starts[p], shapes.starts[p + 1], shapes.corners
            before, after = last - 1 if last > start else end - 1, nearest + 1 if nearest + 1 < end else start
            for corner, a, b in ((last, before, last), (nearest, nearest, after)):
                if shapes.convex[corner] == 1.0 or count >= most:
                    continue
                ex, ey = corners[b, 0] - corners[a, 0], corners[b, 1] - corners[a, 1]
                size = math.sqrt(ex * ex + ey * ey)
                nx, ny = ey / size, -ex / size
                gap = nx * (x - corners[corner, 0]) + ny * (y - corners[corner, 1])
                if gap < radius:
                    rows[count, 2], rows[count, 3], rows[count, 4], rows[count, 5] = radius - gap, nx, ny, 0.0
                    count += 1
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
def segment_contacts(q: Vector, a: int, length: float, radius: float, shapes: Shapes, rows: Vector) -> int:
    """Write what a segment sinks into: discs with its inner part, and corners that stick out; return how many.

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
    """
    count, most = 0, rows.shape[0]
    ax, ay, bx, by = q[a], q[a + 1], q[a + 2], q[a + 3]
    size = math.sqrt((bx - ax) ** 2 + (by - ay) ** 2)
    mx, my = 0.5 * (ax + bx), 0.5 * (ay + by)
    for i in range(shapes.discs.shape[0]):
        reach = shapes.discs[i, 2] + radius
        if (mx - shapes.discs[i, 0]) ** 2 + (my - shapes.discs[i, 1]) ** 2 > (reach + 0.5 * size) ** 2:
            continue
        half = 0.5 * length / reach
        reach *= max(half / math.tan(half), MIN_APOTHEM) if half < 1.5 else MIN_APOTHEM
        gap, nx, ny, s = _segment_gap(ax, ay, bx, by, shapes.discs[i, 0], shapes.discs[i, 1])
        if 0.0 < s < 1.0 and gap < reach and count < most:
            rows[count, 0], rows[count, 1], rows[count, 2] = a, s, reach - gap
            rows[count, 3], rows[count, 4], rows[count, 5] = nx, ny, gap
            count += 1
    # A chord this deep behind a corner passes beside it, not over it.
    deepest = max(radius, 0.25 * size)
    ex, ey, square, corners = bx - ax, by - ay, size * size, shapes.corners
    for p in range(shapes.boxes.shape[0]):
        reach, first = 0.5 * size + deepest, shapes.block_starts[p]
        if _box_square(mx, my, shapes.boxes[p]) >= reach * reach:
            continue
        for k in range(first, shapes.block_starts[p + 1]):
            if _box_square(mx, my, shapes.blocks[k]) >= reach * reach:
                continue
            begin = shapes.starts[p] + BLOCK * (k - first)
            for i in range(begin, min(begin + BLOCK, shapes.starts[p + 1])):
                dx, dy = corners[i, 0] - ax, corners[i, 1] - ay
                # Most corners are beside the segment or far from its line, which takes no division to see.
                along, margin = dx * ex + dy * ey, radius * size
                if not -margin < along < square + margin or abs(dx * ey - dy * ex) >= deepest * size:
                    continue
                if shapes.convex[i] == 0.0 or count >= most:
                    continue
                gap, nx, ny, s = _segment_gap(ax, ay, bx, by, corners[i, 0], corners[i, 1])
                # Inside where it is to the left of both edges of the corner.
                last = i - 1 if i > shapes.starts[p] else shapes.starts[p + 1] - 1
                after = i + 1 if i + 1 < shapes.starts[p + 1] else shapes.starts[p]
                ux, uy = corners[i, 0] - corners[last, 0], corners[i, 1] - corners[last, 1]
                vx, vy = corners[after, 0] - corners[i, 0], corners[after, 1] - corners[i, 1]
                if ux * ny - uy * nx > 0.0 and vx * ny - vy * nx > 0.0:
                    gap, nx, ny = -gap, -nx, -ny
                if gap < radius:
                    rows[count, 0], rows[count, 1], rows[count, 2] = a, s, radius - gap
                    rows[count, 3], rows[count, 4], rows[count, 5] = nx, ny, gap
                    if s == 0.0 or s == 1.0:
                        rows[count, 0], rows[count, 1], rows[count, 5] = a + 2.0 * s, -1.0, 1.0 / gap
                    count += 1
    return count
