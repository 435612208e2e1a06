"""Friction of the thread on what it touches: Coulomb's law, smoothed, with the normal forces at the start of a step.

A contact that pushes with the force N at the start of a step adds, for its slip s = t . (x - x_start) along it,

    mu N (sqrt(s^2 + e^2) - e),    e = SLIP_SPEED dt

to what the step makes least: a force of mu N s / sqrt(s^2 + e^2) against the slip. What should stick creeps, at less
than SLIP_SPEED.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.compiled import compiled
from magnetosuture_thread.rig.mechanics.contact import Shapes, point_contacts, segment_contacts
from magnetosuture_thread.rig.mechanics.contact_grid import clear
from magnetosuture_thread.rig.mechanics.rod import Rod

SLIP_SPEED = 2e-6  # m/s


@compiled
def find_friction(
    q: NDArray[np.float64], rod: Rod, shapes: Shapes, rows: NDArray[np.float64], friction: NDArray[np.float64]
) -> None:
    """Write what rubs at the start of a step.

    Args:
        q: state at the start, shape (N,) [rad, m].
        rod: the thread.
        shapes: what can be touched, with its friction.
        rows: to work in, see `point_contacts`.
        friction: gets the index of the first unknown, place on the segment (0 at a node), t_x, t_y and mu N [N]; a last
            row without a force ends it.
    """
    count, most, limit = 0, friction.shape[0] - 1, shapes.friction * shapes.stiffness
    if limit > 0.0:
        for a in range(3, q.shape[0] - 1, 2):
            if clear(q[a], q[a + 1], rod.radius, shapes.grid, shapes.clearances):
                continue
            for row in range(point_contacts(q[a], q[a + 1], rod.radius, shapes, rows)):
                if count < most:
                    _write(friction[count], a, 0.0, rows[row], limit * rows[row, 0])
                    count += 1
        for a in range(1, q.shape[0] - 2, 2):
            x, y = 0.5 * (q[a] + q[a + 2]), 0.5 * (q[a + 1] + q[a + 3])
            size = math.sqrt((q[a + 2] - q[a]) ** 2 + (q[a + 3] - q[a + 1]) ** 2)
            if clear(x, y, rod.radius + 0.75 * size, shapes.grid, shapes.clearances):
                continue
            found = segment_contacts(q[a], q[a + 1], q[a + 2], q[a + 3], rod.segment, rod.radius, shapes, rows)
            for row in range(found):
                if count < most:
                    _write(friction[count], a, rows[row, 4], rows[row], limit * rows[row, 0])
                    count += 1
    friction[count, 4] = 0.0


@compiled
def _write(friction: NDArray[np.float64], a: int, place: float, row: NDArray[np.float64], limit: float) -> None:
    friction[0], friction[1], friction[2], friction[3], friction[4] = a, place, -row[2], row[1], limit


@compiled
def add_friction(
    q: NDArray[np.float64],
    start: NDArray[np.float64],
    slip: float,
    friction: NDArray[np.float64],
    gradient: NDArray[np.float64],
    band: NDArray[np.float64],
) -> float:
    """Add the friction of a step from `start` to q; `slip` is e [m]."""
    energy = 0.0
    for row in range(friction.shape[0]):
        limit = friction[row, 4]
        if limit == 0.0:
            break
        a, s, tx, ty = int(friction[row, 0]), friction[row, 1], friction[row, 2], friction[row, 3]
        w = ((1.0 - s) * tx, (1.0 - s) * ty, s * tx, s * ty)
        count = 2 if s == 0.0 else 4
        along = 0.0
        for r in range(count):
            along += w[r] * (q[a + r] - start[a + r])
        root = math.sqrt(along * along + slip * slip)
        energy += limit * (root - slip)
        force, second = limit * along / root, limit * slip * slip / root**3
        for r in range(count):
            gradient[a + r] += force * w[r]
            for c in range(r + 1):
                band[a + r, r - c] += second * w[r] * w[c]
    return energy
