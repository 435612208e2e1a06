"""Mechanics of an overdamped inextensible rod: its drag metric and its bending.

All in units of the segment length D, so that x is dimensionless and a velocity is in 1/s.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.geometry.polyline import Points


def drag_metric(positions: Points, anisotropy: float) -> NDArray[np.float64]:
    """Return the drag matrix Z_i of each node, relative to zeta_perp D.

        Z_i = 1/2 sum over the adjacent segments of  I - (1 - zeta_par / zeta_perp) t t'

    Args:
        positions: all nodes, shape (n + 1, d).
        anisotropy: zeta_par / zeta_perp, 1/2 for a slender thread.

    Returns:
        Symmetric positive definite blocks, shape (n + 1, d, d). The free end has one adjacent segment
        and so half of an inner node's drag.

    Source: resistive force theory. Deviation: the paper weighs all nodes alike, Z_i = I.
    """
    segments = np.diff(positions, axis=0)
    lengths = np.linalg.norm(segments, axis=1)
    # A segment without a length, a needle that leapt onto a node, has no direction: its drag is isotropic.
    tangents = segments / np.where(lengths > 0.0, lengths, 1.0)[:, None]
    identity = np.eye(positions.shape[1])
    cells = 0.5 * (identity - (1.0 - anisotropy) * tangents[:, :, None] * tangents[:, None, :])
    metric = np.zeros((len(positions), *identity.shape))
    metric[:-1] += cells
    metric[1:] += cells
    return metric


def bending_bands(segments: int, glued: bool) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return the bands of the bending Hessian K, so that E_bend = 1/2 x' K x + glue terms.

        E_bend / (EI / D) = 1/2 sum_{i=1}^{n-1} |x_{i+1} - 2 x_i + x_{i-1}|^2  (+ |x_1 - x_0 + heading|^2 if glued)

    Args:
        segments: n.
        glued: add the clamp of a glued thread on node 1.

    Returns:
        The diagonal of length n + 1 and the first and second off-diagonals; each entry multiplies
        the identity of dimension d.

    Source: discrete elastic rod with a straight rest shape. Deviation: the paper has the stiffness
    CLF V_i instead, which is of fourth order in the bending angle.
    """
    nodes = segments + 1
    second_difference = np.zeros((segments - 1, nodes))
    index = np.arange(segments - 1)
    second_difference[index, index] = 1.0
    second_difference[index, index + 1] = -2.0
    second_difference[index, index + 2] = 1.0
    hessian = second_difference.T @ second_difference
    if glued:
        hessian[:2, :2] += 2.0 * np.array([[1.0, -1.0], [-1.0, 1.0]])
    return np.diag(hessian).copy(), np.diag(hessian, 1).copy(), np.diag(hessian, 2).copy()


def bending_gradient(positions: Points, heading: Points | None) -> Points:
    """Return the derivative of E_bend / (EI / D) by every node's position, shape (n + 1, d).

    Args:
        positions: all nodes, shape (n + 1, d).
        heading: unit vector along the needle if the thread is glued to it, else None.
    """
    curvature = positions[2:] - 2.0 * positions[1:-1] + positions[:-2]
    gradient = np.zeros_like(positions)
    gradient[:-2] += curvature
    gradient[1:-1] -= 2.0 * curvature
    gradient[2:] += curvature
    if heading is not None:
        misfit = 2.0 * (positions[1] - positions[0] + heading)
        gradient[0] -= misfit
        gradient[1] += misfit
    return gradient
