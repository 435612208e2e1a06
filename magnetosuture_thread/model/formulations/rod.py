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
from numpy.typing import NDArray

from magnetosuture_thread.barrier import Barrier, CompiledBarrier
from magnetosuture_thread.errors import ConfigurationError, InvalidInputError
from magnetosuture_thread.geometry.obstacles import Workspace
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.model import mechanics
from magnetosuture_thread.model.barriers import Compression, Connectivity
from magnetosuture_thread.model.forces import ThreadForces
from magnetosuture_thread.model.formulations.added_rows import LinearRows
from magnetosuture_thread.model.formulations.friction_rows import friction_of, knows_friction
from magnetosuture_thread.model.formulations.rod_forces import write_forces
from magnetosuture_thread.model.formulations.rod_step import (
    ENDED,
    NO_ROOM,
    MotionBuffers,
    RodProperties,
    accept_step,
    solve_step,
)
from magnetosuture_thread.model.formulations.step import (
    Formulation,
    PrescribedMotion,
    StepResult,
    ThreadState,
)
from magnetosuture_thread.model.formulations.step_buffers import StepBuffers
from magnetosuture_thread.model.program import SOLVED, Residuals, Solver, Vector
from magnetosuture_thread.model.self_contact import SelfContact
from magnetosuture_thread.model.solvers import BandedSolver, FallbackSolver, banded
from magnetosuture_thread.model.thread import Attachment, Medium, Thread

MAX_SOLVES = 8  # in a step


class RodFormulation(Formulation):
    """Steps a thread by the program above; see `Formulation` for the arguments.

    Raises:
        ConfigurationError: gravity or flow has not one value for each dimension.
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
        dimension = self.dimension
        medium, clamped = thread.medium, thread.attachment is Attachment.CLAMPED
        if len(medium.gravity) not in (0, dimension):
            raise ConfigurationError("medium.gravity", medium.gravity, f"{dimension} values, or none")
        gravity = np.zeros(dimension)
        gravity[: len(medium.gravity)] = medium.gravity
        self._rod = RodProperties(
            clamped,
            thread.segment_length,
            self._radius,
            thread.bending_stiffness,
            medium.drag_across,
            medium.drag_along,
            medium.mass_per_length,
            medium.bending_damping,
            gravity,
            np.ascontiguousarray(thread.rest_angles),
            mechanics.end_corrected_weights(thread.segments),
            mechanics.bending_bands(thread.segments, clamped),
            self._flow(medium),
        )
        self._axes, (self._banded, self._accepted) = (0, 1, 2)[:dimension], _structured(solver, tolerance)
        selves = [barrier for barrier in barriers if isinstance(barrier, SelfContact)]
        self._self_contact = selves[0] if selves else None
        self.touches_itself = bool(selves)
        self._waits = len(barriers) == len(selves)  # there are no added rows until the thread touches itself
        if not self._waits:  # compiled code knows nothing of their rows, and leaves every solve to `step`
            self._banded = BandedSolver(iterations=0)
        self._rubs = knows_friction(self._near.data)
        self._motion = MotionBuffers.of(thread.segments + 1, dimension)
        self._use(self._buffers)

    @property
    def nodes_in_contact(self) -> NDArray[np.bool_]:
        """Which nodes shapes or wall pushed in the last step, at a node or on a chord beside it, shape (n + 1,)."""
        at_nodes, on_chords = self._buffers.push > 0.0
        at_nodes |= on_chords
        at_nodes[1:] |= on_chords[:-1]
        return np.asarray(at_nodes)

    @property
    def rod(self) -> RodProperties:
        """The thread, for compiled code."""
        return self._rod

    def set_thread(self, thread: Thread) -> None:
        """Change stiffness, rest curvature and medium from the next step on; the chain itself stays as it is.

        Args:
            thread: of the same length, segments, diameter and attachment.
        """
        self._thread, self._rod = thread, self.rod_of(thread)

    def rod_of(self, thread: Thread) -> RodProperties:
        """Return a thread that differs in stiffness, rest curvature and medium, for compiled code."""
        medium = thread.medium
        return self._rod._replace(
            bending_stiffness=thread.bending_stiffness,
            drag_across=medium.drag_across,
            drag_along=medium.drag_along,
            rest_angles=np.ascontiguousarray(thread.rest_angles),
            flow=self._flow(medium),
        )

    def _flow(self, medium: Medium) -> Vector:
        if len(medium.flow) not in (0, self.dimension):
            raise ConfigurationError("medium.flow", medium.flow, f"{self.dimension} values, or none")
        flow = np.zeros(self.dimension)
        flow[: len(medium.flow)] = medium.flow
        return flow

    def check_start(self, positions: Points) -> None:
        """Refuse a thread that crosses itself where it cannot; see `Formulation`."""
        crossings = self._self_contact.crossings(positions) if self._self_contact is not None else []
        if crossings:
            places = " and ".join(f"{1e3 * self._thread.segment_length * (i + 0.5):.1f}" for i in crossings[0])
            given = f"{len(crossings)} crossings, the first at {places} mm along it"
            raise InvalidInputError("thread's nodes", given, "a thread that does not cross itself, as the scene has it")

    def step(self, state: ThreadState, drive: PrescribedMotion, interval: float) -> StepResult:
        """Move the prescribed nodes and let the thread follow; see `Formulation`."""
        unit, motion = self._thread.segment_length, self._motion
        if state.interval == 0.0:
            self._buffers.forget()
        # Compiled code would be compiled anew for another layout, in the middle of a run.
        positions = np.ascontiguousarray(state.positions, np.float64)
        velocities = np.ascontiguousarray(state.velocities, np.float64)
        nodes, ends = drive.arrays()
        worst, solves, status, solver = Residuals(0.0, 0.0, 0.0), 0, SOLVED, self._solver.name
        added: LinearRows | None = None
        takes_rows, max_solves, solver_buffers = not self._waits, MAX_SOLVES, self._solver_buffers
        if self.added:
            self.added.begin(positions, drive.time, interval)
        while True:
            code, contacts, solves, off, number, residuals = solve_step(
                self._axes,
                self._rod,
                self._buffers,
                self._near.data,
                solver_buffers,
                motion,
                positions,
                velocities,
                nodes,
                ends,
                drive.heading,
                interval,
                state.interval,
                self._accepted,
                max_solves,
                solves,
                added.off if added is not None else 0.0,
            )
            worst, status = worst.or_worse(Residuals(*residuals)), status if status != SOLVED else banded.STATUS[number]
            if code == ENDED:
                if self.added and not takes_rows:
                    added = self.added.linearised(motion.about, motion.start, motion.known, interval)
                    if added.off > 1.0:  # it is solved again, with the rows of where it would touch itself
                        takes_rows, max_solves = True, solves + MAX_SOLVES
                        solver_buffers = self._solver_buffers._replace(iterations=0)
                        continue
                break
            if code == NO_ROOM:
                self._use(self._buffers.enlarged())
                solver_buffers = self._solver_buffers._replace(iterations=solver_buffers.iterations)
                continue
            if takes_rows:
                added = added or self.added.linearised(motion.about, motion.start, motion.known, interval)
            solution = self._solve(contacts, motion.known, motion.velocities, added)
            own = solution.multipliers[: self._rows + contacts]
            accept_step(self._buffers, self._near.data, motion, solution.velocities, own, interval)
            if added is not None:
                pushes = solution.multipliers[self._rows + contacts :] if self._waits else np.zeros(len(added.lower))
                forces = added.force(pushes, motion.about.shape)
                self._buffers.contact_force[:] += forces
                self._buffers.tail_load[:] += forces[0]
                added = self.added.linearised(motion.about, motion.start, motion.known, interval)
            worst, solves = worst.or_worse(solution.residuals), solves + 1
            if status == SOLVED:
                status, solver = solution.status, solution.solver
        end = ThreadState(motion.about * unit, (motion.about - motion.before) * (unit / interval), interval)
        if off > 1.0:
            status = f"not converged in {solves} linearisations, off by {off:.1g} times what is allowed; {status}"
        buffers = self._buffers
        loads = buffers.internal.copy(), buffers.contact_force.copy(), buffers.tail_load.copy()
        grip = buffers.grip.copy() if self._rubs else None
        passed = off > 1.0 and self._self_contact is not None and self._self_contact.passed(positions, end.positions)
        return StepResult(end, solver, status, worst, solves, off <= 1.0, loads, grip, passed)

    def forces(self, result: StepResult, heading: Points) -> ThreadForces:
        """Return the forces at the end of a step; see `Formulation`."""
        assert result.loads is not None
        rod, state, (internal, contact, load) = self._rod, result.state, result.loads
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
        velocities, multipliers = self._motion.velocities.copy(), np.zeros(self._rows)
        accept_step(self._buffers, self._near.data, self._motion, velocities, multipliers, 1.0)
        buffers, heading = self._motion, np.eye(self.dimension)[0]
        chain = np.outer(np.arange(self._thread.segments + 1.0), heading)
        internal, tension = np.zeros_like(chain), np.zeros(self._thread.segments)
        written = np.zeros(self.dimension)
        write_forces(self._rod, chain, buffers.velocities, heading, internal, written, 1.0, tension, written)

    def _use(self, buffers: StepBuffers) -> None:
        """Use buffers for the step, and as much for the structured solver."""
        self._buffers = buffers
        self._solver_buffers = self._banded.buffers(self._thread.segments + 1, self.dimension, len(buffers.first))

    def rest_lengths(self, positions: Points, heading: Points) -> Vector:
        """Return the chords of the segments' arcs; see `Formulation`."""
        chords = np.empty(self._thread.segments)
        mechanics.chord_lengths(positions / self._thread.segment_length, heading, self._rod.clamped, chords)
        return chords * self._thread.segment_length

    def segment_barriers(self, positions: Points, heading: Points) -> list[CompiledBarrier]:
        """Return connectivity and compression; see `Formulation`."""
        return [Connectivity(self._thread.segment_length), Compression(self.rest_lengths(positions, heading))]


def _structured(solver: Solver, tolerance: float) -> tuple[BandedSolver, float]:
    """Return the structured solver if it is the first to be tried, else one that does nothing.

    A step does not leave compiled code for it while its residuals are within the tolerance that is returned
    too. Of its subclasses nobody knows how they solve.
    """
    first = solver
    if type(solver) is FallbackSolver:
        first, tolerance = solver.first, min(tolerance, solver.tolerance)
    return first if type(first) is BandedSolver else BandedSolver(iterations=0), tolerance
