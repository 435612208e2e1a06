"""What a compiled forecast takes, works with and records."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.geometry.obstacles import WorkspaceData
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.model.formulations.rod_step import MotionBuffers, RodProperties
from magnetosuture_thread.model.formulations.step_buffers import StepBuffers
from magnetosuture_thread.model.solvers.banded import SolverBuffers
from magnetosuture_thread.safety.certificate import FilterData

OBSTACLE_MARGIN, WALL_MARGIN, CONNECTIVITY_MARGIN, COMPRESSION_MARGIN, NEEDLE_MARGIN = range(5)
"""Columns of the margins that are recorded."""
KINDS = ("obstacle", "wall", "connectivity", "compression", "needle")
NO_CONTACT = -2
"""In place of a shape: nothing is touched."""


class RolloutModel(NamedTuple):
    """What stays the same from step to step.

    Attributes:
        rod: the thread.
        near: obstacles and wall, with the reach of the program's rows.
        around: the same, with the reach of the margins.
        needle: the safety filter.
        offset: where the thread is fixed, along the heading and to its left of the needle's tail, shape (2,) [m].
        prescribed: nodes of prescribed motion, 0 first; the others stay where they are, shape (p,).
        tolerance: the largest residual with which a solution is accepted.
        max_step: intervals are divided into steps of at most this [s].
        max_way: of a prescribed node in such a step [m].
        max_substeps: into which an interval is divided at the most.
        contact_tolerance: the thread touches a shape or the wall to which it is this close [m].
        friction: threshold [m], slowdown of a node, and speed of a node that is stuck [m/s], as of `FrictionLaw`; and
            the time over which the speeds are averaged [s]; shape (4,).
        drag: of the needle, see `NeedleDrag`: along with the thread's and without it, across, turning, and that of the
            whole thread broadside; zeros where the needle follows the filtered velocity exactly, shape (5,).
    """

    rod: RodProperties
    near: WorkspaceData
    around: WorkspaceData
    needle: FilterData
    offset: NDArray[np.float64]
    prescribed: NDArray[np.int64]
    tolerance: float
    max_step: float
    max_way: float
    max_substeps: int
    contact_tolerance: float
    friction: NDArray[np.float64]
    drag: NDArray[np.float64]


class RolloutState(NamedTuple):
    """Needle and thread while they move; written.

    Attributes:
        positions: of all nodes, shape (n + 1, 2) [m].
        velocities: of all nodes over the last step, shape (n + 1, 2) [m/s].
        averaged: the same, averaged, for the friction law, shape (n + 1, 2) [m/s].
        pose: the needle's tail [m] and heading, shape (4,).
        last: velocity of the tip over the last step [m/s], and duration of the thread's last step, 0 for none [s],
            shape (3,).
        added: motion that the thread's pull adds to the needle's; see `moved_needle`, shape (3,).
    """

    positions: Points
    velocities: Points
    averaged: Points
    pose: NDArray[np.float64]
    last: NDArray[np.float64]
    added: NDArray[np.float64]


class MarginBuffers(NamedTuple):
    """Where contacts are written for the margins; see `find_contacts`."""

    node: NDArray[np.int64]
    obstacle: NDArray[np.int64]
    distance: NDArray[np.float64]
    normal: Points
    nearest: NDArray[np.bool_]

    @classmethod
    def of(cls, capacity: int) -> MarginBuffers:
        """Return buffers with room for so many contacts."""
        node, obstacle = np.zeros((2, capacity), np.int64)
        return cls(node, obstacle, np.zeros(capacity), np.zeros((capacity, 2)), np.zeros(capacity, np.bool_))


class RolloutBuffers(NamedTuple):
    """What a rollout works with; of one thread of the processor at a time.

    Attributes:
        step: of the thread's program.
        solver: of its solver.
        motion: of its steps.
        contacts: of the margins, with c rows each.
    """

    step: StepBuffers
    solver: SolverBuffers
    motion: MotionBuffers
    contacts: MarginBuffers


class RolloutRecord(NamedTuple):
    """What is recorded of k steps, and of the instant before them.

    Attributes:
        vertices: shape (k + 1, n + 1, 2) [m].
        poses: of the needle: tail [m] and heading, shape (k + 1, 4).
        filtered: velocity of the tip in each step, shape (k, 2) [m/s].
        touched: shapes, then the wall, that changed it, shape (k, s + 1).
        slowdown: by the thread's friction in each step, shape (k,).
        margin: least of each kind, see `KINDS`, shape (k + 1, 5) [m].
        node: where it is, shape (k + 1, 5).
        shape: and of which shape, `WALL` for the wall, shape (k + 1, 5).
        contact: a shape that the thread touches, `NO_CONTACT` for none, and the node, shape (k + 1, 2).
        rubbed: nodes under friction, shape (k + 1, n + 1).
        tension: greatest, shape (k + 1,) [N].
        pull: of the thread upon the needle, shape (k + 1, 2) [N].
        converged: whether the barriers themselves hold, shape (k + 1,).
    """

    vertices: NDArray[np.float64]
    poses: NDArray[np.float64]
    filtered: Points
    touched: NDArray[np.bool_]
    slowdown: NDArray[np.float64]
    margin: NDArray[np.float64]
    node: NDArray[np.int64]
    shape: NDArray[np.int64]
    contact: NDArray[np.int64]
    rubbed: NDArray[np.bool_]
    tension: NDArray[np.float64]
    pull: Points
    converged: NDArray[np.bool_]

    @classmethod
    def of(cls, steps: int, nodes: int, shapes: int) -> RolloutRecord:
        """Return an empty record."""
        instants = steps + 1
        return cls(
            np.empty((instants, nodes, 2)),
            np.empty((instants, 4)),
            np.zeros((steps, 2)),
            np.zeros((steps, shapes + 1), np.bool_),
            np.ones(steps),
            np.full((instants, len(KINDS)), np.inf),
            np.zeros((instants, len(KINDS)), np.int64),
            np.full((instants, len(KINDS)), NO_CONTACT),
            np.full((instants, 2), NO_CONTACT),
            np.zeros((instants, nodes), np.bool_),
            np.zeros(instants),
            np.zeros((instants, 2)),
            np.ones(instants, np.bool_),
        )
