"""The formulation `rod`: an overdamped inextensible rod, one sparse program a step.

    minimise over u   1/2 sum_i u_i' Z_i u_i  +  E_bend(x + dt u) / (zeta_perp D dt)
    subject to        h_con = 0   (connectivity and compression together)
                      h_obs >= 0  (obstacles, hard)

in units of the segment length D. Node 0 is the needle's tail: it has moved before the step and is no
unknown. The barriers are linearised twice, at the start and at the end point that the first solve
predicts, as the discrete-time condition h(x + dt u) >= (1 - alpha dt) h(x) with alpha = 1 / dt.

Source: [Forghani2025], controller (quadratic program over all velocities). Deviation: the objective is
dissipation and elastic energy instead of |u - kappa v|^2, the thread may not be compressed, the
constraints have no slack, and the second linearisation is new; each of these is a measured gain.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.errors import SolverError
from magnetosuture_thread.geometry.obstacles import Disc
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.model.barriers import BarrierRows, Compression, Connectivity, ObstacleAvoidance
from magnetosuture_thread.model.mechanics import bending_bands, bending_gradient, drag_metric
from magnetosuture_thread.model.program import QuadraticProgram, Solver, SparsePattern
from magnetosuture_thread.model.thread import Attachment, Thread

LINEARISATIONS = 2


@dataclass(frozen=True)
class StepSolution:
    """One step's end point and how it was found.

    Attributes:
        positions: all nodes, shape (n + 1, d) [m].
        solver: its name.
        status: its own word for the last solve.
        residual: the largest scaled residual over the step's solves.
    """

    positions: Points
    solver: str
    status: str
    residual: float


class RodFormulation:
    """Steps a thread by the program above.

    Args:
        thread: the thread.
        obstacles: discs in the dish frame [m].
        solver: solves the program.
        tolerance: the largest residual with which a solution is accepted.
        dimension: d, 2 or 3.
    """

    name = "rod"

    def __init__(
        self, thread: Thread, obstacles: Sequence[Disc], solver: Solver, tolerance: float, dimension: int = 2
    ) -> None:
        unit = thread.segment_length
        self._thread = thread
        self._solver = solver
        self._tolerance = tolerance
        self._glued = thread.attachment is Attachment.GLUED
        # Bending stiffness over drag in units of D and seconds [1/s].
        self._bending_rate = thread.bending_stiffness / (thread.drag_across * unit**4)
        self._bands = bending_bands(thread.segments, self._glued)
        self._connectivity = Connectivity(1.0)
        self._compression = Compression(1.0)
        scaled = [Disc(tuple(c / unit for c in disc.centre), disc.radius / unit) for disc in obstacles]
        self._obstacles = ObstacleAvoidance(scaled, 0.5 * thread.diameter / unit)
        self._hessian = _hessian_pattern(thread.segments, dimension)
        self._constraints = _constraint_pattern(thread.segments, len(scaled), dimension)

    def step(self, positions: Points, tail: Points, heading: Points, interval: float) -> StepSolution:
        """Move the needle's tail and let the thread follow for one interval.

        Args:
            positions: all nodes, shape (n + 1, d) [m].
            tail: the needle's tail at the end of the interval, shape (d,) [m].
            heading: unit vector along the needle at the end of the interval, shape (d,).
            interval: dt [s].

        Raises:
            SolverError: a solution's residual is above the tolerance.
        """
        unit = self._thread.segment_length
        start = positions / unit
        start[0] = tail / unit
        P, q = self._objective(start, heading if self._glued else None, interval)
        end = start
        worst = 0.0
        for _ in range(LINEARISATIONS):
            solution = self._solver.solve(self._program(P, q, start, end, interval))
            if not solution.residual <= self._tolerance:
                raise SolverError(solution.solver, solution.status, solution.residual, self._tolerance)
            worst = max(worst, solution.residual)
            end = start.copy()
            end[1:] += interval * solution.u.reshape(end[1:].shape)
        return StepSolution(end * unit, solution.solver, solution.status, worst)

    def margins(self, positions: Points) -> list[BarrierRows]:
        """Return every barrier at positions of shape (n + 1, d) [m], in SI units."""
        unit = self._thread.segment_length
        found = [barrier.rows(positions / unit) for barrier in (self._connectivity, self._compression, self._obstacles)]
        power = (2, 2, 1)  # of the unit of length in each kind's h
        return [
            replace(
                rows,
                value=rows.value * unit**exponent,
                gradient=rows.gradient * unit ** (exponent - 1),
                clearance=rows.clearance * unit,
            )
            for rows, exponent in zip(found, power, strict=True)
        ]

    def _objective(
        self, start: Points, heading: Points | None, interval: float
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the entries of P, in the pattern's order, and q."""
        metric = drag_metric(start, self._thread.drag_along / self._thread.drag_across)[1:]
        dimension = start.shape[1]
        weight = interval * self._bending_rate
        diagonal, first, second = (weight * band for band in self._bands)
        blocks = metric + diagonal[1:, None, None] * np.eye(dimension)
        upper = np.triu_indices(dimension)
        entries = np.concatenate(
            [
                blocks[:, upper[0], upper[1]].ravel(),
                np.repeat(first[1:], dimension),
                np.repeat(second[1:], dimension),
            ]
        )
        return entries, self._bending_rate * bending_gradient(start, heading)[1:].ravel()

    def _program(
        self, P: NDArray[np.float64], q: NDArray[np.float64], start: Points, about: Points, interval: float
    ) -> QuadraticProgram:
        """Return the program with its barriers linearised about a predicted end point.

        A row is  h(y) + grad h(y)' (x + dt u - y) >= 0.  The compression's rows are the
        connectivity's, negated, so both are one row with two bounds.
        """
        moved = (start - about) / interval
        stretch = self._connectivity.rows(about)
        compression = self._compression.rows(about)
        obstacles = self._obstacles.rows(about)
        segment_drift = _directional(stretch, moved)
        lower = np.concatenate(
            [
                -stretch.value / interval - segment_drift,
                -obstacles.value / interval - _directional(obstacles, moved),
            ]
        )
        upper = np.concatenate([compression.value / interval - segment_drift, np.full(len(obstacles.value), np.inf)])
        entries = np.concatenate(
            [stretch.gradient[:, 1].ravel(), stretch.gradient[1:, 0].ravel(), obstacles.gradient.ravel()]
        )
        return QuadraticProgram(self._hessian.matrix(P), q, self._constraints.matrix(entries), lower, upper)


def _directional(rows: BarrierRows, velocity: Points) -> NDArray[np.float64]:
    """Return each row's rate of change for the nodes' velocities, shape (m,)."""
    return np.asarray(np.einsum("mkd,mkd->m", rows.gradient, velocity[rows.nodes]))


def _hessian_pattern(segments: int, dimension: int) -> SparsePattern:
    """Upper triangle of the band: full diagonal blocks, two diagonal off-diagonal blocks."""
    upper = np.triu_indices(dimension)
    first = np.arange(segments) * dimension
    unknowns = np.arange(segments * dimension)
    rows = [
        (first[:, None] + upper[0]).ravel(),
        unknowns[:-dimension],
        unknowns[: -2 * dimension],
    ]
    columns = [
        (first[:, None] + upper[1]).ravel(),
        unknowns[dimension:],
        unknowns[2 * dimension :],
    ]
    size = segments * dimension
    return SparsePattern(np.concatenate(rows), np.concatenate(columns), (size, size))


def _constraint_pattern(segments: int, obstacles: int, dimension: int) -> SparsePattern:
    """A row for each segment, on its far and its near node, then one for each node and obstacle."""
    unknowns = np.arange(segments * dimension)
    far_rows = np.repeat(np.arange(segments), dimension)
    near_rows = np.repeat(np.arange(1, segments), dimension)
    obstacle_rows = segments + np.repeat(np.arange(obstacles * segments), dimension)
    rows = np.concatenate([far_rows, near_rows, obstacle_rows])
    columns = np.concatenate([unknowns, unknowns[:-dimension], np.tile(unknowns, obstacles)])
    return SparsePattern(rows, columns, (segments * (1 + obstacles), segments * dimension))
