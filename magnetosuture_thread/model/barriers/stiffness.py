"""Stiffness: a control Lyapunov function that falls as the thread goes back to its rest shape."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.barrier import NO_OBSTACLE, STIFFNESS, BarrierRows, CompiledBarrier
from magnetosuture_thread.compiled import compiled
from magnetosuture_thread.geometry.polyline import Points


@dataclass(frozen=True)
class Stiffness(CompiledBarrier):
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
    rest_distance: NDArray[np.float64]

    def rows(self, positions: Points) -> BarrierRows:
        """Return the n - 1 rows at positions of shape (n + 1, d)."""
        positions = np.ascontiguousarray(positions)
        count = len(positions) - 2
        value, gradient = np.empty(count), np.empty((count, 3, positions.shape[1]))
        stiffness_function(positions, self.rest_distance, value, gradient)
        first = np.arange(count)
        distance = np.linalg.norm(positions[2:] - positions[:-2], axis=1)
        return BarrierRows(
            name=self.name,
            nodes=np.column_stack([first, first + 2]),
            obstacle=np.full(count, NO_OBSTACLE),
            value=value,
            gradient=gradient[:, ::2],
            clearance=-np.abs(distance - self.rest_distance),
        )


@compiled
def stiffness_function(
    positions: Points, rest: NDArray[np.float64], value: NDArray[np.float64], gradient: NDArray[np.float64]
) -> None:
    """Write h_i = -V_i and its gradient at the nodes i ... i + 2.

    Args:
        positions: all nodes, shape (m, d).
        rest: delta_i, shape (m - 2,).
        value: written, shape (m - 2,).
        gradient: written, shape (m - 2, 3, d).
    """
    nodes, dimension = positions.shape
    for i in range(nodes - 2):
        square = 0.0
        for a in range(dimension):
            square += (positions[i + 2, a] - positions[i, a]) ** 2
        misfit = square - rest[i] ** 2
        value[i] = -0.5 * misfit * misfit
        for a in range(dimension):
            slope = -2.0 * misfit * (positions[i + 2, a] - positions[i, a])
            gradient[i, 0, a] = -slope
            gradient[i, 1, a] = 0.0
            gradient[i, 2, a] = slope
