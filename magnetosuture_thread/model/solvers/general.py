"""General solvers of the step's program: OSQP, the paper's, and those of the package qpsolvers.

qpsolvers is optional, as it is under the LGPL.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import numpy as np
import osqp
from numpy.typing import NDArray
from scipy.sparse import csc_matrix, vstack

from magnetosuture_thread.errors import ConfigurationError
from magnetosuture_thread.geometry.polyline import Points
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

INSTALL = "pip install qpsolvers and the solver itself"


class _GeneralSolver(ABC):
    """Solves a chain's program with sparse matrices and without a guess."""

    name: str

    def solve(
        self, program: ChainProgram, velocities: Points, multipliers: Vector, wide: WideRows | None = None
    ) -> Solution:
        """Solve one program; see `Solver`. The guess is not used."""
        general = as_quadratic_program(program, wide)
        return self.read(program, general, self.run(general), wide)

    @abstractmethod
    def run(self, general: QuadraticProgram) -> Any:
        """Return what the library finds for a program, or the error by which it is refused."""

    @abstractmethod
    def unpack(self, general: QuadraticProgram, found: Any) -> tuple[Vector | None, Vector, str, int]:
        """Return the variables, None without any, the multipliers, the solver's status and its iterations."""

    def read(
        self, program: ChainProgram, general: QuadraticProgram, found: Any, wide: WideRows | None = None
    ) -> Solution:
        """Return what was found as a solution of the chain's program."""
        x, multipliers, status, iterations = self.unpack(general, found)
        flat = np.full(program.linear.size, np.nan if x is None else 0.0)
        if x is not None:
            flat[general.unknown] = x[: len(general.unknown)]
        u = flat.reshape(program.linear.shape)
        # Rows with a limit have brought further rows of their own.
        multipliers = multipliers[: len(program.first) + (len(wide.lower) if wide is not None else 0)]
        return Solution(u, multipliers, self.name, status, iterations, residuals_of(program, u, multipliers, wide))


class OsqpSolver(_GeneralSolver):
    """Solves programs with OSQP, each of the last one's pattern started from its solution, slacks included.

    The first of a pattern pays for the setup.

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

    def unpack(self, general: QuadraticProgram, found: Any) -> tuple[Vector | None, Vector, str, int]:
        """Return what was found; see `_GeneralSolver`."""
        if isinstance(found, osqp.OSQPException):
            return None, np.full(len(general.lower), np.nan), f"refused: {found}", 0
        # OSQP's sign of multipliers is the other one.
        return found.x, -np.asarray(found.y, dtype=np.float64), str(found.info.status), int(found.info.iter)

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


class QpsolversSolver(_GeneralSolver):
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

    def run(self, general: QuadraticProgram) -> Any:
        """Return what the solver finds for a program in general form, or the error by which it is refused."""
        equal, below, above = _row_kinds(general)
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
        try:
            return self._qpsolvers.solve_problem(problem, self.name)
        except (self._qpsolvers.exceptions.QPError, ValueError) as error:
            return error

    def unpack(self, general: QuadraticProgram, found: Any) -> tuple[Vector | None, Vector, str, int]:
        """Return what was found; see `_GeneralSolver`."""
        multipliers = np.full(len(general.lower), np.nan)
        if isinstance(found, Exception):
            return None, multipliers, f"refused: {found}", 0
        status = SOLVED if found.found else "not solved"
        if found.x is None or found.z is None:
            return None, multipliers, status, 0
        (equal, below, above), multipliers[:] = _row_kinds(general), 0.0
        count = int(below.sum())
        multipliers[below] += np.asarray(found.z[:count])
        multipliers[above] -= np.asarray(found.z[count:])
        if equal.any():
            multipliers[equal] = -np.asarray(found.y)
        return found.x, multipliers, status, 0


def _row_kinds(general: QuadraticProgram) -> tuple[NDArray[np.bool_], NDArray[np.bool_], NDArray[np.bool_]]:
    """Return which rows are equations, and which of the others have a lower and an upper bound."""
    lower, upper = np.isfinite(general.lower), np.isfinite(general.upper)
    equal = lower & upper & (general.lower == general.upper)
    return equal, lower & ~equal, upper & ~equal
