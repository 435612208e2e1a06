"""What a correction makes of the thread's sensitivities to parameters, and what its residuals say of these.

With U_j the derivative of the predicted nodes by a parameter, M = Lambda + A' W A the matrix of a correction's program
with its constraints, d the correction and nu - A d what it leaves of the innovations,

    V_j = U_j - M^-1 A' W A U_j           derivative of the corrected nodes
    J_ij = (A' W A U_i)' V_j              information of the frame on the parameters, U' A' S^-1 A U
    s_j = (A U_j)' W (nu - A d)           its score, U' A' S^-1 nu

with S = A Lambda^-1 A' + W^-1 the covariance of the innovations. So S is never written: one factor of a banded
matrix, which the correction leaves, serves all parameters in time linear in n and in the points.

Source: B. Friedland, Treatment of bias in recursive filtering, 1969; matrix inversion lemma. Deviation: the nodes are
constrained, and M holds the constraints that were active.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.compiled import compiled
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.model.estimator.correction import MeasuredPoints
from magnetosuture_thread.model.solvers import banded

Vector = NDArray[np.float64]


@compiled
def _add_measurement(
    nodes: Points, i: int, t: float, direction: tuple[float, float], precision: float, force: Points
) -> float:
    """Add a w (a' x) of one row to the forces on the nodes; return a' x."""
    mx, my = direction
    value = (1.0 - t) * (mx * nodes[i, 0] + my * nodes[i, 1]) + t * (mx * nodes[i + 1, 0] + my * nodes[i + 1, 1])
    pull = precision * value
    force[i, 0] += (1.0 - t) * pull * mx
    force[i, 1] += (1.0 - t) * pull * my
    force[i + 1, 0] += t * pull * mx
    force[i + 1, 1] += t * pull * my
    return float(value)


@compiled
def correct_sensitivities(
    axes: tuple[int, ...],
    points: MeasuredPoints,
    weights: Vector,
    end: tuple[float, float],
    start: Points,
    moved: Points,
    known: NDArray[np.bool_],
    scale: float,
    band: NDArray[np.float64],
    sensitivities: NDArray[np.float64],
    corrected: NDArray[np.float64],
    information: NDArray[np.float64],
    score: Vector,
) -> tuple[float, float]:
    """Write V, J and s.

    Args:
        axes: (0, 1).
        points: of the correction.
        weights: robust ones.
        end: innovation along the thread of its free end and the variance of it, inf if it is not measured [D], [D^2].
        start: the predicted thread, shape (n + 1, 2) [D].
        moved: d, shape (n + 1, 2) [D].
        known: nodes that are no unknowns, shape (n + 1,).
        scale: by which the program is divided.
        band: factors of M over the scale, as `banded.factorise` leaves them.
        sensitivities: U, shape (p, n + 1, 2) [D].
        corrected: V, written, of the same shape.
        information: J, written, shape (p, p).
        score: s, written, shape (p,).

    Returns:
        nu' S^-1 nu, and the number of independent points.
    """
    count, nodes = len(sensitivities), len(start)
    force = np.zeros((count, nodes, 2))
    unused = np.zeros((nodes, 2))
    score[:] = 0.0
    square, independent = 0.0, 0.0
    for p in range(len(weights) + 1):
        if p < len(weights):
            i = min(int(points.place[p]), nodes - 2)
            t = points.place[p] - i
            ex, ey = start[i + 1, 0] - start[i, 0], start[i + 1, 1] - start[i, 1]
            size = np.hypot(ex, ey)
            direction = (-ey / size, ex / size)
            precision, innovation = weights[p] * points.share[p] / points.variance[p], points.innovation[p]
            independent += weights[p] * points.share[p]
        else:
            if not np.isfinite(end[1]):
                break
            i, t = nodes - 2, 1.0
            ex, ey = start[i + 1, 0] - start[i, 0], start[i + 1, 1] - start[i, 1]
            size = np.hypot(ex, ey)
            direction, precision, innovation = (ex / size, ey / size), 1.0 / end[1], end[0]
            independent += 1.0
        left = innovation - _add_measurement(moved, i, t, direction, precision, unused)
        square += precision * innovation * left
        for j in range(count):
            score[j] += precision * left * _add_measurement(sensitivities[j], i, t, direction, precision, force[j])
    solved = np.zeros(len(band))
    for j in range(count):
        solved[:] = 0.0
        for i in range(nodes):
            for a in range(2):
                if known[i]:
                    force[j, i, a] = 0.0
                solved[2 * i + a] = force[j, i, a] / scale
        banded.substitute(axes, band, solved)
        for i in range(nodes):
            for a in range(2):
                corrected[j, i, a] = sensitivities[j, i, a] - solved[2 * i + a]
    for j in range(count):
        for k in range(count):
            value = 0.0
            for i in range(nodes):
                value += force[j, i, 0] * corrected[k, i, 0] + force[j, i, 1] * corrected[k, i, 1]
            information[j, k] = value
    return square, independent
