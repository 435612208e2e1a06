"""One step of the thread: what goes in, what comes out, and what every formulation shares."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.barrier import Barrier, BarrierRows, CompiledBarrier
from magnetosuture_thread.compiled import compiled
from magnetosuture_thread.errors import SolverError
from magnetosuture_thread.geometry.obstacles import Workspace, half_segment_distances
from magnetosuture_thread.geometry.polyline import Points, chain_along
from magnetosuture_thread.model.barriers import ObstacleAvoidance, WallAvoidance
from magnetosuture_thread.model.forces import ThreadForces
from magnetosuture_thread.model.formulations.added_rows import AddedBarriers, LinearRows
from magnetosuture_thread.model.formulations.step_buffers import StepBuffers, program_of
from magnetosuture_thread.model.program import (
    Residuals,
    Solution,
    Solver,
    Vector,
    WideRows,
    residuals_of,
)
from magnetosuture_thread.model.thread import Thread

ROW_REACH = 1.0  # segments; what is solid and farther from a node than this have no row in the program


@dataclass(frozen=True)
class ThreadState:
    """The thread at one instant.

    Attributes:
        positions: of all nodes, shape (n + 1, d) [m].
        velocities: of all nodes over the last step, shape (n + 1, d) [m/s].
        interval: duration of the last step, 0 if there was none [s].
    """

    positions: Points
    velocities: Points
    interval: float = 0.0

    @classmethod
    def at_rest(cls, positions: Points) -> ThreadState:
        """Return a thread that does not move."""
        return cls(positions, np.zeros_like(positions))

    def resampled(self, before: Thread, thread: Thread) -> ThreadState:
        """Resample the state for another thread: same curve, same velocities along it.

        A longer one goes on straight at its end. Where segments and length are the same, nothing changes.

        Args:
            before: the thread that this is the state of.
            thread: the thread that takes its place.
        """
        if (thread.segments, thread.length) == (before.segments, before.length):
            return self
        positions = chain_along(self.positions, thread.segments, thread.segment_length)
        at = thread.segment_length * np.arange(thread.segments + 1)
        nodes = before.segment_length * np.arange(before.segments + 1)
        velocities = np.column_stack([np.interp(at, nodes, along) for along in self.velocities.T])
        return ThreadState(positions, velocities, self.interval)


@dataclass(frozen=True)
class PrescribedMotion:
    """The nodes whose motion is known: the lead, what tissue holds, what another instrument grasps.

    Attributes:
        nodes: their indices, k of them; node 0 is the needle's tail.
        positions: where they are at the end of the step, shape (k, d) [m].
        heading: unit vector along the needle at the end of the step, shape (d,).
        time: at the end of the step [s].
    """

    nodes: tuple[int, ...]
    positions: Points
    heading: Points
    time: float = 0.0

    def arrays(self) -> tuple[NDArray[np.int64], Points]:
        """Return the nodes and where they are at the end, for compiled code."""
        ends = np.ascontiguousarray(self.positions, dtype=np.float64).reshape(len(self.nodes), len(self.heading))
        return np.array(self.nodes, dtype=np.int64), ends


@dataclass(frozen=True)
class StepResult:
    """One step's end point and how it was found.

    Attributes:
        state: the thread at the end of the step.
        solver: name of the solver of the solve that the status is of.
        status: its own word for the last solve; for the first that it did not solve at once, if there was one.
        residuals: the largest of each kind over the step's solves.
        solves: number of programs solved.
        converged: whether the end satisfies the barriers themselves, not only their last linearisation; of
            `paper` the hard ones, those of the obstacles.
        loads: what the segments push the nodes with, and what contacts do, shape (n + 1, d), and what medium and
            contacts do at the needle's tail, shape (d,), in the program's units; None where these are of no mechanics.
        grip: of friction, as in `StepBuffers`; None where no shape has any.
        passed: whether the thread has passed through itself where it may not; then the step must not be taken.
    """

    state: ThreadState
    solver: str
    status: str
    residuals: Residuals
    solves: int
    converged: bool
    loads: tuple[Points, Points, Vector] | None = field(default=None, compare=False)
    grip: NDArray[np.float64] | None = field(default=None, compare=False)
    passed: bool = False


WarmStart = tuple[Vector, Vector, NDArray[np.int64], NDArray[np.float64]]


@compiled
def move_prescribed(
    positions: Points, nodes: NDArray[np.int64], ends: Points, unit: float
) -> tuple[Points, NDArray[np.bool_]]:
    """Return positions [D] with the prescribed nodes moved to their ends [m], and which nodes these are."""
    moved, known = positions.copy(), np.zeros(len(positions), dtype=np.bool_)
    for k in range(len(nodes)):
        for a in range(positions.shape[1]):
            moved[nodes[k], a] = ends[k, a] / unit
        known[nodes[k]] = True
    return moved, known


class Formulation(ABC):
    """A way of writing one step of the thread as a quadratic program.

    Args:
        thread: the thread.
        workspace: obstacles and wall [m]; their reach is that of the margins.
        solver: solves the program.
        tolerance: the largest residual with which a solution is accepted.
        barriers: what a user adds to the built-in ones.
        rows: number of the program's rows besides those of contacts and added barriers.

    Attributes:
        name: of the formulation.
        dimension: 2 or 3.
        has_friction: whether it knows friction; else shapes have none.
        touches_itself: whether the thread cannot pass through itself.
        added: the barriers that a user has added.
    """

    name: str
    has_friction = False
    touches_itself = False

    def __init__(
        self,
        thread: Thread,
        workspace: Workspace,
        solver: Solver,
        tolerance: float,
        barriers: Sequence[Barrier],
        rows: int,
    ) -> None:
        nodes, self.dimension = thread.segments + 1, workspace.dimension
        self._thread, self._workspace, self._solver, self._tolerance = thread, workspace, solver, tolerance
        self._radius, reach = 0.5 * thread.diameter, ROW_REACH * thread.segment_length
        friction = (workspace.friction, workspace.wall_friction) if self.has_friction else ((), 0.0)
        self._near = Workspace(workspace.shapes, reach, self.dimension, workspace.wall_radius, *friction)
        self.added = AddedBarriers(barriers, thread.segment_length)
        self._rows, self._buffers = rows, StepBuffers.of(nodes, self.dimension, rows, 2 * nodes)

    @abstractmethod
    def step(self, state: ThreadState, drive: PrescribedMotion, interval: float) -> StepResult:
        """Move the prescribed nodes and let the thread follow for one interval [s].

        Raises:
            SolverError: a solution's residual is above the tolerance.
        """

    def warm_up(self) -> None:
        """Load what only a step needs that is hard to solve; after a first step, before the thread's own."""
        nodes = self._thread.segments + 1
        program = program_of(self._buffers, np.zeros(nodes, dtype=np.bool_), self._rows)
        solution = self._solver.solve(program, np.zeros((nodes, self.dimension)), np.zeros(self._rows))
        residuals_of(program, solution.velocities, solution.multipliers)
        if self.added:
            ends, one = np.array([[0, nodes - 1]]), np.zeros(1)
            wide = WideRows(ends, np.zeros((1, 2, self.dimension)), one - 1.0, one)
            self._solver.solve(program, solution.velocities, np.zeros(self._rows + 1), wide)
        self._buffers.forget()

    @property
    def workspace(self) -> Workspace:
        """Obstacles and wall, with the reach of the program's rows [m]."""
        return self._near

    def warm_start(self) -> WarmStart:
        """Return what the next step takes over from the last besides the state: the solver's guess, and friction."""
        buffers = self._buffers
        return (
            buffers.multipliers[: self._rows].copy(),
            buffers.push.copy(),
            buffers.grip_shape.copy(),
            buffers.grip.copy(),
        )

    def restore(self, warm_start: WarmStart) -> None:
        """Restore what `warm_start` returned, so that the next step is that one again to the last bit."""
        self._buffers.multipliers[: self._rows] = warm_start[0]
        self._buffers.push[:] = warm_start[1]
        self._buffers.grip_shape[:], self._buffers.grip[:] = warm_start[2:]

    def forget(self) -> None:
        """Forget the last solve; see `StepBuffers.forget`."""
        self._buffers.forget()

    def check_start(self, positions: Points) -> None:  # noqa: B027 - most know nothing against a shape
        """Refuse a shape that the thread cannot start from, shape (n + 1, d) [m].

        Raises:
            InvalidInputError: it is such a one.
        """

    def rest_lengths(self, positions: Points, heading: Points) -> Vector:
        """Return how long each segment should be, from end to end, at these positions [m], shape (n,)."""
        return np.full(self._thread.segments, self._thread.segment_length)

    def forces(self, result: StepResult, heading: Points) -> ThreadForces | None:
        """Return the forces at the end of a step, None where the formulation is of no mechanics.

        Args:
            result: of the step.
            heading: of the needle at its end, shape (d,).
        """
        return None

    @abstractmethod
    def segment_barriers(self, positions: Points, heading: Points) -> list[CompiledBarrier]:
        """Return the built-in barriers of the thread itself, obstacles and wall aside, at these positions."""

    def margins(self, positions: Points, heading: Points) -> list[BarrierRows]:
        """Return the rows of the built-in barriers at positions of shape (n + 1, d) [m], in SI units."""
        contacts = self._workspace.near(positions)
        distance = half_segment_distances(positions, self._workspace.data, contacts)
        return [
            *(barrier.rows(positions) for barrier in self.segment_barriers(positions, heading)),
            ObstacleAvoidance(self._workspace, self._radius).rows_of(contacts, distance),
            WallAvoidance(self._workspace, self._radius).rows_of(contacts, distance),
        ]

    def _solve(self, contacts: int, known: NDArray[np.bool_], velocities: Points, added: LinearRows | None) -> Solution:
        """Return the solution of the program in the buffers, with the rows of added barriers."""
        count, wide = self._rows + contacts, None
        program, guess = program_of(self._buffers, known, count), self._buffers.multipliers[:count]
        if added is not None:
            program, wide = added.joined(program)
            guess = np.concatenate([guess, np.zeros(len(added.lower))])
        solution = self._solver.solve(program, velocities, guess, wide)
        if not solution.residuals.largest <= self._tolerance:
            self._buffers.forget()
            raise SolverError(solution.solver, solution.status, solution.residuals.largest, self._tolerance)
        return solution
