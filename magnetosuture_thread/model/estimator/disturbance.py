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
    rate: Points, positions: Points, drag_across: float, drag_along: float, bending: float = 0.0
) -> Vector:
    """Return the normal force on each node that explains a velocity that the model does not predict [N].

        f_i = D zeta_perp n_i . r_i + (dt EI / D^3) n_i . (second differences of c(r))_i + T_i kappa_i
        T_i = -sum_{j > i} D zeta_par t_j . r_j,    c(r)_i = r_{i+1} - 2 r_i + r_{i-1}

    The force of what touches the thread is across it; along it the tension alone balances the drag.

    Args:
        rate: r, by how much faster each node moves than predicted, shape (n + 1, 2) [m/s].
        positions: shape (n + 1, 2) [m].
        drag_across: zeta_perp [Pa s].
        drag_along: zeta_par [Pa s].
        bending: dt EI, the stiffness times the interval over which r was averaged [N m^2 s].
    """
    along = np.gradient(positions, axis=0)
    size = np.maximum(np.hypot(*along.T), 1e-12)
    tangent = along / size[:, None]
    normal = np.column_stack([-tangent[:, 1], tangent[:, 0]])
    unit = float(size.mean())
    pull = unit * drag_along * np.einsum("ij,ij->i", tangent, rate)
    tensions = -(np.cumsum(pull[::-1])[::-1] - pull)
    turn = np.zeros(len(positions))
    bend = positions[2:] - 2.0 * positions[1:-1] + positions[:-2]
    turn[1:-1] = np.einsum("ij,ij->i", bend, normal[1:-1]) / unit
    curved = np.zeros_like(rate)
    curved[1:-1] = rate[2:] - 2.0 * rate[1:-1] + rate[:-2]
    bent = -2.0 * curved
    bent[1:] += curved[:-1]
    bent[:-1] += curved[1:]
    force = unit * drag_across * rate + bending / unit**3 * bent
    return np.asarray(np.einsum("ij,ij->i", normal, force) - tensions * turn)


def strongest(force: Vector, positions: Points, unit: float, significance: float, since: float) -> Disturbance:
    """Return the stretch of thread with the greatest force to one side.

    Args:
        force: on each node along its normal, shape (n + 1,) [N].
        positions: shape (n + 1, 2) [m].
        unit: D [m].
        significance: [standard deviations]
        since: [s]
    """
    # Stretches of one sign; the needle itself, node 0, carries what acts on it.
    signs = np.sign(force[1:])
    starts = np.concatenate([[0], np.flatnonzero(np.diff(signs)) + 1, [len(signs)]])
    sums = np.add.reduceat(force[1:], starts[:-1])
    k = int(np.abs(sums).argmax())
    nodes = np.arange(starts[k], starts[k + 1]) + 1
    share = force[nodes] / sums[k] if sums[k] != 0.0 else np.full(len(nodes), 1.0 / len(nodes))
    middle = float(share @ nodes)
    along = np.gradient(positions, axis=0)
    at = round(middle)
    tangent = along[at] / max(float(np.hypot(*along[at])), 1e-12)
    place = np.array([np.interp(middle, np.arange(len(positions)), positions[:, axis]) for axis in range(2)])
    side = 1.0 if sums[k] >= 0.0 else -1.0
    return Disturbance(
        arc_length=middle * unit,
        extent=len(nodes) * unit,
        position=place,
        direction=side * np.array([-tangent[1], tangent[0]]),
        force=abs(float(sums[k])),
        significance=significance,
        since=since,
    )
