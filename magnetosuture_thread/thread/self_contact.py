"""The barrier that keeps a thread from passing through itself, as in a film of liquid too thin to cross in."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.geometry.barrier import NO_OBSTACLE, BarrierRows, RowBarrier
from magnetosuture_thread.geometry.compiled import compiled
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.settings.errors import ConfigurationError, SolverError
from magnetosuture_thread.thread.material import Thread

REACH = 0.5  # segments; what is farther from touching than this has no row
TIGHTEST_TURN = 0.5 * math.pi  # diameters of arc between places of a thread that can touch: half a turn on itself


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
    nodes: NDArray[np.int64],
    gradient: NDArray[np.float64],
    value: NDArray[np.float64],
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
    reach, apart = diameter + REACH * segment, TIGHTEST_TURN * diameter / segment
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
