"""Wall avoidance: every node of the thread, and the needle's tail, stays inside of the round dish."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.barrier import NO_OBSTACLE, WALL, BarrierRows, CompiledBarrier
from magnetosuture_thread.compiled import compiled
from magnetosuture_thread.geometry.obstacles import wall_contact
from magnetosuture_thread.geometry.polyline import Points


@dataclass(frozen=True)
class WallAvoidance(CompiledBarrier):
    """Every node, the needle's tail among them, keeps its distance from the wall of the dish.

        h_wall,i = R - rho - |x_i|,    i = 0 ... n

    about the origin; in space |x_i| is the distance from the axis z. Unit of h: that of the positions. A node
    farther from the wall than the reach has no row.

    Its safe set is a disc, so convex, and h is concave: the half plane  h(y) + grad h(y)' (x - y) >= 0  about any
    point y holds the whole disc, and what else it holds lies outside of the circle by  |x - y|^2 / (2 R)  at most.
    So no row ever forbids what the wall allows, but a step has to take care of what one row leaves.

    Source: none. Deviation: the paper has no wall; its dish is larger than its thread is long.

    Attributes:
        radius: R of the dish, in the unit of the positions; inf for none.
        distance: rho, least distance of a node from the wall; the thread's radius.
        reach: greatest distance at which a node has a row.
    """

    name = WALL
    radius: float
    distance: float
    reach: float

    def rows(self, positions: Points) -> BarrierRows:
        """Return a row for each near node, at positions of shape (n + 1, d)."""
        positions = np.ascontiguousarray(positions)
        count, dimension = positions.shape
        nodes, value, gradient = np.empty((count, 1), np.intp), np.empty(count), np.zeros((count, 1, dimension))
        found = _write(positions, self.radius, self.distance, self.reach, nodes, value, gradient)
        value = value[:found]
        return BarrierRows(self.name, nodes[:found], np.full(found, NO_OBSTACLE), value, gradient[:found], value)


@compiled
def _write(
    positions: Points,
    radius: float,
    distance: float,
    reach: float,
    nodes: NDArray[np.intp],
    value: NDArray[np.float64],
    gradient: NDArray[np.float64],
) -> int:
    """Write the rows of `WallAvoidance.rows`; return their number."""
    count = 0
    for i in range(len(positions)):
        away, x, y = wall_contact(positions[i, 0], positions[i, 1], radius)
        if away <= reach and away < np.inf:
            nodes[count, 0], value[count] = i, away - distance
            gradient[count, 0, 0], gradient[count, 0, 1] = x, y
            count += 1
    return count


@compiled
def moved_inside(positions: Points, known: NDArray[np.bool_], radius: float) -> float:
    """Move each free node that is outside of a circle about the origin onto it, radially; return the longest way.

    The nearest point of a convex set: no two nodes that are both moved, or inside, get farther apart by it.

    Args:
        positions: written, shape (n + 1, d).
        known: nodes that stay where they are, shape (n + 1,).
        radius: of the circle, in space of a cylinder along z; in the unit of the positions.
    """
    longest = 0.0
    for i in range(len(positions)):
        away, x, y = wall_contact(positions[i, 0], positions[i, 1], radius)
        if away < 0.0 and not known[i]:
            positions[i, 0], positions[i, 1] = -radius * x, -radius * y
            longest = max(longest, -away)
    return longest
