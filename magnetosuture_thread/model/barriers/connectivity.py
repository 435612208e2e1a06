"""Connectivity, enhanced connectivity and compression: two nodes are neither too far apart nor too near."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.barrier import (
    COMPRESSION,
    CONNECTIVITY,
    ENHANCED_CONNECTIVITY,
    NO_OBSTACLE,
    BarrierRows,
    CompiledBarrier,
)
from magnetosuture_thread.compiled import compiled
from magnetosuture_thread.geometry.polyline import Points


@dataclass(frozen=True)
class Connectivity(CompiledBarrier):
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
        return _rows(positions, 1, self.segment_length, self.name, 1.0)


@dataclass(frozen=True)
class EnhancedConnectivity(CompiledBarrier):
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

    name = ENHANCED_CONNECTIVITY
    segment_length: float

    def rows(self, positions: Points) -> BarrierRows:
        """Return the n - 1 rows at positions of shape (n + 1, d)."""
        return _rows(positions, 2, 2.0 * self.segment_length, self.name, 1.0)


@dataclass(frozen=True)
class Compression(CompiledBarrier):
    """No segment is shorter than its rest length.

        h_cmp,i = (|x_i - x_{i-1}|^2 - D_i^2) / 2,    i = 1 ... n

    Together with the connectivity it makes the thread inextensible. Unit of h: that of the positions,
    squared.

    Source: none. Deviation: the paper leaves it out, so that nodes may coincide in a loop; without it
    the thread bunches up where it is pushed.

    Attributes:
        segment_length: D_i, of all segments or of each, shape (n,), in the unit of the positions.
    """

    name = COMPRESSION
    segment_length: float | NDArray[np.float64]

    def rows(self, positions: Points) -> BarrierRows:
        """Return the n rows at positions of shape (n + 1, d)."""
        return _rows(positions, 1, self.segment_length, self.name, -1.0)


@compiled
def distance_barrier(
    positions: Points,
    apart: int,
    longest: NDArray[np.float64],
    value: NDArray[np.float64],
    gradient: NDArray[np.float64],
) -> None:
    """Write h_i = (longest_i^2 - |x_{i + apart} - x_i|^2) / 2 and its gradient at the nodes i ... i + 2.

    Args:
        positions: all nodes, shape (m, d).
        apart: 1 or 2.
        longest: greatest distance, shape (m - apart,).
        value: written, shape (m - apart,).
        gradient: written, at the three nodes from min(i, m - 3) on, shape (m - apart, 3, d).
    """
    nodes, dimension = positions.shape
    for i in range(nodes - apart):
        shift = i - min(i, nodes - 3)
        square = 0.0
        for a in range(dimension):
            gradient[i, 0, a] = gradient[i, 1, a] = gradient[i, 2, a] = 0.0
            difference = positions[i + apart, a] - positions[i, a]
            gradient[i, shift, a] = difference
            gradient[i, shift + apart, a] = -difference
            square += difference * difference
        value[i] = 0.5 * (longest[i] ** 2 - square)


@compiled
def _write(
    positions: Points,
    apart: int,
    longest: NDArray[np.float64],
    sign: float,
    nodes: NDArray[np.intp],
    value: NDArray[np.float64],
    gradient: NDArray[np.float64],
    clearance: NDArray[np.float64],
) -> None:
    """Write the rows of `_rows`, with their gradient at the two nodes that they touch."""
    count, dimension = len(positions) - apart, positions.shape[1]
    spread = np.empty((count, 3, dimension))
    distance_barrier(positions, apart, longest, value, spread)
    for i in range(count):
        nodes[i, 0], nodes[i, 1] = i, i + apart
        shift, square = i - min(i, len(positions) - 3), 0.0
        for a in range(dimension):
            gradient[i, 0, a] = sign * spread[i, shift, a]
            gradient[i, 1, a] = sign * spread[i, shift + apart, a]
            square += spread[i, shift, a] * spread[i, shift, a]
        value[i] *= sign
        clearance[i] = sign * (longest[i] - np.sqrt(square))


def _rows(positions: Points, apart: int, longest: float | NDArray[np.float64], name: str, sign: float) -> BarrierRows:
    positions = np.ascontiguousarray(positions)
    count, dimension = len(positions) - apart, positions.shape[1]
    bound, nodes = np.empty(count), np.empty((count, 2), dtype=np.intp)
    value, gradient, clearance = np.empty(count), np.empty((count, 2, dimension)), np.empty(count)
    bound[:] = longest
    _write(positions, apart, bound, sign, nodes, value, gradient, clearance)
    return BarrierRows(name, nodes, np.full(count, NO_OBSTACLE), value, gradient, clearance)
