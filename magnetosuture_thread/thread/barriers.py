"""The built-in control barrier functions of the thread, and the compiled functions that write their rows."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.geometry.barrier import (
    COMPRESSION,
    CONNECTIVITY,
    ENHANCED_CONNECTIVITY,
    NO_OBSTACLE,
    OBSTACLE,
    STIFFNESS,
    WALL,
    BarrierRows,
    RowBarrier,
)
from magnetosuture_thread.geometry.compiled import compiled, compiled_inline, compiled_uncounted
from magnetosuture_thread.geometry.obstacles import WALL as DISH_WALL
from magnetosuture_thread.geometry.obstacles import (
    Workspace,
    WorkspaceData,
    half_segment_distance,
    nearest_edge,
    wall_contact,
)
from magnetosuture_thread.geometry.polyline import Indices, Mask, Points, Table, Vector
from magnetosuture_thread.settings.errors import ConfigurationError, SolverError
from magnetosuture_thread.thread.material import Thread
from magnetosuture_thread.thread.mechanics import RodProperties, chord_lengths


@compiled_inline
def distance_row(points: Points, i: int, j: int, rest: float) -> tuple[float, float]:
    """Return h = (rest^2 - |x_j - x_i|^2) / 2, with the gradient x_j - x_i by x_i, and the distance |x_j - x_i|."""
    square = 0.0
    for a in range(points.shape[1]):
        square += (points[j, a] - points[i, a]) ** 2
    return 0.5 * (rest * rest - square), math.sqrt(square)


@compiled
def _write_distances(points: Points, apart: int, rest: Vector, value: Vector, distance: Vector) -> None:
    for i in range(len(value)):
        value[i], distance[i] = distance_row(points, i, i + apart, rest[i])


class _DistanceBarrier(RowBarrier):
    """A barrier of the distances of nodes some segments apart, h = +-(rest^2 - |x_i - x_{i-apart}|^2) / 2."""

    apart, sign = 1, 1.0

    def _rows(self, positions: Points, rest: float | Vector) -> BarrierRows:
        along, first = positions[self.apart :] - positions[: -self.apart], np.arange(len(positions) - self.apart)
        rests, (value, distance) = np.array(np.broadcast_to(rest, first.shape), np.float64), np.empty((2, len(first)))
        _write_distances(np.array(positions, np.float64), self.apart, rests, value, distance)
        return BarrierRows(
            name=self.name,
            nodes=np.column_stack([first, first + self.apart]),
            obstacle=np.full(len(first), NO_OBSTACLE),
            value=self.sign * value,
            gradient=self.sign * np.stack([along, -along], axis=1),
            clearance=self.sign * (rest - distance),
        )


@dataclass(frozen=True)
class Connectivity(_DistanceBarrier):
    """No segment is longer than its rest length.

        h_con,i = (D^2 - |x_i - x_{i-1}|^2) / 2,    i = 1 ... n

    The first row holds the thread to the needle, x_0. Unit of h: that of the positions, squared.

    Source: [Forghani2025], connectivity functions h_con,i and h_con,1. Deviation: none.

    Attributes:
        segment_length: D, in the unit of the positions.
    """

    name = CONNECTIVITY
    segment_length: float

    def rows(self, positions: Points) -> BarrierRows:
        """Return the n rows at positions of shape (n + 1, d)."""
        return self._rows(positions, self.segment_length)


@dataclass(frozen=True)
class EnhancedConnectivity(_DistanceBarrier):
    """No two nodes with one between them are farther apart than two rest lengths.

        h_enh,i = ((2 D)^2 - |x_i - x_{i-2}|^2) / 2,    i = 2 ... n

    The first row links the thread's second node to the needle, x_0. Unit of h: that of the positions,
    squared.

    Source: [Forghani2025], enhanced connectivity functions. Deviation: printed with the same Delta as the
    connectivity; taken at its word that would fold the thread, so it is read as 2 Delta. The paper counts
    its constraints as 3 n - 2 and as 3 n - 1; here are n - 1 of this kind.

    Attributes:
        segment_length: D, in the unit of the positions.
    """

    name, apart = ENHANCED_CONNECTIVITY, 2
    segment_length: float

    def rows(self, positions: Points) -> BarrierRows:
        """Return the n - 1 rows at positions of shape (n + 1, d)."""
        return self._rows(positions, 2.0 * self.segment_length)


@dataclass(frozen=True)
class Compression(_DistanceBarrier):
    """No segment is shorter than its rest length.

        h_cmp,i = (|x_i - x_{i-1}|^2 - D_i^2) / 2,    i = 1 ... n

    Together with the connectivity it makes the thread inextensible. Unit of h: that of the positions,
    squared.

    Source: none. Deviation: the paper leaves it out, so that nodes may coincide in a loop; without it
    the thread bunches up where it is pushed.

    Attributes:
        segment_length: D_i, of all segments or of each, shape (n,), in the unit of the positions.
    """

    name, sign = COMPRESSION, -1.0
    segment_length: float | Vector

    def rows(self, positions: Points) -> BarrierRows:
        """Return the n rows at positions of shape (n + 1, d)."""
        return self._rows(positions, self.segment_length)


@compiled_uncounted
def link_margins(rod: RodProperties, points: Points, heading: Points, work: Points, rows: Table) -> None:
    """Write value and clearance of connectivity and of compression, the chords that the segments keep, and the strain.

    Args:
        rod: the thread.
        points: nodes, shape (n + 1, d) [m].
        heading: unit vector along the needle, shape (d,).
        work: memory, shape (n + 1, d).
        rows: written, shape (6, n) [m^2], [m], [m^2], [m], [m], [1].
    """
    for i in range(len(points)):
        for a in range(points.shape[1]):
            work[i, a] = points[i, a] / rod.unit
    chord_lengths(work, heading, rod.clamped, rows[4])
    for i in range(len(points) - 1):
        chord = rows[4, i] * rod.unit
        stretched, length = distance_row(points, i, i + 1, rod.unit)
        pressed, _ = distance_row(points, i, i + 1, chord)
        rows[0, i], rows[1, i] = stretched, rod.unit - length
        rows[2, i], rows[3, i], rows[4, i] = -pressed, length - chord, chord
        rows[5, i] = rows[3, i] / chord


@dataclass(frozen=True)
class _ContactBarrier(RowBarrier):
    """A barrier of the nodes' signed distance from something solid.

    Attributes:
        workspace: obstacles and wall, in the unit of the positions.
        distance: rho, least distance of a node from a surface; the thread's radius.
    """

    workspace: Workspace
    distance: float

    def rows(self, positions: Points) -> BarrierRows:
        """Return a row for each near pair, node by node, at positions of shape (n + 1, d)."""
        contacts = self.workspace.near(positions)
        chosen = np.flatnonzero(contacts.nearest & ((contacts.obstacle == DISH_WALL) == (self.name == WALL)))
        signed, normal = contacts.distance[chosen], contacts.normal[chosen]
        node, obstacle = contacts.node[chosen][:, None], contacts.obstacle[chosen]
        value = signed - self.distance
        return BarrierRows(self.name, node, obstacle, value, normal[:, None, :], value)


class SolidRows(NamedTuple):
    """Rows of obstacles, then of the wall, that are written by `solid_rows`.

    Attributes:
        node: index of the node, shape (k,).
        obstacle: index of the obstacle, `DISH_WALL` for the wall, shape (k,).
        value: h of the node, shape (k,) [m].
        clearance: the same of the node and the half segments beside it, shape (k,) [m].
        normal: derivative of h by the node's position, shape (k, d).
    """

    node: NDArray[np.uint32]
    obstacle: NDArray[np.int32]
    value: Vector
    clearance: Vector
    normal: Points

    @classmethod
    def room(cls, count: int, dimension: int) -> SolidRows:
        """Return arrays for a number of rows."""
        indices, (value, clearance) = (np.empty(count, np.uint32), np.empty(count, np.int32)), np.empty((2, count))
        return cls(*indices, value, clearance, np.empty((count, dimension)))


@compiled_uncounted
def solid_rows(
    points: Points, around: WorkspaceData, radius: float, nearby: Indices, rows: SolidRows
) -> tuple[int, int]:
    """Write the row of each node and each obstacle within reach, then of each node and the wall.

    Args:
        points: nodes, shape (n + 1, d) [m].
        around: obstacles and wall.
        radius: of the thread [m].
        nearby: block of each shape that was near each node, as a guess; written, shape (n + 1, o).
        rows: written; with room for a row of each node and each obstacle, and of each node and the wall.

    Returns:
        The number of rows, and of those of obstacles.
    """
    discs, boxes, reach, count, obstacles = len(around.discs), around.boxes, around.reach, 0, 0
    for kind in range(2):
        for i in range(len(points)):
            x, y, z = points[i, 0], points[i, 1], points[i, 2] if points.shape[1] == 3 else 0.0
            for o in range(len(around.order) if kind == 0 else 1):
                s, obstacle, nz = around.order[o] if kind == 0 else 0, o if kind == 0 else DISH_WALL, 0.0
                if kind == 1:
                    distance, nx, ny = wall_contact(x, y, around.wall_radius)
                elif s < discs:
                    nx, ny, nz = x - around.discs[s, 0], y - around.discs[s, 1], z - around.discs[s, 3]
                    away = math.sqrt(nx * nx + ny * ny + nz * nz)
                    distance = away - around.discs[s, 2]
                    nx, ny, nz = (nx / away, ny / away, nz / away) if away > 0.0 else (1.0, 0.0, 0.0)
                elif (
                    boxes[s - discs, 0] - reach <= x <= boxes[s - discs, 2] + reach
                    and boxes[s - discs, 1] - reach <= y <= boxes[s - discs, 3] + reach
                ):
                    nearest = nearest_edge(x, y, s - discs, nearby[i, o], around)
                    distance, nx, ny, nearby[i, o] = nearest.signed, nearest.x, nearest.y, nearest.block
                else:
                    continue
                if not (distance <= reach):
                    continue
                least = half_segment_distance(points, i, obstacle, distance, around)
                rows.node[count], rows.obstacle[count] = i, obstacle
                rows.value[count], rows.clearance[count] = distance - radius, least - radius
                rows.normal[count, 0], rows.normal[count, 1] = nx, ny
                if points.shape[1] == 3:
                    rows.normal[count, 2] = nz
                count += 1
        if kind == 0:
            obstacles = count
    return count, obstacles


@dataclass(frozen=True)
class ObstacleAvoidance(_ContactBarrier):
    """Every node, the needle's tail among them, keeps its distance from every obstacle that is near.

        h_obs,i,O = sd_O(x_i) - rho,    i = 0 ... n,  O = 1 ... M

    with the signed distance sd_O, negative inside. Unit of h: that of the positions. A pair of node and
    obstacle that is farther apart than the workspace' reach has no row.

    Source: [Forghani2025], obstacle avoidance functions h_obs,i,O and h_obs,needle,O. Deviation: the paper
    has (|x_i - p_O|^2 - rho^2) / 2 with the closest point p_O, see `squared_barrier`. Outside of
    the obstacle both have the same safe set; but the paper's gradient vanishes on the surface and points
    inwards below it, so that a node which once got inside is kept there. The signed distance has a unit
    gradient everywhere.
    """

    name = OBSTACLE


def squared_barrier(signed: float, distance: float) -> float:
    """Return the obstacle function in the paper's form; its slope by sd is |sd|.

        h_obs,i,O = (sd |sd| - rho^2) / 2,    sd = sd_O(x_i)

    Source: [Forghani2025], obstacle avoidance functions h_obs,i,O and h_obs,needle,O. Deviation: |x - p|^2
    is signed, negative inside, so that the gradient |sd| n points out of the obstacle on both sides. It
    vanishes on the surface: the formulation `paper` takes `ObstacleAvoidance` for nodes that are too near.

    Args:
        signed: sd.
        distance: rho, in the same unit.
    """
    return 0.5 * (signed * abs(signed) - distance * distance)


@dataclass(frozen=True)
class WallAvoidance(_ContactBarrier):
    """Every node, the needle's tail among them, keeps its distance from the wall of the dish.

        h_wall,i = R - rho - |x_i|,    i = 0 ... n

    about the origin; in space |x_i| is the distance from the axis z. Unit of h: that of the positions. A node
    farther from the wall than the workspace' reach has no row.

    Its safe set is a disc, so convex, and h is concave: the half plane  h(y) + grad h(y)' (x - y) >= 0  about any
    point y holds the whole disc, and what else it holds lies outside of the circle by  |x - y|^2 / (2 R)  at most.
    So no row ever forbids what the wall allows, but a step has to take care of what one row leaves.

    Source: none. Deviation: the paper has no wall; its dish is larger than its thread is long.
    """

    name = WALL


@compiled_uncounted
def move_inside(positions: Points, known: Mask, radius: float) -> None:
    """Move each free node that is outside of a circle about the origin onto it, radially.

    The nearest point of a convex set: no two nodes that are both moved, or inside, get farther apart by it.

    Args:
        positions: written, shape (n + 1, d).
        known: nodes that stay where they are, shape (n + 1,).
        radius: of the circle, in space of a cylinder along z; in the unit of the positions.
    """
    for i in range(len(positions)):
        away, x, y = wall_contact(positions[i, 0], positions[i, 1], radius)
        if away < 0.0 and not known[i]:
            positions[i, 0], positions[i, 1] = -radius * x, -radius * y


@dataclass(frozen=True)
class Stiffness(RowBarrier):
    """Nodes with one between them go back to their distance at rest.

        V_i = (|x_i - x_{i-2}|^2 - delta_i^2)^2 / 2,    i = 2 ... n

    The rows hold h = -V, which grows where V falls: dh/dt >= -gamma h is dV/dt <= -gamma V. So h is never
    above 0, and the least margin of this kind says how far the thread is from its rest shape. Unit of h:
    that of the positions, to the fourth.

    Source: [Forghani2025], stiffness functions V_i and V_1. Deviation: r(t) in V_1 is the needle's
    position x_0.

    Attributes:
        rest_distance: delta_i, shape (n - 1,), in the unit of the positions.
    """

    name = STIFFNESS
    rest_distance: Vector

    def rows(self, positions: Points) -> BarrierRows:
        """Return the n - 1 rows at positions of shape (n + 1, d)."""
        along, first = positions[2:] - positions[:-2], np.arange(len(positions) - 2)
        square = np.einsum("id,id->i", along, along)
        misfit = square - self.rest_distance**2
        slope = 2.0 * misfit[:, None] * along
        return BarrierRows(
            name=self.name,
            nodes=np.column_stack([first, first + 2]),
            obstacle=np.full(len(first), NO_OBSTACLE),
            value=-0.5 * misfit**2,
            gradient=np.stack([slope, -slope], axis=1),
            clearance=-np.abs(np.sqrt(square) - self.rest_distance),
        )


@compiled
def _crosses(points: Points, i: int, j: int) -> bool:
    """Return whether the segments from nodes i and j on cross; one that does not exist crosses nothing."""
    if i < 0 or j < 0 or i + 1 >= len(points) or j + 1 >= len(points) or abs(i - j) < 2:
        return False
    ax, ay = points[i + 1, 0] - points[i, 0], points[i + 1, 1] - points[i, 1]
    bx, by = points[j + 1, 0] - points[j, 0], points[j + 1, 1] - points[j, 1]
    cx, cy = points[j, 0] - points[i, 0], points[j, 1] - points[i, 1]
    first, second = ax * cy - ay * cx, ax * (cy + by) - ay * (cx + bx)
    third, fourth = by * cx - bx * cy, by * (cx - ax) - bx * (cy - ay)
    return bool(first * second < 0.0 and third * fourth < 0.0)


@compiled
def _passes(before: Points, after: Points, node: int, j: int) -> int:
    """Return how often a node passes through segment j while both move on straight lines: 0, 1 or 2 times.

    With e the segment and r the node from the segment's first node, it does so where e x r = 0, a quadratic equation
    in time, and 0 <= r . e <= e . e.
    """
    ex, ey = before[j + 1, 0] - before[j, 0], before[j + 1, 1] - before[j, 1]
    rx, ry = before[node, 0] - before[j, 0], before[node, 1] - before[j, 1]
    fx, fy = after[j + 1, 0] - after[j, 0] - ex, after[j + 1, 1] - after[j, 1] - ey
    gx, gy = after[node, 0] - after[j, 0] - rx, after[node, 1] - after[j, 1] - ry
    c, b, a = ex * ry - ey * rx, ex * gy - ey * gx + fx * ry - fy * rx, fx * gy - fy * gx
    square = b * b - 4.0 * a * c
    if square <= 0.0:
        return 0
    root = -0.5 * (b + math.copysign(math.sqrt(square), b))
    count = 0
    for time in (c / root if root != 0.0 else np.inf, root / a if a != 0.0 else np.inf):
        if 0.0 < time <= 1.0:
            hx, hy = ex + time * fx, ey + time * fy
            along = (rx + time * gx) * hx + (ry + time * gy) * hy
            count += 0.0 <= along <= hx * hx + hy * hy
    return count


@compiled
def find_self_contacts(
    before: Points,
    after: Points,
    diameter: float,
    segment: float,
    crossing: bool,
    nodes: Indices,
    gradient: Table,
    value: Vector,
) -> tuple[int, int]:
    """Write the rows of nodes near segments of the same thread, at the end of a straight motion.

    Of two segments that do not cross, the closest places are a node of one and a place s of the other: so a row is

        h = side |x_k - (1 - s) x_j - s x_{j+1}| - diameter

    where side is -1 if the node has passed through the segment during the motion, an odd number of times, and 1 if it
    is where it was or has gone around an end. Segments that cross already at the beginning may go on, until they do
    not.

    Args:
        before: of all nodes, shape (n + 1, 2) [m].
        after: the same at the end.
        diameter: of the thread [m].
        segment: its segments' length [m].
        crossing: whether segments that cross at the beginning have rows too, as what has passed.
        nodes: written: j, j + 1 and k of each row, shape (r, 3).
        gradient: written, derivative by the position of each, shape (r, 3, 2).
        value: written, h [m], shape (r,).

    Returns:
        The number of rows, -1 if there is no room; and how many nodes have passed through a segment on the way, those
        that came back included: they have no row with the side -1, but no thread moves so.
    """
    count, passed, last, farthest = 0, 0, len(after) - 1, 0.0
    for i in range(last + 1):
        farthest = max(farthest, math.hypot(after[i, 0] - before[i, 0], after[i, 1] - before[i, 1]))
    # What is farther from touching than half a segment has no row. Places of a thread that can touch have half a turn
    # of it on itself between them.
    reach, apart = diameter + 0.5 * segment, 0.5 * math.pi * diameter / segment
    for k in range(last + 1):
        j = -1
        while j < last - 1:
            j += 1
            distance = math.hypot(after[k, 0] - after[j, 0], after[k, 1] - after[j, 1])
            skipped = int((distance - reach - 2.0 * farthest) / segment) - 1
            if skipped > 0:  # nor are the nodes that are fewer segments away
                j += skipped - 1
                continue
            if not min(abs(k - j), abs(k - j - 1)) > apart or k == j or k == j + 1:
                continue
            ex, ey = after[j + 1, 0] - after[j, 0], after[j + 1, 1] - after[j, 1]
            rx, ry = after[k, 0] - after[j, 0], after[k, 1] - after[j, 1]
            size = math.sqrt(ex * ex + ey * ey)
            s = (rx * ex + ry * ey) / (size * size)
            passes = _passes(before, after, k, j)
            through = passes % 2 == 1
            crossed = _crosses(before, k, j) or _crosses(before, k - 1, j)
            if crossed:
                if not crossing:
                    continue
                through = True
            passed += passes > 0 or through
            if not through and not (0.0 <= s <= 1.0) and ((s > 1.0 and j < last - 1) or (s < 0.0 and k < j)):
                continue  # a corner: the next segment's, or the row of the other node
            s = min(max(s, 0.0), 1.0)
            px, py = rx - s * ex, ry - s * ey
            gap = math.sqrt(px * px + py * py)
            if not through and gap > reach:
                continue
            nx, ny = -ey / size, ex / size
            if through:
                side = -1.0 if nx * rx + ny * ry > 0.0 else 1.0
                nx, ny = side * nx, side * ny
                gap = -abs(nx * px + ny * py)
            elif gap > 1e-12:
                nx, ny = px / gap, py / gap
            if count == len(value):
                return -1, 0
            nodes[count, 0], nodes[count, 1], nodes[count, 2] = j, j + 1, k
            value[count] = gap - diameter
            for a in range(2):
                n = nx if a == 0 else ny
                gradient[count, 0, a], gradient[count, 1, a], gradient[count, 2, a] = -(1.0 - s) * n, -s * n, n
            count += 1
    return count, passed


class SelfContact(RowBarrier):
    """Segments of a thread keep its diameter apart, so that it does not pass through itself: h >= 0 in the plane.

    A `ThreadPredictor` takes it where the scene says so, see `Dish.crossing`; a user can pass it as a barrier.

    Args:
        thread: the thread.

    Raises:
        ConfigurationError: the thread has no diameter.
    """

    name = "self_contact"

    def __init__(self, thread: Thread) -> None:
        if not thread.diameter > 0.0:
            raise ConfigurationError("thread.diameter", thread.diameter, "above 0 m where the thread touches itself")
        self._diameter, self._segment = thread.diameter, thread.segment_length
        # There is room for 32 rows a node.
        count = 32 * (thread.segments + 1)
        self._buffers = np.zeros((count, 3), dtype=np.int64), np.zeros((count, 3, 2)), np.zeros(count)

    def rows(self, positions: Points) -> BarrierRows:
        """Return all rows at positions of shape (n + 1, 2) [m]; those of segments that cross are -diameter or less."""
        return self._rows(positions, positions, True)[0]

    def rows_after(self, before: Points, positions: Points) -> BarrierRows:
        """Return all rows at the end of a straight motion; see `find_self_contacts`."""
        return self._rows(before, positions, False)[0]

    def passed(self, before: Points, positions: Points) -> bool:
        """Return whether any segment passes through another, even there and back, between two shapes [m]."""
        return self._rows(before, positions, False)[1] > 0

    def crossings(self, positions: Points) -> list[tuple[int, int]]:
        """Return the segments that cross, each pair by their first nodes, the lower one first."""
        last = len(positions) - 1
        return [(i, j) for i in range(last) for j in range(i + 2, last) if _crosses(positions, i, j)]

    def _rows(self, before: Points, after: Points, crossing: bool) -> tuple[BarrierRows, int]:
        before, after = np.ascontiguousarray(before), np.ascontiguousarray(after)
        nodes, gradient, value = self._buffers
        count, passed = find_self_contacts(
            before, after, self._diameter, self._segment, crossing, nodes, gradient, value
        )
        if count < 0:
            words = f"more than {len(value)} places where the thread may touch itself"
            raise SolverError(self.name, words, math.inf, 0.0)
        values, free = value[:count].copy(), np.full(count, NO_OBSTACLE, dtype=np.intp)
        # h is a distance between places that move by the gradient's own norm or less, so it is the clearance too.
        rows = BarrierRows(self.name, nodes[:count].copy(), free, values, gradient[:count].copy(), values)
        return rows, passed
