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
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.barrier import Barrier, CompiledBarrier
from magnetosuture_thread.compiled import compiled
from magnetosuture_thread.geometry.obstacles import WALL, Workspace, WorkspaceData
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.model.barriers import (
    Connectivity,
    EnhancedConnectivity,
    Stiffness,
    distance_barrier,
    moved_inside,
    squared_barrier,
    stiffness_function,
)
from magnetosuture_thread.model.formulations.added_rows import LinearRows
from magnetosuture_thread.model.formulations.contact_rows import DEPTH_TOLERANCE, contact_rows, keep_multipliers
from magnetosuture_thread.model.formulations.step import (
    Formulation,
    PrescribedMotion,
    StepResult,
    ThreadState,
    move_prescribed,
)
from magnetosuture_thread.model.formulations.step_buffers import StepBuffers
from magnetosuture_thread.model.mechanics import rest_distances
from magnetosuture_thread.model.program import Solver, Vector
from magnetosuture_thread.model.thread import Thread


class PaperOptions(NamedTuple):
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


class PaperFormulation(Formulation):
    """Steps a thread by the program above; see `Formulation` for the other arguments.

    Of the thread's mechanics only the rest shape counts. Rows of added barriers are linearised once, as all are here.

    Args:
        options: what the paper sets or leaves open.
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
        super().__init__(thread, workspace, solver, tolerance, barriers, 3 * thread.segments - 2)
        self._options = options or PaperOptions()
        self._wall_radius = (workspace.wall_radius - self._radius) / thread.segment_length
        self._rest = rest_distances(thread.rest_angles)

    def step(self, state: ThreadState, drive: PrescribedMotion, interval: float) -> StepResult:
        """Move the prescribed nodes and let the thread follow; see `Formulation`."""
        unit, options = self._thread.segment_length, self._options
        options = options._replace(
            gain=min(options.gain, 1.0 / interval), stiffness_gain=min(options.stiffness_gain, 1.0 / interval)
        )
        before, velocities = state.positions / unit, state.velocities / unit
        moved, known = move_prescribed(before, *drive.arrays(), unit)
        start = moved if options.lead_ahead else before
        if state.interval == 0.0:
            self._buffers.forget()
        while True:
            contacts, before_depth = _assemble(
                self._buffers, self._near.data, start, velocities, known, self._rest, unit, self._radius, options
            )
            if contacts >= 0:
                break
            self._buffers = self._buffers.enlarged()
        added: LinearRows | None = None
        if self.added:
            self.added.begin(state.positions, drive.time, interval)
            added = self.added.linearised(start, moved, known, interval)
        solution = self._solve(contacts, known, velocities, added)
        keep_multipliers(self._buffers, solution.multipliers[: self._rows + contacts], self._rows)
        end = moved + interval * solution.velocities
        moved_inside(end, known, self._wall_radius)
        after = ThreadState(end * unit, (end - before) * (unit / interval), interval)
        # The hard barriers, h(x + dt u) >= (1 - alpha dt) h(x), where the obstacles themselves are.
        near = self._near.near(after.positions)
        depth = max(0.0, self._radius - float(near.distance[~known[near.node]].min(initial=self._radius)))
        allowed = (1.0 - options.gain * interval) * before_depth + DEPTH_TOLERANCE
        converged, status = depth <= allowed, solution.status
        if not converged:
            status = f"not converged, a node is {depth:.1e} m deep and {allowed:.1e} m are allowed; {status}"
        return StepResult(after, solution.solver, status, solution.residuals, 1, converged)

    def segment_barriers(self, positions: Points, heading: Points) -> list[CompiledBarrier]:
        """Return connectivities and stiffness; see `Formulation`. There is none of compression in this formulation.

        Connectivity may give way, as the paper's has slack; what is left of it is what the margins say.
        """
        unit = self._thread.segment_length
        return [Connectivity(unit), EnhancedConnectivity(unit), Stiffness(unit * self._rest)]


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
    options: PaperOptions,
) -> tuple[int, float]:
    """Write the program; return contacts, -1 if there is no room for them, and the greatest depth of a node [m]."""
    nodes, dimension = start.shape
    segments, gain = nodes - 1, options.gain
    buffers.couplings[:] = 0.0
    for i in range(nodes):
        for a in range(dimension):
            for b in range(dimension):
                buffers.blocks[i, a, b] = 1.0 if a == b else 0.0
            buffers.linear[i, a] = -options.damping * velocities[i, a]
    enhanced, stiff = segments, 2 * segments - 1
    rows = 3 * segments - 2
    one = np.ones(segments)
    distance_barrier(start, 1, one, buffers.value, buffers.gradient)
    distance_barrier(start, 2, 2.0 * one, buffers.value[enhanced:], buffers.gradient[enhanced:])
    stiffness_function(start, rest, buffers.value[stiff:], buffers.gradient[stiff:])
    for r in range(rows):
        node = r if r < enhanced else (r - enhanced if r < stiff else r - stiff)
        buffers.first[r] = min(node, nodes - 3)
        buffers.lower[r] = -(gain if r < stiff else options.stiffness_gain) * buffers.value[r]
        buffers.upper[r] = np.inf
        buffers.compliance[r] = 1.0 / (options.connectivity_weight if r < stiff else options.stiffness_weight)
    contacts, depth = contact_rows(buffers, rows, workspace, start, start, known, 1.0 / gain, unit, radius, False)
    for r in range(rows, rows + contacts):
        clearance = buffers.value[r]
        if clearance > 0.0 and buffers.obstacle[r - rows] != WALL:
            # grad h' u >= -alpha h, divided by the slope: the row's own size does not matter, it is hard.
            value, slope = squared_barrier(clearance + radius / unit, radius / unit)
            buffers.lower[r] = -gain * value / slope
    return contacts, depth
