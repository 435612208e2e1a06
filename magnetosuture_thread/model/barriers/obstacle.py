"""Obstacle avoidance: no node of the thread, and not the needle, enters an obstacle."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from magnetosuture_thread.compiled import compiled
from magnetosuture_thread.geometry.obstacles import WALL, Workspace
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.model.barriers.rows import BarrierKind, BarrierRows


@dataclass(frozen=True)
class ObstacleAvoidance:
    """Every node, the needle's tail among them, keeps its distance from every obstacle that is near.

        h_obs,i,O = sd_O(x_i) - rho,    i = 0 ... n,  O = 1 ... M

    with the signed distance sd_O, negative inside. Unit of h: that of the positions. A pair of node and
    obstacle that is farther apart than the workspace' reach has no row.

    Source: [Forghani2025], obstacle avoidance functions h_obs,i,O and h_obs,needle,O. Deviation: the paper
    has (|x_i - p_O|^2 - rho^2) / 2 with the closest point p_O, see `SquaredObstacleAvoidance`. Outside of
    the obstacle both have the same safe set; but the paper's gradient vanishes on the surface and points
    inwards below it, so that a node which once got inside is kept there. The signed distance has a unit
    gradient everywhere.

    Attributes:
        workspace: the obstacles, in the unit of the positions.
        distance: rho, least distance of a node from a surface; the thread's radius.
    """

    workspace: Workspace
    distance: float

    def rows(self, positions: Points) -> BarrierRows:
        """Return a row for each near pair, node by node, at positions of shape (n + 1, d)."""
        found = self.workspace.near(positions)
        chosen = found.nearest & (found.obstacle != WALL)
        value = found.distance[chosen] - self.distance
        return BarrierRows(
            kind=BarrierKind.OBSTACLE,
            nodes=found.node[chosen][:, None],
            obstacle=found.obstacle[chosen],
            value=value,
            gradient=found.outward[chosen][:, None, :],
            clearance=value,
        )


@dataclass(frozen=True)
class SquaredObstacleAvoidance:
    """The same margin in the paper's form.

        h_obs,i,O = (sd |sd| - rho^2) / 2,    sd = sd_O(x_i)

    Unit of h: that of the positions, squared.

    Source: [Forghani2025], obstacle avoidance functions h_obs,i,O and h_obs,needle,O. Deviation: |x - p|^2
    is signed, negative inside, so that the gradient |sd| n points out of the obstacle on both sides. It
    vanishes on the surface: the formulation `paper` takes `ObstacleAvoidance` for nodes that are too near.

    Attributes:
        workspace: the obstacles, in the unit of the positions.
        distance: rho, least distance of a node from a surface; the thread's radius.
    """

    workspace: Workspace
    distance: float

    def rows(self, positions: Points) -> BarrierRows:
        """Return a row for each near pair, node by node, at positions of shape (n + 1, d)."""
        found = self.workspace.near(positions)
        chosen = found.nearest & (found.obstacle != WALL)
        signed = found.distance[chosen]
        value, slope = np.empty(len(signed)), np.empty(len(signed))
        for k in range(len(signed)):
            value[k], slope[k] = squared_barrier(signed[k], self.distance)
        return BarrierRows(
            kind=BarrierKind.OBSTACLE,
            nodes=found.node[chosen][:, None],
            obstacle=found.obstacle[chosen],
            value=value,
            gradient=(slope[:, None] * found.outward[chosen])[:, None, :],
            clearance=signed - self.distance,
        )


@compiled
def squared_barrier(signed: float, distance: float) -> tuple[float, float]:
    """Return h = (sd |sd| - rho^2) / 2 and its slope by sd, |sd|."""
    return 0.5 * (signed * abs(signed) - distance * distance), abs(signed)
