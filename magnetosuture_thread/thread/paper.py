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
from typing import Annotated

import numpy as np

from magnetosuture_thread.geometry.barrier import Barrier
from magnetosuture_thread.geometry.obstacles import WALL, Workspace
from magnetosuture_thread.geometry.polyline import Points, Table
from magnetosuture_thread.settings.configuration import bounded, checked_arguments
from magnetosuture_thread.thread.barriers import (
    Connectivity,
    EnhancedConnectivity,
    Stiffness,
    move_inside,
    squared_barrier,
)
from magnetosuture_thread.thread.contact_rows import DEPTH_TOLERANCE, contact_rows
from magnetosuture_thread.thread.margins import BarrierMargins
from magnetosuture_thread.thread.material import Thread
from magnetosuture_thread.thread.program import SPAN, Solver, first_rows
from magnetosuture_thread.thread.step import AddedRows, Formulation, PrescribedMotion, StepResult, ThreadState

WEIGHT = bounded("", 1e-30, 1e12)
MAX_ELONGATION = 1.5  # of the thread; slacks that give way by more hold nothing together, whatever the residuals say


@checked_arguments("paper")
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

    damping: Annotated[float, bounded("", 0.0, 1.0)] = 0.95
    gain: Annotated[float, bounded("1/s", 1e-6, unlimited=True)] = 20.0
    stiffness_gain: Annotated[float, bounded("1/s", 1e-6, unlimited=True)] = 20.0
    connectivity_weight: Annotated[float, WEIGHT] = 1e5
    stiffness_weight: Annotated[float, WEIGHT] = 1.0
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
        self._rest = 2.0 * np.cos(0.5 * thread.rest_angles)  # delta_i of the nodes beside each inner node [D]

    def step(self, state: ThreadState, drive: PrescribedMotion, interval: float) -> StepResult:
        """Move the prescribed nodes and let the thread follow; see `Formulation`."""
        unit, options, buffers = self._thread.segment_length, self._options, self._program
        alpha, gamma = min(options.gain, 1.0 / interval), min(options.stiffness_gain, 1.0 / interval)
        before, velocities = np.ascontiguousarray(state.positions / unit), state.velocities / unit
        moved, known, nodes = before.copy(), buffers.known, list(drive.nodes)
        known[:] = False
        known[nodes] = True
        moved[nodes] = drive.arrays()[1] / unit
        start = moved if options.lead_ahead else before
        if state.interval == 0.0:
            self.forget()
        buffers.blocks[:], buffers.couplings[:] = np.eye(self.dimension), 0.0  # P = I, q = -kappa v
        buffers.linear[:] = -options.damping * velocities
        self._write_barriers(start, alpha, gamma)
        contacts, before_depth = self._write_obstacles(start, alpha)
        added: AddedRows | None = None
        if self.added:
            self.added.begin(state.positions, drive, interval)
            added = self.added.linearised(start, moved, known, interval)
        solution = self._solve(first_rows(buffers, self._rows + contacts), velocities, added)
        rows = self._rows + contacts
        buffers.multipliers[:rows], buffers.push[:] = solution.multipliers[:rows], 0.0
        np.maximum.at(buffers.push[0], buffers.contacts.node[:contacts], buffers.multipliers[self._rows : rows])
        end = moved + interval * solution.velocities
        move_inside(end, known, self._wall_radius)
        after = ThreadState(end * unit, (end - before) * (unit / interval), interval)
        # The hard barriers, h(x + dt u) >= (1 - alpha dt) h(x), where the obstacles themselves are.
        near = self.workspace.near(after.positions)
        depth = max(0.0, self._radius - float(near.distance[~known[near.node]].min(initial=self._radius)))
        allowed = (1.0 - alpha * interval) * before_depth + DEPTH_TOLERANCE
        longest = float(np.sqrt(np.square(np.diff(end, axis=0)).sum(axis=1)).mean())
        status, converged = solution.status, depth <= allowed and longest <= MAX_ELONGATION
        if longest > MAX_ELONGATION:
            status = f"not converged, the thread is {longest:.2f} times as long as it is; {status}"
        elif not converged:
            status = f"not converged, a node is {depth:.1e} m deep and {allowed:.1e} m are allowed; {status}"
        return StepResult(after, solution.solver, status, solution.residuals, 1, converged)

    def _write_barriers(self, start: Points, alpha: float, gamma: float) -> None:
        """Write the rows of connectivity, enhanced connectivity and stiffness, with their slacks as compliances."""
        connectivity, stiffness = 1.0 / self._options.connectivity_weight, 1.0 / self._options.stiffness_weight
        row, buffers = 0, self._program
        for barrier, gain, compliance in (
            (Connectivity(1.0), alpha, connectivity),
            (EnhancedConnectivity(1.0), alpha, connectivity),
            (Stiffness(self._rest), gamma, stiffness),
        ):
            rows = barrier.rows(start)
            part = slice(row, row + len(rows.value))
            first = np.minimum(rows.nodes[:, 0], len(start) - SPAN)
            buffers.first[part], buffers.gradient[part] = first, 0.0
            index = np.arange(row, part.stop)[:, None]
            buffers.gradient[index, rows.nodes - first[:, None]] = rows.gradient
            buffers.lower[part], buffers.upper[part] = -gain * rows.value, np.inf
            buffers.compliance[part] = compliance
            row = part.stop

    def _write_obstacles(self, start: Points, gain: float) -> tuple[int, float]:
        """Write the rows of obstacles and wall; return how many there are, and the greatest depth of a node [m]."""
        unit, radius, buffers, first = self._thread.segment_length, self._radius, self._program, self._rows
        workspace = self.workspace.data
        contacts, depth = contact_rows(buffers, first, workspace, start, start, 1.0 / gain, unit, radius, False)
        if contacts < 0:
            self._refuse_contacts()
        for row in range(first, first + contacts):
            signed = buffers.contacts.distance[row - first] / unit
            if signed > radius / unit and buffers.contacts.obstacle[row - first] != WALL:
                # grad h' u >= -alpha h, divided by the slope: the row's own size does not matter, it is hard.
                buffers.lower[row] = -gain * squared_barrier(signed, radius / unit) / signed
        return contacts, depth

    def segment_margins(self, positions: Points, heading: Points, links: Table | None = None) -> list[BarrierMargins]:
        """Return connectivities and stiffness; see `Formulation`. There is none of compression in this formulation.

        Connectivity may give way, as the paper's has slack; what is left of it is what the margins say.
        """
        unit = self._thread.segment_length
        barriers = Connectivity(unit), EnhancedConnectivity(unit), Stiffness(unit * self._rest)
        return [BarrierMargins.from_rows(barrier.rows(positions)) for barrier in barriers]
