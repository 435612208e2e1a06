"""The quadratic program of a step, and a solution that judges itself.

minimise over u   1/2 u' P u + q' u
subject to        lower <= A u <= upper
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

Vector = NDArray[np.float64]


class SparsePattern:
    """Builds sparse matrices of one pattern fast: entries in, compressed columns out.

    Args:
        rows: row of each entry.
        columns: column of each entry; entries at one place add up.
        shape: the matrix's shape.
    """

    def __init__(self, rows: NDArray[np.intp], columns: NDArray[np.intp], shape: tuple[int, int]) -> None:
        self.shape = shape
        places, self._slot = np.unique(columns * np.int64(shape[0]) + rows, return_inverse=True)
        self._indices = (places % shape[0]).astype(np.int32)
        counts = np.bincount(places // shape[0], minlength=shape[1])
        self._indptr = np.concatenate([[0], np.cumsum(counts)]).astype(np.int32)

    def matrix(self, entries: Vector) -> sp.csc_matrix:
        """Return the matrix with these entries, in the order in which the pattern was given."""
        data = np.bincount(self._slot, weights=entries, minlength=len(self._indices))
        return sp.csc_matrix((data, self._indices, self._indptr), shape=self.shape)


@dataclass(frozen=True)
class QuadraticProgram:
    """One program.

    Attributes:
        P: upper triangle of the symmetric positive definite Hessian, shape (m, m).
        q: shape (m,).
        A: shape (r, m).
        lower: shape (r,), -inf where there is none.
        upper: shape (r,), inf where there is none.
    """

    P: sp.csc_matrix
    q: Vector
    A: sp.csc_matrix
    lower: Vector
    upper: Vector


@dataclass(frozen=True)
class Solution:
    """What a solver found; `residual` is computed here, never taken from the solver.

    Attributes:
        u: the minimiser, shape (m,).
        multipliers: of the rows, shape (r,); negative at a lower bound, positive at an upper one.
        solver: its name.
        status: its own word.
        residual: the largest violation of the optimality conditions, relative to the largest term of
            each (at least 1).
    """

    u: Vector
    multipliers: Vector
    solver: str
    status: str
    residual: float


class Solver(Protocol):
    """Solves programs of one pattern, one after the other."""

    name: str

    def solve(self, program: QuadraticProgram) -> Solution:
        """Return the solution with its residual, whatever it is: the caller judges it."""
        ...


def optimality_residual(program: QuadraticProgram, u: Vector, multipliers: Vector) -> float:
    """Return the largest scaled violation of the Karush-Kuhn-Tucker conditions, inf for a NaN.

    Primal: max(lower - A u, A u - upper, 0). Dual: |P u + q + A' y|. Complementarity: |y| times the
    distance from the bound that its sign names. A row is divided by max(1, its own largest term), so that
    a far obstacle does not make light of the others; the balance of forces by max(1, its largest force).
    """
    if not (np.all(np.isfinite(u)) and np.all(np.isfinite(multipliers))):
        return float("inf")
    image = program.A @ u
    below, above = program.lower - image, image - program.upper
    lower, upper = (np.where(np.isfinite(bound), np.abs(bound), 0.0) for bound in (program.lower, program.upper))
    scale = np.maximum.reduce([np.ones_like(image), np.abs(image), lower, upper])
    primal = float((np.maximum(below, above) / scale).max(initial=0.0))
    curved = program.P @ u + program.P.T @ u - program.P.diagonal() * u
    pulled = program.A.T @ multipliers
    largest = max(float(np.abs(part).max(initial=0.0)) for part in (curved, program.q, pulled))
    dual = float(np.abs(curved + program.q + pulled).max(initial=0.0)) / max(1.0, largest)
    # A push on a bound that does not exist counts as one from a whole scale away.
    gap = np.where(multipliers < 0.0, np.abs(below), np.abs(above)) / scale
    pushed = np.abs(multipliers) * np.where(np.isfinite(gap), gap, 1.0)
    complementarity = float(pushed.max(initial=0.0)) / max(1.0, float(np.abs(multipliers).max(initial=0.0)))
    return max(primal, dual, complementarity)
