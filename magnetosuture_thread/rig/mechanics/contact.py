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

from magnetosuture_thread.compiled import compiled, compiled_inline
from magnetosuture_thread.errors import ConfigurationError
from magnetosuture_thread.geometry.obstacles import Disc

MIN_APOTHEM = 0.6  # of a disc's radius, where segments are longer than the disc
GRID = 128  # cells along the longer side of all that can be touched
MAX_CLEARANCE = 8.0  # cells; clearances are not found beyond


class Bins(NamedTuple):
    """What is in each cell of a grid.

    Attributes:
        starts: where the content of each cell begins in `content`, and the end, shape (h w + 1,).
        content: indices.
    """

    starts: NDArray[np.int64]
    content: NDArray[np.int64]


class Shapes(NamedTuple):
    """A surface as kernels read it.

    Attributes:
        discs: centre, radius, shape (k, 3) [m].
        corners: of all polygons, the solid to the left of every edge, shape (c, 2) [m].
        starts: where each polygon begins in `corners`, and the end, shape (p + 1,).
        boxes: least x, least y, greatest x, greatest y of each polygon, shape (p, 4) [m].
        grid: least x and y of the cells of `clearances`, and their side, shape (3,) [m].
        clearances: at the least, of all points of a cell, rows along y, shape (h, w) [m].
        convex: 1 at corners that stick out of the solid, else 0, shape (c,).
        owners: polygon of each corner, and of the edge that ends there, shape (c,).
        edges: of each cell the edges that may pass through it, cells by row.
        sharp: of each cell the corners in it that stick out of the solid.
        wall: radius of the dish's wall around the origin, infinite if there is none [m].
        stiffness: k of every contact [N/m].
        friction: mu, of the thread on everything; the needle has none.
        self_contact: whether the thread touches itself; else it passes over itself.
    """

    discs: NDArray[np.float64]
    corners: NDArray[np.float64]
    starts: NDArray[np.int64]
    boxes: NDArray[np.float64]
    grid: NDArray[np.float64]
    clearances: NDArray[np.float64]
    convex: NDArray[np.float64]
    owners: NDArray[np.int64]
    edges: Bins
    sharp: Bins
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
    polygons: tuple[NDArray[np.float64], ...] = ()
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
        corners = np.concatenate([np.zeros((0, 2)), *rings])
        befores = np.concatenate([np.zeros((0, 2)), *(np.roll(ring, 1, axis=0) for ring in rings)])
        starts = np.cumsum([0, *(len(ring) for ring in rings)]).astype(np.int64)
        convex = np.concatenate([np.zeros(0), *(_convex(ring) for ring in rings)])
        boxes = np.array([(*ring.min(axis=0), *ring.max(axis=0)) for ring in rings], dtype=np.float64).reshape(-1, 4)
        reached = [*boxes, *((x - r, y - r, x + r, y + r) for x, y, r in [*discs, (0.0, 0.0, wall)] if r < math.inf)]
        grid, cells = np.array([0.0, 0.0, 1.0]), np.full((1, 1), np.inf)
        if reached:
            low, high = np.min(reached, axis=0)[:2], np.max(reached, axis=0)[2:]
            grid = np.array([*low, float(max(high - low)) / GRID])
            cells = np.full(np.ceil((high - low)[::-1] / grid[2]).astype(int), np.inf)
        sharp = np.where(convex[:, None] > 0.0, corners, np.nan)
        shapes = Shapes(
            discs=discs,
            corners=corners,
            starts=starts,
            boxes=boxes,
            grid=grid,
            clearances=cells,
            convex=convex,
            owners=np.repeat(np.arange(len(rings)), np.diff(starts)),
            edges=_bin_boxes(np.minimum(corners, befores), np.maximum(corners, befores), grid, cells.shape),
            sharp=_bin_boxes(sharp, sharp, grid, cells.shape),
            wall=float(wall),
            stiffness=float(self.stiffness),
            friction=float(self.friction),
            self_contact=bool(self.self_contact),
        )
        _find_clearances(shapes)
        return shapes


def _directed(given: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a ring counter-clockwise and open, once it is known to bound an area."""
    ring = np.array(given, dtype=np.float64)
    if ring.ndim != 2 or ring.shape[1] != 2 or not np.isfinite(ring).all():
        raise ConfigurationError("surface.polygons", ring.shape, "finite corners, shape (m, 2) [m]")
    ring = ring[:-1] if len(ring) > 1 and (ring[0] == ring[-1]).all() else ring
    x, y = (ring - ring[:1]).T
    area = 0.5 * float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y))
    if len(ring) < 3 or area == 0.0 or (ring == np.roll(ring, 1, axis=0)).all(axis=1).any():
        raise ConfigurationError("surface.polygons", ring.tolist(), "at least three distinct corners around an area")
    return ring if area > 0.0 else np.ascontiguousarray(ring[::-1])


def _convex(ring: NDArray[np.float64]) -> NDArray[np.float64]:
    before, after = ring - np.roll(ring, 1, axis=0), np.roll(ring, -1, axis=0) - ring
    return np.where(before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0] > 0.0, 1.0, 0.0)


def _bin_boxes(
    low: NDArray[np.float64], high: NDArray[np.float64], grid: NDArray[np.float64], shape: tuple[int, ...]
) -> Bins:
    """Return which boxes reach into each cell; those that are not finite reach into none."""
    cells: list[list[int]] = [[] for _ in range(shape[0] * shape[1])]
    for index, ends in enumerate(np.stack([low, high], axis=1)):
        if np.isfinite(ends).all():
            # Rounded as `cells_around` does, so that a point is in one cell, and boxes that meet share one.
            first, last = np.clip(((ends - grid[:2]) / grid[2]).astype(int), 0, (shape[1] - 1, shape[0] - 1))
            for row in range(first[1], last[1] + 1):
                for column in range(first[0], last[0] + 1):
                    cells[row * shape[1] + column].append(index)
    counts = [len(cell) for cell in cells]
    return Bins(np.cumsum([0, *counts]), np.array([index for cell in cells for index in cell], dtype=np.int64))


@compiled_inline
def _cells_around(
    low_x: float, low_y: float, high_x: float, high_y: float, grid: NDArray[np.float64], shape: tuple[int, int]
) -> tuple[int, int, int, int]:
    """Return the first and last row, and the first and last column, of the cells that a box reaches into."""
    x, y, side = grid[0], grid[1], grid[2]
    rows, columns = shape[0] - 1.0, shape[1] - 1.0
    return (
        int(min(max((low_y - y) / side, 0.0), rows)),
        int(min(max((high_y - y) / side, 0.0), rows)),
        int(min(max((low_x - x) / side, 0.0), columns)),
        int(min(max((high_x - x) / side, 0.0), columns)),
    )


@compiled_inline
def clear(x: float, y: float, reach: float, grid: NDArray[np.float64], clearances: NDArray[np.float64]) -> bool:
    """Return whether nothing is within reach, as far as the grid tells; from beyond the grid all is as far or farther.

    All but the wall, that is, which is in the cells at the border already.
    """
    rows, columns = clearances.shape
    i = int(min(max((y - grid[1]) / grid[2], 0.0), rows - 1.0))
    j = int(min(max((x - grid[0]) / grid[2], 0.0), columns - 1.0))
    return bool(clearances[i, j] > reach)


@compiled_inline
def inside(x: float, y: float, shapes: Shapes, p: int) -> bool:
    """Return whether a point is in polygon p: a ray from it crosses the outline an odd number of times."""
    corners, start, end = shapes.corners, shapes.starts[p], shapes.starts[p + 1]
    within, j = False, end - 1
    for i in range(start, end):
        if (corners[i, 1] > y) != (corners[j, 1] > y):
            part = (y - corners[i, 1]) / (corners[j, 1] - corners[i, 1])
            if x < corners[i, 0] + part * (corners[j, 0] - corners[i, 0]):
                within = not within
        j = i
    return within


@compiled_inline
def polygon_gap(x: float, y: float, shapes: Shapes, p: int, reach: float) -> tuple[float, float, float, float]:
    """Return signed distance from polygon p, its gradient (n_x, n_y), and its curvature [m, 1, 1, 1/m].

    The distance of a point that is farther outside than `reach` is infinite.
    """
    corners, start, end = shapes.corners, shapes.starts[p], shapes.starts[p + 1]
    starts, content, owners, shape = shapes.edges.starts, shapes.edges.content, shapes.owners, shapes.clearances.shape
    least, nearest = reach * reach, -1
    first_row, last_row, first, last = _cells_around(x - reach, y - reach, x + reach, y + reach, shapes.grid, shape)
    columns = shape[1]
    for row in range(first_row, last_row + 1):
        for column in range(first, last + 1):
            cell = row * columns + column
            for k in range(starts[cell], starts[cell + 1]):
                i = content[k]
                if owners[i] != p:
                    continue
                distance = _edge_distance(x, y, corners, i, i - 1 if i > start else end - 1)
                if distance < least:
                    least, nearest = distance, i
    if nearest < 0:
        if not inside(x, y, shapes, p):
            return np.inf, 1.0, 0.0, 0.0
        least = np.inf
        for i in range(start, end):
            distance = _edge_distance(x, y, corners, i, i - 1 if i > start else end - 1)
            if distance < least:
                least, nearest = distance, i
    i, j = nearest, nearest - 1 if nearest > start else end - 1
    ex, ey, dx, dy = corners[i, 0] - corners[j, 0], corners[i, 1] - corners[j, 1], x - corners[j, 0], y - corners[j, 1]
    s = (dx * ex + dy * ey) / (ex * ex + ey * ey)
    t = min(max(s, 0.0), 1.0)
    distance = math.sqrt(least)
    if distance < 1e-12:
        size = math.sqrt(ex * ex + ey * ey)
        return 0.0, ey / size, -ex / size, 0.0
    # Beside an edge its side tells; off its ends whether the corner sticks out of the solid.
    within = ex * dy - ey * dx > 0.0 if t == s else shapes.convex[j if t == 0.0 else i] == 0.0
    gap = -distance if within else distance
    return gap, (dx - t * ex) / gap, (dy - t * ey) / gap, 1.0 / gap if t != s else 0.0


@compiled_inline
def _edge_distance(x: float, y: float, corners: NDArray[np.float64], i: int, j: int) -> float:
    """Return the squared distance from the edge that begins at corner j and ends at corner i [m^2]."""
    ex, ey, dx, dy = corners[i, 0] - corners[j, 0], corners[i, 1] - corners[j, 1], x - corners[j, 0], y - corners[j, 1]
    t = min(max((dx * ex + dy * ey) / (ex * ex + ey * ey), 0.0), 1.0)
    return float((dx - t * ex) ** 2 + (dy - t * ey) ** 2)


@compiled
def _find_clearances(shapes: Shapes) -> None:
    least, side = MAX_CLEARANCE * shapes.grid[2], shapes.grid[2]
    for i in range(shapes.clearances.shape[0]):
        for j in range(shapes.clearances.shape[1]):
            x, y = shapes.grid[0] + (j + 0.5) * side, shapes.grid[1] + (i + 0.5) * side
            gap = min(least, shapes.wall - math.sqrt(x * x + y * y))
            for disc in shapes.discs:
                gap = min(gap, math.sqrt((x - disc[0]) ** 2 + (y - disc[1]) ** 2) - disc[2])
            for p in range(shapes.boxes.shape[0]):
                gap = min(gap, polygon_gap(x, y, shapes, p, least)[0])
            shapes.clearances[i, j] = gap - 0.75 * side  # half a diagonal and more


@compiled_inline
def point_contacts(x: float, y: float, radius: float, shapes: Shapes, rows: NDArray[np.float64]) -> int:
    """Write what a round point sinks into; return how many.

    Args:
        x: of its centre [m].
        y: the same.
        radius: of the point [m].
        shapes: the surface.
        rows: gets depth, gradient n_x, n_y of the gap and its curvature c, where the gap's second derivative
            is c (I - n n'); at least as many rows as shapes and wall.
    """
    count = 0
    for i in range(shapes.discs.shape[0]):
        dx, dy = x - shapes.discs[i, 0], y - shapes.discs[i, 1]
        reach = shapes.discs[i, 2] + radius
        square = dx * dx + dy * dy
        if 0.0 < square < reach * reach:
            size = math.sqrt(square)
            rows[count, 0], rows[count, 1], rows[count, 2] = reach - size, dx / size, dy / size
            rows[count, 3] = 1.0 / size
            count += 1
    square = x * x + y * y
    reach = shapes.wall - radius
    if square > reach * reach:
        size = math.sqrt(square)
        rows[count, 0], rows[count, 1], rows[count, 2] = size - reach, -x / size, -y / size
        rows[count, 3] = -1.0 / size
        count += 1
    for p in range(shapes.boxes.shape[0]):
        box = shapes.boxes[p]
        if box[0] - radius < x < box[2] + radius and box[1] - radius < y < box[3] + radius:
            gap, nx, ny, bend = polygon_gap(x, y, shapes, p, radius)
            if gap < radius:
                rows[count, 0], rows[count, 1], rows[count, 2], rows[count, 3] = radius - gap, nx, ny, bend
                count += 1
    return count


@compiled_inline
def _segment_gap(ax: float, ay: float, bx: float, by: float, cx: float, cy: float) -> tuple[float, float, float, float]:
    """Return distance of a point c from the line through a and b, its normal away from c, and where (0 at a)."""
    ex, ey = bx - ax, by - ay
    size = math.sqrt(ex * ex + ey * ey)
    nx, ny = -ey / size, ex / size
    gap = nx * (ax - cx) + ny * (ay - cy)
    s = -((ax - cx) * ex + (ay - cy) * ey) / (size * size)
    if gap < 0.0:
        gap, nx, ny = -gap, -nx, -ny
    return gap, nx, ny, s


@compiled_inline
def segment_contacts(
    ax: float,
    ay: float,
    bx: float,
    by: float,
    length: float,
    radius: float,
    shapes: Shapes,
    rows: NDArray[np.float64],
) -> int:
    """Write what the inner part of a segment sinks into: discs, and corners that stick out; return how many.

    Against a disc of reach r, a chain of chords D that all touch the circle of radius (D / 2) / tan(D / 2 r) from
    outside turns as a thread of the same length on the disc does. That is the radius a segment keeps, less than
    r; its end points keep r. A segment on both sides of a corner's solid has a negative gap to the corner.

    Args:
        ax: first end point [m].
        ay: the same.
        bx: second end point.
        by: the same.
        length: D, of the segment at rest [m].
        radius: half the thread's diameter [m].
        shapes: the surface.
        rows: gets depth, gradient n_x, n_y at the place s, the gap, and s; see `point_contacts`.
    """
    count = 0
    size = math.sqrt((bx - ax) ** 2 + (by - ay) ** 2)
    mx, my = 0.5 * (ax + bx), 0.5 * (ay + by)
    for i in range(shapes.discs.shape[0]):
        reach = shapes.discs[i, 2] + radius
        if (mx - shapes.discs[i, 0]) ** 2 + (my - shapes.discs[i, 1]) ** 2 > (reach + 0.5 * size) ** 2:
            continue
        half = 0.5 * length / reach
        reach *= max(half / math.tan(half), MIN_APOTHEM) if half < 1.5 else MIN_APOTHEM
        gap, nx, ny, s = _segment_gap(ax, ay, bx, by, shapes.discs[i, 0], shapes.discs[i, 1])
        if 0.0 < s < 1.0 and gap < reach and count < rows.shape[0]:
            rows[count, 0], rows[count, 1], rows[count, 2] = reach - gap, nx, ny
            rows[count, 3], rows[count, 4] = gap, s
            count += 1
    # A chord this deep behind a corner passes beside it, not over it.
    deepest = max(radius, 0.25 * size)
    first_row, last_row, first, last = _cells_around(
        min(ax, bx) - deepest,
        min(ay, by) - deepest,
        max(ax, bx) + deepest,
        max(ay, by) + deepest,
        shapes.grid,
        shapes.clearances.shape,
    )
    columns, corners = shapes.clearances.shape[1], shapes.corners
    starts, content = shapes.sharp.starts, shapes.sharp.content
    ex, ey, square = bx - ax, by - ay, size * size
    for row in range(first_row, last_row + 1):
        for column in range(first, last + 1):
            cell = row * columns + column
            for k in range(starts[cell], starts[cell + 1]):
                i = content[k]
                dx, dy = corners[i, 0] - ax, corners[i, 1] - ay
                # Most corners are beside the segment or far from its line, which takes no division to see.
                if not 0.0 < dx * ex + dy * ey < square or abs(dx * ey - dy * ex) >= deepest * size:
                    continue
                gap, nx, ny, s = _segment_gap(ax, ay, bx, by, corners[i, 0], corners[i, 1])
                if inside(ax + s * (bx - ax), ay + s * (by - ay), shapes, shapes.owners[i]):
                    gap, nx, ny = -gap, -nx, -ny
                if gap < radius and count < rows.shape[0]:
                    rows[count, 0], rows[count, 1], rows[count, 2] = radius - gap, nx, ny
                    rows[count, 3], rows[count, 4] = gap, s
                    count += 1
    return count
