"""One step of the thread: what goes in, what comes out, and what every formulation shares."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.geometry.barrier import OBSTACLE, WALL, Barrier, BarrierRows
from magnetosuture_thread.geometry.compiled import TypedKernel
from magnetosuture_thread.geometry.obstacles import Workspace
from magnetosuture_thread.geometry.polyline import Indices, Mask, Points, Table, Vector, chain_along
from magnetosuture_thread.settings.errors import SolverError
from magnetosuture_thread.thread.barriers import SolidRows, solid_rows
from magnetosuture_thread.thread.contact_rows import DEPTH_TOLERANCE
from magnetosuture_thread.thread.margins import BarrierMargins, constant_column
from magnetosuture_thread.thread.material import Thread
from magnetosuture_thread.thread.mechanics import ThreadForces
from magnetosuture_thread.thread.program import (
    ChainProgram,
    Residuals,
    Solution,
    Solver,
    StepBuffers,
    first_rows,
    residuals_of,
)


class ThreadState(NamedTuple):
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


class PrescribedMotion(NamedTuple):
    """The nodes whose motion is known: the lead, what tissue holds, what another instrument grasps.

    Attributes:
        nodes: their indices, k of them; node 0 is the needle's tail.
        positions: where they are at the end of the step, shape (k, d) [m].
        heading: unit vector along the needle at the end of the step, shape (d,).
        time: at the end of the step [s].
    """

    nodes: Sequence[int] | Indices
    positions: Points
    heading: Points
    time: float = 0.0

    def arrays(self) -> tuple[Indices, Points, Points]:
        """Return the nodes, where they are at the end, and the heading, for compiled code."""
        ends = np.ascontiguousarray(self.positions, dtype=np.float64).reshape(len(self.nodes), len(self.heading))
        return np.asarray(self.nodes, np.int64), ends, np.ascontiguousarray(self.heading, dtype=np.float64)


class StepResult(NamedTuple):
    """One step's end point and how it was found.

    Attributes:
        state: the thread at the end of the step.
        solver: name of the solver of the solve that the status is of.
        status: its own word for the last solve; for the first that it did not solve at once, if there was one.
        residuals: the largest of each kind over the step's solves.
        solves: number of programs solved.
        converged: whether the end satisfies the barriers themselves, not only their last linearisation; of
            `paper` the hard ones, those of the obstacles.
        loads: `end` and `tail_load` of `RodBuffers`; None where these are of no mechanics.
        grip: of friction, as in `GripBuffers`; None where no shape has any.
        links: as in `RodBuffers`; None where they are not worked out with the step.
        passed: whether the thread has passed through itself where it may not; then the step must not be taken.
    """

    state: ThreadState
    solver: str
    status: str
    residuals: Residuals
    solves: int
    converged: bool
    loads: tuple[Table, Vector] | None = None
    grip: Table | None = None
    links: Table | None = None
    passed: bool = False


WarmStart = tuple[NDArray[Any], ...]
"""What the next step takes over from the last besides the state: the solver's guess, and friction."""


class AddedRows(NamedTuple):
    """Linearised rows of all added barriers, in units of the segment length.

    Attributes:
        nodes: the nodes of each row, padded by repeating the last with gradient 0, shape (r, k).
        gradient: a_r at these nodes, a unit vector over all of them, shape (r, k, d).
        lower: of a_r' u, shape (r,).
        compliance: shape (r,).
        unmet: whether a row is not met where it was linearised.
        off: how far the hard rows are from being met over what is allowed; 1 or less if they hold.
    """

    nodes: Indices
    gradient: Table
    lower: Vector
    compliance: Vector
    unmet: bool
    off: float

    def added_to(self, program: ChainProgram) -> ChainProgram:
        """Return a program with these rows as its far rows."""
        unlimited = np.full(len(self.lower), np.inf)
        return program._replace(
            lower=np.concatenate([program.lower, self.lower]),
            upper=np.concatenate([program.upper, unlimited]),
            compliance=np.concatenate([program.compliance, self.compliance]),
            limit=np.concatenate([program.limit, unlimited]),
            far_nodes=self.nodes,
            far_gradient=self.gradient,
        )

    def force(self, multipliers: Vector, shape: tuple[int, ...]) -> Points:
        """Return sum_r a_r lambda_r, shape (n + 1, d)."""
        force = np.zeros(shape)
        np.add.at(force, self.nodes, self.gradient * multipliers[:, None, None])
        return force


class AddedBarriers:
    """The barriers that a user has added to a formulation, over one step after the other.

    Args:
        barriers: in the order in which margins list them.
        segment_length: D [m].

    Attributes:
        first_time: stamp of the needle's first pose [s].
    """

    def __init__(self, barriers: Sequence[Barrier], segment_length: float) -> None:
        self._barriers, self._unit = tuple(barriers), segment_length
        self._before: list[Vector | None] = [None] * len(self._barriers)
        self._start = np.empty((0, 0))
        self._heading: Points | None = None
        self.first_time = math.inf

    def __bool__(self) -> bool:
        """Return whether there are any."""
        return bool(self._barriers)

    def rows_at(self, stamp: float, positions: Points, heading: Points) -> list[BarrierRows]:
        """Return the rows of each barrier at a stamp [s], positions of shape (n + 1, d) [m] and a heading."""
        self.move_to(stamp, positions[0], heading)
        return [barrier.rows(positions) for barrier in self._barriers]

    def move_to(self, stamp: float, tail: Points, heading: Points) -> None:
        """Set the stamp of the next evaluation [s], and the needle: where the thread is fixed [m], and its heading."""
        self._heading = heading
        for barrier in self._barriers:
            barrier.move_to(stamp, self.first_time, (tail, heading))

    def begin(self, positions: Points, drive: PrescribedMotion, interval: float) -> None:
        """Begin a step: keep h(x) of the barriers whose gain does not let it fall to 0 within it.

        Args:
            positions: of all nodes before the step, shape (n + 1, d) [m].
            drive: the needle at the end of the step.
            interval: dt [s].
        """
        self._start, before = positions, drive.heading if self._heading is None else self._heading
        self.move_to(drive.time - interval, positions[0], before)
        for index, barrier in enumerate(self._barriers):
            slow = barrier.gain * interval < 1.0
            self._before[index] = np.asarray(barrier.value(positions), dtype=np.float64) if slow else None
        self.move_to(drive.time, drive.positions[0], drive.heading)

    def linearised(self, about: Points, start: Points, known: Mask, interval: float) -> AddedRows:
        """Return the rows of all barriers about a predicted end point.

            a' u >= ((1 - alpha dt) h(x) - h(y) - grad h(y)' (start - y)) / (|grad h| dt),    a = grad h / |grad h|

        A row that no unknown can change is left out.

        Args:
            about: y, shape (n + 1, d) [D].
            start: where the nodes are once those of a known motion have moved, shape (n + 1, d) [D].
            known: those of a known motion, shape (n + 1,).
            interval: dt [s].
        """
        found = []
        for barrier, before in zip(self._barriers, self._before, strict=True):
            rows = barrier.rows_after(self._start, about * self._unit)
            gradient = np.where(known[rows.nodes][:, :, None], 0.0, rows.gradient)
            slope = np.sqrt(np.einsum("rkd,rkd->r", gradient, gradient))
            free = slope > 0.0
            allowed = np.zeros(len(slope))
            # A barrier whose number of rows changes with time decays as fast as a step allows.
            if before is not None and before.shape == rows.value.shape:
                allowed = (1.0 - barrier.gain * interval) * before
            missing = (allowed - rows.value)[free] / slope[free]  # m
            nodes, gradient = rows.nodes[free].astype(np.int64), gradient[free] / slope[free, None, None]
            moved = np.einsum("rkd,rkd->r", gradient, (start - about)[nodes])
            lower = (missing / self._unit - moved) / interval
            soft, most = 1.0 / barrier.slack_weight, float(missing.max(initial=0.0))
            # Against a hard row that has to be met from outside something else may hold.
            compliance = np.where(lower > 0.0, max(soft, 1e-7), soft)
            off = most / DEPTH_TOLERANCE if soft == 0.0 else 0.0
            unmet = off > 1.0 if soft == 0.0 else most > 0.0
            found.append(AddedRows(nodes, gradient, lower, compliance, unmet, off))
        width = max(rows.nodes.shape[1] for rows in found)
        wide = [(rows, width - rows.nodes.shape[1]) for rows in found]
        return AddedRows(
            np.concatenate([np.pad(rows.nodes, ((0, 0), (0, more)), mode="edge") for rows, more in wide]),
            np.concatenate([np.pad(rows.gradient, ((0, 0), (0, more), (0, 0))) for rows, more in wide]),
            np.concatenate([rows.lower for rows in found]),
            np.concatenate([rows.compliance for rows in found]),
            any(rows.unmet for rows in found),
            max(rows.off for rows in found),
        )


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
        workspace: obstacles and wall, with the reach of the program's rows [m].
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
        self._thread, self._margin_workspace, self._solver, self._tolerance = thread, workspace, solver, tolerance
        # What is solid and farther from a node than a segment has no row in the program.
        self._radius, reach = 0.5 * thread.diameter, thread.segment_length
        friction = (workspace.friction, workspace.wall_friction) if self.has_friction else ((), 0.0)
        self.workspace = Workspace(workspace.shapes, reach, self.dimension, workspace.wall_radius, *friction)
        self.added = AddedBarriers(barriers, thread.segment_length)
        # Memory of margins.
        self._nearby = np.full((nodes, len(workspace.shapes)), -1)
        self._solid_rows = SolidRows.room((len(workspace.shapes) + 1) * nodes, self.dimension)
        self._write_solid_rows = TypedKernel(solid_rows)
        nothing = SolidRows.room(0, self.dimension)
        self._far_from_solids = [BarrierMargins(name, *nothing[:4], normal=nothing.normal) for name in (OBSTACLE, WALL)]
        self._rows, self._program = rows, StepBuffers.of(nodes, self.dimension, rows)

    @abstractmethod
    def step(self, state: ThreadState, drive: PrescribedMotion, interval: float) -> StepResult:
        """Move the prescribed nodes and let the thread follow for one interval [s].

        Raises:
            SolverError: a solution's residual is above the tolerance.
        """

    def warm_up(self) -> None:
        """Load what only a step needs that is hard to solve; after a first step, before the thread's own."""
        nodes = self._thread.segments + 1
        program = first_rows(self._program, self._rows)
        solution = self._solver.solve(program, np.zeros((nodes, self.dimension)), np.zeros(self._rows))
        residuals_of(program, solution.velocities, solution.multipliers)
        self.forget()

    def _memory(self) -> WarmStart:
        """Return the arrays that the next step takes over."""
        return self._program.multipliers[: self._rows], self._program.push

    def warm_start(self) -> WarmStart:
        """Return a copy of what the next step takes over from the last besides the state."""
        return tuple(array.copy() for array in self._memory())

    def restore(self, warm_start: WarmStart) -> None:
        """Restore what `warm_start` returned, so that the next step is that one again to the last bit."""
        for array, kept in zip(self._memory(), warm_start, strict=True):
            array[:] = kept

    def forget(self) -> None:
        """Forget the last solve: the next step starts without tension, contacts and friction."""
        self._program.multipliers[:] = 0.0
        self._program.push[:] = 0.0

    def check_start(self, positions: Points) -> None:  # noqa: B027 - most know nothing against a shape
        """Refuse a shape that the thread cannot start from, shape (n + 1, d) [m].

        Raises:
            InvalidInputError: it is such a one.
        """

    def strain(self, positions: Points, heading: Points, links: Table | None = None) -> Vector:
        """Return each segment's length over what it should be from end to end, less one, shape (n,); see `margins`."""
        along = positions[1:] - positions[:-1]
        return np.asarray(np.sqrt(np.einsum("ij,ij->i", along, along)) / self._thread.segment_length - 1.0)

    def forces(self, result: StepResult, heading: Points) -> ThreadForces | None:
        """Return the forces at the end of a step, None where the formulation is of no mechanics.

        Args:
            result: of the step.
            heading: of the needle at its end, shape (d,).
        """
        return None

    @abstractmethod
    def segment_margins(self, positions: Points, heading: Points, links: Table | None = None) -> list[BarrierMargins]:
        """Return the margins of the built-in barriers of the thread itself, obstacles and wall aside."""

    def margins(self, positions: Points, heading: Points, links: Table | None = None) -> list[BarrierMargins]:
        """Return the margins of the built-in barriers at positions of shape (n + 1, d) [m], in SI units.

        Args:
            positions: of all nodes.
            heading: of the needle.
            links: of the step that led there, see `StepResult`.
        """
        return [*self.segment_margins(positions, heading, links), *self.solid_margins(positions)]

    def solid_margins(self, positions: Points) -> list[BarrierMargins]:
        """Return the margins of obstacles and wall at positions of shape (n + 1, d) [m].

        The clearance is that of the node and the half segments beside it.
        """
        points, rows = np.ascontiguousarray(positions), self._solid_rows
        memory = self._margin_workspace.data, self._radius, self._nearby, rows
        count, obstacles = self._write_solid_rows(points, *memory)
        margins = []
        for far, part in zip(self._far_from_solids, (slice(0, obstacles), slice(obstacles, count)), strict=True):
            if part.start < part.stop:
                node, obstacle, value, clearance, normal = [column[part].copy() for column in rows]
                bound = constant_column(-math.inf, len(value))
                margins.append(BarrierMargins(far.barrier, node, obstacle, value, clearance, bound, normal))
            else:
                margins.append(far)
        return margins

    def _solve(self, program: ChainProgram, velocities: Points, added: AddedRows | None) -> Solution:
        """Return the solution of a program with the rows of added barriers, started from the buffers' multipliers."""
        guess = self._program.multipliers[: len(program.lower)]
        if added is not None:
            program = added.added_to(program)
            guess = np.concatenate([guess, np.zeros(len(added.lower))])
        solution = self._solver.solve(program, velocities, guess)
        if not solution.residuals.largest <= self._tolerance:
            self.forget()
            raise SolverError(solution.solver, solution.status, solution.residuals.largest, self._tolerance)
        return solution

    def _refuse_contacts(self) -> None:
        """Raise the error of a step that has more contacts than the buffers have room for.

        Raises:
            SolverError: always.
        """
        self.forget()
        most = len(self._program.contacts.node)
        raise SolverError(self._solver.name, f"more than {most} contacts at once", math.inf, self._tolerance)
