"""General solvers on the very programs of a run: Clarabel and PIQP, both sparse interior-point methods.

    minimise over x   1/2 x' P x + q' x    subject to   lower <= A x <= upper
    P x + q = A' lambda,    lambda_r > 0 at a lower bound, < 0 at an upper one

is what they have to solve. Only setting up and solving is timed: writing the program in each one's form,
and reading lambda from it, is not. Where a program's entries are at the same places as the last one's, the
solver keeps its setup and gets new numbers.
"""

from __future__ import annotations

import importlib
import importlib.metadata
from typing import Any, NamedTuple, Protocol

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from magnetosuture_thread.model.program import (
    ChainProgram,
    QuadraticProgram,
    Residuals,
    Vector,
    as_quadratic_program,
    residuals_of,
)

TOLERANCE = 1e-9  # asked of both: the residual that the banded solver leaves is between 1e-9 and 1e-8
ITERATIONS = 200


class Form(NamedTuple):
    """One program in the form that a solver takes.

    Attributes:
        general: the program.
        arguments: of the solver, its own.
        rows: indices of the rows with an equation, a lower and an upper bound only, as the solver needs them.
        pattern: two programs of the same pattern have their entries at the same places.
    """

    general: QuadraticProgram
    arguments: dict[str, Any]
    rows: tuple[NDArray[np.intp], ...]
    pattern: tuple[bytes, ...]


class GeneralSolver(Protocol):
    """A general solver of quadratic programs."""

    name: str

    def form(self, general: QuadraticProgram) -> Form:
        """Write a program in the solver's form."""
        ...

    def solve(self, form: Form) -> Any:
        """Set up and solve: what is timed."""
        ...

    def read(self, form: Form, found: Any) -> tuple[Vector, Vector]:
        """Return x and lambda."""
        ...


class ClarabelSolver:
    """Clarabel: an interior-point method for  A x + s = b,  s in a cone, one row for each bound."""

    name = "clarabel"

    def __init__(self, tolerance: float = TOLERANCE) -> None:
        self._clarabel = importlib.import_module("clarabel")
        self._settings = self._clarabel.DefaultSettings()
        self._settings.verbose = False
        self._settings.max_iter = ITERATIONS
        self._settings.presolve_enable = False  # or it could not be given new numbers
        self._settings.max_threads = 1
        for name in ("tol_feas", "tol_gap_abs", "tol_gap_rel"):
            setattr(self._settings, name, tolerance)
        self._solver: Any = None
        self._pattern: tuple[bytes, ...] = ()

    def form(self, general: QuadraticProgram) -> Form:
        """Write a program in the solver's form."""
        rows = equal, below, above = _kinds(general)
        bounds = np.concatenate([general.lower[equal], -general.lower[below], general.upper[above]])
        image = sp.csc_matrix(sp.vstack([general.A[equal], -general.A[below], general.A[above]]))
        arguments = {"P": general.P, "q": general.q, "A": image, "b": bounds}
        return Form(general, arguments, rows, _pattern(general.P, image, rows))

    def solve(self, form: Form) -> Any:
        """Set up and solve."""
        if form.pattern == self._pattern:
            self._solver.update(**form.arguments)
        else:
            zero, rest = len(form.rows[0]), len(form.rows[1]) + len(form.rows[2])
            cones = [self._clarabel.ZeroConeT(zero), self._clarabel.NonnegativeConeT(rest)]
            P, q, A, b = form.arguments.values()
            self._solver, self._pattern = self._clarabel.DefaultSolver(P, q, A, b, cones, self._settings), form.pattern
        return self._solver.solve()

    def read(self, form: Form, found: Any) -> tuple[Vector, Vector]:
        """Return x and lambda."""
        equal, below, above = form.rows
        dual = np.asarray(found.z)
        multipliers = np.zeros(len(form.general.lower))
        multipliers[equal] = -dual[: len(equal)]
        multipliers[below] += dual[len(equal) : len(equal) + len(below)]
        multipliers[above] -= dual[len(equal) + len(below) :]
        return np.asarray(found.x), multipliers


class PiqpSolver:
    """PIQP: a proximal interior-point method for  A x = b,  lower <= G x <= upper."""

    name = "piqp"

    def __init__(self, tolerance: float = TOLERANCE) -> None:
        self._piqp = importlib.import_module("piqp")
        self._tolerance = tolerance
        self._solver: Any = None
        self._pattern: tuple[bytes, ...] = ()

    def form(self, general: QuadraticProgram) -> Form:
        """Write a program in the solver's form."""
        rows = equal, below, above = _kinds(general)
        unequal = np.union1d(below, above)
        P, A, G = general.P, general.A[equal].tocsc(), general.A[unequal].tocsc()
        arguments = {"P": P, "c": general.q, "A": A, "b": general.lower[equal]}
        if len(unequal):
            arguments |= {"G": G, "h_l": general.lower[unequal], "h_u": general.upper[unequal]}
        return Form(general, arguments, (equal, unequal), _pattern(P, general.A, rows))

    def solve(self, form: Form) -> Any:
        """Set up and solve."""
        if form.pattern == self._pattern:
            self._solver.update(**form.arguments)
        else:
            self._solver = self._piqp.SparseSolver()
            settings = self._solver.settings
            settings.eps_abs = settings.eps_duality_gap_abs = self._tolerance
            settings.eps_rel = settings.eps_duality_gap_rel = self._tolerance
            settings.max_iter, settings.verbose = ITERATIONS, False
            self._solver.setup(**form.arguments)
            self._pattern = form.pattern
        self._solver.solve()
        found = self._solver.result
        # The result is overwritten by the next solve.
        return np.array(found.x), np.array(found.y), np.array(found.z_l) - np.array(found.z_u)

    def read(self, form: Form, found: Any) -> tuple[Vector, Vector]:
        """Return x and lambda."""
        x, equal, unequal = found
        multipliers = np.zeros(len(form.general.lower))
        multipliers[form.rows[0]] = -equal
        if len(form.rows[1]):
            multipliers[form.rows[1]] = unequal
        return x, multipliers


SOLVERS: dict[str, type[ClarabelSolver] | type[PiqpSolver]] = {"clarabel": ClarabelSolver, "piqp": PiqpSolver}


def residuals_of_general(program: ChainProgram, form: Form, x: Vector, multipliers: Vector) -> Residuals:
    """Return how far a general solver's x and lambda are from optimal."""
    flat = np.zeros(program.linear.size)
    flat[form.general.unknown] = x[: len(form.general.unknown)]
    return residuals_of(program, flat.reshape(program.linear.shape), multipliers)


def converted(program: ChainProgram, solver: GeneralSolver) -> Form:
    """Return a chain's program in a solver's form."""
    return solver.form(as_quadratic_program(program))


def _kinds(general: QuadraticProgram) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp]]:
    """Return the rows with an equation, and of the others those with a lower and those with an upper bound."""
    equal = general.lower == general.upper
    below, above = ~equal & np.isfinite(general.lower), ~equal & np.isfinite(general.upper)
    return np.flatnonzero(equal), np.flatnonzero(below), np.flatnonzero(above)


def _pattern(P: sp.csc_matrix, A: sp.csc_matrix, rows: tuple[NDArray[np.intp], ...]) -> tuple[bytes, ...]:
    parts = [P.indptr, P.indices, A.indptr, A.indices, *rows]
    return tuple(np.asarray(part).tobytes() for part in parts)
