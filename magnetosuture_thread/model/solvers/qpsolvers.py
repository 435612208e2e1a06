"""Solvers of the package qpsolvers, by their names there; it is optional, as it is under the LGPL."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_matrix, vstack

from magnetosuture_thread.errors import ConfigurationError
from magnetosuture_thread.model.program import (
    SOLVED,
    ChainProgram,
    Solution,
    Vector,
    WideRows,
    as_quadratic_program,
    residuals_of,
)

INSTALL = "pip install qpsolvers and the solver itself"


class QpsolversSolver:
    """Solves programs by a solver that qpsolvers knows, each from a cold start.

    Args:
        name: of the solver, as in `qpsolvers.available_solvers`.

    Raises:
        ConfigurationError: qpsolvers is not installed, or finds no solver of this name.
    """

    def __init__(self, name: str) -> None:
        try:
            import qpsolvers
        except ImportError:
            raise ConfigurationError("solver", name, f"one of banded, osqp; for others: {INSTALL}") from None
        if name not in qpsolvers.available_solvers:
            known = ", ".join(["banded", "osqp", *sorted(set(qpsolvers.available_solvers) - {"osqp"})])
            raise ConfigurationError("solver", name, f"one of {known}; for others: {INSTALL}")
        self.name = name
        self._qpsolvers = qpsolvers

    def solve(
        self,
        program: ChainProgram,
        velocities: NDArray[np.float64],
        multipliers: Vector,
        wide: WideRows | None = None,
    ) -> Solution:
        """Solve one program; see `Solver`. The guess is not used."""
        general = as_quadratic_program(program, wide)
        lower, upper = np.isfinite(general.lower), np.isfinite(general.upper)
        equal = lower & upper & (general.lower == general.upper)
        below, above = lower & ~equal, upper & ~equal
        hessian = general.P + general.P.T
        hessian.setdiag(general.P.diagonal())
        problem = self._qpsolvers.Problem(
            csc_matrix(hessian),
            general.q,
            csc_matrix(vstack([-general.A[below], general.A[above]])),
            np.concatenate([-general.lower[below], general.upper[above]]),
            csc_matrix(general.A[equal]) if equal.any() else None,
            general.lower[equal] if equal.any() else None,
        )
        u, pushes = np.full(program.linear.shape, np.nan), np.full(len(general.lower), np.nan)
        found: Any = None
        try:
            found = self._qpsolvers.solve_problem(problem, self.name)
            status = SOLVED if found.found else "not solved"
        except (self._qpsolvers.exceptions.QPError, ValueError) as error:
            status = f"refused: {error}"
        if found is not None and found.x is not None and found.z is not None:
            flat = np.zeros(program.linear.size)
            flat[general.unknown] = found.x[: len(general.unknown)]
            u, pushes[:] = flat.reshape(program.linear.shape), 0.0
            count = int(below.sum())
            pushes[below] += np.asarray(found.z[:count])
            pushes[above] -= np.asarray(found.z[count:])
            if equal.any():
                pushes[equal] = -np.asarray(found.y)
        return Solution(u, pushes, self.name, status, 0, residuals_of(program, u, pushes, wide))
