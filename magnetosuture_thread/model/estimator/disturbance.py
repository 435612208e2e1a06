"""Disturbances: where the thread moves in a way that no force of the model explains."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.geometry.polyline import Points

Vector = NDArray[np.float64]


@dataclass(frozen=True)
class Disturbance:
    """A force on the thread that the model does not know: a contact, a hand, a current.

    Attributes:
        arc_length: of the middle of the force, from the needle's tail [m].
        extent: length of the stretch of thread that it acts on [m].
        position: of the middle, shape (2,) [m].
        direction: unit vector of the force, shape (2,).
        force: [N]
        significance: of the innovations, in standard deviations.
        since: when it was first found [s].
    """

    arc_length: float
    extent: float
    position: Points
    direction: Points
    force: float
    significance: float
    since: float


def force_density(
    rate: Points, positions: Points, drag_across: float, drag_along: float, tension: float = 0.0
) -> Vector:
    """Return the normal force on each node that explains a velocity that the model does not predict [N].

        f_i = D zeta_perp n_i . r_i + T_i kappa_i,    T_i = T_n + sum_{j > i} D zeta_par t_j . r_j

    The force of what touches the thread is across it; along it the tension alone balances the drag.

    Args:
        rate: r, by how much faster each node moves than predicted, shape (n + 1, 2) [m/s].
        positions: shape (n + 1, 2) [m].
        drag_across: zeta_perp [Pa s].
        drag_along: zeta_par [Pa s].
        tension: T_n at the free end [N].
    """
    along = np.gradient(positions, axis=0)
    size = np.maximum(np.hypot(*along.T), 1e-12)
    tangent = along / size[:, None]
    normal = np.column_stack([-tangent[:, 1], tangent[:, 0]])
    unit = float(size.mean())
    pull = unit * drag_along * np.einsum("ij,ij->i", tangent, rate)
    tensions = tension - (np.cumsum(pull[::-1])[::-1] - pull)
    turn = np.zeros(len(positions))
    bend = positions[2:] - 2.0 * positions[1:-1] + positions[:-2]
    turn[1:-1] = np.einsum("ij,ij->i", bend, normal[1:-1]) / unit
    return np.asarray(unit * drag_across * np.einsum("ij,ij->i", normal, rate) - tensions * turn)
