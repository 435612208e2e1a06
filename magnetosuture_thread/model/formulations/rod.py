"""The formulation `rod`: an inextensible rod, one sparse program a step.

    minimise over u   1/2 sum_i (a u_i - v_i)' Z_i (a u_i - v_i) / a  +  E_bend(x + dt u) / dt
    subject to        |x_i - x_{i-1}| = the chord of a segment  (connectivity and compression together)
                      h_obs >= 0                                (obstacles, hard)

in units of the segment length D and of the drag (or mass / dt + drag) of one segment. The driven nodes,
the needle's tail among them, have moved before the step and are no unknowns.

In a viscous liquid Z_i is the drag, and the rate of change at the end of the step is the second-order
backward difference a u - v, with v = b times the last step's velocities, a = (1 + 2 w) / (1 + w),
b = w / (1 + w), and w = dt over the last step's dt; the first step, and one more than twice as long as
the last, has a = 1, v = 0. In air there is besides the drag, with a = 1 and v = 0, the inertia

    1/2 sum_i (m_i / dt) |u_i - (velocity_i + dt g)|^2

The barriers are linearised about the end point that the last velocities predict, and again at the one
that each solve predicts, as the discrete-time condition h(x + dt u) >= (1 - alpha dt) h(x) with
alpha = 1 / dt, until segments are right to a thousandth and nodes to 1e-7 m, or for `MOST_SOLVES` times.
One solve is nearly always enough: the prediction is of second order already, and with the constraints'
curvature in P (`rod_program`) each solve is a Newton step.

Source: [Forghani2025], controller (quadratic program over all velocities). Deviation: the objective is
dissipation and elastic energy instead of |u - kappa v|^2, the thread may not be compressed, segments have
a compliance of 1e-7 instead of slacks, and where the barriers are linearised is new; each is a measured gain.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.errors import ConfigurationError, SolverError
from magnetosuture_thread.geometry.obstacles import Surroundings
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.model import mechanics
from magnetosuture_thread.model.barriers import BarrierRows, Compression, Connectivity, ObstacleAvoidance
from magnetosuture_thread.model.formulations.rod_program import LONGEST_RATIO, Rod, assemble
from magnetosuture_thread.model.formulations.step import (
    ROW_REACH,
    Drive,
    Memory,
    StepSolution,
    ThreadState,
    driven,
    remember_push,
)
from magnetosuture_thread.model.program import SOLVED, Residuals, Solver, Vector
from magnetosuture_thread.model.thread import Attachment, Thread

MOST_SOLVES = 8  # in a step


class RodFormulation:
    """Steps a thread by the program above.

    Args:
        thread: the thread.
        surroundings: obstacles [m]; their reach is that of the margins.
        solver: solves the program.
        tolerance: the largest residual with which a solution is accepted.

    Raises:
        ConfigurationError: gravity has not one value for each dimension.
    """

    name = "rod"

    def __init__(self, thread: Thread, surroundings: Surroundings, solver: Solver, tolerance: float) -> None:
        nodes, dimension = thread.segments + 1, surroundings.dimension
        self.dimension = dimension
        self._thread, self._surroundings, self._solver, self._tolerance = thread, surroundings, solver, tolerance
        self._near = Surroundings(surroundings.shapes, ROW_REACH * thread.segment_length, dimension)
        medium, glued = thread.medium, thread.attachment is Attachment.GLUED
        if len(medium.gravity) not in (0, dimension):
            raise ConfigurationError("medium.gravity", medium.gravity, f"{dimension} values, or none")
        gravity = np.zeros(dimension)
        gravity[: len(medium.gravity)] = medium.gravity
        self._rod = Rod(
            glued,
            thread.segment_length,
            0.5 * thread.diameter,
            thread.bending_stiffness,
            medium.drag_across,
            medium.drag_along,
            medium.mass_per_length,
            medium.bending_damping,
            gravity,
            np.ascontiguousarray(thread.rest_turns),
            mechanics.end_corrected_weights(thread.segments),
            mechanics.bending_bands(thread.segments, glued),
        )
        self._memory = Memory.of(nodes, dimension, thread.segments, 2 * nodes)

    def step(self, state: ThreadState, drive: Drive, interval: float) -> StepSolution:
        """Move the driven nodes and let the thread follow; see `Formulation`."""
        unit, segments = self._thread.segment_length, self._thread.segments
        before = state.positions / unit
        velocities = last = state.velocities / unit
        start, known = driven(before, drive, unit)
        if state.interval == 0.0:
            self._memory.forget()
        about = _extrapolated(start, velocities, known, interval, state.interval)
        worst, solves, status = Residuals(0.0, 0.0, 0.0), 0, SOLVED
        while True:
            contacts, off = self._assemble(
                solves, about, start, before, last, known, drive.heading, interval, state.interval
            )
            if off <= 1.0 or solves == MOST_SOLVES:
                break
            program = self._memory.program(segments + contacts, known)
            solution = self._solver.solve(program, velocities, self._memory.multipliers[: segments + contacts])
            if not solution.residuals.largest <= self._tolerance:
                self._memory.forget()
                raise SolverError(solution.solver, solution.status, solution.residuals.largest, self._tolerance)
            worst, solves, velocities = worst.or_worse(solution.residuals), solves + 1, solution.velocities
            status = status if status != SOLVED else solution.status
            self._memory.multipliers[: segments + contacts] = solution.multipliers
            remember_push(self._memory.node, solution.multipliers[segments:], self._memory.push)
            about = start + interval * velocities  # known nodes have moved, and have no velocity
        end = ThreadState(about * unit, (about - before) * (unit / interval), interval)
        if off > 1.0:
            status = f"not converged in {solves} linearisations, off by {off:.1g} times what is allowed; {status}"
        return StepSolution(end, solution.solver, status, worst, solves, converged=off <= 1.0)

    def rest_lengths(self, positions: Points, heading: Points) -> Vector:
        """Return the chords of the segments' arcs; see `Formulation`."""
        chords = np.empty(self._thread.segments)
        mechanics.chord_lengths(positions / self._thread.segment_length, heading, self._rod.glued, chords)
        return chords * self._thread.segment_length

    def margins(self, positions: Points, heading: Points) -> list[BarrierRows]:
        """Return every barrier; see `Formulation`."""
        return [
            Connectivity(self._thread.segment_length).rows(positions),
            Compression(self.rest_lengths(positions, heading)).rows(positions),
            ObstacleAvoidance(self._surroundings, 0.5 * self._thread.diameter).rows(positions),
        ]

    def _assemble(
        self,
        solves: int,
        about: Points,
        start: Points,
        before: Points,
        last: Points,
        known: NDArray[np.bool_],
        heading: Points,
        interval: float,
        last_interval: float,
    ) -> tuple[int, float]:
        while True:
            contacts, off = assemble(
                solves,
                self._rod,
                self._memory,
                self._near.data,
                about,
                start,
                before,
                last,
                known,
                heading,
                interval,
                last_interval,
            )
            if contacts >= 0:
                return contacts, off
            self._memory = self._memory.with_room()


def _extrapolated(
    start: Points, velocities: Points, known: NDArray[np.bool_], interval: float, last_interval: float
) -> Points:
    """Return where the thread would be if it moved on as it did: the first guess, of second order.

    Not after a step that was much shorter, where the velocities may be those of a sample's noise, and not
    farther than a segment: then the guess is where the thread is.
    """
    if last_interval <= 0.0 or interval > LONGEST_RATIO * last_interval:
        return start
    end = start + interval * velocities
    end[known] = start[known]
    return end if np.abs(end - start).max() <= 1.0 else start
