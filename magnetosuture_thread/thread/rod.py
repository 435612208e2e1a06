"""The formulation `rod`: an inextensible rod, one sparse program a step.

    minimise over u   1/2 sum_i (a u_i - v_i)' Z_i (a u_i - v_i) / a  +  E_bend(x + dt u) / dt
    subject to        |x_i - x_{i-1}| = the chord of a segment  (connectivity and compression together)
                      h_obs >= 0,  h_wall >= 0                  (obstacles and the wall of the dish, hard)

in units of the segment length D and of the drag (or mass / dt + drag) of one segment. The prescribed nodes,
the needle's tail among them, have moved before the step and are no unknowns.

In a viscous liquid Z_i is the drag, and the rate of change at the end of the step is the second-order
backward difference a u - v, with v = b times the last step's velocities, a = (1 + 2 w) / (1 + w),
b = w / (1 + w), and w = dt over the last step's dt; the first step, and one more than twice as long as
the last, has a = 1, v = 0. In air there is besides the drag, with a = 1 and v = 0, the inertia

    1/2 sum_i (m_i / dt) |u_i - (velocity_i + dt g)|^2

A uniform flow w of the medium adds Z_i w to the drag's part of Z_i v: drag is on the velocity against the medium.

The barriers are linearised about the end point that the last velocities predict, and again at the one
that each solve predicts, as the discrete-time condition h(x + dt u) >= (1 - alpha dt) h(x) with
alpha = 1 / dt, until segments are right to a thousandth and nodes to 1e-7 m, or for `MAX_SOLVES` times.
One solve is nearly always enough: the prediction is of second order already, and with the constraints'
curvature in P (`_taut`) each solve is a Newton step.

Source: [Forghani2025], controller (quadratic program over all velocities). Deviation: the objective is
dissipation and elastic energy instead of |u - kappa v|^2, the thread may not be compressed, segments have
a compliance of 1e-7 instead of slacks, and where the barriers are linearised is new; each is a measured gain.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from magnetosuture_thread.barrier import Barrier
from magnetosuture_thread.errors import ConfigurationError, InvalidInputError
from magnetosuture_thread.geometry.obstacles import Workspace
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.thread import banded, mechanics
from magnetosuture_thread.thread.barriers import Compression, Connectivity
from magnetosuture_thread.thread.contact_rows import knows_friction
from magnetosuture_thread.thread.forces import ThreadForces, friction_of, write_forces
from magnetosuture_thread.thread.material import Attachment, Thread
from magnetosuture_thread.thread.program import SOLVED, Mask, Residuals, Solver, Vector
from magnetosuture_thread.thread.rod_step import (
    ENDED,
    MAX_SOLVES,
    NO_ROOM,
    RodProperties,
    StepInput,
    StepModel,
    accept_step,
    solve_step,
)
from magnetosuture_thread.thread.self_contact import SelfContact
from magnetosuture_thread.thread.solvers import BandedSolver, FallbackSolver
from magnetosuture_thread.thread.step import (
    AddedRows,
    Formulation,
    PrescribedMotion,
    StepResult,
    ThreadState,
)
from magnetosuture_thread.thread.step_buffers import program_of


class RodFormulation(Formulation):
    """Steps a thread by the program above; see `Formulation` for the arguments.

    Raises:
        ConfigurationError: gravity or flow has not one value for each dimension.

    Attributes:
        rod: the thread, for compiled code.
    """

    name = "rod"
    has_friction = True

    def __init__(
        self,
        thread: Thread,
        workspace: Workspace,
        solver: Solver,
        tolerance: float,
        barriers: Sequence[Barrier] = (),
    ) -> None:
        super().__init__(thread, workspace, solver, tolerance, barriers, thread.segments)
        medium, clamped = thread.medium, thread.attachment is Attachment.CLAMPED
        self.rod = RodProperties(
            clamped,
            thread.segment_length,
            self._radius,
            thread.bending_stiffness,
            medium.drag_across,
            medium.drag_along,
            medium.mass_per_length,
            medium.bending_damping,
            self._vector("gravity", medium.gravity),
            np.ascontiguousarray(thread.rest_angles),
            mechanics.end_corrected_weights(thread.segments),
            mechanics.bending_bands(thread.segments, clamped),
            self._vector("flow", medium.flow),
        )
        first = solver.first if type(solver) is FallbackSolver else solver
        self._structured = type(first) is BandedSolver  # another one's way of solving is its own
        banded_solver = first if isinstance(first, BandedSolver) else BandedSolver()
        self._solver_buffers = banded_solver.buffers(thread.segments + 1, self.dimension, len(self._buffers.first))
        selves = [barrier for barrier in barriers if isinstance(barrier, SelfContact)]
        self._self_contact = selves[0] if selves else None
        self.touches_itself = bool(selves)
        self._only_self_contact = len(barriers) == len(selves)
        self._rough = knows_friction(self.workspace.data)

    @property
    def nodes_in_contact(self) -> Mask:
        """Which nodes shapes or wall pushed in the last step, at a node or on a chord beside it, shape (n + 1,)."""
        at_nodes, on_chords = self._buffers.push > 0.0
        at_nodes |= on_chords
        at_nodes[1:] |= on_chords[:-1]
        return np.asarray(at_nodes)

    def set_thread(self, thread: Thread) -> None:
        """Change stiffness, rest curvature and medium from the next step on; the chain itself stays as it is.

        Args:
            thread: of the same length, segments, diameter and attachment.
        """
        self._thread, self.rod = thread, self.rod_of(thread)

    def rod_of(self, thread: Thread) -> RodProperties:
        """Return a thread that differs in stiffness, rest curvature and medium, for compiled code."""
        medium = thread.medium
        return self.rod._replace(
            bending_stiffness=thread.bending_stiffness,
            drag_across=medium.drag_across,
            drag_along=medium.drag_along,
            rest_angles=np.ascontiguousarray(thread.rest_angles),
            flow=self._vector("flow", medium.flow),
        )

    def _vector(self, name: str, values: tuple[float, ...]) -> Vector:
        """Return a vector of the medium, zeros where it has none."""
        if len(values) not in (0, self.dimension):
            raise ConfigurationError(f"medium.{name}", values, f"{self.dimension} values, or none")
        return np.array(values) if values else np.zeros(self.dimension)

    def check_start(self, positions: Points) -> None:
        """Refuse a thread that crosses itself where it cannot; see `Formulation`."""
        crossings = self._self_contact.crossings(positions) if self._self_contact is not None else []
        if crossings:
            places = " and ".join(f"{1e3 * self._thread.segment_length * (i + 0.5):.1f}" for i in crossings[0])
            given = f"{len(crossings)} crossings, the first at {places} mm along it"
            raise InvalidInputError("thread's nodes", given, "a thread that does not cross itself, as the scene has it")

    def step(self, state: ThreadState, drive: PrescribedMotion, interval: float) -> StepResult:
        """Move the prescribed nodes and let the thread follow; see `Formulation`.

        Compiled code takes the step as long as the structured solver gets on with it. The rows of added barriers are
        in the program from where it ends without them and one is not met.
        """
        unit, buffers = self._thread.segment_length, self._buffers
        if state.interval == 0.0:
            buffers.forget()
        # Compiled code would be compiled anew for another layout, in the middle of a run.
        positions = np.ascontiguousarray(state.positions, np.float64)
        velocities = np.ascontiguousarray(state.velocities, np.float64)
        given = StepInput(positions, velocities, *drive.arrays(), drive.heading, interval, state.interval)
        model = self.step_model()._replace(structured=self._structured)
        worst, solves, status, solver = Residuals(0.0, 0.0, 0.0), 0, SOLVED, self._solver.name
        added: AddedRows | None = None
        off = 0.0  # how far the added rows are from being met
        before = None
        if self.added:
            self.added.begin(positions, drive.time, interval)
            before = self.warm_start()
        while True:
            done = solve_step(model, buffers, self._solver_buffers, given, solves, off)
            worst, solves = worst.or_worse(Residuals(*done.residuals)), done.solves
            status = status if status != SOLVED else banded.STATUS[done.status]
            if done.code == NO_ROOM:
                self._refuse_contacts()
            if done.code == ENDED:
                if before is not None and added is None:
                    try:
                        added = self._linearised(interval)
                    except InvalidInputError:  # of a user's barrier: the step is not taken
                        self.restore(before)
                        raise
                    if added.unmet:
                        model, off = model._replace(structured=False, max_solves=solves + MAX_SOLVES), np.inf
                        continue
                break
            program = program_of(buffers, buffers.known, self._rows + done.contacts)
            solution = self._solve(program, buffers.velocities, added)
            own, pushes = np.split(solution.multipliers, [len(program.lower)])
            accept_step(buffers, self.workspace.data, solution.velocities, own, interval)
            if added is not None:
                if self._only_self_contact:
                    buffers.contact_force[:] += added.force(pushes, positions.shape)
                    buffers.tail_load[:] += added.force(pushes, positions.shape)[0]
                added = self._linearised(interval)
                off = added.off
            worst, solves = worst.or_worse(solution.residuals), solves + 1
            if status == SOLVED:
                status, solver = solution.status, solution.solver
        end = ThreadState(buffers.about * unit, (buffers.about - buffers.before) * (unit / interval), interval)
        if done.off > 1.0:
            words = f"not converged in {solves} linearisations, off by {done.off:.1g} times what is allowed"
            status = f"{words}; {status}"
        loads = buffers.internal.copy(), buffers.contact_force.copy(), buffers.tail_load.copy()
        grip, own_way = buffers.grip.copy() if self._rough else None, self._self_contact
        passed = done.off > 1.0 and own_way is not None and own_way.passed(positions, end.positions)
        return StepResult(end, solver, status, worst, solves, done.off <= 1.0, loads, grip, passed)

    def step_model(self) -> StepModel:
        """Return the thread and what is around it, for compiled code."""
        return StepModel((0, 1, 2)[: self.dimension], self.rod, self.workspace.data, self._tolerance, MAX_SOLVES)

    def _linearised(self, interval: float) -> AddedRows:
        return self.added.linearised(self._buffers.about, self._buffers.start, self._buffers.known, interval)

    def forces(self, result: StepResult, heading: Points) -> ThreadForces:
        """Return the forces at the end of a step; see `Formulation`."""
        assert result.loads is not None
        rod, state, (internal, contact, load) = self.rod, result.state, result.loads
        scale = (rod.drag_across + rod.mass_per_length / state.interval) * rod.unit**2
        tension, force = np.empty(len(internal) - 1), np.empty(self.dimension)
        positions, velocities = state.positions / rod.unit, state.velocities
        moment = write_forces(rod, positions, velocities, heading, internal, load, scale, tension, force)
        friction, use = np.zeros(len(positions)), np.zeros(len(positions))
        if result.grip is not None:
            friction, use = friction_of(result.grip)
            friction *= scale
        return ThreadForces(tension, scale * contact, force, moment, friction, use)

    def warm_up(self) -> None:
        """Load what follows where the structured solver does not get on with a step; see `Formulation`."""
        super().warm_up()
        nodes, heading = self._thread.segments + 1, np.eye(self.dimension)[0]
        still, chain = np.zeros((nodes, self.dimension)), np.outer(np.arange(nodes), heading)
        accept_step(self._buffers, self.workspace.data, still, np.zeros(self._rows), 1.0)
        tension, force = np.zeros(self._rows), np.zeros(self.dimension)
        write_forces(self.rod, chain, still, heading, still, force, 1.0, tension, force)

    def rest_lengths(self, positions: Points, heading: Points) -> Vector:
        """Return the chords of the segments' arcs; see `Formulation`."""
        chords = np.empty(self._thread.segments)
        mechanics.chord_lengths(positions / self._thread.segment_length, heading, self.rod.clamped, chords)
        return chords * self._thread.segment_length

    def segment_barriers(self, positions: Points, heading: Points) -> list[Barrier]:
        """Return connectivity and compression; see `Formulation`."""
        return [Connectivity(self._thread.segment_length), Compression(self.rest_lengths(positions, heading))]
