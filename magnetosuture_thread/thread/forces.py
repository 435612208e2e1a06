"""The forces of a step: what its multipliers and the rod's energies say in newtons."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from magnetosuture_thread.geometry.compiled import compiled, compiled_within
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.thread import mechanics
from magnetosuture_thread.thread.margins import FrictionState
from magnetosuture_thread.thread.mechanics import RodProperties
from magnetosuture_thread.thread.program import (
    BEFORE,
    CONTACT,
    END,
    END_VELOCITIES,
    INTERNAL,
    SPAN,
    START,
    VELOCITIES,
    RodBuffers,
    Table,
    Vector,
)


@dataclass(frozen=True, eq=False)
class ThreadForces:
    """The forces in a thread and on it, at the end of a step.

    A row's multiplier is the force that keeps its barrier. With the program in units of the segment's length D, and of
    the metric's scale Z = zeta_perp + mu / dt, and f_j what the thread's own segments push node j with, by tension and
    bending (`keep_internal_forces`),

        T_i = Z D^2 t_i' sum_{j<i} f_j,    N_i = Z D^2 sum_c lambda_c n_c

    over the contacts c of node i, those of friction included. The thread pulls the needle with what its first segment
    does, and with the loads on half of that,

        F = Z D^2 f_0 + N_0 + (D / 2) (mu (g - dv / dt) - zeta_perp v + (zeta_perp - zeta_par) t_1 t_1' v)

    with the tail's velocity v, in the drag against the medium, and turns it, if clamped, by
    M = -dE_bend / d(heading angle).

    Attributes:
        tension: T_i of each segment, positive where it is pulled, shape (n,) [N]: what the one half of the thread pulls
            at the other with, along the segment.
        contact: N_i, the force of shapes and wall upon each node, shape (n + 1, d) [N].
        needle_force: F, of the thread upon the needle, at its tail, shape (d,) [N].
        needle_moment: M about the tail, counter-clockwise, 0 of a pinned thread; in the plane only, else NaN [N m].
        friction: the part of N_i along the shapes, shape (n + 1,) [N].
        friction_use: the same over its limit mu N of the shape where it is nearest to it: 1 where the node slides, 0
            where it has no friction, shape (n + 1,).

    Source: Lagrange's multipliers; the paper works no force out. Deviation: none but that friction on the first segment
    is not in F.
    """

    tension: Vector
    contact: Points
    needle_force: Vector
    needle_moment: float
    friction: Vector
    friction_use: Vector

    @property
    def friction_states(self) -> tuple[FrictionState, ...]:
        """Of each node: free of friction, stuck, or sliding."""
        # A node slides where its friction is within 1e-6 of its limit.
        slides, sticks = self.friction_use >= 1.0 - 1e-6, self.friction_use > 0.0
        return tuple(
            FrictionState.SLIDING if slide else FrictionState.STUCK if stick else FrictionState.FREE
            for slide, stick in zip(slides.tolist(), sticks.tolist(), strict=True)
        )

    @property
    def peak_tension(self) -> float:
        """The greatest tension of all segments [N]."""
        return float(np.max(self.tension))


@compiled_within
def keep_internal_forces(buffers: RodBuffers, rows: int, interval: float) -> None:
    """Keep what the segments push each node with, and what medium and contacts do at the needle's tail.

    A solution balances at each free node what the segments, the medium and contacts do. What the segments do is P u + q
    without the medium's part, and the multipliers of the segments' rows:

        f_i = lambda_i g_i(y) - (P - R) u - (q - r),    R u + r = the medium's part

    So the forces of all nodes add up to nothing, and are in balance with the loads. Multipliers and bending taken at
    the step's end, in place of y, are not: short segments are so stiff in bending that tenths of a micrometre count.

    Args:
        buffers: of the program that was solved, with its solution; written.
        rows: of the program.
        interval: dt [s].
    """
    program, motion, velocities = buffers.program, buffers.motion, buffers.motion[VELOCITIES]
    nodes, dimension = velocities.shape
    internal, contact, load = buffers.end[INTERNAL], buffers.end[CONTACT], buffers.tail_load
    multipliers = program.multipliers
    blocks, couplings, contacts = program.blocks, program.couplings, program.contacts
    for i in range(nodes):
        for a in range(dimension):
            value = program.linear[i, a] - buffers.drag_linear[i, a]
            for b in range(dimension):
                value += (blocks[i, a, b] - buffers.drag[i, a, b]) * velocities[i, b]
            for apart in range(1, min(SPAN, nodes - 1 - i) + 1):
                value += couplings[apart - 1, i] * velocities[i + apart, a]
            for apart in range(1, min(SPAN, i) + 1):
                value += couplings[apart - 1, i - apart] * velocities[i - apart, a]
            internal[i, a] = -value
    for row in range(nodes - 1):
        for k in range(SPAN):
            for a in range(dimension):
                internal[program.first[row] + k, a] += multipliers[row] * program.gradient[row, k, a]
    for a in range(dimension):
        load[a] = contact[0, a] - buffers.drag_linear[0, a]
        for b in range(dimension):
            load[a] -= buffers.drag[0, a, b] * (motion[START, 0, b] - motion[BEFORE, 0, b]) / interval
    # A row of a contact has no gradient at a node that is known, whose share is with the needle.
    for row in range(nodes - 1, rows):
        c = row - nodes + 1
        if program.known[0] and contacts.node[c] == 0 and program.limit[row] == np.inf:
            for a in range(dimension):
                load[a] += (1.0 - contacts.place[c]) * contacts.normal[c, a] * multipliers[row]


@compiled
def write_forces(
    rod: RodProperties, end: Table, tail_load: Vector, interval: float, heading: Points, tension: Vector, force: Vector
) -> tuple[float, float]:
    """Write the tension of each segment [N] and the force upon the needle [N]; return the moment about its tail [N m].

    Args:
        rod: its properties.
        end: of the step, see `RodBuffers`.
        tail_load: what medium and contacts push node 0 with, shape (d,).
        interval: duration of the step [s].
        heading: unit vector along the needle, shape (d,).
        tension: written, shape (n,).
        force: written, shape (d,).

    Returns:
        The moment, counter-clockwise; 0 of a pinned thread, NaN in space, where it is no single number; and the force
        of a unit of the loads [N].
    """
    positions, internal = end[END], end[INTERNAL]
    nodes, dimension = positions.shape
    scale = (rod.drag_across + rod.mass_per_length / interval) * rod.unit**2
    tangent, passed = np.zeros(dimension), np.zeros(dimension)
    for a in range(dimension):
        force[a] = scale * (internal[0, a] + tail_load[a])
    for i in range(nodes - 1):
        chord = 0.0
        for a in range(dimension):
            tangent[a] = positions[i + 1, a] - positions[i, a]
            chord += tangent[a] ** 2
        chord = np.sqrt(chord)
        tension[i] = 0.0
        for a in range(dimension):
            tangent[a] /= chord
            passed[a] += internal[i, a]  # what the thread behind pulls at that before
            tension[i] += scale * passed[a] * tangent[a]
    # The end correction takes some of the load on the last segment from the node behind its middle.
    along = 0.0
    for a in range(dimension):
        slip = end[END_VELOCITIES, nodes - 1, a] - rod.flow[a]
        along += tangent[a] * (rod.mass_per_length * rod.gravity[a] - rod.drag_along * slip)
    tension[nodes - 2] += mechanics.END_CORRECTION * rod.unit * along
    if not rod.clamped:
        return 0.0, scale
    if dimension != 2:
        return np.nan, scale
    work, points = np.zeros((3, nodes, dimension)), np.empty((nodes, dimension))
    for i in range(nodes):
        for a in range(dimension):
            points[i, a] = positions[i, a] / rod.unit
    mechanics.bending_gradient(points, heading, rod.clamped, rod.rest_angles, work, work[2])
    bending = rod.bending_stiffness / rod.unit
    return -2.0 * bending * (work[1, 0, 1] * heading[0] - work[1, 0, 0] * heading[1]), scale


def friction_of(grip: Table) -> tuple[Vector, Vector]:
    """Return friction on each node, that of chords shared by their nodes, and the greatest ratio to its limit.

    Args:
        grip: as in `GripBuffers`.
    """
    rubbed, limit, place = np.abs(grip[..., 2]), grip[..., 3], grip[..., 4]
    ratio = np.divide(rubbed, limit, out=np.zeros_like(limit), where=limit > 0.0).max(axis=2)
    first, second = ((1.0 - place) * rubbed).sum(axis=2), (place * rubbed).sum(axis=2)
    friction, use = first[0] + first[1], np.maximum(ratio[0], ratio[1])
    friction[1:] += second[1, :-1]
    use[1:] = np.maximum(use[1:], ratio[1, :-1])
    return friction, use
