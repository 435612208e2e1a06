"""Other general solvers of a step's program, Clarabel and PIQP: both sparse interior-point methods.

    minimise over x   1/2 x' P x + q' x    subject to   lower <= A x <= upper
    P x + q = A' lambda,    lambda_r > 0 at a lower bound, < 0 at an upper one

Writing a program in each one's form is a part of the solve.
"""

from __future__ import annotations

import importlib
from typing import Any

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.thread.program import ChainProgram, Solution, Vector, residuals_of
from magnetosuture_thread.thread.solvers import QuadraticProgram, as_quadratic_program

PEERS = ("clarabel", "piqp")
TOLERANCE = 1e-9  # the residual that the banded solver leaves is between 1e-9 and 1e-8
ITERATIONS = 200

Rows = NDArray[np.intp]


class PeerSolver:
    """Solves a program from a cold start.

    Args:
        name: of `PEERS`.
    """

    def __init__(self, name: str) -> None:
        self.name, self._library = name, importlib.import_module(name)
        self._find = {"clarabel": _clarabel, "piqp": _piqp}[name]

    def solve(self, program: ChainProgram, velocities: Points, multipliers: Vector) -> Solution:
        """Solve one program; see `Solver`."""
        general = as_quadratic_program(program)
        equal = general.lower == general.upper
        below, above = ~equal & np.isfinite(general.lower), ~equal & np.isfinite(general.upper)
        x, found, status = self._find(self._library, general, *map(np.flatnonzero, (equal, below, above)))
        flat = np.zeros(program.linear.size)
        flat[general.unknown] = x[: len(general.unknown)]
        u, found = flat.reshape(program.linear.shape), found[: len(program.lower)]
        return Solution(u, found, self.name, status, 0, residuals_of(program, u, found))


def _clarabel(
    library: Any, general: QuadraticProgram, equal: Rows, below: Rows, above: Rows
) -> tuple[Vector, Vector, str]:
    """Return x, lambda and the status:  A x + s = b,  s in a cone, one row for each bound."""
    settings = library.DefaultSettings()
    settings.verbose, settings.max_iter, settings.max_threads = False, ITERATIONS, 1
    settings.tol_feas = settings.tol_gap_abs = settings.tol_gap_rel = TOLERANCE
    image = sp.csc_matrix(sp.vstack([general.A[equal], -general.A[below], general.A[above]]))
    bounds = np.concatenate([general.lower[equal], -general.lower[below], general.upper[above]])
    cones = [library.ZeroConeT(len(equal)), library.NonnegativeConeT(len(below) + len(above))]
    found = library.DefaultSolver(general.P, general.q, image, bounds, cones, settings).solve()
    multipliers = np.zeros(len(general.lower))
    of_equal, of_below, of_above = np.split(np.asarray(found.z), np.cumsum([len(equal), len(below)]))
    multipliers[equal] = -of_equal
    multipliers[below] += of_below
    multipliers[above] -= of_above
    return np.asarray(found.x), multipliers, str(found.status)


def _piqp(library: Any, general: QuadraticProgram, equal: Rows, below: Rows, above: Rows) -> tuple[Vector, Vector, str]:
    """Return x, lambda and the status:  A x = b,  lower <= G x <= upper."""
    unequal, solver = np.union1d(below, above), library.SparseSolver()
    settings = solver.settings
    settings.eps_abs = settings.eps_duality_gap_abs = TOLERANCE
    settings.eps_rel = settings.eps_duality_gap_rel = TOLERANCE
    settings.max_iter, settings.verbose = ITERATIONS, False
    arguments = {"P": general.P, "c": general.q, "A": general.A[equal].tocsc(), "b": general.lower[equal]}
    if len(unequal):
        arguments |= {"G": general.A[unequal].tocsc(), "h_l": general.lower[unequal], "h_u": general.upper[unequal]}
    solver.setup(**arguments)
    status, found, multipliers = solver.solve(), solver.result, np.zeros(len(general.lower))
    multipliers[equal] = -np.asarray(found.y)
    if len(unequal):
        multipliers[unequal] = np.asarray(found.z_l) - np.asarray(found.z_u)
    return np.array(found.x), multipliers, str(status)
