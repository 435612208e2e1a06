"""Solvers of the step's program: the structured one, OSQP, and how one falls back on the other.

OSQP, the solver of the paper, gets the program with sparse matrices.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from magnetosuture_thread.geometry.polyline import Points, Table, Vector
from magnetosuture_thread.settings.configuration import Quantity
from magnetosuture_thread.thread.banded import BandedSolver
from magnetosuture_thread.thread.program import SOLVED, SPAN, ChainProgram, Solution, Solver, residuals_of

__all__ = ["SOLVERS", "BandedSolver", "FallbackSolver", "OsqpSolver", "make_solver"]


@dataclass(frozen=True)
class QuadraticProgram:
    """A chain's program for a general solver: minimise 1/2 x' P x + q' x subject to lower <= A x <= upper.

    Attributes:
        P: upper triangle of the symmetric positive definite Hessian, shape (v, v).
        q: shape (v,).
        A: shape (r, v).
        lower: shape (r,), -inf where there is none.
        upper: shape (r,), inf where there is none.
        unknown: which of the chain's m d coordinates the first variables are; slacks follow them, then for each row
            with a limit the parts e+ and e- of e; their bounds e+, e- >= 0 are the last rows.
    """

    P: sp.csc_matrix
    q: Vector
    A: sp.csc_matrix
    lower: Vector
    upper: Vector
    unknown: NDArray[np.intp]

    def check(self) -> None:
        """Raise `ValueError` where a number is not finite or bounds cross."""
        if not all(np.isfinite(values).all() for values in (self.P.data, self.q, self.A.data)):
            raise ValueError("a number that is not finite")
        if not (self.lower <= self.upper).all():
            raise ValueError("a lower bound above the upper one")


def as_quadratic_program(program: ChainProgram) -> QuadraticProgram:
    """Write a chain's program with sparse matrices, its known nodes taken out and its slacks as variables.

    A slack is scaled by the root of its weight, s = sqrt(c) s', so that its own entry in P is 1: with the
    weights themselves, 1 beside 1e5, a first-order method does not converge. A row with a limit F may miss its bounds
    by e = e+ - e-, at a price of F (e+ + e-).
    """
    nodes, dimension = program.linear.shape
    coordinates = np.arange(nodes * dimension).reshape(nodes, dimension)
    unknown = np.flatnonzero(np.repeat(~program.known, dimension))
    near = program.first[:, None] + np.arange(SPAN)
    band = _rows(coordinates[near], program.gradient, nodes * dimension)
    far = _rows(coordinates[program.far_nodes], program.far_gradient, nodes * dimension)
    image = sp.vstack([band, far], format="csc")[:, unknown]
    count = len(program.lower)
    soft, limited = np.flatnonzero(program.compliance > 0.0), np.flatnonzero(program.limit < np.inf)
    slack = sp.csc_matrix((np.sqrt(program.compliance[soft]), (soft, np.arange(len(soft)))), (count, len(soft)))
    miss = sp.csc_matrix((np.ones(len(limited)), (limited, np.arange(len(limited)))), (count, len(limited)))
    variables, misses, prices = len(unknown) + len(soft), 2 * len(limited), program.limit[limited]
    bounds = sp.hstack([sp.csc_matrix((misses, variables)), sp.eye(misses)])
    hessian = _hessian(program, coordinates)[unknown][:, unknown]
    return QuadraticProgram(
        P=sp.csc_matrix(sp.block_diag([hessian, sp.eye(len(soft)), sp.csc_matrix((misses, misses))])),
        q=np.concatenate([program.linear.ravel()[unknown], np.zeros(len(soft)), prices, prices]),
        A=sp.csc_matrix(sp.vstack([sp.hstack([image, slack, miss, -miss]), bounds])),
        lower=np.concatenate([program.lower, np.zeros(misses)]),
        upper=np.concatenate([program.upper, np.full(misses, np.inf)]),
        unknown=unknown,
    )


def _rows(columns: NDArray[np.intp], gradient: Table, width: int) -> sp.csc_matrix:
    """Return rows with a gradient at some coordinates, both of shape (r, k, d)."""
    row = np.repeat(np.arange(len(columns)), columns[:1].size)
    return sp.csc_matrix((gradient.ravel(), (row, columns.ravel())), (len(columns), width))


def _hessian(program: ChainProgram, coordinates: NDArray[np.intp]) -> sp.csc_matrix:
    """Return the upper triangle of P, with the known nodes."""
    size, dimension = program.linear.size, program.linear.shape[1]
    above = np.triu_indices(dimension)
    parts = [(program.blocks[:, above[0], above[1]], coordinates[:, above[0]], coordinates[:, above[1]])]
    for apart in range(1, SPAN + 1):
        entries = np.repeat(program.couplings[apart - 1, :-apart], dimension)
        parts.append((entries, coordinates[:-apart], coordinates[apart:]))
    entries, rows, columns = (np.concatenate([part[k].ravel() for part in parts]) for k in range(3))
    return sp.csc_matrix((entries, (rows, columns)), (size, size))


class OsqpSolver:
    """Solves programs with OSQP, each of the last one's pattern started from its solution, slacks included.

    The first of a pattern pays for the setup. The guess is not used.

    Args:
        tolerance: absolute and relative tolerance asked of OSQP before its solution is polished.
        iterations: the most iterations it may take.
    """

    name = "osqp"

    def __init__(self, tolerance: float = 1e-7, iterations: int = 20_000) -> None:
        tolerances = {"eps_abs": tolerance, "eps_rel": tolerance}
        self._settings: dict[str, Any] = {**tolerances, "max_iter": iterations, "polishing": True, "verbose": False}
        self._solver: Any = None
        self._loaded: QuadraticProgram | None = None

    def solve(self, program: ChainProgram, velocities: Points, multipliers: Vector) -> Solution:
        """Solve one program; see `Solver`."""
        import osqp  # here, as it brings a library for pages that most processes do not need

        general = as_quadratic_program(program)
        flat, found_multipliers = np.full(program.linear.size, np.nan), np.full(len(program.lower), np.nan)
        try:
            general.check()  # OSQP prints what is wrong, and cannot be kept from it
            self._load(general)
            found = self._solver.solve(raise_error=False)
        except (ValueError, osqp.OSQPException) as error:
            self._loaded, status, iterations = None, f"refused: {error}", 0
        else:
            status, iterations = str(found.info.status), int(found.info.iter)
            if status != SOLVED:
                self._loaded = None  # or the next program would start from what is no solution, even from NaN
            flat[:] = 0.0
            flat[general.unknown] = found.x[: len(general.unknown)]
            # OSQP's sign of multipliers is the other one; rows with a limit have brought further rows of their own.
            found_multipliers = -np.asarray(found.y[: len(program.lower)], dtype=np.float64)
        u = flat.reshape(program.linear.shape)
        residuals = residuals_of(program, u, found_multipliers)
        return Solution(u, found_multipliers, self.name, status, iterations, residuals)

    def __getstate__(self) -> dict[str, Any]:
        """Return everything but what OSQP keeps of the last program, which is set up again."""
        return {**self.__dict__, "_solver": None, "_loaded": None}

    def _load(self, program: QuadraticProgram) -> None:
        import osqp

        last = self._loaded
        if last is not None and _same_pattern(last.P, program.P) and _same_pattern(last.A, program.A):
            self._solver.update(Px=program.P.data, Ax=program.A.data, q=program.q, l=program.lower, u=program.upper)
        else:
            self._solver = osqp.OSQP()
            self._solver.setup(program.P, program.q, program.A, program.lower, program.upper, **self._settings)
        self._loaded = program


def _same_pattern(one: sp.csc_matrix, other: sp.csc_matrix) -> bool:
    """Return whether the entries of two matrices are at the same places."""
    return all(np.array_equal(getattr(one, name), getattr(other, name)) for name in ("shape", "indptr", "indices"))


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


SOLVERS = (BandedSolver.name, OsqpSolver.name)


def make_solver(name: str, tolerance: float) -> Solver:
    """Return a solver by name; `banded` falls back on a cold start and on OSQP, OSQP on a cold start alone.

    Raises:
        ConfigurationError: there is no solver of this name.
    """
    Quantity("", choices=SOLVERS).checked("solver", name, str)
    return FallbackSolver((BandedSolver(), OsqpSolver()) if name == BandedSolver.name else (OsqpSolver(),), tolerance)
