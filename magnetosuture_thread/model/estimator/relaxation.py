"""Relaxation: what the rod's own bending makes of a displacement across it, in time linear in the number of nodes.

    (1 + a C' C) e' = e,    a = dt EI / (zeta D^4),    (C e)_i = e_{i-1} - 2 e_i + e_{i+1}

is an implicit step of a straight rod in a viscous liquid, without tension, from the displacement e. The node at the
needle is given; where the thread is clamped, so is its direction there.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.compiled import compiled

Vector = NDArray[np.float64]
Points = NDArray[np.float64]


@compiled
def relax(amount: float, clamped: bool, slope: Vector, displacement: Points) -> None:
    """Let displacements relax by bending.

    Args:
        amount: a.
        clamped: whether the direction at the needle is given.
        slope: that direction, by how much the first node is displaced farther than the needle, shape (k,).
        displacement: e, with that of the needle as its first row, which stays; written, shape (n + 1, k), n > 1.
    """
    nodes, columns = displacement.shape
    diagonal, first, second = np.ones(nodes), np.zeros(nodes), np.zeros(nodes)  # M[i, i], M[i + 1, i], M[i + 2, i]
    for i in range(1, nodes - 1):
        diagonal[i - 1] += amount
        diagonal[i] += 4.0 * amount
        diagonal[i + 1] += amount
        first[i - 1] -= 2.0 * amount
        first[i] -= 2.0 * amount
        second[i - 1] += amount
    if clamped:  # half a segment of curvature 2 (e_1 - e_0 - slope)
        diagonal[1] += 2.0 * amount
    for k in range(columns):
        given = displacement[0, k]
        displacement[1, k] -= first[0] * given
        displacement[2, k] -= second[0] * given
        if clamped:
            displacement[1, k] += 2.0 * amount * (given + slope[k])
    # L D L' of the nodes behind the needle.
    for i in range(1, nodes):
        if i + 1 < nodes:
            low = first[i] / diagonal[i]
            diagonal[i + 1] -= low * first[i]
            if i + 2 < nodes:
                far = second[i] / diagonal[i]
                first[i + 1] -= low * second[i]
                diagonal[i + 2] -= far * second[i]
                second[i] = far
            first[i] = low
    for k in range(columns):
        for i in range(1, nodes):
            if i > 1:
                displacement[i, k] -= first[i - 1] * displacement[i - 1, k]
            if i > 2:
                displacement[i, k] -= second[i - 2] * displacement[i - 2, k]
        for i in range(nodes - 1, 0, -1):
            displacement[i, k] /= diagonal[i]
            if i + 1 < nodes:
                displacement[i, k] -= first[i] * displacement[i + 1, k]
            if i + 2 < nodes:
                displacement[i, k] -= second[i] * displacement[i + 2, k]


@compiled
def significance(
    displacement: Points, normals: Points, variance: Vector, response: Points, deviations: Vector
) -> float:
    """Return how significant a displacement is in its worst window, against what needs no disturbance.

        z = |mean displacement| / (2 r + sum_j (g_j s_j)^2)^(1/2)

    Of a right model the displacement is a difference of two errors of the estimate, and neither is larger than that of
    the points alone, r; and g_j s_j are what errors of the needle's pose displace it by.

    Args:
        displacement: shape (n + 1, 2).
        normals: of the nodes, shape (n + 1, 2).
        variance: r of the mean of a window's points, inf where nothing is measured, shape (w,).
        response: g, displacement of each node across the thread by each error of the pose, shape (n + 1, p).
        deviations: s, standard deviation of each error of the pose, shape (p,).
    """
    windows, nodes, largest = len(variance), len(displacement), 0.0
    explained = np.empty(len(deviations))
    for w in range(windows):
        total, count = 0.0, 0
        explained[:] = 0.0
        for i in range(max(1, (w * nodes) // windows), nodes):
            at = min(i * windows // nodes, windows - 1)
            if at > w:
                break
            if at == w:
                total += normals[i, 0] * displacement[i, 0] + normals[i, 1] * displacement[i, 1]
                count += 1
                for j in range(len(deviations)):
                    explained[j] += response[i, j] * deviations[j]
        if count > 0 and np.isfinite(variance[w]):
            expected = 2.0 * variance[w]
            for j in range(len(deviations)):
                expected += (explained[j] / count) ** 2
            largest = max(largest, abs(total) / count / np.sqrt(expected))
    return largest
