"""The quadratic program of a step, and residuals of a solution, computed independently of the solver.

    minimise over u, s   1/2 u' P u + q' u + 1/2 sum_r s_r^2 / c_r
    subject to           lower_r <= a_r' u + s_r <= upper_r,    u_i = 0 for the known nodes

A row of friction has a limit F_r on its multiplier, |lambda_r| <= F_r: its bounds may be missed by e_r at a price of
F_r |e_r|, the dissipation of Coulomb's friction.

The unknowns are the velocities u_i of a chain's nodes. A slack s_r with weight W_r is what its multiplier makes of it,
s_r = lambda_r / W_r: so it is no variable but the row's compliance c_r = 1 / W_r, and 0 makes the row hard. A row
touches three nodes in a row, or, as a far row, any nodes; P couples nodes at most three apart. Without far rows, and
with d coordinates a node, all is one band of half-width 3 d.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.compiled import compiled, compiled_inline, compiled_inner
from magnetosuture_thread.geometry.polyline import Points

Vector = NDArray[np.float64]
Table = NDArray[np.float64]
Indices = NDArray[np.int64]
Mask = NDArray[np.bool_]

SPAN = 3  # nodes that a row of the band touches, and how far apart nodes may be coupled
SOLVED = "solved"  # every solver's word for a solution at the first attempt


class ChainProgram(NamedTuple):
    """One program over the velocities of a chain of m >= 3 nodes in d dimensions.

    Its r rows of the band come first, then w far rows.

    Attributes:
        blocks: diagonal blocks of P, symmetric, shape (m, d, d).
        couplings: off-diagonal entries of P, shape (3, m): [k - 1, i] times the identity couples the
            nodes i and i + k.
        linear: q, shape (m, d).
        known: nodes whose velocity is none of the unknowns, as their motion is prescribed, shape (m,).
        first: the first of the three nodes of each row of the band, at most m - 3, shape (r,).
        gradient: a_r on these three nodes, shape (r, 3, d).
        lower: shape (r + w,), -inf where there is none.
        upper: shape (r + w,), inf where there is none.
        compliance: c_r >= 0, shape (r + w,).
        limit: F_r >= 0 of |lambda_r|, inf of all rows but those of friction, shape (r + w,).
        far_nodes: the nodes of each far row, padded with any node of gradient 0, shape (w, k).
        far_gradient: a_r at these nodes, shape (w, k, d).
    """

    blocks: Table
    couplings: Table
    linear: Points
    known: Mask
    first: Indices
    gradient: Table
    lower: Vector
    upper: Vector
    compliance: Vector
    limit: Vector
    far_nodes: Indices
    far_gradient: Table


def no_far_rows(dimension: int) -> tuple[Indices, Table]:
    """Return `far_nodes` and `far_gradient` of a program that has no far rows."""
    return np.zeros((0, 1), np.int64), np.zeros((0, 1, dimension))


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
        multipliers: lambda of the rows, shape (r + w,); positive at a lower bound, negative at an upper one.
        solver: the solver's name.
        status: its own word.
        iterations: how many it took.
        residuals: computed apart from the solver, by `residuals_of`.
    """

    velocities: Points
    multipliers: Vector
    solver: str
    status: str
    iterations: int
    residuals: Residuals


class Solver(Protocol):
    """Solves programs, one after the other."""

    name: str

    def solve(self, program: ChainProgram, velocities: Points, multipliers: Vector) -> Solution:
        """Return the solution with its residuals; the caller decides whether to accept it.

        Args:
            program: the program.
            velocities: a guess, shape (m, d).
            multipliers: a guess, shape (r + w,).
        """
        ...


def residuals_of(program: ChainProgram, velocities: Points, multipliers: Vector) -> Residuals:
    """Return how far a solution is from optimal.

    A row is divided by max(1, its own largest term), so that a far obstacle does not make light of the
    others; the balance of forces by max(1, its largest force); the complementarity by
    max(1, the largest multiplier).
    """
    return Residuals(*compiled_residuals(program, velocities, multipliers))


@compiled
def compiled_residuals(program: ChainProgram, velocities: Points, multipliers: Vector) -> tuple[float, float, float]:
    """Return the same, for compiled code: primal, dual, complementarity.

    Shares nothing with a solver, so P u is written out here once more.
    """
    return _residuals(program, velocities, multipliers, np.empty(velocities.shape), np.zeros(velocities.shape))


@compiled_inline
def _pull(program: ChainProgram, r: int, velocities: Points, multiplier: float, pulled: Points) -> float:
    """Add a_r lambda_r to what rows pull with; return a_r' u."""
    image, far = 0.0, r - len(program.first)
    for k in range(SPAN if far < 0 else program.far_nodes.shape[1]):
        node = program.first[r] + k if far < 0 else program.far_nodes[far, k]
        for a in range(velocities.shape[1]):
            gradient = program.gradient[r, k, a] if far < 0 else program.far_gradient[far, k, a]
            image += gradient * velocities[node, a]
            pulled[node, a] += gradient * multiplier
    return image


@compiled_inner
def _residuals(
    program: ChainProgram, velocities: Points, multipliers: Vector, force: Points, pulled: Points
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
        multiplier, scale = multipliers[r], 1.0
        image = _pull(program, r, velocities, multiplier, pulled)
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
