"""The quadratic program of a step, and residuals of a solution, computed independently of the solver.

    minimise over u, s   1/2 u' P u + q' u + 1/2 sum_r s_r^2 / c_r
    subject to           lower_r <= a_r' u + s_r <= upper_r,    u_i = 0 for the known nodes

A row of friction has a limit F_r on its multiplier, |lambda_r| <= F_r: its bounds may be missed by e_r at a price of
F_r |e_r|, the dissipation of Coulomb's friction.

The unknowns are the velocities u_i of a chain's nodes. A slack s_r with weight W_r is what its
multiplier makes of it, s_r = lambda_r / W_r: so it is no variable but the row's compliance c_r = 1 / W_r,
and 0 makes the row hard. Every row touches at most three nodes in a row, and P couples nodes at most
three apart: with d coordinates a node, all is one band of half-width 3 d.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.compiled import compiled, compiled_uncounted
from magnetosuture_thread.geometry.polyline import Points

if TYPE_CHECKING:
    import scipy.sparse as sp

Vector = NDArray[np.float64]

SPAN = 3  # nodes that a row may touch, and how far apart nodes may be coupled
SOLVED = "solved"  # every solver's word for a solution at the first attempt


class ChainProgram(NamedTuple):
    """One program over the velocities of a chain of m >= 3 nodes in d dimensions.

    Attributes:
        blocks: diagonal blocks of P, symmetric, shape (m, d, d).
        couplings: off-diagonal entries of P, shape (3, m): [k - 1, i] times the identity couples the
            nodes i and i + k.
        linear: q, shape (m, d).
        known: nodes whose velocity is none of the unknowns, as their motion is known, shape (m,).
        first: the first of the three nodes of each row, at most m - 3, shape (r,).
        gradient: a_r on these three nodes, shape (r, 3, d).
        lower: shape (r,), -inf where there is none.
        upper: shape (r,), inf where there is none.
        compliance: c_r >= 0, shape (r,).
        limit: F_r >= 0 of |lambda_r|, inf of all rows but those of friction, shape (r,).
    """

    blocks: NDArray[np.float64]
    couplings: NDArray[np.float64]
    linear: NDArray[np.float64]
    known: NDArray[np.bool_]
    first: NDArray[np.int64]
    gradient: NDArray[np.float64]
    lower: Vector
    upper: Vector
    compliance: Vector
    limit: Vector


class WideRows(NamedTuple):
    """Rows of a program that depend on nodes farther apart than `SPAN`, so that no band holds them.

        lower_r <= a_r' u + s_r,    s_r as of the other rows

    Attributes:
        nodes: the nodes of each row, padded with any node of gradient 0, shape (w, k).
        gradient: a_r at these nodes, shape (w, k, d).
        lower: shape (w,).
        compliance: c_r >= 0, shape (w,).
    """

    nodes: NDArray[np.int64]
    gradient: NDArray[np.float64]
    lower: Vector
    compliance: Vector

    def force(self, multipliers: Vector, shape: tuple[int, ...]) -> NDArray[np.float64]:
        """Return sum_r a_r lambda_r, shape (m, d)."""
        force = np.zeros(shape)
        np.add.at(force, self.nodes, self.gradient * multipliers[:, None, None])
        return force


class Residuals(NamedTuple):
    """The largest scaled violations of the Karush-Kuhn-Tucker conditions, inf for a NaN.

    Attributes:
        primal: of the bounds, with y = a' u + c lambda:  max(lower - y, y - upper, 0).
        dual: of the balance of forces:  |P u + q - sum a lambda|; and of friction's cone:  max(|lambda| - F, 0).
        complementarity: |lambda| times the distance of y from the bound that its sign names; where a row with a limit
            misses that bound, which is no violation, F - |lambda| times the distance.
    """

    primal: float
    dual: float
    complementarity: float

    @property
    def largest(self) -> float:
        """The largest of the three."""
        return max(self)

    def or_worse(self, other: Residuals) -> Residuals:
        """Return the larger of each."""
        return Residuals(max(self[0], other[0]), max(self[1], other[1]), max(self[2], other[2]))


class Solution(NamedTuple):
    """What a solver found.

    Attributes:
        velocities: u, shape (m, d), 0 at the known nodes.
        multipliers: lambda of the rows, shape (r,); positive at a lower bound, negative at an upper one.
        solver: the solver's name.
        status: its own word.
        iterations: how many it took.
        residuals: computed apart from the solver, by `residuals_of`.
    """

    velocities: NDArray[np.float64]
    multipliers: Vector
    solver: str
    status: str
    iterations: int
    residuals: Residuals


class Solver(Protocol):
    """Solves programs, one after the other."""

    name: str

    def solve(
        self, program: ChainProgram, velocities: Points, multipliers: Vector, wide: WideRows | None = None
    ) -> Solution:
        """Return the solution with its residuals; the caller decides whether to accept it.

        Args:
            program: the program.
            velocities: a guess, shape (m, d).
            multipliers: a guess, shape (r,), or (r + w,) with the wide rows last.
            wide: further rows, which only a general solver takes.
        """
        ...


def residuals_of(
    program: ChainProgram, velocities: NDArray[np.float64], multipliers: Vector, wide: WideRows | None = None
) -> Residuals:
    """Return how far a solution is from optimal.

    A row is divided by max(1, its own largest term), so that a far obstacle does not make light of the
    others; the balance of forces by max(1, its largest force); the complementarity by
    max(1, the largest multiplier).
    """
    if wide is None:
        return Residuals(*compiled_residuals(program, velocities, multipliers))
    chain = len(program.first)
    pushes = multipliers[chain:]
    force = wide.force(pushes, program.linear.shape)
    found = Residuals(
        *compiled_residuals(program._replace(linear=program.linear - force), velocities, multipliers[:chain])
    )
    image = np.einsum("rkd,rkd->r", wide.gradient, velocities[wide.nodes]) + wide.compliance * pushes
    scale = np.maximum(1.0, np.maximum(np.abs(image), np.abs(wide.lower)))
    short = (wide.lower - image) / scale
    gap = np.minimum(np.where(pushes > 0.0, np.abs(short), 1.0), 1.0)  # a pull has no bound to pull at
    largest = max(1.0, float(np.abs(multipliers).max(initial=0.0)))
    further = (float(short.max(initial=0.0)), 0.0, float((np.abs(pushes) * gap).max(initial=0.0)) / largest)
    return found.or_worse(Residuals(*(value if math.isfinite(value) else math.inf for value in further)))


@compiled
def compiled_residuals(
    program: ChainProgram, velocities: NDArray[np.float64], multipliers: Vector
) -> tuple[float, float, float]:
    """Return the same, for compiled code: primal, dual, complementarity.

    Shares nothing with a solver, so P u is written out here once more.
    """
    return _residuals(program, velocities, multipliers, np.empty(velocities.shape), np.zeros(velocities.shape))


@compiled_uncounted
def _residuals(
    program: ChainProgram, velocities: NDArray[np.float64], multipliers: Vector, force: Points, pulled: Points
) -> tuple[float, float, float]:
    """Return them, with memory for P u + q and for the sum of what rows pull with, 0; each of shape (m, d)."""
    nodes, dimension = velocities.shape
    largest = 1.0
    for i in range(nodes):
        for k in range(dimension):
            value = 0.0
            for j in range(dimension):
                value += program.blocks[i, k, j] * velocities[i, j]
            for apart in range(1, SPAN + 1):
                if i >= apart:
                    value += program.couplings[apart - 1, i - apart] * velocities[i - apart, k]
                if i + apart < nodes:
                    value += program.couplings[apart - 1, i] * velocities[i + apart, k]
            largest = max(largest, abs(value), abs(program.linear[i, k]))
            force[i, k] = value + program.linear[i, k]
    primal, complementarity, pushed, outside = 0.0, 0.0, 1.0, 0.0
    finite = True
    for r in range(len(program.lower)):
        first, multiplier = program.first[r], multipliers[r]
        image, scale = 0.0, 1.0
        for node in range(SPAN):
            for k in range(dimension):
                gradient = program.gradient[r, node, k]
                image += gradient * velocities[first + node, k]
                pulled[first + node, k] += gradient * multiplier
        image += program.compliance[r] * multiplier
        scale = max(scale, abs(image))
        lower, upper = program.lower[r], program.upper[r]
        if np.isfinite(lower):
            scale = max(scale, abs(lower))
        if np.isfinite(upper):
            scale = max(scale, abs(upper))
        gap = abs(image - lower) if multiplier > 0.0 else abs(image - upper)
        if program.limit[r] < np.inf:
            outside = max(outside, abs(multiplier) - program.limit[r])
            for miss, push in ((lower - image, multiplier), (image - upper, -multiplier)):
                weight = program.limit[r] - push if miss > 0.0 else max(push, 0.0)
                complementarity = max(complementarity, weight * min(abs(miss) / scale, 1.0))
            gap = 0.0
        else:
            primal = max(primal, (lower - image) / scale, (image - upper) / scale)
        # A push on a bound that does not exist counts as one from a whole scale away.
        complementarity = max(complementarity, abs(multiplier) * (min(gap / scale, 1.0)))
        pushed = max(pushed, abs(multiplier))
        finite = finite and np.isfinite(image) and np.isfinite(multiplier)
        finite = finite and not (np.isnan(lower) or np.isnan(upper) or np.isnan(program.limit[r]))
    dual = 0.0
    for i in range(nodes):
        for k in range(dimension):
            finite = finite and np.isfinite(force[i, k])
            if not program.known[i]:
                largest = max(largest, abs(pulled[i, k]))
                dual = max(dual, abs(force[i, k] - pulled[i, k]))
    if not finite:
        return np.inf, np.inf, np.inf
    return primal, max(dual / largest, outside / pushed), complementarity / pushed


@dataclass(frozen=True)
class QuadraticProgram:
    """The same program for a general solver: minimise 1/2 x' P x + q' x subject to lower <= A x <= upper.

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


def as_quadratic_program(program: ChainProgram, wide: WideRows | None = None) -> QuadraticProgram:
    """Write a chain's program with sparse matrices, its known nodes taken out and its slacks as variables.

    Wide rows follow those of the chain.

    A slack is scaled by the root of its weight, s = sqrt(c) s', so that its own entry in P is 1: with the
    weights themselves, 1 beside 1e5, a first-order method does not converge.
    """
    import scipy.sparse as sp  # late, as most who import this module solve nothing

    nodes, dimension = program.linear.shape
    coordinates = np.arange(nodes * dimension).reshape(nodes, dimension)
    triangle = np.triu_indices(dimension)
    rows, columns = [coordinates[:, triangle[0]].ravel()], [coordinates[:, triangle[1]].ravel()]
    entries = [program.blocks[:, triangle[0], triangle[1]].ravel()]
    for apart in range(1, SPAN + 1):
        rows.append(coordinates[:-apart].ravel())
        columns.append(coordinates[apart:].ravel())
        entries.append(np.repeat(program.couplings[apart - 1, :-apart], dimension))
    hessian = _matrix(entries, rows, columns, (nodes * dimension, nodes * dimension))
    touched = coordinates[program.first[:, None] + np.arange(SPAN)].reshape(len(program.first), SPAN * dimension)
    row = np.repeat(np.arange(len(program.first)), SPAN * dimension)
    entries, rows, columns, count = [program.gradient.ravel()], [row], [touched.ravel()], len(program.first)
    lower, upper, compliance = program.lower, program.upper, program.compliance
    if wide is not None:
        entries.append(wide.gradient.ravel())
        rows.append(np.repeat(np.arange(count, count + len(wide.lower)), wide.nodes.shape[1] * dimension))
        columns.append(coordinates[wide.nodes].ravel())
        count += len(wide.lower)
        lower = np.concatenate([lower, wide.lower])
        upper = np.concatenate([upper, np.full(len(wide.lower), np.inf)])
        compliance = np.concatenate([compliance, wide.compliance])
    image = _matrix(entries, rows, columns, (count, nodes * dimension))
    unknown = np.flatnonzero(np.repeat(~program.known, dimension))
    soft = np.flatnonzero(compliance > 0.0)
    slack = sp.csc_matrix((np.sqrt(compliance[soft]), (soft, np.arange(len(soft)))), shape=(count, len(soft)))
    full = QuadraticProgram(
        P=sp.csc_matrix(sp.block_diag([hessian[unknown][:, unknown], sp.eye(len(soft))])),
        q=np.concatenate([program.linear.ravel()[unknown], np.zeros(len(soft))]),
        A=sp.csc_matrix(sp.hstack([image[:, unknown], slack])),
        lower=lower,
        upper=upper,
        unknown=unknown,
    )
    limited = np.flatnonzero(program.limit < np.inf)
    return _with_limits(full, limited, program.limit[limited]) if len(limited) else full


def _with_limits(full: QuadraticProgram, rows: NDArray[np.intp], limits: Vector) -> QuadraticProgram:
    """Return a program in which some rows may miss their bounds by e = e+ - e-, at a price of F (e+ + e-)."""
    import scipy.sparse as sp

    count = len(rows)
    miss = sp.csc_matrix((np.ones(count), (rows, np.arange(count))), shape=(len(full.lower), count))
    variables, bounds = full.A.shape[1], sp.eye(2 * count)
    return QuadraticProgram(
        P=sp.csc_matrix(sp.block_diag([full.P, sp.csc_matrix((2 * count, 2 * count))])),
        q=np.concatenate([full.q, limits, limits]),
        A=sp.csc_matrix(
            sp.vstack([sp.hstack([full.A, miss, -miss]), sp.hstack([sp.csc_matrix((2 * count, variables)), bounds])])
        ),
        lower=np.concatenate([full.lower, np.zeros(2 * count)]),
        upper=np.concatenate([full.upper, np.full(2 * count, np.inf)]),
        unknown=full.unknown,
    )


def _matrix(
    entries: list[Vector], rows: list[NDArray[np.intp]], columns: list[NDArray[np.intp]], shape: tuple[int, int]
) -> sp.csc_matrix:
    import scipy.sparse as sp

    return sp.csc_matrix(
        (np.concatenate(entries), (np.concatenate(rows), np.concatenate(columns))), shape=shape, dtype=np.float64
    )
