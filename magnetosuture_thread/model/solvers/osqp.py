"""OSQP as solver of the step's program: the paper's way, a general first-order method."""

from __future__ import annotations

from typing import Any

import numpy as np
import osqp
from numpy.typing import NDArray

from magnetosuture_thread.model.program import (
    SOLVED,
    ChainProgram,
    QuadraticProgram,
    Solution,
    Vector,
    WideRows,
    as_quadratic_program,
    residuals_of,
)


class OsqpSolver:
    """Solves programs with OSQP, each of the last one's pattern started from its solution.

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
        self._loaded: QuadraticProgram | None = None

    def solve(
        self,
        program: ChainProgram,
        velocities: NDArray[np.float64],
        multipliers: Vector,
        wide: WideRows | None = None,
    ) -> Solution:
        """Solve one program; the first of a pattern pays for the set-up.

        The guess is not used: OSQP starts from its own last solution, slacks included.
        """
        general = as_quadratic_program(program, wide)
        return self.read(program, general, self.run(general), wide)

    def run(self, general: QuadraticProgram) -> Any:
        """Return what OSQP finds for a program in general form, or the error by which it refuses it."""
        try:
            self._load(general)
            found = self._solver.solve(raise_error=False)
        except osqp.OSQPException as error:
            self._loaded = None
            return error
        if found.info.status != SOLVED:
            self._loaded = None  # or the next program would start from what is no solution, even from NaN
        return found

    def read(
        self, program: ChainProgram, general: QuadraticProgram, found: Any, wide: WideRows | None = None
    ) -> Solution:
        """Return what was found as a solution of the chain's program."""
        u, multipliers = np.full(program.linear.shape, np.nan), np.full(len(general.lower), np.nan)
        status, iterations = f"refused: {found}", 0
        if not isinstance(found, osqp.OSQPException):
            status, iterations = str(found.info.status), int(found.info.iter)
            flat = np.zeros(program.linear.size)
            flat[general.unknown] = found.x[: len(general.unknown)]
            u = flat.reshape(program.linear.shape)
            multipliers = -np.asarray(found.y, dtype=np.float64)  # OSQP's sign is the other one
        return Solution(u, multipliers, self.name, status, iterations, residuals_of(program, u, multipliers, wide))

    def _load(self, program: QuadraticProgram) -> None:
        if self._loaded is not None and _alike(self._loaded, program):
            self._solver.update(Px=program.P.data, Ax=program.A.data, q=program.q, l=program.lower, u=program.upper)
        else:
            self._solver = osqp.OSQP()
            self._solver.setup(program.P, program.q, program.A, program.lower, program.upper, **self._settings)
        self._loaded = program


def _alike(one: QuadraticProgram, other: QuadraticProgram) -> bool:
    """Whether the entries of two programs are at the same places."""
    return all(
        first.shape == second.shape
        and np.array_equal(first.indptr, second.indptr)
        and np.array_equal(first.indices, second.indices)
        for first, second in ((one.P, other.P), (one.A, other.A))
    )
