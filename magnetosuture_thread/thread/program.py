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

import math
from typing import NamedTuple, Protocol

import numpy as np

from magnetosuture_thread.geometry.compiled import compiled_inline, compiled_uncounted
from magnetosuture_thread.geometry.obstacles import Contacts
from magnetosuture_thread.geometry.polyline import Indices, Mask, Points, Table, Vector

SPAN = 3  # nodes that a row of the band touches, and how far apart nodes may be coupled
CONTACTS_PER_NODE = 64  # for which there is room; a smooth outline has dozens of corners beside one segment
GRIPS = 3  # shapes at most that a node or a chord has friction with at once
NO_SHAPE = -2  # in place of a shape
END, END_VELOCITIES, INTERNAL, CONTACT = range(4)
"""Of a step's end: where the nodes are [m] and their velocities over the step [m/s]; what the segments push each node
with; and what contacts do, with friction."""
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


class StepBuffers(NamedTuple):
    """Memory for the programs of a thread with n + 1 nodes, kept from step to step so that no step pays for it.

    Lengths are in units of the segment length.

    Attributes:
        blocks: see `ChainProgram`, as are those to `far_gradient`; rows of the formulation come first, then those of
            contacts and friction.
        multipliers: of the last solve: a guess for the next one, and the segments' tension, shape (r,).
        chords: length of each segment, shape (n,).
        work: shape (2, n + 1, d).
        contacts: those with rows, then those of friction.
        clearance: distance of each node from the nearest of all that is solid, at most the reach, shape (n + 1,) [m].
        push: what contacts last pushed each node and each segment with, shape (2, n + 1).
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
    multipliers: Vector
    chords: Vector
    work: Table
    contacts: Contacts
    clearance: Vector
    push: Table

    @classmethod
    def of(cls, nodes: int, dimension: int, rows: int) -> StepBuffers:
        """Return buffers for a number of rows besides those of contacts and friction."""
        total = rows + CONTACTS_PER_NODE * nodes
        lower, upper, compliance, multipliers = np.zeros((4, total))
        return cls(
            np.zeros((nodes, dimension, dimension)),
            np.zeros((SPAN, nodes)),
            np.zeros((nodes, dimension)),
            np.zeros(nodes, np.bool_),
            np.zeros(total, np.int64),
            np.zeros((total, SPAN, dimension)),
            lower,
            upper,
            compliance,
            np.full(total, np.inf),
            *no_far_rows(dimension),
            multipliers,
            chords=np.zeros(nodes - 1),
            work=np.zeros((2, nodes, dimension)),
            contacts=Contacts.room(CONTACTS_PER_NODE * nodes, dimension),
            clearance=np.zeros(nodes),
            push=np.zeros((2, nodes)),
        )


class GripBuffers(NamedTuple):
    """Memory of friction: the shapes with friction that last pushed each node, and each chord between its nodes.

    Attributes:
        shape: of each, `NO_SHAPE` for none, shape (2, n + 1, GRIPS).
        force: the force (2), the multiplier of friction, its limit, and the place on the chord, shape
            (2, n + 1, GRIPS, 5).
        contact: the contact that is now in its place, -1 for none, shape (2, n + 1, GRIPS).
    """

    shape: Indices
    force: Table
    contact: Indices


class StepMotion(NamedTuple):
    """Positions and velocities of a step, each of shape (n + 1, d).

    Attributes:
        before: where the nodes are.
        start: the same with the prescribed nodes moved.
        last: velocities over the last step.
        velocities: over this step, better with each solve.
        about: where these lead.
        last_about: where the program was written about.
    """

    before: Points
    start: Points
    last: Points
    velocities: Points
    about: Points
    last_about: Points


class RodBuffers(NamedTuple):
    """Memory for the steps of a rod; lengths are in units of the segment length, and forces in those of the program.

    Attributes:
        program: its programs.
        grips: its friction.
        motion: positions and velocities of the step.
        drag: the medium's part of `blocks`, shape (n + 1, d, d).
        drag_linear: the medium's part of `linear`, shape (n + 1, d).
        end: positions [m] and velocities [m/s] at the end of the step, and forces, see `END` and what follows it, shape
            (4, n + 1, d).
        tail_load: what medium and contacts do at the needle's tail, shape (d,).
        links: connectivity, compression and strain at the end of the step, see `link_margins`, shape (6, n).
        residuals: the largest of each kind over the step's solves, see `Residuals`, shape (3,).
    """

    program: StepBuffers
    grips: GripBuffers
    motion: StepMotion
    drag: Table
    drag_linear: Points
    end: Table
    tail_load: Vector
    links: Table
    residuals: Vector

    @classmethod
    def of(cls, program: StepBuffers) -> RodBuffers:
        """Return buffers for a rod with these programs."""
        nodes, dimension = program.linear.shape
        places = (2, nodes, GRIPS)
        grips = GripBuffers(np.full(places, NO_SHAPE), np.zeros((*places, 5)), np.full(places, -1))
        motion = StepMotion(*np.zeros((6, nodes, dimension)))
        of_drag = (nodes, dimension, dimension), (nodes, dimension)
        of_end = (4, nodes, dimension), (dimension,), (6, nodes - 1), (3,)
        return cls(program, grips, motion, *map(np.zeros, (*of_drag, *of_end)))


def first_rows(buffers: StepBuffers, rows: int) -> ChainProgram:
    """Return the program of the first rows."""
    return ChainProgram(
        buffers.blocks,
        buffers.couplings,
        buffers.linear,
        buffers.known,
        buffers.first[:rows],
        buffers.gradient[:rows],
        buffers.lower[:rows],
        buffers.upper[:rows],
        buffers.compliance[:rows],
        buffers.limit[:rows],
        buffers.far_nodes,
        buffers.far_gradient,
    )


program_view = compiled_inline(first_rows)
"""The same for kernels."""


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
    return Residuals(*residuals_with(program, velocities, multipliers, np.empty((2, *velocities.shape))))


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


@compiled_inline
def _missed(miss: float, push: float, limit: float, scale: float) -> float:
    """Return what a row with a limit that misses a bound, or does not, adds to the complementarity."""
    return (limit - push if miss > 0.0 else max(push, 0.0)) * min(abs(miss) / scale, 1.0)


@compiled_uncounted
def residuals_with(
    program: ChainProgram, velocities: Points, multipliers: Vector, work: Table
) -> tuple[float, float, float]:
    """Return the same, for compiled code: primal, dual, complementarity, with memory of shape (2, m, d).

    Shares nothing with a solver, so P u is written out here once more.
    """
    nodes, dimension = velocities.shape
    blocks, couplings, linear, known = program.blocks, program.couplings, program.linear, program.known
    compliance, limits, force, pulled = program.compliance, program.limit, work[0], work[1]
    largest = 1.0
    for i in range(nodes):
        for k in range(dimension):
            value = pulled[i, k] = 0.0
            for j in range(dimension):
                value += blocks[i, k, j] * velocities[i, j]
            for apart in range(1, SPAN + 1):
                if i >= apart:
                    value += couplings[apart - 1, i - apart] * velocities[i - apart, k]
                if i + apart < nodes:
                    value += couplings[apart - 1, i] * velocities[i + apart, k]
            largest = max(largest, abs(value), abs(linear[i, k]))
            force[i, k] = value + linear[i, k]
    primal, complementarity, pushed, outside, finite = 0.0, 0.0, 1.0, 0.0, True
    for r in range(len(program.lower)):
        multiplier, lower, upper, limit = multipliers[r], program.lower[r], program.upper[r], limits[r]
        image = _pull(program, r, velocities, multiplier, pulled) + compliance[r] * multiplier
        scale = max(1.0, abs(image))
        scale = max(scale, abs(lower)) if abs(lower) < np.inf else scale
        scale = max(scale, abs(upper)) if abs(upper) < np.inf else scale
        if limit < np.inf:
            outside = max(outside, abs(multiplier) - limit)
            missed = max(
                _missed(lower - image, multiplier, limit, scale), _missed(image - upper, -multiplier, limit, scale)
            )
            complementarity = max(complementarity, missed)
        else:
            primal = max(primal, (lower - image) / scale, (image - upper) / scale)
            # A push on a bound that does not exist counts as one from a whole scale away.
            gap = abs(image - lower) if multiplier > 0.0 else abs(image - upper)
            complementarity = max(complementarity, abs(multiplier) * min(gap / scale, 1.0))
        pushed = max(pushed, abs(multiplier))
        finite = finite and abs(image) < np.inf and abs(multiplier) < np.inf
        finite = finite and not (math.isnan(lower) or math.isnan(upper) or math.isnan(limit))
    dual = 0.0
    for i in range(nodes):
        for k in range(dimension):
            finite = finite and abs(force[i, k]) < np.inf
            if not known[i]:
                largest = max(largest, abs(pulled[i, k]))
                dual = max(dual, abs(force[i, k] - pulled[i, k]))
    if not finite:
        return np.inf, np.inf, np.inf
    return primal, max(dual / largest, outside / pushed), complementarity / pushed
