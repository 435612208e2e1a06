"""Obstacle avoidance: no node of the thread enters an obstacle."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from magnetosuture_thread.geometry.obstacles import Disc
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.model.barriers.rows import BarrierKind, BarrierRows


@dataclass(frozen=True)
class ObstacleAvoidance:
    """Every thread node keeps its distance from every obstacle.

        h_obs,i,O = sd_O(x_i) - rho,    i = 1 ... n,  O = 1 ... M

    with the signed distance sd_O, negative inside. Unit of h: that of the positions.

    Source: [Forghani2025], obstacle avoidance functions h_obs,i,O. Deviation: the paper has
    (|x_i - p_O|^2 - rho^2) / 2 with the closest point p_O. Outside of the obstacle both have the same
    safe set; but the paper's gradient vanishes on the surface and points inwards below it, so that a
    node which once got inside is kept there. The signed distance has a unit gradient everywhere.

    Attributes:
        obstacles: the obstacles, M of them.
        distance: rho, least distance of a node from a surface; the thread's radius.
    """

    obstacles: Sequence[Disc]
    distance: float

    def rows(self, positions: Points) -> BarrierRows:
        """Return the M n rows at positions of shape (n + 1, d), obstacle by obstacle."""
        nodes = np.arange(1, len(positions))
        values, outwards = [], []
        for obstacle in self.obstacles:
            signed, outward = obstacle.signed_distance(positions[1:])
            values.append(signed - self.distance)
            outwards.append(outward)
        value = np.concatenate(values) if values else np.empty(0)
        gradient = np.vstack(outwards) if outwards else np.empty((0, positions.shape[1]))
        return BarrierRows(
            kind=BarrierKind.OBSTACLE,
            nodes=np.tile(nodes, len(self.obstacles))[:, None],
            obstacle=np.repeat(np.arange(len(self.obstacles)), len(nodes)),
            value=value,
            gradient=gradient[:, None, :],
            clearance=value,
        )
