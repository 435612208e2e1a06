"""OSQP as solver of the step's program."""

from __future__ import annotations

from typing import Any

import numpy as np
import osqp

from magnetosuture_thread.model.program import QuadraticProgram, Solution, optimality_residual


class OsqpSolver:
    """Solves programs of one pattern with OSQP, each started from the last one's solution.

    Args:
        tolerance: absolute and relative tolerance asked of OSQP before its solution is polished.
        iterations: the most iterations it may take.
    """

    name = "osqp"

    def __init__(self, tolerance: float = 1e-7, iterations: int = 20_000) -> None:
        self._settings: dict[str, Any] = {
            "eps_abs": tolerance,
            "eps_rel": tolerance,
            "max_iter": iterations,
            "polishing": True,
            "verbose": False,
        }
        self._solver: Any = None
        self._pattern: tuple[tuple[int, int], int, int] | None = None

    def solve(self, program: QuadraticProgram) -> Solution:
        """Solve one program; the first of a pattern pays for the set-up."""
        try:
            self._load(program)
        except osqp.OSQPException as error:
            self._pattern = None
            nothing = np.full(len(program.q), np.nan)
            return Solution(nothing, np.full(len(program.lower), np.nan), self.name, f"refused: {error}", np.inf)
        found = self._solver.solve(raise_error=False)
        if found.info.status != "solved":
            self._pattern = None  # or the next program would start from what is no solution, even from NaN
        u = np.asarray(found.x, dtype=np.float64)
        multipliers = np.asarray(found.y, dtype=np.float64)
        residual = optimality_residual(program, u, multipliers)
        return Solution(u, multipliers, self.name, str(found.info.status), residual)

    def _load(self, program: QuadraticProgram) -> None:
        pattern = (program.A.shape, program.A.nnz, program.P.nnz)
        if pattern == self._pattern:
            self._solver.update(Px=program.P.data, Ax=program.A.data, q=program.q, l=program.lower, u=program.upper)
        else:
            self._solver = osqp.OSQP()
            self._solver.setup(program.P, program.q, program.A, program.lower, program.upper, **self._settings)
            self._pattern = pattern
