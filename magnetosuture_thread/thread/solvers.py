"""Solvers of the step's program: the structured one, OSQP, and how one falls back on the other."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from magnetosuture_thread.configuration import Quantity
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.thread.banded import BandedSolver
from magnetosuture_thread.thread.osqp_solver import OsqpSolver
from magnetosuture_thread.thread.program import ChainProgram, Solution, Solver, Vector

__all__ = ["SOLVERS", "BandedSolver", "FallbackSolver", "OsqpSolver", "make_solver"]

SOLVERS = (BandedSolver.name, OsqpSolver.name)


class FallbackSolver:
    """Solves by the first solver; where its residual check fails, again from a cold start, then by the others.

    The solution's status says what was tried before: "solved, after banded: iteration limit".

    Args:
        solvers: in the order in which they are tried.
        tolerance: the largest residual with which a solution is accepted.

    Attributes:
        first: of the solvers.
    """

    def __init__(self, solvers: Sequence[Solver], tolerance: float) -> None:
        self._solvers, self._tolerance = tuple(solvers), tolerance
        self.first = self._solvers[0]
        self.name = self.first.name

    def solve(self, program: ChainProgram, velocities: Points, multipliers: Vector) -> Solution:
        """Return the first solution that passes, else the best; see `Solver`."""
        solution = self.first.solve(program, velocities, multipliers)
        if solution.residuals.largest <= self._tolerance:
            return solution
        tried, best = [f"{solution.solver}: {solution.status}"], solution
        for solver in self._solvers:
            solution = solver.solve(program, np.zeros_like(program.linear), np.zeros_like(multipliers))
            if solution.residuals.largest < best.residuals.largest:
                best = solution
            if solution.residuals.largest <= self._tolerance:
                break
            tried.append(f"{solution.solver} from a cold start: {solution.status}")
        return best._replace(status=f"{best.status}, after {', '.join(tried)}")


def make_solver(name: str, tolerance: float) -> Solver:
    """Return a solver by name; `banded` falls back on a cold start and on OSQP, OSQP on a cold start alone.

    Raises:
        ConfigurationError: there is no solver of this name.
    """
    Quantity("", choices=SOLVERS).checked("solver", name, str)
    return FallbackSolver((BandedSolver(), OsqpSolver()) if name == BandedSolver.name else (OsqpSolver(),), tolerance)
