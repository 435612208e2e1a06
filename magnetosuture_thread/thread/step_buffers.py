"""Memory of a step of the thread, shared by all formulations: the step under way, its program, contacts and forces."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from magnetosuture_thread.compiled import compiled, compiled_inline
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.thread.program import SPAN, ChainProgram, Indices, Mask, Table, Vector, no_far_rows

CONTACTS_PER_NODE = 64  # for which there is room; a smooth outline has dozens of corners beside one segment
GRIPS = 3  # shapes at most that a node or a chord has friction with at once
NO_SHAPE = -2  # in place of a shape


class ContactBuffers(NamedTuple):
    """Where contacts are written, as by `find_contacts`.

    Attributes:
        node: shape (c,).
        obstacle: shape (c,).
        distance: shape (c,) [m].
        normal: shape (c, d).
        nearest: shape (c,).
        place: of a contact on the segment from its node on, 0 at the node itself, shape (c,).
    """

    node: Indices
    obstacle: Indices
    distance: Vector
    normal: Points
    nearest: Mask
    place: Vector

    @classmethod
    def of(cls, nodes: int, dimension: int, shapes: int = 0) -> ContactBuffers:
        """Return room for the contacts of a thread; more for one whose nodes may be near many shapes at once."""
        count = (CONTACTS_PER_NODE + 2 * shapes) * nodes
        node, obstacle = np.zeros((2, count), np.int64)
        return cls(
            node, obstacle, np.zeros(count), np.zeros((count, dimension)), np.zeros(count, np.bool_), np.zeros(count)
        )


class StepBuffers(NamedTuple):
    """Memory for the steps of a thread with n + 1 nodes, kept from step to step so that no step pays for it.

    Lengths are in units of the segment length, and forces in those of the program.

    Attributes:
        before: where the nodes are, shape (n + 1, d).
        start: the same with the prescribed nodes moved.
        last: velocities over the last step.
        velocities: those of this step, better with each solve.
        about: where they lead.
        last_about: where the program was written about.
        trial: velocities of a solve, shape (n + 1, d).
        trial_multipliers: of the same, shape (r,).
        known: the prescribed nodes, shape (n + 1,).
        blocks: see `ChainProgram`, as are the following.
        couplings: shape (3, n + 1).
        linear: shape (n + 1, d).
        first: rows: those of the formulation, then those of contacts and friction, shape (r,).
        gradient: shape (r, 3, d).
        lower: shape (r,).
        upper: shape (r,).
        compliance: shape (r,).
        limit: shape (r,).
        far_nodes: none.
        far_gradient: none.
        value: h of each row, shape (r,).
        multipliers: of the last solve: a guess for the next one, and the segments' tension, shape (r,).
        chords: length of each segment, shape (n,).
        work: shape (2, n + 1, d).
        contacts: those with rows, then those of friction.
        clearance: distance of each node from the nearest of all that is solid, at most the reach, shape (n + 1,) [m].
        push: what contacts last pushed each node and each segment with, shape (2, n + 1).
        grip_shape: the shapes with friction that last pushed each node, and each chord between its nodes, `NO_SHAPE`
            for none, shape (2, n + 1, GRIPS).
        grip: of these, the force (2), the multiplier of friction, its limit, and the place on the chord, shape
            (2, n + 1, GRIPS, 5).
        grip_contact: of these, the contact that is now in its place, -1 for none, shape (2, n + 1, GRIPS).
        drag: the medium's part of `blocks`.
        drag_linear: the medium's part of `linear`.
        internal: what the segments push each node with, shape (n + 1, d).
        contact_force: what contacts push each node with, with friction, shape (n + 1, d).
        tail_load: what medium and contacts do at the needle's tail, shape (d,).
    """

    before: Points
    start: Points
    last: Points
    velocities: Points
    about: Points
    last_about: Points
    trial: Points
    trial_multipliers: Vector
    known: Mask
    blocks: Table
    couplings: Table
    linear: Points
    first: Indices
    gradient: Table
    lower: Vector
    upper: Vector
    compliance: Vector
    limit: Vector
    far_nodes: Indices
    far_gradient: Table
    value: Vector
    multipliers: Vector
    chords: Vector
    work: Table
    contacts: ContactBuffers
    clearance: Vector
    push: Table
    grip_shape: Indices
    grip: Table
    grip_contact: Indices
    drag: Table
    drag_linear: Points
    internal: Points
    contact_force: Points
    tail_load: Vector

    @classmethod
    def of(cls, nodes: int, dimension: int, rows: int) -> StepBuffers:
        """Return buffers for a number of rows besides those of contacts and friction."""
        total, square = rows + CONTACTS_PER_NODE * nodes, (nodes, dimension, dimension)
        before, start, last, velocities, about, last_about, trial = np.zeros((7, nodes, dimension))
        linear, drag_linear, internal, contact_force = np.zeros((4, nodes, dimension))
        lower, upper, compliance, value, multipliers, trial_multipliers = np.zeros((6, total))
        far_nodes, far_gradient = no_far_rows(dimension)
        return cls(
            before=before,
            start=start,
            last=last,
            velocities=velocities,
            about=about,
            last_about=last_about,
            trial=trial,
            trial_multipliers=trial_multipliers,
            known=np.zeros(nodes, np.bool_),
            blocks=np.zeros(square),
            couplings=np.zeros((SPAN, nodes)),
            linear=linear,
            first=np.zeros(total, np.int64),
            gradient=np.zeros((total, SPAN, dimension)),
            lower=lower,
            upper=upper,
            compliance=compliance,
            limit=np.full(total, np.inf),
            far_nodes=far_nodes,
            far_gradient=far_gradient,
            value=value,
            multipliers=multipliers,
            chords=np.zeros(nodes - 1),
            work=np.zeros((2, nodes, dimension)),
            contacts=ContactBuffers.of(nodes, dimension),
            clearance=np.zeros(nodes),
            push=np.zeros((2, nodes)),
            grip_shape=np.full((2, nodes, GRIPS), NO_SHAPE),
            grip=np.zeros((2, nodes, GRIPS, 5)),
            grip_contact=np.full((2, nodes, GRIPS), -1),
            drag=np.zeros(square),
            drag_linear=drag_linear,
            internal=internal,
            contact_force=contact_force,
            tail_load=np.zeros(dimension),
        )

    def forget(self) -> None:
        """Forget the last solve: the next step starts without tension and contacts."""
        self.multipliers[:] = 0.0
        self.push[:] = 0.0
        self.grip_shape[:], self.grip[:] = NO_SHAPE, 0.0

    def restore(self, warm_start: tuple[Vector, Table, Indices, Table]) -> None:
        """Restore multipliers, pushes and friction of a step; see `Formulation.warm_start`."""
        self.multipliers[: len(warm_start[0])] = warm_start[0]
        self.push[:], self.grip_shape[:], self.grip[:] = warm_start[1:]


def _program_of(buffers: StepBuffers, known: Mask, rows: int) -> ChainProgram:
    """Return the program of the first rows."""
    return ChainProgram(
        buffers.blocks,
        buffers.couplings,
        buffers.linear,
        known,
        buffers.first[:rows],
        buffers.gradient[:rows],
        buffers.lower[:rows],
        buffers.upper[:rows],
        buffers.compliance[:rows],
        buffers.limit[:rows],
        buffers.far_nodes,
        buffers.far_gradient,
    )


program_of = compiled(_program_of)
program_view = compiled_inline(_program_of)
"""The same for kernels that do not count references to arrays."""
