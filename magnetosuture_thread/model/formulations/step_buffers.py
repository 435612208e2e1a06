"""Memory of one step of the thread, shared by all formulations: its program, contacts and forces."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.compiled import compiled
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.model.program import SPAN, ChainProgram, Vector

GRIPS = 3  # shapes at most that a node or a chord has friction with at once
NO_SHAPE = -2  # in place of a shape


class StepBuffers(NamedTuple):
    """Memory for a step's program and its contacts, kept from step to step so that no step pays for it.

    Attributes:
        blocks: see `ChainProgram`, as are the following; n + 1 nodes.
        couplings: shape (3, n + 1).
        linear: shape (n + 1, d).
        first: rows: those of the formulation, then those of the contacts, shape (r,).
        gradient: shape (r, 3, d).
        lower: shape (r,).
        upper: shape (r,).
        compliance: shape (r,).
        limit: shape (r,).
        value: h of each row, shape (r,).
        multipliers: of the last solve: a guess for the next one, and the segments' tension, shape (r,).
        chords: length of each segment, shape (n,).
        work: shape (2, n + 1, d).
        node: contacts: as `find_contacts` writes them, shape (c,).
        obstacle: shape (c,).
        distance: shape (c,).
        normal: shape (c, d).
        nearest: shape (c,).
        clearance: distance of each node from the nearest of all that is solid, at most the reach, shape (n + 1,) [m].
        place: of a contact on the segment from its node on, 0 at the node itself, shape (c,).
        push: what contacts last pushed each node and each segment with, shape (2, n + 1).
        contact_force: the same as vectors, with friction, of all contacts of a node, shape (n + 1, d).
        grip_shape: the shapes with friction that last pushed each node, and each chord between its nodes, `NO_SHAPE`
            for none, shape (2, n + 1, GRIPS).
        grip: of these, the force (2), the multiplier of friction, its limit, and the place on the chord, shape
            (2, n + 1, GRIPS, 5).
    """

    blocks: NDArray[np.float64]
    couplings: NDArray[np.float64]
    linear: NDArray[np.float64]
    first: NDArray[np.int64]
    gradient: NDArray[np.float64]
    lower: Vector
    upper: Vector
    compliance: Vector
    limit: Vector
    value: Vector
    multipliers: Vector
    chords: Vector
    work: NDArray[np.float64]
    node: NDArray[np.int64]
    obstacle: NDArray[np.int64]
    distance: Vector
    normal: Points
    nearest: NDArray[np.bool_]
    clearance: Vector
    place: Vector
    push: NDArray[np.float64]
    contact_force: Points
    grip_shape: NDArray[np.int64]
    grip: NDArray[np.float64]
    drag: NDArray[np.float64]
    drag_linear: Points
    internal: Points
    tail_load: Vector

    @classmethod
    def of(cls, nodes: int, dimension: int, rows: int, contacts: int) -> StepBuffers:
        """Return buffers for a number of rows, and of contacts besides."""
        total = rows + contacts
        return cls(
            np.zeros((nodes, dimension, dimension)),
            np.zeros((SPAN, nodes)),
            np.zeros((nodes, dimension)),
            np.zeros(total, dtype=np.int64),
            np.zeros((total, SPAN, dimension)),
            np.zeros(total),
            np.zeros(total),
            np.zeros(total),
            np.full(total, np.inf),
            np.zeros(total),
            np.zeros(total),
            np.zeros(nodes - 1),
            np.zeros((2, nodes, dimension)),
            np.zeros(contacts, dtype=np.int64),
            np.zeros(contacts, dtype=np.int64),
            np.zeros(contacts),
            np.zeros((contacts, dimension)),
            np.zeros(contacts, dtype=np.bool_),
            np.zeros(nodes),
            np.zeros(contacts),
            np.zeros((2, nodes)),
            np.zeros((nodes, dimension)),
            np.full((2, nodes, GRIPS), NO_SHAPE),
            np.zeros((2, nodes, GRIPS, 5)),
            np.zeros((nodes, dimension, dimension)),
            np.zeros((nodes, dimension)),
            np.zeros((nodes, dimension)),
            np.zeros(dimension),
        )

    def enlarged(self) -> StepBuffers:
        """Return buffers for twice as many contacts, with the same chords and multipliers."""
        nodes, dimension = self.linear.shape
        rows = len(self.first) - len(self.node)
        larger = StepBuffers.of(nodes, dimension, rows, 2 * len(self.node))
        larger.multipliers[:rows] = self.multipliers[:rows]
        larger.chords[:] = self.chords
        larger.push[:] = self.push
        larger.grip_shape[:], larger.grip[:] = self.grip_shape, self.grip
        return larger

    def forget(self) -> None:
        """Forget the last solve: the next step starts without tension and contacts."""
        self.multipliers[:] = 0.0
        self.push[:] = 0.0
        self.grip_shape[:], self.grip[:] = NO_SHAPE, 0.0


@compiled
def program_of(buffers: StepBuffers, known: NDArray[np.bool_], rows: int) -> ChainProgram:
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
    )
