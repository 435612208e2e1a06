"""Covariance of a chain's nodes: what is left of it after a correction, and what a step makes of it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.compiled import compiled
from magnetosuture_thread.geometry.polyline import Points

Vector = NDArray[np.float64]


@compiled
def selected_inverse(width: int, unknowns: int, band: NDArray[np.float64], inverse: NDArray[np.float64]) -> None:
    """Write the entries within the band of the inverse of L D L', in time linear in its size.

        Z = D^-1 L^-1 + (I - L') Z,    column by column from the last

    Args:
        width: half-width of the band.
        unknowns: size of the matrix.
        band: L D L' as `banded.factorise` leaves it.
        inverse: written: [j, k] is the entry of row j + k and column j, shape (unknowns + width, width + 1).

    Source: K. Takahashi, J. Fagan, M.-S. Chen 1973.
    """
    inverse[unknowns:] = 0.0
    for j in range(unknowns - 1, -1, -1):
        for a in range(width, -1, -1):
            value = band[j, 0] if a == 0 else 0.0
            for k in range(1, width + 1):
                low, high = (a, k) if a <= k else (k, a)
                # Z[j + a, j + k], which for a = 0 is in the column being written.
                value -= band[j, k] * (inverse[j, k] if a == 0 else inverse[j + low, high - low])
            inverse[j, a] = value


@compiled
def propagate(positions: Points, before: Points, added: Vector, variance: Vector, work: Vector) -> None:
    """Propagate variances of errors across the thread over a step: they stay where they are, and grow.

    The thread slides along itself when it is pulled: a node comes to where another part of the thread was, and has
    that part's error. Behind the needle, whose place is known, comes thread without error.

    Args:
        positions: after the step, shape (n + 1, 2) [D].
        before: before it [D].
        added: noise over the step, shape (n + 1,) [D^2].
        variance: of each node, shape (n + 1,) [D^2]; written.
        work: written, shape (n + 1,).
    """
    last = len(positions) - 1
    work[:] = variance
    for i in range(last + 1):
        a, b = max(i - 1, 0), min(i + 1, last)
        tx, ty = before[a, 0] - before[b, 0], before[a, 1] - before[b, 1]  # towards the needle
        size = np.hypot(tx, ty)
        slid = 0.0
        if size > 0.0:
            slid = ((positions[i, 0] - before[i, 0]) * tx + (positions[i, 1] - before[i, 1]) * ty) / size
        at = min(max(i - slid, 0.0), float(last))
        low = min(int(at), last - 1)
        part = at - low
        variance[i] = (1.0 - part) * work[low] + part * work[low + 1] + added[i]
