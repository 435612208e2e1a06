"""Least squares of a few unknowns, at the rate of the coils' loop."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.compiled import compiled

Vector = NDArray[np.float64]


def solve_by_reflections(system: Vector, target: Vector) -> Vector:
    """Return the x of least |system x - target|, by Householder's reflections; not finite if the columns are dependent.

    Args:
        system: of independent columns, shape (k, m) with k >= m.
        target: shape (k,).

    Source: Golub and Van Loan, Matrix Computations, section 5.3. Deviation: none.
    """
    found = np.empty(system.shape[1])
    _solve(system.copy(), target.copy(), found)
    return found


@compiled
def _solve(system: Vector, target: Vector, found: Vector) -> None:
    """Write the solution; system and target are overwritten."""
    rows, columns = system.shape
    for j in range(columns):
        square = 0.0
        for i in range(j, rows):
            square += system[i, j] * system[i, j]
        size = math.copysign(math.sqrt(square), -system[j, j])
        # The reflection along w = column - size e_j takes the column to size e_j, and |w|^2 = -2 size w_j.
        system[j, j] -= size
        scale = size * system[j, j]
        for k in range(j + 1, columns + 1):
            along = 0.0
            for i in range(j, rows):
                along += system[i, j] * (system[i, k] if k < columns else target[i])
            along /= scale
            for i in range(j, rows):
                if k < columns:
                    system[i, k] += along * system[i, j]
                else:
                    target[i] += along * system[i, j]
        found[j] = size
    for j in range(columns - 1, -1, -1):
        total = target[j]
        for k in range(j + 1, columns):
            total -= system[j, k] * found[k]
        found[j] = total / found[j]
