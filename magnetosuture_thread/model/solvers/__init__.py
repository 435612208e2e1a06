"""Solvers of the step's program: the structured one, general ones, and how one falls back on the others."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.model.program import ChainProgram, Solution, Solver, Vector, WideRows
from magnetosuture_thread.model.solvers.banded import BandedSolver
from magnetosuture_thread.model.solvers.general import OsqpSolver, QpsolversSolver
from magnetosuture_thread.model.solvers.low_rank import LowRankSolver

__all__ = ["SOLVERS", "BandedSolver", "FallbackSolver", "LowRankSolver", "OsqpSolver", "QpsolversSolver", "make_solver"]

SOLVERS = (BandedSolver.name, OsqpSolver.name)
"""Those that need no other package; besides, any that qpsolvers knows."""


class FallbackSolver:
    """Solves by the first solver; where its residual check fails, again from a cold start, then by the others.

    The solution's status says what was tried before: "solved, after banded: iteration limit".

    Args:
        solvers: in the order in which they are tried.
        tolerance: the largest residual with which a solution is accepted.

    Attributes:
        first: of the solvers.
        tolerance: as given.
    """

    def __init__(self, solvers: Sequence[Solver], tolerance: float) -> None:
        self._solvers, self.tolerance = tuple(solvers), tolerance
        self.first = self._solvers[0]
        self.name = self.first.name

    def solve(
        self, program: ChainProgram, velocities: Points, multipliers: Vector, wide: WideRows | None = None
    ) -> Solution:
        """Return the first solution that passes, else the best; see `Solver`.

        Wide rows are nothing for the banded solver, and without them there is nothing of low rank.
        """
        apart = LowRankSolver if wide is None else BandedSolver
        solvers = [solver for solver in self._solvers if not isinstance(solver, apart)]
        solution = solvers[0].solve(program, velocities, multipliers, wide)
        if solution.residuals.largest <= self.tolerance:
            return solution
        tried, best = [f"{solution.solver}: {solution.status}"], solution
        still, free = np.zeros_like(program.linear), np.zeros_like(multipliers)
        for solver in solvers:
            solution = solver.solve(program, still, free, wide)
            if solution.residuals.largest < best.residuals.largest:
                best = solution
            if solution.residuals.largest <= self.tolerance:
                break
            tried.append(f"{solution.solver} from a cold start: {solution.status}")
        return best._replace(status=f"{best.status}, after {', '.join(tried)}")


def make_solver(name: str, tolerance: float) -> Solver:
    """Return a solver by name; `banded` falls back on a cold start and on OSQP, OSQP on a cold start alone.

    Any other name is that of a solver of the package qpsolvers, where that is installed.

    Raises:
        ConfigurationError: there is no solver of this name.
    """
    if name == BandedSolver.name:
        return FallbackSolver((BandedSolver(), LowRankSolver(), OsqpSolver()), tolerance)
    return FallbackSolver((OsqpSolver() if name == OsqpSolver.name else QpsolversSolver(name),), tolerance)
