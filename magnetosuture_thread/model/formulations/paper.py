"""The formulation `paper`: the program as printed.

    minimise over u, s   1/2 sum_i |u_i - kappa v_i|^2  +  1/2 s' W s
    subject to           grad h_con,i' u >= -alpha h_con,i - s_i       connectivity, W_con
                         grad h_enh,i' u >= -alpha h_enh,i - s_i       enhanced connectivity, W_con
                         grad V_i' u     <= -gamma V_i + s_i           stiffness, W_stiff
                         grad h_obs' u   >= -alpha h_obs               obstacles, hard
                         grad h_wall' u  >= -alpha h_wall              the wall of the dish, hard

in units of the segment length D, so that weights and gains mean the same for each thread; the paper leaves
that open. v_i is the node's velocity over the last step. Where the lead moves first (`lead_ahead`), x_0 in
the rows is the needle's new position, else the old one, as printed.

Source: [Forghani2025], controller. Deviation: enhanced connectivity with 2 Delta, see its class; the
obstacle function is signed, see `SquaredObstacleAvoidance`, and where it is below 0 the signed distance
stands for it, with a compliance of 1e-7: its own gradient vanishes on the surface, and nodes that are inside
of two obstacles at once could not obey two hard rows. What the paper leaves open, alpha, gamma,
W_stiff of each material and the lead's order, is in `PaperOptions`; a gain is never taken higher than 1 / dt,
where the discrete step would overshoot the barrier. The wall is new: what its rows leave outside, of second order
in a node's way along it, is moved in to it along its normal; the dish is convex, so no two nodes get farther apart.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.barrier import Barrier, BarrierRows
from magnetosuture_thread.compiled import compiled
from magnetosuture_thread.errors import SolverError
from magnetosuture_thread.geometry.obstacles import WALL, Workspace
from magnetosuture_thread.geometry.obstacles.contacts import WorkspaceData
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.model.barriers import (
    Connectivity,
    EnhancedConnectivity,
    ObstacleAvoidance,
    Stiffness,
    WallAvoidance,
    distance_barrier,
    moved_inside,
    squared_barrier,
    stiffness_function,
)
from magnetosuture_thread.model.formulations.added_rows import AddedBarriers
from magnetosuture_thread.model.formulations.step import (
    DEPTH_TOLERANCE,
    ROW_REACH,
    PrescribedMotion,
    StepBuffers,
    StepResult,
    ThreadState,
    contact_rows,
    keep_contact_multipliers,
    move_prescribed,
    warmed,
)
from magnetosuture_thread.model.mechanics import rest_distances
from magnetosuture_thread.model.program import Solver, Vector
from magnetosuture_thread.model.thread import Thread


@dataclass(frozen=True)
class PaperOptions:
    """The parameters of the printed program.

    Attributes:
        damping: kappa, part of its velocity that a node keeps from step to step.
        gain: alpha of all barriers [1/s].
        stiffness_gain: gamma of the stiffness [1/s].
        connectivity_weight: W_con, of connectivity and enhanced connectivity.
        stiffness_weight: W_stiff.
        lead_ahead: whether the needle moves before the rows are set up.
    """

    damping: float = 0.95
    gain: float = 20.0
    stiffness_gain: float = 20.0
    connectivity_weight: float = 1e5
    stiffness_weight: float = 1.0
    lead_ahead: bool = False

    @classmethod
    def tuned(cls, stiffness_weight: float) -> PaperOptions:
        """Return what the paper leaves open as it did best on the reference set; W_stiff is the material's."""
        return cls(gain=66.0, stiffness_gain=2.0, stiffness_weight=stiffness_weight, lead_ahead=True)


class PaperFormulation:
    """Steps a thread by the program above.

    Args:
        thread: the thread; of its mechanics only the rest shape counts.
        workspace: obstacles and wall [m]; their reach is that of the margins.
        solver: solves the program.
        tolerance: the largest residual with which a solution is accepted.
        options: what the paper sets or leaves open.
        barriers: what a user adds to the built-in ones; their rows are linearised once, as all of this formulation.
    """

    name = "paper"

    def __init__(
        self,
        thread: Thread,
        workspace: Workspace,
        solver: Solver,
        tolerance: float,
        options: PaperOptions | None = None,
        barriers: Sequence[Barrier] = (),
    ) -> None:
        nodes, dimension = thread.segments + 1, workspace.dimension
        self.dimension = dimension
        self._thread, self._workspace, self._solver, self._tolerance = thread, workspace, solver, tolerance
        self._options = options or PaperOptions()
        self.added = AddedBarriers(barriers, thread.segment_length)
        reach, wall_radius = ROW_REACH * thread.segment_length, workspace.wall_radius
        self._near = Workspace(workspace.shapes, reach, dimension, wall_radius)
        self._room_radius = (wall_radius - 0.5 * thread.diameter) / thread.segment_length
        self._rest = rest_distances(thread.rest_angles)
        self._rows = 3 * thread.segments - 2
        self._buffers = StepBuffers.of(nodes, dimension, self._rows, 2 * nodes)

    def step(self, state: ThreadState, drive: PrescribedMotion, interval: float) -> StepResult:
        """Move the prescribed nodes and let the thread follow; see `Formulation`."""
        unit, options = self._thread.segment_length, self._options
        before, velocities = state.positions / unit, state.velocities / unit
        moved, known = move_prescribed(before, *drive.arrays(), unit)
        start, gain = moved if options.lead_ahead else before, min(options.gain, 1.0 / interval)
        if state.interval == 0.0:
            self._buffers.forget()
        while True:
            contacts, before_depth = _assemble(
                self._buffers,
                self._near.data,
                start,
                velocities,
                known,
                self._rest,
                unit,
                0.5 * self._thread.diameter,
                options.damping,
                gain,
                min(options.stiffness_gain, 1.0 / interval),
                1.0 / options.connectivity_weight,
                1.0 / options.stiffness_weight,
            )
            if contacts >= 0:
                break
            self._buffers = self._buffers.with_room()
        count = self._rows + contacts
        program, wide, guess = self._buffers.program(count, known), None, self._buffers.multipliers[:count]
        if self.added:
            self.added.begin(state.positions, drive.time, interval)
            added = self.added.linearised(start, moved, known, interval)
            program, wide = added.joined(program)
            guess = np.concatenate([guess, np.zeros(len(added.lower))])
        solution = self._solver.solve(program, velocities, guess, wide)
        if not solution.residuals.largest <= self._tolerance:
            self._buffers.forget()
            raise SolverError(solution.solver, solution.status, solution.residuals.largest, self._tolerance)
        self._buffers.multipliers[:count] = solution.multipliers[:count]
        keep_contact_multipliers(self._buffers.node, solution.multipliers[self._rows : count], self._buffers.push)
        end = moved + interval * solution.velocities
        moved_inside(end, known, self._room_radius)
        after = ThreadState(end * unit, (end - before) * (unit / interval), interval)
        # The hard barriers, h(x + dt u) >= (1 - alpha dt) h(x), where the obstacles themselves are.
        depth = self._depth(after.positions, known)
        allowed = (1.0 - gain * interval) * before_depth + DEPTH_TOLERANCE
        converged, status = depth <= allowed, solution.status
        if not converged:
            status = f"not converged, a node is {depth:.1e} m deep and {allowed:.1e} m are allowed; {status}"
        return StepResult(after, solution.solver, status, solution.residuals, 1, converged)

    def warm_up(self) -> None:
        """Load what follows where the first solver fails; see `Formulation`."""
        warmed(self._solver, self._buffers, np.zeros(self._thread.segments + 1, dtype=np.bool_), self._rows)
        self._buffers.forget()

    def _depth(self, positions: Points, known: NDArray[np.bool_]) -> float:
        """Return the greatest depth of a free node in an obstacle or the wall [m]."""
        near = self._near.near(positions)
        clearance = near.distance[~known[near.node]] - 0.5 * self._thread.diameter
        return max(0.0, -float(clearance.min(initial=0.0)))

    def rest_lengths(self, positions: Points, heading: Points) -> Vector:
        """Return the segments' length at rest; see `Formulation`."""
        return np.full(self._thread.segments, self._thread.segment_length)

    def margins(self, positions: Points, heading: Points) -> list[BarrierRows]:
        """Return the built-in barriers; see `Formulation`. There is none of compression in this formulation.

        Connectivity may give way, as the paper's has slack; what is left of it is what the margins say.
        """
        unit, radius = self._thread.segment_length, 0.5 * self._thread.diameter
        return [
            Connectivity(unit).rows(positions),
            EnhancedConnectivity(unit).rows(positions),
            Stiffness(unit * self._rest).rows(positions),
            ObstacleAvoidance(self._workspace, radius).rows(positions),
            WallAvoidance(self._workspace.wall_radius, radius, self._workspace.reach).rows(positions),
        ]


@compiled
def _assemble(
    buffers: StepBuffers,
    workspace: WorkspaceData,
    start: Points,
    velocities: Points,
    known: NDArray[np.bool_],
    rest: Vector,
    unit: float,
    radius: float,
    damping: float,
    gain: float,
    stiffness_gain: float,
    connectivity_compliance: float,
    stiffness_compliance: float,
) -> tuple[int, float]:
    """Write the program; return contacts, -1 if there is no room for them, and the greatest depth of a node [m]."""
    nodes, dimension = start.shape
    segments = nodes - 1
    buffers.couplings[:] = 0.0
    for i in range(nodes):
        for a in range(dimension):
            for b in range(dimension):
                buffers.blocks[i, a, b] = 1.0 if a == b else 0.0
            buffers.linear[i, a] = -damping * velocities[i, a]
    enhanced, stiff = segments, 2 * segments - 1
    rows = 3 * segments - 2
    one = np.ones(segments)
    distance_barrier(start, 1, one, buffers.value, buffers.gradient)
    distance_barrier(start, 2, 2.0 * one, buffers.value[enhanced:], buffers.gradient[enhanced:])
    stiffness_function(start, rest, buffers.value[stiff:], buffers.gradient[stiff:])
    for r in range(rows):
        node = r if r < enhanced else (r - enhanced if r < stiff else r - stiff)
        buffers.first[r] = min(node, nodes - 3)
        buffers.lower[r] = -(gain if r < stiff else stiffness_gain) * buffers.value[r]
        buffers.upper[r] = np.inf
        buffers.compliance[r] = connectivity_compliance if r < stiff else stiffness_compliance
    contacts, depth = contact_rows(buffers, rows, workspace, start, start, known, 1.0 / gain, unit, radius)
    for r in range(rows, rows + contacts):
        clearance = buffers.value[r]
        if clearance > 0.0 and buffers.obstacle[r - rows] != WALL:
            # grad h' u >= -alpha h, divided by the slope: the row's own size does not matter, it is hard.
            value, slope = squared_barrier(clearance + radius / unit, radius / unit)
            buffers.lower[r] = -gain * value / slope
    return contacts, depth
