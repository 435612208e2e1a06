"""Solvers tried one after the other, until a solution passes its residual check."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.model.program import ChainProgram, Solution, Solver, Vector, WideRows
from magnetosuture_thread.model.solvers.banded import BandedSolver


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
        self,
        program: ChainProgram,
        velocities: NDArray[np.float64],
        multipliers: Vector,
        wide: WideRows | None = None,
    ) -> Solution:
        """Return the first solution that passes, else the best; see `Solver`. Wide rows are left to the others."""
        solvers = [s for s in self._solvers if wide is None or not isinstance(s, BandedSolver)]
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
